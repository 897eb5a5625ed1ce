"""The bus over Zenoh: one hub listens, all other processes are its clients. Only this package imports zenoh.

There is no multicast: a client connects to its configured endpoint. Missed samples are fetched from the publishers'
caches. Publishers never block, so a frozen viewer does not stall the others.
"""

from buddyline.protocol.zenoh_bus.bus import ZenohBus, connect
from buddyline.protocol.zenoh_bus.hub import Hub, open_hub
from buddyline.protocol.zenoh_bus.session import open_session

__all__ = ["Hub", "ZenohBus", "connect", "open_hub", "open_session"]
