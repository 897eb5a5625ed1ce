"""Attitude and depth of a node at the instant of a frame, from the samples around or before it."""

from __future__ import annotations

import bisect
import math
from collections import deque
from typing import Final, Generic, TypeVar

import numpy as np
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.messages import Attitude, Depth
from numpy.typing import NDArray

# Samples further back than this come of a clock that has been set.
HORIZON_NS: Final = 20 * S_NS
# After an outage a node's samples wait for the other node's frames: as far as the nodes' caches reach.
KEPT_NS: Final = 60 * S_NS
MAX_SAMPLES: Final = 8192
SENSOR_WAIT_NS: Final = 3 * S_NS

# An attitude is interpolated between neighbours at most this far apart, or held at most this long.
ATTITUDE_GAP_NS: Final = 300 * MS_NS
ATTITUDE_HOLD_NS: Final = 100 * MS_NS
# A held attitude ages by a diver's ordinary turning.
TURN_RATE_RADPS: Final = 0.2

# Depth comes at 10 to 20 Hz: a frame never waits for the next sample, it uses those up to 100 ms before.
DEPTH_LAG_NS: Final = 100 * MS_NS
DEPTH_FIT_NS: Final = 350 * MS_NS
DEPTH_STALE_NS: Final = 1 * S_NS
# What a linear fit leaves of a diver's vertical motion, per second of extrapolation.
DEPTH_DRIFT_MPS: Final = 0.1

S = TypeVar("S", Attitude, Depth)


class SampleStream(Generic[S]):
    """Samples of one sensor by time, bounded; `lag_ns`: how far before a frame its samples may end."""

    def __init__(self, lag_ns: int) -> None:
        self._lag_ns = lag_ns
        self._stamps: list[int] = []
        self._samples: list[S] = []
        self._recent_back: deque[int] = deque(maxlen=5)

    def add(self, sample: S) -> None:
        """Take one sample, in any order."""
        if self._stamps and sample.stamp_ns < self._stamps[-1] - HORIZON_NS:
            # A clock that jumped back is believed once it goes on from there.
            self._recent_back.append(sample.stamp_ns)
            if len(self._recent_back) < 5:
                return
            self.clear()
        elif not self._recent_back or sample.stamp_ns > self._recent_back[-1] + HORIZON_NS:
            self._recent_back.clear()
        at = bisect.bisect_left(self._stamps, sample.stamp_ns)
        if at < len(self._stamps) and self._stamps[at] == sample.stamp_ns:
            return
        self._stamps.insert(at, sample.stamp_ns)
        self._samples.insert(at, sample)
        if len(self._stamps) > MAX_SAMPLES or self._stamps[0] < self._stamps[-1] - 2 * KEPT_NS:
            keep = max(bisect.bisect_left(self._stamps, self._stamps[-1] - KEPT_NS), len(self._stamps) - MAX_SAMPLES)
            del self._stamps[:keep], self._samples[:keep]

    def clear(self) -> None:
        """Forget all samples."""
        self._stamps.clear()
        self._samples.clear()
        self._recent_back.clear()

    def covers(self, stamp_ns: int, first_frame_ns: int, newest_frame_ns: int, held_up: bool) -> bool:
        """Whether what matters for a frame at stamp_ns is here, or is not going to come.

        first_frame_ns, newest_frame_ns: the node's frames so far; a sensor that stays behind them for three
        seconds of the dive is not waited for any longer. held_up: whether its samples may still be on their way; then
        one that has sent any is.
        """
        newest_ns = self._stamps[-1] if self._stamps else first_frame_ns
        stopped = newest_frame_ns - newest_ns > SENSOR_WAIT_NS and not (held_up and self._stamps)
        return stopped or newest_ns >= stamp_ns - self._lag_ns

    def around(self, stamp_ns: int) -> tuple[S | None, S | None]:
        """Return the samples at or before, and after, stamp_ns."""
        at = bisect.bisect_right(self._stamps, stamp_ns)
        before = self._samples[at - 1] if at else None
        after = self._samples[at] if at < len(self._samples) else None
        return before, after

    def between(self, start_ns: int, end_ns: int) -> list[S]:
        """Return the samples from start_ns to end_ns, both included."""
        return self._samples[bisect.bisect_left(self._stamps, start_ns) : bisect.bisect_right(self._stamps, end_ns)]


def attitude_at(
    stream: SampleStream[Attitude], stamp_ns: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return q_ned_body_xyzw (4,) and sigma_rad (3,) at stamp_ns, None where no sample is near.

    Between two samples it turns at a constant rate (slerp; samples are close, so the chord serves).
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
    """Return depth and its standard deviation (m) at stamp_ns, None where the sensor is stale.

    A line through the samples of the last 0.35 s that may be used, carried on to stamp_ns.
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
