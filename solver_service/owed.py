"""Triggers that an earlier solver owes: it had a frame of them, and was killed before it gave an outcome."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Final

from buddyline.protocol.messages import Rejected
from buddyline.solver_service.answered import Answered, Outcome, by_pair
from buddyline.solver_service.journal import Noted
from buddyline.solver_service.pair_core import PairId

# Within this time the nodes have connected again, sent what was missed, and the solver has waited for all.
OWED_S: Final = 10.0
LOST: Final = "its frames were lost with the solver and node that had them"


class Owed:
    """Remembers them until each has an outcome. Their nodes still hold the frames, unless they have ended too."""

    def __init__(self, answered: Answered) -> None:
        self._answered = answered
        # With the frame's stamp.
        self._owed: dict[tuple[PairId, int], int] = {}
        self._triggers: set[int] = set()
        self._until_s = 0.0
        # Node and trigger of frames of such triggers that have come, and wait for their turn or have had it.
        self._come_again: set[tuple[str, int]] = set()

    def expect(self, past: Noted) -> None:
        """Note the triggers of which there is a frame and no outcome in what earlier solvers have noted."""
        for pair, noted in by_pair(past.said).items():
            stamps_ns = {trigger: stamp_ns for node, trigger, stamp_ns in past.frames if node in pair}
            for trigger in self._answered.pair(pair).expect(stamps_ns, noted):
                self._owed[pair, trigger] = stamps_ns[trigger]
        self._triggers = {trigger for _, trigger in self._owed}
        self._until_s = time.monotonic() + OWED_S

    def saw_frame(self, node: str, trigger: int) -> None:
        """Note a frame that has come; it may wait for its turn for long."""
        if trigger in self._triggers:
            self._come_again.add((node, trigger))

    def saw_unused(self, node: str, trigger: int) -> None:
        """Note a frame that has come and is not solved again."""
        self._come_again.discard((node, trigger))

    def saw_outcome(self, outcome: Outcome) -> None:
        """Note that a trigger has its outcome."""
        self._owed.pop(((outcome.node_a, outcome.node_b), outcome.trigger), None)

    def lost(self, is_single: Callable[[str], bool]) -> list[Rejected]:
        """Return outcomes for the triggers whose frames have not come again in time.

        is_single: whether a node is in no pair; of its triggers none is owed.
        """
        if time.monotonic() <= self._until_s:
            return []
        return [
            Rejected(node_a=pair[0], node_b=pair[1], stamp_ns=stamp_ns, trigger=trigger, reason="late", detail=LOST)
            for (pair, trigger), stamp_ns in sorted(self._owed.items())
            if not any((node, trigger) in self._come_again or is_single(node) for node in pair)
        ]

    def give_up(self, outcomes: Sequence[Rejected]) -> None:
        """Note that these were published; their frames may still come."""
        for one in outcomes:
            self.saw_outcome(one)
            self._answered.pair((one.node_a, one.node_b)).give_up(one.trigger)
