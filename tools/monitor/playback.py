"""A stored dive as the pair's state at any instant; it is read as it is played, and never held as a whole."""

from __future__ import annotations

import threading
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.messages import Rejected, RelativePose
from buddyline.protocol.topics import INFO
from buddyline.tools.dives import Dive
from buddyline.tools.monitor.coverage import Coverage
from buddyline.tools.monitor.overview import Overview
from buddyline.tools.monitor.picture import PairPicture
from buddyline.tools.pairs import Pair

SHOWN: Final = (
    *("info", "candidates", "attitude", "depth", "image", "node_status"),
    *("pose", "track", "rejected", "net_pose", "solver_status"),
)
# After a jump, this much of the dive before the new instant is read for trail and plots.
LEAD_NS: Final = 30 * S_NS
# While the whole dive is read, other threads get a turn after this many outcomes.
PACE: Final = 256


class Playback:
    """A dive at one instant; pair: the one that is shown."""

    def __init__(self, dive: Dive, pair: Pair | None = None) -> None:
        self._dive = dive
        self._pair = pair
        self.start_ns, self.end_ns = dive.start_ns, dive.end_ns
        self.seek(self.start_ns)

    @property
    def picture(self) -> PairPicture:
        """The pair that is shown first."""
        return self.overview.picture()

    def seek(self, to_ns: int) -> None:
        """Go to an instant of log time, forward or back."""
        to_ns = min(max(to_ns, self.start_ns), self.end_ns)
        self.overview = Overview(self._pair)
        # The first calibrations, which a jump may pass over.
        for node, info in self._dive.infos().items():
            self.overview.take(Envelope(INFO.key(node), INFO, (node,), info, b"", self.start_ns))
        self._messages = self._dive.messages(*SHOWN, since_ns=to_ns - LEAD_NS)
        self._next = next(self._messages, None)
        self.position_ns = to_ns
        self._feed()

    def advance(self, to_ns: int) -> None:
        """Go on to a later instant."""
        self.position_ns = min(max(to_ns, self.position_ns), self.end_ns)
        self._feed()

    def close(self) -> None:
        """Close the logs."""
        self._dive.close()

    def _feed(self) -> None:
        while self._next is not None and self._next.time_ns <= self.position_ns:
            self.overview.take(self._next)
            self._next = next(self._messages, None)


def cover(coverage: Coverage, paths: list[str], pair: Pair | None, stop: threading.Event) -> None:
    """Count a whole dive's outcomes of one pair (None: of all) into coverage, until stop is set.

    Opens the logs itself, because the playback reads other parts of the same files meanwhile.
    """
    with Dive(paths, one_rig=False) as dive:
        for count, envelope in enumerate(dive.messages("pose", "rejected")):
            outcome = envelope.message
            if isinstance(outcome, RelativePose | Rejected) and (pair is None or envelope.ids == pair):
                reason = outcome.reason if isinstance(outcome, Rejected) else None
                coverage.add(envelope.time_ns, reason, outcome.stamp_ns)
            if count % PACE == PACE - 1 and stop.wait(0.001):
                return
    coverage.complete = True
