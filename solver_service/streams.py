"""The stream of one node: a bounded window of its frames, samples and calibrations, by its own clock.

All pairs of a node read its stream; none removes anything from it.
"""

from __future__ import annotations

import bisect
from collections import OrderedDict, deque
from collections.abc import Iterable
from enum import Enum
from typing import Final, TypeAlias

from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Candidates, Depth, Imu, NodeInfo
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.results import rig_of
from buddyline.solver_service.sensors import DEPTH_LAG_NS, KEPT_NS, SENSOR_WAIT_NS, ImuWindow, SampleStream
from msgspec import UNSET
from msgspec.structs import replace

# A frame further than this from the node's newest one may be from a clock that was set ...
FAR_NS: Final = 5 * S_NS
# ... which is believed when this many frames in a row agree.
FRAMES_TO_BELIEVE: Final = 5
# Each frame adds at most this much to elapsed_ns: during a gap in the dive no frames could have come.
LONGEST_STEP_NS: Final = 1 * S_NS
# A node with neither frames nor samples in this time before the newest outcome is not waited for.
STOPPED_NS: Final = 1 * S_NS
# A live sensor that has told nothing yet is waited for this long: a running one is heard at once, another has none.
FIRST_WAIT_NS: Final = 1 * S_NS
MAX_FRAME_BYTES: Final = 8 << 20
MAX_INFOS: Final = 64
MAX_SEQUENCE_MEMORY: Final = 512

Sensor: TypeAlias = ImuWindow | SampleStream[Attitude] | SampleStream[Depth]


class Arrival(Enum):
    """The verdict on a frame.

    FRESH: usable. DUPLICATE: came before. CONFLICT: another frame has its trigger. FAR: its stamp is far from the
    node's newest. LATER: a long gap ends, or the node's clock was set forward. CLOCK_SET: the node's clock was set
    back, and a new time line begins with it: triggers may come again.
    """

    FRESH = "fresh"
    DUPLICATE = "duplicate"
    CONFLICT = "conflict"
    FAR = "far"
    LATER = "later"
    CLOCK_SET = "clock_set"


def size_bytes(frame: Candidates) -> int:
    """Estimate the memory of a frame."""
    return 512 + len(frame.boot) + 256 * len(frame.blobs)


class FrameWindow:
    """A node's frames, sorted by stamp. Beyond a minute or MAX_FRAME_BYTES the oldest are dropped."""

    def __init__(self) -> None:
        self.bytes = 0
        self._stamps: list[int] = []
        self._frames: list[tuple[Candidates, int | None]] = []

    def add(self, frame: Candidates, receive_ns: int | None) -> None:
        """Take a frame; frames may come in any order."""
        at = bisect.bisect_right(self._stamps, frame.stamp_ns)
        self._stamps.insert(at, frame.stamp_ns)
        self._frames.insert(at, (frame, receive_ns))
        self.bytes += size_bytes(frame)
        while self.bytes > MAX_FRAME_BYTES or self._stamps[0] < self._stamps[-1] - KEPT_NS:
            self.bytes -= size_bytes(self._frames[0][0])
            del self._stamps[0], self._frames[0]

    def between(self, start_ns: int, end_ns: int) -> list[Candidates]:
        """Return the frames from start_ns to end_ns, both included."""
        first, last = bisect.bisect_left(self._stamps, start_ns), bisect.bisect_right(self._stamps, end_ns)
        return [frame for frame, _ in self._frames[first:last]]

    def received_since(self, receive_ns: int | None) -> list[Candidates]:
        """Return the frames received at receive_ns or later, and those whose receive time is unknown; None: all."""
        return [frame for frame, at_ns in self._frames if receive_ns is None or (at_ns or receive_ns) >= receive_ns]

    def since(self, start_ns: int) -> list[tuple[Candidates, int | None]]:
        """Return the frames from start_ns on, with their receive times."""
        return self._frames[bisect.bisect_left(self._stamps, start_ns) :]

    def clear(self) -> None:
        """Drop all frames."""
        self._stamps.clear()
        self._frames.clear()
        self.bytes = 0


class NodeStream:
    """The messages of one node. All windows are bounded.

    received: number of frames so far. first_ns, newest_ns: stamps of the first and newest frame since the node's clock
    was last set. elapsed_ns: time covered by the frames, without gaps: the waiting clock of a dive read from a log.
    live: whether the frames are of now.
    """

    def __init__(self, node: str) -> None:
        self.node = node
        self.frames = FrameWindow()
        self.attitude: SampleStream[Attitude] = SampleStream(lag_ns=0)
        self.depth: SampleStream[Depth] = SampleStream(lag_ns=DEPTH_LAG_NS)
        self.imu = ImuWindow()
        self.received = 0
        self.first_ns: int | None = None
        self.newest_ns: int | None = None
        self.elapsed_ns = 0
        self.live = False
        self._newest_receive_ns: int | None = None
        self._calibrations: list[tuple[NodeInfo, Rig]] = []
        self._sequence: OrderedDict[int, tuple[int, int, int]] = OrderedDict()  # trigger: hash of boot, seq, stamp
        self._newest_trigger = -1
        self._far: deque[int] = deque(maxlen=FRAMES_TO_BELIEVE)

    def add_info(self, info: NodeInfo) -> None:
        """Take a calibration; it is in force from its stamp on."""
        # Fields that the solver does not need are dropped, because they may be of any length.
        info = replace(info, software="", config_sha256="", tags=UNSET)
        at = bisect.bisect_left(self._calibrations, info.stamp_ns, key=_since)
        if at < len(self._calibrations) and _since(self._calibrations[at]) == info.stamp_ns:
            self._calibrations[at] = (info, rig_of(info))
        else:
            self._calibrations.insert(at, (info, rig_of(info)))
            del self._calibrations[:-MAX_INFOS]

    def calibration(self, stamp_ns: int) -> tuple[NodeInfo, Rig] | None:
        """Return the calibration in force at stamp_ns, or the first one if stamp_ns is before it; None for none."""
        at = bisect.bisect_right(self._calibrations, stamp_ns, key=_since)
        return self._calibrations[max(at - 1, 0)] if self._calibrations else None

    def add_sample(self, sample: Attitude | Depth | Imu) -> bool:
        """Take a sample of one of the sensors; return False for an inertial one that came before."""
        sensor: Sensor
        is_new = True
        if isinstance(sample, Imu):
            sensor = self.imu
            is_new = self.imu.add(sample)
        elif isinstance(sample, Attitude):
            sensor = self.attitude
            self.attitude.add(sample)
        else:
            sensor = self.depth
            self.depth.add(sample)
        if self.newest_ns is None or sample.stamp_ns >= self.newest_ns - SENSOR_WAIT_NS:
            sensor.missing_ns = 0
        return is_new

    def add_frame(
        self, frame: Candidates, others_ns: Iterable[int], receive_ns: int | None, *, live: bool = False
    ) -> Arrival:
        """Take a frame, and return the verdict on it.

        others_ns: newest stamps of the other nodes; after a gap, a stamp near to the frame's confirms it. live: whether
        its stamp is of now.
        """
        self.received += 1
        verdict = self._place_in_time(frame.stamp_ns, others_ns)
        if verdict is Arrival.FAR:
            return verdict
        self.live = live
        identity = hash(frame.boot), frame.seq, frame.stamp_ns
        seen = self._sequence.get(frame.trigger)
        if seen is not None:
            return Arrival.DUPLICATE if seen == identity else Arrival.CONFLICT
        self._sequence[frame.trigger] = identity
        self._newest_trigger = max(self._newest_trigger, frame.trigger)
        if len(self._sequence) > MAX_SEQUENCE_MEMORY:
            self._sequence.popitem(last=False)
        self.frames.add(frame, receive_ns)
        self._count_missing(receive_ns)
        return verdict

    def has_passed(self, trigger: int) -> bool:
        """Return whether the node made no frame for a trigger: the frames around it are consecutive."""
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

    def sensors_cover(self, stamp_ns: int) -> bool:
        """Return whether attitude and depth for a frame at stamp_ns are here, or will not come."""
        return all(
            self._has_stopped(sensor) or _newest_ns(sensor) >= stamp_ns - sensor.lag_ns
            for sensor in (self.attitude, self.depth)
        )

    def complete_ns(self, end_ns: int) -> int:
        """Return up to when, at most end_ns, all samples are here that will come.

        end_ns: of the newest outcome. Samples may be later than the frames of their time: a publisher sends frames
        first.
        """
        lately_ns = end_ns - STOPPED_NS
        waited = self.newest_ns is not None and self.newest_ns > lately_ns
        for sensor in (self.imu, self.attitude, self.depth):
            newest_ns = _newest_ns(sensor)
            if newest_ns > lately_ns or (waited and not self._has_stopped(sensor)):
                end_ns = min(end_ns, newest_ns)
        return end_ns

    @property
    def heard_ns(self) -> int:
        """Return the newest stamp of all its messages, -1 where there is none."""
        return max(self.newest_ns or -1, _newest_ns(self.imu), _newest_ns(self.attitude), _newest_ns(self.depth))

    def _has_stopped(self, sensor: Sensor) -> bool:
        """Return whether a sensor has been without samples for three seconds, or for one second after a live start.

        A live dive counts receive time, because a backlog arrives in a burst; other dives count their own time.
        """
        if self.live:
            return sensor.missing_ns > (FIRST_WAIT_NS if sensor.newest_ns is None else SENSOR_WAIT_NS)
        return (self.newest_ns or 0) - (sensor.newest_ns or self.first_ns or 0) > SENSOR_WAIT_NS

    def _place_in_time(self, stamp_ns: int, others_ns: Iterable[int]) -> Arrival:
        if self.newest_ns is None:
            self.first_ns = self.newest_ns = stamp_ns
            return Arrival.FRESH
        step_ns = stamp_ns - self.newest_ns
        resumed = step_ns > 0 and any(abs(stamp_ns - other_ns) <= FAR_NS for other_ns in others_ns)
        if resumed or abs(step_ns) <= FAR_NS:
            self._far.clear()
            self.elapsed_ns += min(max(step_ns, 0), LONGEST_STEP_NS)
            self.newest_ns = max(self.newest_ns, stamp_ns)
            return Arrival.FRESH
        if self._far and abs(stamp_ns - self._far[-1]) > FAR_NS:
            self._far.clear()
        # An old frame that comes again and again shows no new time.
        if not self._far or stamp_ns > self._far[-1]:
            self._far.append(stamp_ns)
        if len(self._far) < FRAMES_TO_BELIEVE:
            return Arrival.FAR
        self._far.clear()
        self.first_ns = self.newest_ns = stamp_ns
        if step_ns > 0:
            return Arrival.LATER
        self.frames.clear()
        self._sequence.clear()
        self._newest_trigger = -1
        for sensor in (self.imu, self.attitude, self.depth):
            sensor.clear()
        return Arrival.CLOCK_SET

    def _count_missing(self, receive_ns: int | None) -> None:
        """Add the time since the last frame to each sensor's missing_ns."""
        if receive_ns is None:
            return
        if self._newest_receive_ns is not None:
            step_ns = min(max(receive_ns - self._newest_receive_ns, 0), LONGEST_STEP_NS)
            for sensor in (self.imu, self.attitude, self.depth):
                sensor.missing_ns += step_ns
        self._newest_receive_ns = receive_ns


def _newest_ns(sensor: Sensor) -> int:
    """Return the stamp of a sensor's newest sample, -1 for none."""
    return -1 if sensor.newest_ns is None else sensor.newest_ns


def _since(calibration: tuple[NodeInfo, Rig]) -> int:
    return calibration[0].stamp_ns
