"""Whether an inertial unit says what its node says of it: units, axes, saturation. Of its turns, see gyros.py."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.strapdown import Bools

# Full scales of common gyroscopes: 125, 245, 250, 500, 1000 and 2000 deg/s. A value this near to one is clipped.
FULL_SCALES_RADPS: Final = np.radians((125.0, 245.0, 250.0, 500.0, 1000.0, 2000.0))
CLIPPED_SHARE: Final = 0.003
# A diver's accelerometer shows gravity within this over seconds.
LIGHTEST_MPS2: Final = 7.0
HEAVIEST_MPS2: Final = 13.0
# Beyond this angle between its gravity and the attitude's the unit stands otherwise than stated.
MISMOUNTED_RAD: Final = math.radians(30.0)
# Real samples have noise. So many that differ by less are one sample, sent again and again.
LEAST_STUCK: Final = 50
STUCK: Final = 1e-9


def clipped(rate_radps: Floats) -> Bools:
    """Which samples (N, 3) have an axis at the end of a gyroscope's scale (N,)."""
    size = np.abs(rate_radps)[..., None]
    at_end: Bools = (np.abs(size - FULL_SCALES_RADPS) < CLIPPED_SHARE * FULL_SCALES_RADPS).any(-1).any(-1)
    return at_end


def stuck(node: str, values: Floats) -> str | None:
    """Say which of seconds of force and rate (N, 6) never change; None where all do, or too few are there."""
    if len(values) < LEAST_STUCK:
        return None
    force, rate = (bool((np.ptp(each, axis=0) < STUCK).all()) for each in (values[:, :3], values[:, 3:6]))
    if not (force or rate):
        return None
    return stuck_words(node, force, rate)


def stuck_words(node: str, force: bool, rate: bool) -> str:
    """Say that a unit's force, its rate or both do not change."""
    which = "inertial" if force and rate else "accelerometer's" if force else "gyro's"
    return f"node {node}: the {which} samples do not change for seconds, as of a unit that is stuck; not used"


def stuck_runs(values: Floats) -> list[tuple[int, int]]:
    """Give first and last row of each run of at least LEAST_STUCK of the values (N, 3) that do not change."""
    changes = (np.abs(np.diff(values, axis=0)) >= STUCK).any(axis=1)
    ends = np.concatenate(((-1,), np.flatnonzero(changes), (len(values) - 1,)))
    return [(a + 1, b) for a, b in pairwise(ends.tolist()) if b - a >= LEAST_STUCK]


def fault_of(node: str, force_mps2: Floats, R_level_camera: Floats | None) -> str | None:
    """Say what is wrong with seconds of samples (N, 3), camera axes; None where nothing is, or too little is there.

    R_level_camera (N, 3, 3): each sample's, by the node's attitudes. In axes that turn with a node gravity's mean is
    small, and off the last attitude's.
    """
    if len(force_mps2) < 8:
        return None
    if R_level_camera is not None:
        force_mps2 = (R_level_camera @ force_mps2[:, :, None])[:, :, 0]
    mean = force_mps2.mean(axis=0)
    size = float(np.linalg.norm(mean))
    least = size if R_level_camera is not None else float(np.linalg.norm(force_mps2, axis=1).mean())
    if LIGHTEST_MPS2 / 9.80665 < least < HEAVIEST_MPS2 / 9.80665:
        return f"node {node}: the accelerometer shows {size:.2f} m/s^2 over seconds: g in place of m/s^2; not used"
    if least < LIGHTEST_MPS2 or size > HEAVIEST_MPS2:
        return f"node {node}: the accelerometer shows {size:.2f} m/s^2 over seconds, not gravity; not used"
    if R_level_camera is not None:
        angle = math.acos(max(-1.0, min(1.0, float(-mean[2]) / size)))
        if angle > MISMOUNTED_RAD:
            return (
                f"node {node}: the accelerometer's gravity is {math.degrees(angle):.0f} deg off the attitude's: "
                "the unit is mounted otherwise than stated; not used"
            )
    return None
