"""What a solver before this one answered, so that one that is started again says nothing twice."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Message, Rejected, RelativePose

Outcome = RelativePose | Rejected

MAX_WITHHELD: Final = 8192
# Longer than a prediction lives and than a sensor is waited for.
WARM_UP_NS: Final = 10 * S_NS
# Stored dives can have the same triggers; of live dives there is one at a time.
LIVE_WITHIN_NS: Final = 600 * S_NS


class Answered:
    """The outcomes of all pairs: those that were said are withheld; `said`: each pair's last ones."""

    def __init__(self, said: Iterable[Outcome] = ()) -> None:
        self._said: dict[tuple[str, str], list[Outcome]] = {}
        self._pairs: dict[tuple[str, str], AnsweredPair] = {}
        for outcome in said:
            self._said.setdefault((outcome.node_a, outcome.node_b), []).append(outcome)

    def unsaid(self, messages: Iterable[Message]) -> list[Message]:
        """Return those messages that are no outcome, or were not said before."""
        return [
            message
            for message in messages
            if not isinstance(message, Outcome) or self.pair((message.node_a, message.node_b)).is_due(message)
        ]

    def is_over(self, pairs: Iterable[tuple[str, str]], stamp_ns: int, now_ns: int) -> bool:
        """Whether a frame from a cache need not be solved: the dive is live, and was answered well beyond it.

        pairs: of the frame's node.
        """
        known = [self.pair(nodes).is_over(stamp_ns, now_ns) for nodes in pairs]
        return bool(known) and all(known)

    def saw_new_frame(self, pairs: Iterable[tuple[str, str]], trigger: int) -> list[Message]:
        """Take note of a frame that was not there when this solver joined; return what is due after all."""
        return [outcome for nodes in pairs for outcome in self.pair(nodes).saw_new_frame(trigger)]

    def pair(self, nodes: tuple[str, str]) -> AnsweredPair:
        """Return what was said of a pair."""
        if nodes not in self._pairs:
            self._pairs[nodes] = AnsweredPair(self._said.pop(nodes, ()))
        return self._pairs[nodes]


class AnsweredPair:
    """Triggers up to one were answered; what the nodes' caches hold of them is solved again and not said again.

    The last seconds are solved again because later poses are judged by earlier ones. A new frame cannot have been
    answered. Where its trigger was, the frame is of another dive, or a clock was set back: then what was withheld so
    far is published after all.
    """

    def __init__(self, said: Iterable[Outcome] = ()) -> None:
        # Late ones are out of order: they tell nothing about the triggers before.
        in_order = [one for one in said if not (isinstance(one, Rejected) and one.reason == "late")]
        self._up_to: int | None = max((one.trigger for one in in_order), default=None)
        self._up_to_ns = max((one.stamp_ns for one in in_order), default=0)
        self._withheld: deque[Outcome] = deque(maxlen=MAX_WITHHELD)

    def is_due(self, outcome: Outcome) -> bool:
        """Whether an outcome was not said before; else it is withheld."""
        if self._up_to is not None and outcome.trigger <= self._up_to:
            self._withheld.append(outcome)
            return False
        self._withheld.clear()
        return True

    def is_over(self, stamp_ns: int, now_ns: int) -> bool:
        """Whether the dive goes on now, and was answered well beyond stamp_ns."""
        live = self._up_to is not None and abs(now_ns - self._up_to_ns) < LIVE_WITHIN_NS
        return live and stamp_ns < self._up_to_ns - WARM_UP_NS

    def saw_new_frame(self, trigger: int) -> list[Outcome]:
        """Take note of a frame that is new; return what is due after all."""
        if self._up_to is None or trigger > self._up_to:
            return []
        due = list(self._withheld)
        self._withheld.clear()
        self._up_to = None
        return due
