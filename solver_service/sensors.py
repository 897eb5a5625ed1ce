"""A node's sensor samples by time; its attitude and depth at the instant of a frame."""

from __future__ import annotations

import bisect
import math
from collections import deque
from typing import Final, Generic, Literal, TypeVar

import numpy as np
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.messages import Attitude, Depth, Imu
from numpy.typing import NDArray

# A sample this much older than the newest one shows that the clock was set back.
HORIZON_NS: Final = 20 * S_NS
# Samples are kept for this time: after an outage the other node's frames may come from its cache, which is as long.
KEPT_NS: Final = 60 * S_NS
MAX_SAMPLES: Final = 8192
SENSOR_WAIT_NS: Final = 3 * S_NS

# An attitude is interpolated between samples at most this far apart, or taken from one sample at most this far away.
ATTITUDE_GAP_NS: Final = 300 * MS_NS
ATTITUDE_HOLD_NS: Final = 100 * MS_NS
# A diver's ordinary turn rate: the sigma of an attitude from one sample grows by it.
TURN_RATE_RADPS: Final = 0.2

# Depth has 10 to 20 Hz. A frame does not wait for the next sample: it uses samples up to this long before it.
DEPTH_LAG_NS: Final = 100 * MS_NS
DEPTH_FIT_NS: Final = 350 * MS_NS
DEPTH_STALE_NS: Final = 1 * S_NS
# Error of the linear fit, from a diver's vertical motion, per second of extrapolation.
DEPTH_DRIFT_MPS: Final = 0.1

S = TypeVar("S", Attitude, Depth)


class BackwardJump:
    """Distinguishes samples of a clock that was set back from samples that are late."""

    def __init__(self) -> None:
        self._stamps: deque[int] = deque(maxlen=5)

    def judge(self, stamp_ns: int, newest_ns: int | None) -> Literal["take", "drop", "restart"]:
        """Return what to do with a sample. newest_ns: stamp of the newest kept sample; None for none."""
        if newest_ns is not None and stamp_ns < newest_ns - HORIZON_NS:
            # Several samples in a row with the old time show that the clock was set back.
            self._stamps.append(stamp_ns)
            if len(self._stamps) < 5:
                return "drop"
            self._stamps.clear()
            return "restart"
        if not self._stamps or stamp_ns > self._stamps[-1] + HORIZON_NS:
            self._stamps.clear()
        return "take"


class SampleStream(Generic[S]):
    """Samples of one sensor by time; memory is bounded. lag_ns: how far before a frame its samples may end.

    missing_ns: how long, in receive time, frames have come without samples of their time.
    """

    def __init__(self, lag_ns: int) -> None:
        self.missing_ns = 0
        self.lag_ns = lag_ns
        self._stamps: list[int] = []
        self._samples: list[S] = []
        self._jump = BackwardJump()

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample; None if there is none."""
        return self._stamps[-1] if self._stamps else None

    def add(self, sample: S) -> None:
        """Take one sample; samples may come in any order."""
        verdict = self._jump.judge(sample.stamp_ns, self.newest_ns)
        if verdict == "drop":
            return
        if verdict == "restart":
            self.clear()
        at = bisect.bisect_left(self._stamps, sample.stamp_ns)
        if at < len(self._stamps) and self._stamps[at] == sample.stamp_ns:
            return
        self._stamps.insert(at, sample.stamp_ns)
        self._samples.insert(at, sample)
        if len(self._stamps) > MAX_SAMPLES or self._stamps[0] < self._stamps[-1] - 2 * KEPT_NS:
            keep = max(bisect.bisect_left(self._stamps, self._stamps[-1] - KEPT_NS), len(self._stamps) - MAX_SAMPLES)
            del self._stamps[:keep], self._samples[:keep]

    def clear(self) -> None:
        """Drop all samples: the clock was set back."""
        self._stamps.clear()
        self._samples.clear()

    def around(self, stamp_ns: int) -> tuple[S | None, S | None]:
        """Return the last sample at or before stamp_ns, and the first after it; None where there is none."""
        at = bisect.bisect_right(self._stamps, stamp_ns)
        before = self._samples[at - 1] if at else None
        after = self._samples[at] if at < len(self._samples) else None
        return before, after

    def between(self, start_ns: int, end_ns: int) -> list[S]:
        """Return the samples from start_ns to end_ns, both included."""
        return self._samples[bisect.bisect_left(self._stamps, start_ns) : bisect.bisect_right(self._stamps, end_ns)]


class ImuWindow:
    """The last minute of a node's inertial samples, sorted by stamp, as arrays; memory is bounded.

    missing_ns: as of SampleStream.
    """

    def __init__(self) -> None:
        self.missing_ns = 0
        self._stamps = np.empty(2 * MAX_SAMPLES, dtype=np.int64)
        self._values = np.empty((2 * MAX_SAMPLES, 6))
        self._start = self._end = 0
        self._jump = BackwardJump()

    def __len__(self) -> int:
        """Return the number of samples."""
        return self._end - self._start

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample; None if there is none."""
        return int(self._stamps[self._end - 1]) if len(self) else None

    def add(self, sample: Imu) -> bool:
        """Take one sample; samples may come in any order. Return False for one that came before."""
        newest_ns = self.newest_ns
        verdict = self._jump.judge(sample.stamp_ns, newest_ns)
        if verdict == "drop":
            return True
        if verdict == "restart":
            self.clear()
        if self._end == len(self._stamps):
            self._stamps[: len(self)] = self._stamps[self._start : self._end].copy()
            self._values[: len(self)] = self._values[self._start : self._end].copy()
            self._start, self._end = 0, len(self)
        at = self._end
        if newest_ns is not None and verdict == "take" and sample.stamp_ns <= newest_ns:
            at = self._place(sample.stamp_ns)
            if self._stamps[at] == sample.stamp_ns:
                return False
            self._stamps[at + 1 : self._end + 1] = self._stamps[at : self._end].copy()
            self._values[at + 1 : self._end + 1] = self._values[at : self._end].copy()
        self._stamps[at] = sample.stamp_ns
        self._values[at] = (*sample.accel_mps2, *sample.gyro_radps)
        self._end += 1
        oldest_ns = self._stamps[self._end - 1] - KEPT_NS
        while self._stamps[self._start] < oldest_ns or len(self) > MAX_SAMPLES:
            self._start += 1
        return True

    def clear(self) -> None:
        """Drop all samples: the clock was set back."""
        self._start = self._end = 0

    def between(self, start_ns: int, end_ns: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the samples from start_ns to end_ns, both included: stamps (N,), and (N, 6) m/s^2 and rad/s."""
        first, last = self._place(start_ns), self._place(end_ns, "right")
        return self._stamps[first:last].copy(), self._values[first:last].copy()

    def _place(self, stamp_ns: int, side: Literal["left", "right"] = "left") -> int:
        return self._start + int(np.searchsorted(self._stamps[self._start : self._end], stamp_ns, side))


def attitude_at(
    stream: SampleStream[Attitude], stamp_ns: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return q_ned_body_xyzw (4,) and sigma_rad (3,) at stamp_ns; None if no sample is near.

    Between two samples the quaternion is interpolated linearly and normalized: they are close, so slerp is not needed.
    """
    before, after = stream.around(stamp_ns)
    if before is not None and before.stamp_ns == stamp_ns:
        return np.array(before.q_ned_body_xyzw), np.array(before.sigma_rad)
    if before is not None and after is not None and after.stamp_ns - before.stamp_ns <= ATTITUDE_GAP_NS:
        share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        q_0, q_1 = np.array(before.q_ned_body_xyzw), np.array(after.q_ned_body_xyzw)
        if q_0 @ q_1 < 0:
            q_1 = -q_1
        q = (1 - share) * q_0 + share * q_1
        norm = math.sqrt(float(q @ q))
        return q / norm, np.maximum(before.sigma_rad, after.sigma_rad)
    near = min(
        (sample for sample in (before, after) if sample is not None),
        key=lambda sample: abs(sample.stamp_ns - stamp_ns),
        default=None,
    )
    if near is None or abs(near.stamp_ns - stamp_ns) > ATTITUDE_HOLD_NS:
        return None
    turned_rad = TURN_RATE_RADPS * abs(near.stamp_ns - stamp_ns) / S_NS
    return np.array(near.q_ned_body_xyzw), np.hypot(near.sigma_rad, turned_rad)


def depth_at(stream: SampleStream[Depth], stamp_ns: int) -> tuple[float, float] | None:
    """Return depth and its sigma (m) at stamp_ns; None if the sensor is stale.

    A line is fitted to 0.35 s of samples, which end DEPTH_LAG_NS before stamp_ns or earlier, and extrapolated.
    """
    end_ns = stamp_ns - DEPTH_LAG_NS
    newest, _ = stream.around(end_ns)
    if newest is None or newest.stamp_ns < end_ns - DEPTH_STALE_NS:
        return None
    samples = stream.between(newest.stamp_ns - DEPTH_FIT_NS, end_ns)
    ages_s = [(sample.stamp_ns - stamp_ns) / S_NS for sample in samples]
    depths_m = [sample.depth_m for sample in samples]
    sigma_m = max(sample.sigma_m for sample in samples)
    drift_m = DEPTH_DRIFT_MPS * -ages_s[-1]
    count = len(samples)
    if count < 3:
        return depths_m[-1], math.hypot(sigma_m, 2 * drift_m)
    middle_s = sum(ages_s) / count
    spread = sum((age_s - middle_s) ** 2 for age_s in ages_s)
    slope_mps = sum((age_s - middle_s) * depth_m for age_s, depth_m in zip(ages_s, depths_m, strict=True)) / spread
    variance = sigma_m * sigma_m * (1 / count + middle_s**2 / spread)
    return sum(depths_m) / count - slope_mps * middle_s, math.hypot(math.sqrt(variance), drift_m)
