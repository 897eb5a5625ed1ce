"""Record the frames and outcomes that a viewer on the bus receives, and compare them with the nodes' logs."""

from __future__ import annotations

import threading
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.messages import Candidates, Rejected, RelativePose
from buddyline.protocol.topics import CANDIDATES, POSE, REJECTED
from buddyline.tools.client import ClientConfig
from buddyline.tools.live import follow, open_bus_within

# Frames exposed in the last moment before a node was stopped may not have been sent.
END_NS = S_NS
CONNECT_S = 20.0
# The longest wait for the outcomes of the last frames.
SETTLE_S = 60.0

Frame = tuple[str, str, int]  # node, boot, seq
Outcome = Rejected | RelativePose


def frame_of(message: Candidates) -> Frame:
    return message.node, message.boot, message.seq


@dataclass
class Tally:
    """Counts over one run. published: by the nodes' own logs; a trigger's outcome is its pose or rejection."""

    published: int = 0
    received: int = 0
    lost: int = 0
    duplicated: int = 0
    disordered: int = 0
    triggers: int = 0
    without_outcome: int = 0
    outcomes_doubled: int = 0
    reasons: Counter[str] = field(default_factory=Counter)

    def __add__(self, other: Tally) -> Tally:
        return Tally(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))


class Observer:
    """A client of the bus that keeps every frame and every outcome it receives."""

    def __init__(self, endpoint: str) -> None:
        self.bus = open_bus_within(ClientConfig(connect=endpoint), CONNECT_S)
        self.refusals = Refusals("observer")
        self.frames: list[tuple[Candidates, int]] = []
        self.outcomes: list[tuple[Outcome, int]] = []
        self._changed = threading.Condition()
        for topic in (CANDIDATES, POSE, REJECTED):
            follow(self.bus, topic.key_any(), self.refusals, self._take, capacity=100_000)

    def close(self) -> None:
        self.bus.close()

    def _take(self, envelope: Envelope) -> None:
        message = envelope.message
        with self._changed:
            if isinstance(message, Candidates):
                self.frames.append((message, envelope.time_ns))
            elif isinstance(message, Rejected | RelativePose):
                self.outcomes.append((message, envelope.time_ns))
            self._changed.notify_all()

    def wait_for_match(self, since_ns: int, timeout_s: float) -> int:
        """Wait for an outcome from frames of both nodes exposed at since_ns or later; return its receive time, ns."""

        def found() -> int | None:
            return next(
                (
                    received_ns
                    for outcome, received_ns in reversed(self.outcomes)
                    if outcome.stamp_ns >= since_ns and _matched(outcome)
                ),
                None,
            )

        with self._changed:
            received_ns = self._changed.wait_for(found, timeout_s)
        if received_ns is None:
            raise TimeoutError(f"no matched trigger within {timeout_s:g} s")
        first = [r for o, r in self.outcomes if o.stamp_ns >= since_ns and _matched(o)]
        return min(first)

    def settle(self, timeout_s: float = SETTLE_S) -> None:
        """Wait until all triggers have an outcome."""

        def all_answered() -> bool:
            return {frame.trigger for frame, _ in self.frames} <= {outcome.trigger for outcome, _ in self.outcomes}

        with self._changed:
            self._changed.wait_for(all_answered, timeout_s)

    def tally(self, logs: Iterable[Path]) -> Tally:
        """Compare with the nodes' own logs, from the first frame of each boot that was on the bus."""
        frames = [frame_of(message) for message, _ in self.frames]
        seen = Counter(frames)
        first: dict[tuple[str, str], int] = {}
        for node, boot, seq in frames:
            first[node, boot] = min(seq, first.get((node, boot), seq))
        messages = [m for path in logs for m in _frames(path)]
        # The stamp of each node's last frame; there are later ones where its clock was set back.
        last_ns = {m.node: m.stamp_ns for m in messages}

        def may_be_unsent(m: Candidates) -> bool:
            return last_ns[m.node] - END_NS < m.stamp_ns <= last_ns[m.node]

        published = set(seen) | {
            frame_of(m) for m in messages if not may_be_unsent(m) and m.seq >= first.get((m.node, m.boot), m.seq + 1)
        }
        triggers = {m.trigger for m, _ in self.frames if not may_be_unsent(m)}
        outcomes = Counter(o.trigger for o, _ in self.outcomes)
        # A node whose clock was set comes to a trigger again, and each time has an outcome.
        times = Counter((m.trigger, m.node, m.boot) for m in {frame_of(m): m for m, _ in self.frames}.values())
        due = {trigger: count for (trigger, *_), count in sorted(times.items(), key=lambda one: one[1])}
        return Tally(
            published=len(published),
            received=len(seen),
            lost=len(published - set(seen)),
            duplicated=len(frames) - len(seen),
            disordered=_disordered(frames),
            triggers=len(triggers),
            without_outcome=sum(1 for trigger in triggers if trigger not in outcomes),
            outcomes_doubled=sum(max(count - due.get(trigger, 1), 0) for trigger, count in outcomes.items()),
            reasons=Counter(
                o.reason if isinstance(o, Rejected) else "pose" for o, _ in self.outcomes if o.trigger in triggers
            ),
        )


def _matched(outcome: Outcome) -> bool:
    return isinstance(outcome, RelativePose) or outcome.reason not in ("unmatched", "late", "duplicate")


def _disordered(frames: list[Frame]) -> int:
    newest: dict[tuple[str, str], int] = defaultdict(lambda: -1)
    count = 0
    for node, boot, seq in frames:
        count += seq < newest[node, boot]
        newest[node, boot] = max(seq, newest[node, boot])
    return count


def _frames(path: Path) -> list[Candidates]:
    with DiveLogReader(path) as reader:
        opened = [record.open().message for record in reader.records(lambda key: key.endswith("/candidates"))]
    return [message for message in opened if isinstance(message, Candidates)]
