"""The bus over Zenoh: one hub listens, all others are its clients. Nothing outside this package imports zenoh.

There is no multicast: a client connects to the endpoint it was given. Missed samples are fetched from their
publishers' caches; publishers never block, so that one frozen viewer does not stall the rest.
"""

from buddyline.protocol.zenoh_bus.bus import ZenohBus, connect
from buddyline.protocol.zenoh_bus.hub import Hub, open_hub
from buddyline.protocol.zenoh_bus.session import open_session

__all__ = ["Hub", "ZenohBus", "connect", "open_hub", "open_session"]
