"""What an earlier solver has published, so that a restarted one does not publish it again: outcomes, tracks, nets."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from typing import Final

import msgspec
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Message, NodePose, Rejected, RelativePose, Track
from buddyline.protocol.topics import TRACK, TRACK_LAG, key_of

Outcome = RelativePose | Rejected
Row = Track | NodePose

MAX_WITHHELD: Final = 8192
# Longer than a prediction is valid, and longer than the solver waits for a sensor.
WARM_UP_NS: Final = 10 * S_NS
# A pair that another solver takes over is solved again from this long before its last answer. It must not take long.
HANDED_OVER_NS: Final = 2 * S_NS
# An answer this near to the present is of the live dive, of which there is one. A stored dive may come again.
THIS_DIVE_NS: Final = 600 * S_NS
# When a solver ends, its tracks' last rows are up to so long after its last answer.
ROWS_AHEAD_NS: Final = 2 * S_NS
# A track's rows were published up to so long before the last answer: it waits 3 s for a sensor, `track_lag` 1 s more.
ROWS_BEHIND_NS: Final = 5 * S_NS


class Answer(msgspec.Struct, frozen=True):
    """What counts of an outcome that has been published. reason: "" for a pose."""

    node_a: str
    node_b: str
    trigger: int
    stamp_ns: int
    reason: str = ""

    @property
    def in_order(self) -> bool:
        """Whether it shows that all earlier triggers were answered; one that came `late` does not."""
        return self.reason != "late"


def answer_of(outcome: Outcome) -> Answer:
    """Return what counts of an outcome."""
    reason = outcome.reason if isinstance(outcome, Rejected) else ""
    return Answer(outcome.node_a, outcome.node_b, outcome.trigger, outcome.stamp_ns, reason)


def said_of(held: Iterable[Answer], noted: Iterable[Answer]) -> list[Answer]:
    """Return each pair's last outcomes by the journal, or as the hub holds them if the journal does not know those."""
    by_journal, by_hub = by_pair(noted), by_pair(held)
    said: list[Answer] = []
    for pair in {**by_journal, **by_hub}:
        of_journal, of_hub = by_journal.get(pair, []), by_hub.get(pair, [])
        known = {(one.trigger, one.stamp_ns) for one in of_journal}
        if of_hub and not any((one.trigger, one.stamp_ns) in known for one in of_hub):
            said += of_hub
        else:
            # What the journal has beyond the hub was published too, and is published again.
            said += [one for one in of_journal if one.in_order][-1:]
            said += [one for one in of_journal if not one.in_order]
    return said


def by_pair(outcomes: Iterable[Answer]) -> dict[tuple[str, str], list[Answer]]:
    """Return outcomes by their pairs, in their order."""
    found: dict[tuple[str, str], list[Answer]] = {}
    for one in outcomes:
        found.setdefault((one.node_a, one.node_b), []).append(one)
    return found


class Answered:
    """Withholds what was published before, of all pairs and nets. said: the last published outcomes of each pair."""

    def __init__(self, said: Iterable[Answer] = ()) -> None:
        self._said: dict[tuple[str, str], list[Answer]] = {}
        self._pairs: dict[tuple[str, str], AnsweredPair] = {}
        self._rows = ToldRows()
        self.know(said)

    def know(self, said: Iterable[Answer]) -> None:
        """Take the last outcomes that were published before."""
        for outcome in said:
            self._said.setdefault((outcome.node_a, outcome.node_b), []).append(outcome)

    def know_rows(self, held: Iterable[Row]) -> None:
        """Take the last rows that were published before, as the hub holds them; `know` comes first.

        A track's rows some seconds before its pair's last answer were published, also if the hub holds none.
        """
        answered = {nodes: self.pair(nodes).up_to_ns for nodes in [*self._said, *self._pairs]}
        told_ns = {
            topic.key(*nodes): up_to_ns - ROWS_BEHIND_NS
            for nodes, up_to_ns in answered.items()
            for topic in (TRACK, TRACK_LAG)
        }
        last_ns = max(answered.values(), default=0)
        for row in held:
            up_to_ns = answered.get((row.node_a, row.node_b), 0) if isinstance(row, Track) else last_ns
            # One that no solver of this dive can have published would silence the track for as long as its stamp says.
            if row.stamp_ns <= up_to_ns + ROWS_AHEAD_NS:
                told_ns[key_of(row)] = max(row.stamp_ns, told_ns.get(key_of(row), 0))
        self._rows.know(told_ns)

    def unsaid(self, messages: Iterable[Message]) -> list[Message]:
        """Return the messages without those outcomes and rows that were published before."""
        due: list[Message] = []
        for message in messages:
            if isinstance(message, Row):
                due += [message] if self._rows.is_due(message) else []
                continue
            if isinstance(message, Outcome):
                pair = self.pair((message.node_a, message.node_b))
                if not pair.is_due(message):
                    continue
                if pair.is_of_another_dive(message):
                    due += self._rows.release()
            due.append(message)
        return due

    def is_over(self, pairs: Iterable[tuple[str, str]], stamp_ns: int, now_ns: int) -> bool:
        """Return whether a frame from a cache need not be solved: the dive is live, and it is before the answers.

        pairs: those of the frame's node. The last WARM_UP_NS of the answered time are solved again.
        """
        known = [self.pair(nodes).is_over(stamp_ns, now_ns) for nodes in pairs]
        return bool(known) and all(known)

    def saw_new_frame(self, pairs: Iterable[tuple[str, str]], trigger: int, stamp_ns: int) -> list[Message]:
        """Note a frame that was sent after this solver joined; return what was withheld and is to be published now."""
        due: list[Message] = []
        for nodes in pairs:
            withheld = self.pair(nodes).saw_new_frame(trigger, stamp_ns)
            if withheld is not None:
                due += [*withheld, *self._rows.release()]
        return due

    def take_over(self, nodes: tuple[str, str], said: Iterable[Answer]) -> int:
        """Go on with a pair that another solver had; return the time of that one's last answer, 0 for none."""
        pair = self._pairs[nodes] = AnsweredPair(said, taken_over=True)
        return pair.up_to_ns

    def pair(self, nodes: tuple[str, str]) -> AnsweredPair:
        """Return the published outcomes of a pair."""
        if nodes not in self._pairs:
            self._pairs[nodes] = AnsweredPair(self._said.pop(nodes, ()))
        return self._pairs[nodes]


class ToldRows:
    """Withholds the rows of tracks and nets that were published before: by key, all up to one stamp.

    The rows of a key come in the order of their stamps. If the dive turns out to be another one, they are published.
    """

    def __init__(self) -> None:
        self._told_ns: dict[str, int] = {}
        self._withheld: dict[str, deque[Row]] = {}

    def know(self, told_ns: Mapping[str, int]) -> None:
        """Take the stamps up to which the rows of keys were published."""
        self._told_ns |= told_ns

    def is_due(self, row: Row) -> bool:
        """Return whether a row is to be published; if not, withhold it."""
        if not self._told_ns:
            return True
        key = key_of(row)
        if row.stamp_ns <= self._told_ns.get(key, -1):
            self._withheld.setdefault(key, deque(maxlen=MAX_WITHHELD)).append(row)
            return False
        self._told_ns.pop(key, None)
        self._withheld.pop(key, None)
        return True

    def release(self) -> list[Row]:
        """Return the withheld rows, and withhold none any more."""
        due = [row for rows in self._withheld.values() for row in rows]
        self._told_ns.clear()
        self._withheld.clear()
        return due


class AnsweredPair:
    """The published outcomes of one pair: all triggers up to one number were answered before.

    The last seconds are solved again, because the prior needs the earlier poses, but the outcomes are withheld. A new
    frame cannot have been answered before. If its trigger number was, the frame is of another dive, or a clock was set
    back: then the withheld outcomes are published. taken_over: from a solver that runs no longer, or lets it go; then
    frames of the last seconds that it has answered may still come. up_to_ns: the time of the last answer, 0 for none.
    """

    def __init__(self, said: Iterable[Answer] = (), *, taken_over: bool = False) -> None:
        self._taken_over = taken_over
        said = list(said)
        in_order = [one for one in said if one.in_order]
        self._up_to: int | None = max((one.trigger for one in in_order), default=None)
        self.up_to_ns = max((one.stamp_ns for one in in_order), default=0)
        # An outcome that came `late` says nothing of other triggers.
        self._late = {one.trigger for one in said if not one.in_order}
        # Without an answer, though later triggers have one.
        self._open: set[int] = set()
        self._withheld: deque[Outcome] = deque(maxlen=MAX_WITHHELD)

    def is_of_another_dive(self, outcome: Outcome) -> bool:
        """Return whether an outcome's trigger is after all that were answered, and its stamp a second before the last.

        The dive before had another rate of triggers.
        """
        after = self._up_to is not None and outcome.trigger > self._up_to
        return after and answer_of(outcome).in_order and outcome.stamp_ns < self.up_to_ns - S_NS

    def expect(self, triggers: Iterable[int], noted: Iterable[Answer]) -> set[int]:
        """Return those triggers that have no answer; from now on each is due, also before later ones that have one.

        noted: all answers since the first of them that is in order, by the solvers that had a frame of these triggers.
        If another solver has answered since, by `said`, it may have answered all up to there.
        """
        known = {one.trigger: one.in_order for one in noted}
        in_order = [trigger for trigger, is_in_order in known.items() if is_in_order]
        before = self._up_to if self._up_to != max(in_order, default=None) else min(in_order, default=None)
        self._open = {one for one in triggers if one not in known and (before is None or one > before)} - self._late
        return set(self._open)

    def give_up(self, trigger: int) -> None:
        """Note a trigger that was answered without its frames; they may still come."""
        self._late.add(trigger)

    def is_due(self, outcome: Outcome) -> bool:
        """Return whether an outcome is to be published; if not, withhold it."""
        if outcome.trigger in self._open:
            self._open.remove(outcome.trigger)
            return True
        if self._up_to is not None and outcome.trigger <= self._up_to:
            self._withheld.append(outcome)
            return False
        if outcome.trigger in self._late:
            return False
        self._withheld.clear()
        return True

    def is_over(self, stamp_ns: int, now_ns: int) -> bool:
        """Return whether the dive is live, and was answered to WARM_UP_NS after stamp_ns or later."""
        live = self._up_to is not None and abs(now_ns - self.up_to_ns) < THIS_DIVE_NS
        return live and stamp_ns < self.up_to_ns - WARM_UP_NS

    def saw_new_frame(self, trigger: int, stamp_ns: int) -> list[Outcome] | None:
        """Note a new frame; return the withheld outcomes if it shows that the dive is another one, else None."""
        if self._up_to is None or trigger > self._up_to:
            return None
        if self._taken_over and stamp_ns > self.up_to_ns - WARM_UP_NS:
            return None
        due = list(self._withheld)
        self._withheld.clear()
        self._up_to = None
        return due
