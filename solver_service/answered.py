"""What a solver before this one has answered, so that one that is started again says nothing twice."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Rejected, RelativePose

Outcome = RelativePose | Rejected

MAX_WITHHELD: Final = 8192
# More than a prediction lives and a sensor is waited for.
WARM_UP_NS: Final = 10 * S_NS
# Two dives can have the same triggers where one is stored: of now, there is one.
LIVE_WITHIN_NS: Final = 600 * S_NS


class Answered:
    """Triggers up to one were answered; what the nodes' caches hold of them is solved again and not said again.

    Solved again it is, as far as later poses are judged by earlier ones. A frame that is new cannot have been
    answered: where its trigger was, it is another dive, or a clock was set back, and what was withheld so far is due
    after all.
    """

    def __init__(self, said: Iterable[Outcome] = ()) -> None:
        # Late ones are out of order: they tell nothing about the triggers before.
        in_order = [one for one in said if not (isinstance(one, Rejected) and one.reason == "late")]
        self._up_to: int | None = max((one.trigger for one in in_order), default=None)
        self._up_to_ns = max((one.stamp_ns for one in in_order), default=0)
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

    def is_over(self, stamp_ns: int, now_ns: int) -> bool:
        """Whether a frame out of a cache need not be solved: of a dive that goes on now, and answered long before."""
        live = self._up_to is not None and abs(now_ns - self._up_to_ns) < LIVE_WITHIN_NS
        return live and stamp_ns < self._up_to_ns - WARM_UP_NS

    def saw_new_frame(self, trigger: int) -> list[Outcome]:
        """Take note of a frame that was not there when this solver joined; return what is due after all."""
        if self._up_to is None or trigger > self._up_to:
            return []
        due = list(self._withheld)
        self._withheld.clear()
        self._up_to = None
        return due
