"""A stored dive as a picture of the pair at any instant, read as it is played and never held as a whole."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, Self

from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Rejected
from buddyline.tools.dives import Dive
from buddyline.tools.monitor.coverage import Coverage
from buddyline.tools.monitor.picture import PairPicture

SHOWN: Final = (
    *("info", "candidates", "attitude", "depth", "image", "node_status"),
    *("pose", "rejected", "solver_status"),
)
# Before an instant that was jumped to, this much of the dive is read for trail and plots.
LEAD_NS: Final = 30 * S_NS


class Playback:
    """The logs of one dive, at one instant."""

    def __init__(self, paths: list[str]) -> None:
        self._dive = Dive(paths, one_rig=False)
        try:
            self.start_ns, self.end_ns = self._dive.start_ns, self._dive.end_ns
        except BaseException:
            self._dive.close()
            raise
        self.seek(self.start_ns)

    def seek(self, to_ns: int) -> None:
        """Go to an instant of log time, forward or back."""
        to_ns = min(max(to_ns, self.start_ns), self.end_ns)
        self.picture = PairPicture()
        # The first calibrations, which a jump may pass over.
        for info in self._dive.infos().values():
            self.picture.take(info, None, self.start_ns)
        self._messages = self._dive.messages(*SHOWN, since_ns=to_ns - LEAD_NS)
        self._next = next(self._messages, None)
        self.position_ns = to_ns
        self._feed()

    def advance(self, to_ns: int) -> None:
        """Go on to a later instant."""
        self.position_ns = min(max(to_ns, self.position_ns), self.end_ns)
        self._feed()

    def _feed(self) -> None:
        while self._next is not None and self._next.time_ns <= self.position_ns:
            self.picture.take(self._next.message, self._next.node, self._next.time_ns)
            self._next = next(self._messages, None)

    def close(self) -> None:
        """Close the logs."""
        self._dive.close()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the logs."""
        self.close()


def survey(paths: list[str], coverage: Coverage) -> Iterator[None]:
    """Fill coverage from the logs, a record at a time; yields so that the reader sets the pace.

    Opens the logs anew: it runs beside the playback, which reads elsewhere in the files.
    """
    with Dive(paths, one_rig=False) as dive:
        for envelope in dive.messages("pose", "rejected"):
            outcome = envelope.message
            coverage.add(envelope.time_ns, outcome.reason if isinstance(outcome, Rejected) else None)
            yield
    coverage.complete = True
