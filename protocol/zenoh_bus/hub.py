"""The hub's session."""

from __future__ import annotations

from types import TracebackType
from typing import Self

import zenoh

from protocol.endpoint import DEFAULT_ENDPOINT, hub_settings
from protocol.errors import BuddylineError
from protocol.security import Tls
from protocol.zenoh_bus.session import config_of


class Hub:
    """The one process that listens; closing it sends everyone else waiting for it."""

    def __init__(self, session: zenoh.Session, endpoint: str) -> None:
        self.endpoint = endpoint
        self._session = session

    def close(self) -> None:
        """Stop listening."""
        self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        """Return the hub."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()


def open_hub(
    endpoint: str = DEFAULT_ENDPOINT, *, tls: Tls | None = None, access: dict[str, object] | None = None
) -> Hub:
    """Listen on endpoint; raise BuddylineError where the port is taken or the address is not this machine's."""
    config = config_of(hub_settings(endpoint, tls, access))
    try:
        return Hub(zenoh.open(config), endpoint)
    except zenoh.ZError as error:
        if "Address already in use" in str(error):
            raise BuddylineError(
                f"{endpoint} is in use: a hub runs there already (use that one), or give this one another port"
            ) from error
        raise BuddylineError(f"hub at {endpoint}: cannot listen: {str(error).split(' at /')[0]}") from error
