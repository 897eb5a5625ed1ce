"""What a solver before this one has answered, so that one that is started again says nothing twice."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Final

from protocol.messages import Rejected, RelativePose

Outcome = RelativePose | Rejected

MAX_WITHHELD: Final = 8192


class Answered:
    """Triggers up to one were answered; what the nodes' caches hold of them is solved again and not said again.

    Solved again it is, because later poses are judged by earlier ones. Nothing of a node was new when it was
    answered: where a new frame has a trigger that was, it is another dive, or a clock was set back, and what was
    withheld so far is due after all.
    """

    def __init__(self, said: Iterable[Outcome] = ()) -> None:
        # Late ones are out of order: they tell nothing about the triggers before.
        in_order = [one.trigger for one in said if not (isinstance(one, Rejected) and one.reason == "late")]
        self._up_to: int | None = max(in_order, default=None)
        self._withheld: deque[Outcome] = deque(maxlen=MAX_WITHHELD)

    def unsaid(self, outcomes: Iterable[Outcome]) -> list[Outcome]:
        """Return those outcomes that have not been said before."""
        due = []
        for outcome in outcomes:
            if self._up_to is not None and outcome.trigger <= self._up_to:
                self._withheld.append(outcome)
            else:
                self._withheld.clear()
                due.append(outcome)
        return due

    def saw_new_frame(self, trigger: int) -> list[Outcome]:
        """Take note of a frame that was not there when this solver joined; return what is due after all."""
        if self._up_to is None or trigger > self._up_to:
            return []
        due = list(self._withheld)
        self._withheld.clear()
        self._up_to = None
        return due
