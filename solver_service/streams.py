"""What one node has sent, in the order of its own time: frames, calibration, attitude, depth."""

from __future__ import annotations

import bisect
from collections import OrderedDict
from enum import Enum
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Candidates, Depth, NodeInfo
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.results import rig_of
from buddyline.solver_service.sensors import DEPTH_LAG_NS, SampleStream

# A frame further than this from the node's others is not of the same time line ...
FAR_NS: Final = 5 * S_NS
# ... until so many in a row agree that the clock has been set.
FRAMES_TO_BELIEVE: Final = 5
# A frame of a live dive, which is one of so near the receiver's own time, has been held up where it comes so much later
# after the last one than it was made; but a link that lets frames through by fits and starts is no outage each time.
LIVE_WITHIN_NS: Final = 60 * S_NS
HELD_UP_NS: Final = 1 * S_NS
HELD_UP_AGAIN_NS: Final = 5 * S_NS
MAX_INFOS: Final = 64
MAX_SEQUENCE_MEMORY: Final = 512


class Arrival(Enum):
    """What a frame turned out to be."""

    FRESH = "fresh"
    DUPLICATE = "duplicate"
    CONFLICT = "conflict"
    FAR = "far"
    CLOCK_SET = "clock_set"


class NodeStream:
    """One node's side of the match; bounded. held_up_ns: when the first frame after an outage has come."""

    def __init__(self, node: str) -> None:
        self.node = node
        self.frames: dict[int, Candidates] = {}
        self.attitude: SampleStream[Attitude] = SampleStream(lag_ns=0)
        self.depth: SampleStream[Depth] = SampleStream(lag_ns=DEPTH_LAG_NS)
        self.received = 0
        self.first_ns: int | None = None
        self.newest_ns: int | None = None
        self.held_up_ns = -HELD_UP_AGAIN_NS
        self._newest_came_ns: tuple[int, int] | None = None
        self._calibrations: list[tuple[NodeInfo, Rig]] = []
        self._sequence: OrderedDict[int, tuple[str, int, int]] = OrderedDict()  # trigger: boot, seq, stamp
        self._newest_trigger = -1
        self._far: list[int] = []

    def add_info(self, info: NodeInfo) -> None:
        """Take a calibration; it holds from its stamp on."""
        at = bisect.bisect_left(self._calibrations, info.stamp_ns, key=_since)
        if at < len(self._calibrations) and _since(self._calibrations[at]) == info.stamp_ns:
            self._calibrations[at] = (info, rig_of(info))
        else:
            self._calibrations.insert(at, (info, rig_of(info)))
            del self._calibrations[:-MAX_INFOS]

    def calibration_at(self, stamp_ns: int) -> tuple[NodeInfo, Rig] | None:
        """Return the calibration in force at stamp_ns (before the first one: the first)."""
        at = bisect.bisect_right(self._calibrations, stamp_ns, key=_since)
        return self._calibrations[max(at - 1, 0)] if self._calibrations else None

    def add_frame(self, frame: Candidates, other_newest_ns: int | None) -> Arrival:
        """Take a frame, or say why not; other_newest_ns: how far the other node has come, which vouches for a gap."""
        self.received += 1
        verdict = self._place_in_time(frame.stamp_ns, other_newest_ns)
        if verdict is Arrival.FAR:
            return verdict
        seen = self._sequence.get(frame.trigger)
        if seen is not None and verdict is not Arrival.CLOCK_SET:
            if seen == (frame.boot, frame.seq, frame.stamp_ns):
                return Arrival.DUPLICATE
            return Arrival.CONFLICT
        self._sequence[frame.trigger] = (frame.boot, frame.seq, frame.stamp_ns)
        self._newest_trigger = max(self._newest_trigger, frame.trigger)
        if len(self._sequence) > MAX_SEQUENCE_MEMORY:
            self._sequence.popitem(last=False)
        self.frames[frame.trigger] = frame
        return verdict

    def saw_frame_come(self, stamp_ns: int, came_ns: int) -> None:
        """Compare when a frame was made and when it has come with the newest before; an old one again says nothing."""
        made_before_ns, came_before_ns = self._newest_came_ns or (stamp_ns - 1, came_ns)
        if stamp_ns <= made_before_ns:
            return
        held_up_ns = came_ns - came_before_ns - (stamp_ns - made_before_ns)
        again = 0 <= came_ns - self.held_up_ns < HELD_UP_AGAIN_NS
        if held_up_ns > HELD_UP_NS and abs(came_ns - stamp_ns) < LIVE_WITHIN_NS and not again:
            self.held_up_ns = came_ns
        self._newest_came_ns = stamp_ns, came_ns

    def _place_in_time(self, stamp_ns: int, other_newest_ns: int | None) -> Arrival:
        if self.newest_ns is None:
            self.first_ns = self.newest_ns = stamp_ns
            return Arrival.FRESH
        resumed = (
            stamp_ns > self.newest_ns and other_newest_ns is not None and abs(stamp_ns - other_newest_ns) <= FAR_NS
        )
        if resumed or abs(stamp_ns - self.newest_ns) <= FAR_NS:
            self._far.clear()
            self.newest_ns = max(self.newest_ns, stamp_ns)
            return Arrival.FRESH
        if self._far and abs(stamp_ns - self._far[-1]) > FAR_NS:
            self._far.clear()
        self._far.append(stamp_ns)
        if len(self._far) < FRAMES_TO_BELIEVE:
            return Arrival.FAR
        self._far.clear()
        self.frames.clear()
        self._sequence.clear()
        self._newest_came_ns = None
        self._newest_trigger = -1
        self.first_ns = self.newest_ns = stamp_ns
        return Arrival.CLOCK_SET

    def has_passed(self, trigger: int) -> bool:
        """Whether this node sent no frame for trigger: its neighbours are here, with nothing between them."""
        if trigger in self._sequence or trigger > self._newest_trigger:
            return False
        if trigger - 1 in self._sequence and trigger + 1 in self._sequence:
            before: int | None = trigger - 1
            after: int | None = trigger + 1
        else:
            before = max((k for k in self._sequence if k < trigger), default=None)
            after = min((k for k in self._sequence if k > trigger), default=None)
        if before is None or after is None:
            return False
        boot_0, seq_0, _ = self._sequence[before]
        boot_1, seq_1, _ = self._sequence[after]
        return boot_0 == boot_1 and seq_1 == seq_0 + 1

    def sensors_cover(self, stamp_ns: int, held_up: bool) -> bool:
        """Whether attitude and depth for a frame at stamp_ns are here, or are not going to come.

        held_up: whether they may still be on their way, so that their absence says nothing.
        """
        if self.first_ns is None or self.newest_ns is None:
            return True
        first_ns, newest_ns = self.first_ns, self.newest_ns
        return all(sensor.covers(stamp_ns, first_ns, newest_ns, held_up) for sensor in (self.attitude, self.depth))


def _since(calibration: tuple[NodeInfo, Rig]) -> int:
    return calibration[0].stamp_ns
