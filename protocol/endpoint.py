"""Where the hub is, and the settings that keep everyone else from opening a socket of their own."""

from __future__ import annotations

import re
from typing import Final

from protocol.errors import BuddylineError
from protocol.messages import MAX_MESSAGE_BYTES

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"

_ENDPOINT = re.compile(r"tcp/(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9_.-]+):([0-9]{1,5})\Z")

# The lease is how long a link that fell silent is held for alive. A hub that accepts and then does not answer is
# given up within open_timeout, or a client would be deaf for ten seconds after it thawed.
_COMMON: Final = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "transport/link/tx/lease": 3000,
    "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES + 65536,
    "transport/unicast/open_timeout": 2000,
    "transport/shared_memory/enabled": False,
}


def check_endpoint(endpoint: str) -> str:
    """Return endpoint; raise BuddylineError where it is not `tcp/<host>:<port>`."""
    match = _ENDPOINT.match(endpoint)
    if match is None or not 0 < int(match.group(2)) < 65536:
        raise BuddylineError(f"endpoint {endpoint!r}: write it as tcp/<host>:<port>, like {DEFAULT_ENDPOINT}")
    return endpoint


def hub_settings(endpoint: str) -> dict[str, object]:
    """Return the Zenoh settings of the one process that listens."""
    return {
        "mode": "router",
        "listen/endpoints": [check_endpoint(endpoint)],
        "connect/endpoints": [],
        **_COMMON,
    }


def client_settings(endpoint: str, namespace: str | None) -> dict[str, object]:
    """Return the Zenoh settings of a client: it connects to endpoint, again and again, and listens nowhere."""
    settings = {
        "mode": "client",
        "listen/endpoints": [],
        "connect/endpoints": [check_endpoint(endpoint)],
        "connect/timeout_ms": 0,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5},
        **_COMMON,
    }
    return settings if namespace is None else {**settings, "namespace": namespace}
