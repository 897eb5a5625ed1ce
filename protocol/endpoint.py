"""The hub's address: `tcp/<host>:<port>`, or `tls/<host>:<port>`."""

from __future__ import annotations

import ipaddress
import re
from typing import Final

from buddyline.protocol.errors import BuddylineError

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"

_LABEL = "[A-Za-z0-9_-]{1,63}"
_ENDPOINT = re.compile(rf"(?:tcp|tls)/(\[[0-9a-fA-F:.]+\]|{_LABEL}(?:\.{_LABEL})*\.?):([0-9]{{1,5}})\Z")


def host_and_port(endpoint: str) -> tuple[str, int]:
    """Return host and port of an endpoint; raise BuddylineError unless it is `tcp/<host>:<port>` or `tls/...`."""
    match = _ENDPOINT.match(endpoint)
    if match is None or not 0 < int(match.group(2)) < 65536:
        raise BuddylineError(
            f"endpoint {endpoint!r}: write it as tcp/<host>:<port> (or tls/...), like {DEFAULT_ENDPOINT}"
        )
    return match.group(1).strip("[]"), int(match.group(2))


def is_loopback(endpoint: str) -> bool:
    """Return whether only this machine can reach endpoint, judged by its host: a loopback address or localhost."""
    host, _ = host_and_port(endpoint)
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
