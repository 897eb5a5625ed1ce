"""The solver's pure core: messages in, poses and rejections out; no clock, no bus, no files.

The live service, the offline solver, replay and tests all call `SolverCore.handle`. Triggers are resolved in
their own order and from their own data alone, so that the same messages give the same poses in whatever
order they arrive within the matching window.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from typing import Final

from buddyline.protocol.clock import S_NS, trigger_index
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    Depth,
    Message,
    NodeInfo,
    Reason,
    Rejected,
    RelativePose,
)
from buddyline.solver_service.alignment import ClockAlignment
from buddyline.solver_service.geometry.observation import Heading
from buddyline.solver_service.geometry.trigger import NoFix, Rig, Settings
from buddyline.solver_service.pair import Matched, PairSolver
from buddyline.solver_service.results import relative_pose, sensed_of
from buddyline.solver_service.streams import FAR_NS, FRAMES_TO_BELIEVE, Arrival, NodeStream
from msgspec.structs import replace

# How long, in the dive's own time, a frame waits for the other node's frame that may still come.
MATCH_WINDOW_NS: Final = 1 * S_NS
# Where the other node is silent altogether.
SILENCE_WINDOW_NS: Final = 2 * S_NS
# After an outage what was held up comes all at once, one node's before the other's, frames before attitudes: for so
# long after its first frame, by when things come, nothing counts as silent.
PATIENCE_NS: Final = 3 * S_NS // 2
MAX_PENDING: Final = 512
MAX_RESOLVED_MEMORY: Final = 8192


class SolverCore:
    """Matches the frames of nodes a and b, and solves each trigger once.

    clock_offset_ns: b's clock minus a's, where it is known; b's times are brought to a's clock by it.
    `counts` holds what became of the triggers ("solved" and the reasons), `late`, `duplicates`, `foreign`
    what was not used. alignment: collects what the fixes tell of the clocks' offset, for whoever wants to know.
    """

    def __init__(
        self,
        node_a: str,
        node_b: str,
        settings: Settings,
        clock_offset_ns: int = 0,
        alignment: ClockAlignment | None = None,
    ) -> None:
        if node_a == node_b:
            raise ValueError(f"the two nodes have the same id, {node_a!r}")
        self.node_a = node_a
        self.node_b = node_b
        self.settings = settings
        self.counts: Counter[str] = Counter()
        self.matched = 0
        self.late = 0
        self.duplicates = 0
        self.foreign = 0
        self._a = NodeStream(node_a)
        self._b = NodeStream(node_b)
        self._conflicts: set[int] = set()
        self._resolved: OrderedDict[int, None] = OrderedDict()
        self._far: deque[int] = deque(maxlen=4 * FRAMES_TO_BELIEVE)
        self._newest_resolved = -1
        self._came_ns: int | None = None
        self._solver = PairSolver(settings, alignment)
        self._clock_offset_ns = clock_offset_ns

    @property
    def received(self) -> tuple[int, int]:
        """Frames received from a and b."""
        return self._a.received, self._b.received

    @property
    def newest_ns(self) -> tuple[int | None, int | None]:
        """Stamps of the newest frames of a and b."""
        return self._a.newest_ns, self._b.newest_ns

    @property
    def heading(self) -> Heading | None:
        """How far the headings disagree by the poses up to the newest frame, None where they have not told."""
        newest_ns = max((ns for ns in self.newest_ns if ns is not None), default=0)
        return self._solver.heading(newest_ns)

    @property
    def pending(self) -> int:
        """Triggers that wait for something."""
        return len(self._pending())

    def handle(self, message: Message, came_ns: int | None = None) -> list[RelativePose | Rejected]:
        """Take one message of a node; return what is resolved by it, in the order of the triggers.

        came_ns: when it has come, by the receiver's clock; None where it was read from a log.
        """
        self._came_ns = came_ns
        stream = {self.node_a: self._a, self.node_b: self._b}.get(getattr(message, "node", ""))
        if stream is None:
            self.foreign += 1
            return []
        if self._clock_offset_ns and stream is self._b:
            message = self._on_clock_of_a(message)
        if isinstance(message, NodeInfo):
            stream.add_info(message)
        elif isinstance(message, Attitude):
            stream.attitude.add(message)
        elif isinstance(message, Depth):
            stream.depth.add(message)
        elif isinstance(message, Candidates):
            early = self._take_frame(stream, message)
            return early + self._resolve()
        else:
            return []
        return self._resolve()

    def flush(self) -> list[RelativePose | Rejected]:
        """Resolve all that is pending with what there is: the dive has ended or has paused."""
        return self._resolve(everything=True)

    def _take_frame(self, stream: NodeStream, frame: Candidates) -> list[RelativePose | Rejected]:
        other = self._b if stream is self._a else self._a
        arrival = stream.add_frame(frame, other.newest_ns)
        if self._came_ns is not None and arrival is not Arrival.FAR:
            stream.saw_frame_come(frame.stamp_ns, self._came_ns)
        if arrival is Arrival.DUPLICATE:
            self.duplicates += 1
            return []
        if arrival is Arrival.CLOCK_SET:
            # The same triggers may come again, as in a dive played twice; those that told of the new time are done.
            self._resolved = OrderedDict.fromkeys(self._far)
            self._newest_resolved = -1
            self._solver.forget()
            if frame.trigger in self._resolved:
                stream.frames.pop(frame.trigger, None)
                self.late += 1
            return []
        if arrival is Arrival.FAR:
            self.late += 1
            seconds = (frame.stamp_ns - (stream.newest_ns or 0)) / S_NS
            detail = f"frame of {frame.node} is {seconds:+.1f} s from the node's others"
            self._far.append(frame.trigger)
            return [] if frame.trigger in self._resolved else [self._reject(frame, "late", detail)]
        if frame.trigger in self._resolved:
            stream.frames.pop(frame.trigger, None)
            self.late += 1
            return []
        if arrival is Arrival.CONFLICT:
            self._conflicts.add(frame.trigger)
            return []
        if frame.trigger < self._newest_resolved:
            stream.frames.pop(frame.trigger, None)
            self.late += 1
            return [self._reject(frame, "late", f"frame of {frame.node} came after later triggers were solved")]
        return []

    def _on_clock_of_a(self, message: Message) -> Message:
        stamp_ns = max(getattr(message, "stamp_ns", 0) - self._clock_offset_ns, 0)
        if not isinstance(message, Candidates):
            return replace(message, stamp_ns=stamp_ns)
        calibration = self._b.calibration_at(stamp_ns)
        trigger = trigger_index(stamp_ns, calibration[0].trigger_period_ns) if calibration else message.trigger
        return replace(message, stamp_ns=stamp_ns, trigger=trigger)

    def _pending(self) -> list[int]:
        return sorted(self._a.frames.keys() | self._b.frames.keys())

    def _resolve(self, *, everything: bool = False) -> list[RelativePose | Rejected]:
        results: list[RelativePose | Rejected] = []
        pending = self._pending()
        for position, trigger in enumerate(pending):
            crowded = len(pending) - position > MAX_PENDING
            result = self._resolve_one(trigger, at_once=everything or crowded)
            if result is None:
                break
            results.append(result)
        return results

    def _resolve_one(self, trigger: int, *, at_once: bool) -> RelativePose | Rejected | None:
        """Resolve one trigger; None where it still waits for something that may come."""
        frame_a, frame_b = self._a.frames.get(trigger), self._b.frames.get(trigger)
        frame = frame_a or frame_b
        if frame is None:
            return None
        if trigger in self._conflicts:
            return self._reject(frame, "duplicate", "two different frames claim this trigger: two nodes of one id?")
        if frame_a is None or frame_b is None:
            other = self._b if frame_b is None else self._a
            if not (at_once or other.has_passed(trigger) or self._expired(frame, other)):
                return None
            return self._reject(frame, "unmatched", f"no frame of {other.node} for this trigger")
        expired = at_once or self._expired(frame_a, self._b) or self._expired(frame_b, self._a)
        known_a, known_b = self._a.calibration_at(frame_a.stamp_ns), self._b.calibration_at(frame_b.stamp_ns)
        if known_a is None or known_b is None:
            if not expired:
                return None
            missing = " and ".join(n for n, known in ((self.node_a, known_a), (self.node_b, known_b)) if known is None)
            return self._reject(frame_a, "no_info", f"no NodeInfo of {missing}")
        held_up = self._held_up()
        covered = self._a.sensors_cover(frame_a.stamp_ns, held_up) and self._b.sensors_cover(frame_b.stamp_ns, held_up)
        if not covered and not at_once:
            return None
        return self._solve(frame_a, frame_b, known_a, known_b)

    def _expired(self, frame: Candidates, other: NodeStream) -> bool:
        """Whether the other node's frame for the same trigger can be given up."""
        own = self._a if other is self._b else self._b
        other_ns = other.newest_ns if other.newest_ns is not None else 0
        own_ns = own.newest_ns if own.newest_ns is not None else 0
        silent = own_ns - frame.stamp_ns > SILENCE_WINDOW_NS and not self._held_up()
        # A node whose clock is far from this frame says nothing about what of it may still come.
        return silent or MATCH_WINDOW_NS < other_ns - frame.stamp_ns <= FAR_NS

    def _held_up(self) -> bool:
        """Whether what has been held up may still be coming."""
        came_ns = self._came_ns
        return came_ns is not None and any(0 <= came_ns - s.held_up_ns <= PATIENCE_NS for s in (self._a, self._b))

    def _solve(
        self,
        frame_a: Candidates,
        frame_b: Candidates,
        calibration_a: tuple[NodeInfo, Rig],
        calibration_b: tuple[NodeInfo, Rig],
    ) -> RelativePose | Rejected:
        self.matched += 1
        (info_a, rig_a), (info_b, rig_b) = calibration_a, calibration_b
        for frame, info in ((frame_a, info_a), (frame_b, info_b)):
            if (frame.width_px, frame.height_px) != (info.width_px, info.height_px):
                detail = (
                    f"frame of {frame.node} is {frame.width_px}x{frame.height_px} px, "
                    f"its calibration {info.width_px}x{info.height_px}"
                )
                return self._reject(frame, "no_info", detail)
        matched = Matched(
            trigger=frame_a.trigger,
            stamp_ns=(frame_a.stamp_ns + frame_b.stamp_ns) // 2,
            frame_a=frame_a,
            frame_b=frame_b,
            info_a=info_a,
            info_b=info_b,
            rig_a=rig_a,
            rig_b=rig_b,
            sensed_a=sensed_of(self._a.attitude, self._a.depth, frame_a.stamp_ns),
            sensed_b=sensed_of(self._b.attitude, self._b.depth, frame_b.stamp_ns),
        )
        (found,) = self._solver.solve([matched])
        if isinstance(found, NoFix):
            return self._reject(frame_a, found.reason, found.detail, matched.stamp_ns)
        pose = relative_pose(frame_a, frame_b, rig_a, matched.sensed_a, found)
        self._finish(frame_a.trigger)
        self.counts["solved"] += 1
        return pose

    def _reject(self, frame: Candidates, reason: Reason, detail: str, stamp_ns: int | None = None) -> Rejected:
        self._finish(frame.trigger, newest=reason != "late")
        self.counts[reason] += 1
        return Rejected(
            node_a=self.node_a,
            node_b=self.node_b,
            stamp_ns=frame.stamp_ns if stamp_ns is None else stamp_ns,
            trigger=frame.trigger,
            reason=reason,
            detail=detail,
        )

    def _finish(self, trigger: int, *, newest: bool = True) -> None:
        self._a.frames.pop(trigger, None)
        self._b.frames.pop(trigger, None)
        self._conflicts.discard(trigger)
        self._resolved[trigger] = None
        if len(self._resolved) > MAX_RESOLVED_MEMORY:
            self._resolved.popitem(last=False)
        if newest:
            self._newest_resolved = max(self._newest_resolved, trigger)
