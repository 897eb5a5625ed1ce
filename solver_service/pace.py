"""What a live solver of many nodes leaves out while it cannot keep up, by how long frames of now have waited in it.

From BEHIND_NS on it takes one in LOOKS triggers, from FAR_NS on one in LOOKS^2: to solve (resting.py), and their
pictures into tracks and network, which have as few rows. It makes no later track and no expectations, which would come
too late. Where it is further behind than FAR_NS, every other track ends; while that does not help, each second every
other one of those left, and last the network. They begin anew after STOPPED_NS, once it has caught up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

from buddyline.protocol.clock import S_NS
from buddyline.solver_service.resting import LOOKS

BEHIND_NS: Final = 1 * S_NS
FAR_NS: Final = 2 * S_NS
STOPPED_NS: Final = 30 * S_NS
# So often it is looked whether what was ended was enough.
JUDGED_NS: Final = 1 * S_NS
# What a status says meanwhile.
ONE_IN_FIVE: Final = (
    "meanwhile it takes one in five pictures, or one in 25, makes no track of a second later, "
    "and tells no node where to look"
)
NO_TRACK: Final = "this pair has no track for half a minute: the solver could not keep up"
NO_NETWORK: Final = "the network has no poses for half a minute: the solver could not keep up"


class Follower(Protocol):
    """A track, or the network."""

    def stop(self) -> None:
        """End, and take nothing up to `go_on`."""

    def go_on(self) -> None:
        """Begin anew with what comes."""


class Pace:
    """one_in: of so many triggers one is taken."""

    def __init__(self) -> None:
        self.one_in = 1
        self._stopped: list[tuple[int, Follower]] = []
        # When it was judged last, and how far behind it was then.
        self._judged: tuple[int, int] | None = None

    def take(self, behind_ns: int, now_ns: int, following: Sequence[Follower]) -> None:
        """Take how long frames have waited, and end what there is no time for.

        following: what is followed, in an order that lasts.
        """
        self.one_in = LOOKS ** min(behind_ns // BEHIND_NS, 2)
        if self.one_in == 1 and self._stopped and now_ns > self._stopped[0][0] + STOPPED_NS:
            for _, one in self._stopped:
                one.go_on()
            self._stopped = []
        if behind_ns <= FAR_NS:
            self._judged = None
            return
        if self._judged is not None and now_ns - self._judged[0] < JUDGED_NS:
            return
        if self._judged is None or behind_ns >= self._judged[1]:
            for one in following[::2]:
                one.stop()
                self._stopped.append((now_ns, one))
        self._judged = now_ns, behind_ns
