"""The bus over Zenoh: one hub that listens, everyone else its client. Nothing outside this package imports zenoh.

Nothing but the hub listens, and nothing is found by multicast: a client speaks to the endpoint it was given.
Streams are recovered by their publishers' caches, never blocked for: one frozen viewer must not stall the rest.
"""

from buddyline.protocol.zenoh_bus.bus import ZenohBus, connect
from buddyline.protocol.zenoh_bus.hub import Hub, open_hub
from buddyline.protocol.zenoh_bus.session import open_session

__all__ = ["Hub", "ZenohBus", "connect", "open_hub", "open_session"]
