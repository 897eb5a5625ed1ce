"""Match the frames of two nodes by trigger. Each trigger is matched once, or gets a reason why not.

A trigger waits for frames and samples that may still come. A dive that is read or played from a log waits in the dive's
own time. A live dive waits in receive time, because a backlog arrives in a burst after an outage.
"""

from __future__ import annotations

import bisect
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, Reason
from buddyline.solver_service.pair import Matched
from buddyline.solver_service.results import sensed_of, wrong_size
from buddyline.solver_service.streams import FAR_NS, Arrival, NodeStream, size_bytes

# A missing frame is given up when the node's frames have advanced this far beyond it, in the dive's own time.
MATCH_WINDOW_NS: Final = 1 * S_NS
# How long a frame waits for a node that sends no frames at all.
SILENCE_WINDOW_NS: Final = 2 * S_NS
# How long a trigger waits at most, for example for a sensor that has stopped.
LONGEST_WAIT_NS: Final = 3 * S_NS
MAX_PENDING: Final = 512
MAX_PENDING_BYTES: Final = 16 << 20
MAX_RESOLVED_MEMORY: Final = 2048

TWO_FRAMES: Final = "two different frames claim this trigger: two nodes of one id?"


@dataclass(frozen=True)
class Unmatched:
    """A trigger that cannot be solved, with the reason; stamp_ns: of its frame."""

    trigger: int
    stamp_ns: int
    reason: Reason
    detail: str


@dataclass(eq=False, slots=True)
class _Waiting:
    """The frames of one trigger, of a and b, and the arrival of the first one.

    receive_ns: receive time; None when read from a log. elapsed_ns: both streams' elapsed_ns at that time, which
    measures the waiting where receive time does not. live: the dive is live, so it waits in receive time. due: whether
    an outcome is due; if not, the trigger has one, and waits for a frame that repeats it.
    """

    trigger: int
    frames: list[Candidates | None]
    receive_ns: int | None
    elapsed_ns: tuple[int, int]
    live: bool
    due: bool
    conflict: bool = False


@dataclass(frozen=True, slots=True)
class _Resolved:
    """A resolved trigger: both nodes' time lines then (how often their clocks had been set), and which had a frame."""

    time_lines: tuple[int, int]
    had_frame: tuple[bool, bool]


class PairMatcher:
    """Matches the frames of nodes a and b. Deterministic; time is an argument.

    late: number of frames that came after their trigger was resolved. duplicates: number of frames that came twice.
    matched: number of triggers with a frame and a calibration from both nodes.
    """

    def __init__(self, stream_a: NodeStream, stream_b: NodeStream) -> None:
        self.streams = stream_a, stream_b
        self.matched = 0
        self.late = 0
        self.duplicates = 0
        self.pending_bytes = 0
        self._waiting: dict[int, _Waiting] = {}
        self._order: list[int] = []
        self._arrivals: deque[_Waiting] = deque()
        self._time_lines = [0, 0]
        self._resolved: OrderedDict[int, _Resolved] = OrderedDict()
        self._newest_resolved = -1
        self._now_ns: int | None = None

    @property
    def pending(self) -> int:
        """Number of triggers that wait for data."""
        return len(self._order)

    def take(
        self, frame: Candidates, arrival: Arrival, receive_ns: int | None, *, live: bool
    ) -> list[Matched | Unmatched]:
        """Take a frame; return a trigger that it resolves at once.

        arrival: the verdict of the node's stream. For CLOCK_SET call `restart` first.
        """
        if receive_ns is not None:
            self._now_ns = receive_ns
        if arrival is Arrival.DUPLICATE:
            self.duplicates += 1
            return []
        trigger, side = frame.trigger, self._side(frame)
        due, may_repeat = self._is_due(trigger, side)
        waiting = self._waiting.get(trigger)
        if waiting is not None:
            waiting.due |= due
        if arrival is Arrival.FAR:
            self.late += 1
            seconds = (frame.stamp_ns - (self.streams[side].newest_ns or 0)) / S_NS
            detail = f"frame of {frame.node} is {seconds:+.1f} s from the node's others"
            # An earlier one may be the first of a new time line: its outcome is stored for that one.
            return self._give_up(frame, "late", detail, ahead=int(seconds < 0)) if due else []
        if not (due or may_repeat):
            self.late += 1
            return []
        if arrival is Arrival.CONFLICT:
            if waiting is None:
                return self._give_up(frame, "duplicate", TWO_FRAMES) if due else []
            waiting.conflict = True
            return []
        if trigger < self._newest_resolved:
            self.late += 1
            detail = f"frame of {frame.node} came after later triggers were solved"
            return self._give_up(frame, "late", detail) if due else []
        if waiting is None:
            elapsed_ns = self.streams[0].elapsed_ns, self.streams[1].elapsed_ns
            waiting = _Waiting(trigger, [None, None], receive_ns, elapsed_ns, live, due)
            if len(self._arrivals) > 2 * MAX_PENDING:
                self._arrivals = deque(one for one in self._arrivals if self._waiting.get(one.trigger) is one)
            self._arrivals.append(waiting)
            self._waiting[trigger] = waiting
            bisect.insort(self._order, trigger)
        waiting.frames[side] = frame
        self.pending_bytes += size_bytes(frame)
        return []

    def restart(self, node: str) -> list[Matched | Unmatched]:
        """Begin a new time line of a node whose clock was set; return the results of triggers with its old frames.

        The node's triggers may then come again, as in a dive played twice. The triggers of the frames that showed the
        new time may not: they have their outcome.
        """
        side = 0 if self.streams[0].node == node else 1
        results: list[Matched | Unmatched] = []
        for trigger in list(self._order):
            if self._waiting[trigger].frames[side] is not None:
                results += self._resolve_one(self._waiting[trigger], at_once=True) or ()
        self._time_lines[side] += 1
        self._newest_resolved = -1
        return results

    def resolve(self, receive_ns: int | None, *, everything: bool = False) -> list[Matched | Unmatched]:
        """Resolve the triggers whose waiting is over, in order; everything: resolve all of them."""
        if receive_ns is not None:
            self._now_ns = receive_ns
        if not self._order:
            return []
        overdue = self._newest_overdue()
        results: list[Matched | Unmatched] = []
        while self._order:
            trigger = self._order[0]
            crowded = len(self._order) > MAX_PENDING or self.pending_bytes > MAX_PENDING_BYTES
            at_once = everything or crowded or trigger <= overdue
            result = self._resolve_one(self._waiting[trigger], at_once=at_once)
            if result is None:
                break
            results += result
        return results

    def _side(self, frame: Candidates) -> int:
        return 0 if frame.node == self.streams[0].node else 1

    def _newest_overdue(self) -> int:
        """Return the newest trigger that has waited too long, -1 for none. Earlier triggers stop waiting with it."""
        overdue = -1
        while self._arrivals:
            first = self._arrivals[0]
            if self._waiting.get(first.trigger) is first:
                if not self._has_waited(first):
                    break
                overdue = max(overdue, first.trigger)
            self._arrivals.popleft()
        return overdue

    def _has_waited(self, waiting: _Waiting) -> bool:
        if waiting.receive_ns is not None and self._now_ns is not None:
            if self._now_ns - waiting.receive_ns > LONGEST_WAIT_NS:
                return True
            if waiting.live:
                return False
        since = zip(self.streams, waiting.elapsed_ns, strict=True)
        return any(stream.elapsed_ns - began_ns > LONGEST_WAIT_NS for stream, began_ns in since)

    def _resolve_one(self, waiting: _Waiting, *, at_once: bool) -> Sequence[Matched | Unmatched] | None:
        """Resolve one trigger, with no result if none is due; None if it still waits."""
        frame_a, frame_b = waiting.frames
        frame = frame_a or frame_b
        if frame is None:
            return None
        stream_a, stream_b = self.streams
        if waiting.conflict:
            return self._give_up(frame, "duplicate", TWO_FRAMES)
        if frame_a is None or frame_b is None:
            other = stream_b if frame_b is None else stream_a
            if not (at_once or other.has_passed(waiting.trigger) or self._expired(waiting, frame, other)):
                return None
            return self._give_up(frame, "unmatched", f"no frame of {other.node} for this trigger")
        expired = at_once or self._expired(waiting, frame_a, stream_b) or self._expired(waiting, frame_b, stream_a)
        known_a, known_b = stream_a.calibration(frame_a.stamp_ns), stream_b.calibration(frame_b.stamp_ns)
        if known_a is None or known_b is None:
            if not expired:
                return None
            pairs = ((stream_a.node, known_a), (stream_b.node, known_b))
            missing = " and ".join(node for node, known in pairs if known is None)
            return self._give_up(frame_a, "no_info", f"no NodeInfo of {missing}")
        covered = stream_a.sensors_cover(frame_a.stamp_ns) and stream_b.sensors_cover(frame_b.stamp_ns)
        if not (covered or at_once):
            return None
        self.matched += 1
        for one, (info, _) in ((frame_a, known_a), (frame_b, known_b)):
            if sizes := wrong_size(one, info):
                return self._give_up(one, "no_info", f"frame of {one.node} is {sizes}")
        self._finish(waiting.trigger, 0)
        self._newest_resolved = max(self._newest_resolved, waiting.trigger)
        matched = Matched(
            trigger=waiting.trigger,
            stamp_ns=(frame_a.stamp_ns + frame_b.stamp_ns) // 2,
            frame_a=frame_a,
            frame_b=frame_b,
            info_a=known_a[0],
            info_b=known_b[0],
            rig_a=known_a[1],
            rig_b=known_b[1],
            sensed_a=sensed_of(stream_a.attitude, stream_a.depth, frame_a.stamp_ns),
            sensed_b=sensed_of(stream_b.attitude, stream_b.depth, frame_b.stamp_ns),
        )
        return [matched]

    def _expired(self, waiting: _Waiting, frame: Candidates, other: NodeStream) -> bool:
        """Return whether to stop waiting for the other node's frame of this frame's trigger."""
        # If the other node's clock is far from this frame, its frames do not show that this one will not come.
        if other.newest_ns is not None and MATCH_WINDOW_NS < other.newest_ns - frame.stamp_ns <= FAR_NS:
            return True
        if waiting.live and waiting.receive_ns is not None and self._now_ns is not None:
            return self._now_ns - waiting.receive_ns > SILENCE_WINDOW_NS
        own_ns = self.streams[self._side(frame)].newest_ns or 0
        return own_ns - frame.stamp_ns > SILENCE_WINDOW_NS

    def _is_due(self, trigger: int, side: int) -> tuple[bool, bool]:
        """Return whether a frame calls for an outcome of its trigger, and whether the other node's frame still may.

        A trigger that has its outcome gets another one if a node that had a frame in it reaches the trigger again on a
        new time line. The frame of a node that had none waits for that one: the other's clock was ahead for a while.
        """
        resolved = self._resolved.get(trigger)
        if resolved is None:
            return True, True
        again = [
            now > then and had
            for now, then, had in zip(self._time_lines, resolved.time_lines, resolved.had_frame, strict=True)
        ]
        return again[side], any(again)

    def _give_up(self, frame: Candidates, reason: Reason, detail: str, *, ahead: int = 0) -> list[Matched | Unmatched]:
        """End a trigger without a match; ahead: 1 if the frame may be the first of a new time line."""
        waiting = self._waiting.get(frame.trigger)
        if waiting is not None and not waiting.due:
            self._drop(waiting)
            return []
        self._finish(frame.trigger, self._side(frame), ahead)
        if reason != "late":
            self._newest_resolved = max(self._newest_resolved, frame.trigger)
        return [Unmatched(frame.trigger, frame.stamp_ns, reason, detail)]

    def _drop(self, waiting: _Waiting) -> None:
        """Drop a trigger's frames."""
        del self._waiting[waiting.trigger]
        del self._order[bisect.bisect_left(self._order, waiting.trigger)]
        self.pending_bytes -= sum(size_bytes(frame) for frame in waiting.frames if frame is not None)
        waiting.frames = [None, None]

    def _finish(self, trigger: int, side: int, ahead: int = 0) -> None:
        """Drop a trigger's frames, and store that it has its outcome. side: 0 or 1, the node that had a frame."""
        waiting = self._waiting.get(trigger)
        had_frame = [False, False]
        if waiting is not None:
            had_frame = [frame is not None for frame in waiting.frames]
            self._drop(waiting)
        had_frame[side] = True
        time_lines = list(self._time_lines)
        time_lines[side] += ahead
        self._resolved[trigger] = _Resolved((time_lines[0], time_lines[1]), (had_frame[0], had_frame[1]))
        if len(self._resolved) > MAX_RESOLVED_MEMORY:
            self._resolved.popitem(last=False)
