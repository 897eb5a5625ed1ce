"""What the simulator knows of its inertial units, as an estimate is told it to find the bound."""

from __future__ import annotations

import math

from buddyline.node.sim.inertial import Grade

# A bias's wandering part of 1 sd (node/sim/inertial.WALK_S) changes in 10 s by as much as a walk of this density.
WALKED = 0.28


def walks_of(grade: Grade) -> tuple[float, float]:
    """Return how much the gyros' (rad/s per root s) and the accelerometers' biases (m/s^2 per root s) walk."""
    return WALKED * grade.gyro_walk_radps, WALKED * grade.accel_walk_mps2


def sigmas_of(grade: Grade) -> dict[str, float]:
    """Return the sigmas of biases, mount, lever arm and delay, by the names of the estimators' constants."""
    least_s, most_s = (ns * 1e-9 for ns in grade.delay_ns)
    return {
        "GYRO_BIAS_RADPS": math.hypot(grade.gyro_bias_radps, grade.gyro_walk_radps),
        "ACCEL_BIAS_MPS2": math.hypot(grade.accel_bias_mps2, grade.accel_walk_mps2),
        "MOUNT_RAD": grade.misalignment_rad / math.sqrt(3.0),
        "LEVER_TOLD_M": grade.lever_sigma_m,
        "DELAY_UNTOLD_S": max(math.hypot((least_s + most_s) / 2, (most_s - least_s) / math.sqrt(12.0)), 1e-6),
    }
