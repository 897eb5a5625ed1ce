"""Zenoh's settings for the hub and its clients; only the hub listens."""

from __future__ import annotations

from typing import Final

from buddyline.protocol.codec import MAX_MESSAGE_BYTES
from buddyline.protocol.endpoint import host_and_port
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.held import OVERHEAD_BYTES, PAGE_BYTES
from buddyline.protocol.log_pages import MOST_PAGE_BYTES
from buddyline.protocol.security import Tls
from buddyline.protocol.topics import LOG, TOPICS

# Nothing repeats a lost one of the four datagrams that open a session. The next attempt comes after two round trips of
# a long link and a second in its modem's queue.
DATAGRAM_OPEN_MS: Final = 2500
# lease, ms: a link that is silent for this time counts as dead. keep_alive: how many packets an idle link sends in this
# time. TCP finds a lost packet by the acknowledgement of the next. With four packets (Zenoh's default), two losses in
# succession make a silence that is longer than the lease. open_timeout, ms: how long a client waits for a hub that
# accepts the connection but does not answer; a slow link needs seconds for its five round trips. compression: for slow
# links; both ends must have it. queue: messages of this urgency go at once, each in a batch of its own, and Zenoh drops
# those for which no batch is free; a lost packet holds up a long link for the time of several frames.
_COMMON: Final[dict[str, object]] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "transport/link/tx/lease": 3000,
    "transport/link/tx/keep_alive": 12,
    "transport/link/tx/queue/size/interactive_high": 16,
    "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES + 65536,
    "transport/unicast/open_timeout": 6000,
    "transport/unicast/compression/enabled": True,
    "transport/shared_memory/enabled": False,
}


def hub_settings(endpoint: str, tls: Tls | None = None, access: dict[str, object] | None = None) -> dict[str, object]:
    """Return the Zenoh settings of the one process that listens; access: `protocol.access.access_rules`."""
    settings = {
        "mode": "router",
        "listen/endpoints": [check_endpoint(endpoint, tls), datagram_endpoint(endpoint)],
        "connect/endpoints": [],
        **_COMMON,
        **_tls_settings(tls, "listen"),
        "low_pass_filter": size_limits(),
        "qos/network": own_urgency(),
    }
    return settings if access is None else {**settings, "access_control": access}


def size_limits() -> list[dict[str, object]]:
    """Return Zenoh's `low_pass_filter` for a hub: payloads above their topic's limit go no further.

    Each client's heartbeats and pages of what it holds are under `@adv`, which `**` does not match.
    """
    keys: dict[int, list[str]] = {}
    for topic in TOPICS:
        # Clients may have a namespace, which comes before the key; the hub itself has none.
        key = f"**/{topic.key_any()}"
        keys.setdefault(topic.max_bytes, []).append(key)
        keys.setdefault(max(topic.max_bytes, PAGE_BYTES) + OVERHEAD_BYTES, []).append(f"{key}/@adv/**")
    keys.setdefault(MOST_PAGE_BYTES, []).append(f"**/{LOG.format(node='*')}")
    return [
        {
            "id": f"at most {max_bytes} bytes",
            "flows": ["ingress"],
            "messages": ["put", "delete", "query", "reply"],
            "key_exprs": of_size,
            "size_limit": max_bytes,
        }
        for max_bytes, of_size in keys.items()
    ]


def own_urgency() -> list[dict[str, object]]:
    """Return Zenoh's `qos/network` for a hub: each topic goes on as urgently as its table says, whoever sent it.

    A client could claim the highest priority, and that the hub waits (BLOCK) for a receiver that takes nothing.

    Zenoh's `downsampling` is no limit of rate for us: it passes one message in each interval, and lets none of a burst
    follow. Of three samples that a link delivers together two would be lost.
    """
    keys: dict[tuple[str, bool], list[str]] = {}
    for topic in TOPICS:
        keys.setdefault((topic.priority, topic.express), []).append(f"**/{topic.key_any()}")
    return [
        {
            "id": f"{priority}{' express' if express else ''}",
            "flows": ["ingress"],
            "messages": ["put", "delete"],
            "key_exprs": of_kind,
            "overwrite": {"priority": priority, "congestion_control": "drop", "express": express},
        }
        for (priority, express), of_kind in keys.items()
    ]


def client_settings(
    endpoint: str, namespace: str | None, tls: Tls | None = None, *, datagrams: bool = False
) -> dict[str, object]:
    """Return the Zenoh settings of a client: it connects to endpoint, reconnects after a failure, and never listens.

    datagrams: for a session that only sends, and whose messages may be lost.
    """
    stated = check_endpoint(endpoint, tls)
    settings = {
        "mode": "client",
        "listen/endpoints": [],
        "connect/endpoints": [datagram_endpoint(stated) if datagrams else stated],
        "connect/timeout_ms": 0,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5},
        **_COMMON,
        **_tls_settings(tls, "connect"),
    }
    if datagrams:
        settings["transport/unicast/open_timeout"] = DATAGRAM_OPEN_MS
    return settings if namespace is None else {**settings, "namespace": namespace}


def datagram_endpoint(endpoint: str) -> str:
    """Return where the hub takes datagrams: the same port of UDP, secured by the same certificates (QUIC) if TCP is."""
    scheme, _, address = endpoint.partition("/")
    return f"quic/{address}?rel=0" if scheme == "tls" else f"udp/{address}"


def _tls_settings(tls: Tls | None, side: str) -> dict[str, object]:
    if tls is None:
        return {}
    return {
        "transport/link/tls/root_ca_certificate": tls.ca,
        f"transport/link/tls/{side}_certificate": tls.certificate,
        f"transport/link/tls/{side}_private_key": tls.key,
        "transport/link/tls/enable_mtls": True,
        # The hub is identified by its authority and its certificate's purpose: addresses on a tether change.
        "transport/link/tls/verify_name_on_connect": False,
    }


def check_endpoint(endpoint: str, tls: Tls | None = None) -> str:
    """Return endpoint; raise BuddylineError if it is not valid, or contradicts the [tls] table."""
    host_and_port(endpoint)
    if endpoint.startswith("tls/") and tls is None:
        raise BuddylineError(f"{endpoint}: needs a [tls] table in the configuration (`buddyline keys` makes it)")
    if endpoint.startswith("tcp/") and tls is not None:
        raise BuddylineError(
            f"{endpoint}: is without TLS, but the configuration has a [tls] table; write tls/..., or remove the table"
        )
    return endpoint
