"""A node whose clock is set in mid-dive: SIGUSR1 sets it JUMP_S ahead, SIGUSR2 back by as much."""

import signal
import sys
import time

from buddyline.node import service
from buddyline.node.__main__ import main
from buddyline.node.time_base import NodeClock
from buddyline.protocol.clock import S_NS

JUMP_S = 30


class SetWall:
    """The machine's clock, which is set."""

    def __init__(self) -> None:
        self._ahead_ns = 0

    def now_ns(self) -> int:
        """Return the time."""
        return time.time_ns() + self._ahead_ns

    def jump(self, by_ns: int) -> None:
        """Set it."""
        self._ahead_ns += by_ns


if __name__ == "__main__":
    wall = SetWall()
    signal.signal(signal.SIGUSR1, lambda *_: wall.jump(JUMP_S * S_NS))
    signal.signal(signal.SIGUSR2, lambda *_: wall.jump(-JUMP_S * S_NS))
    service.NodeClock = lambda: NodeClock(wall.now_ns)
    sys.exit(main())
