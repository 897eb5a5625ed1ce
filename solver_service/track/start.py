"""How a track starts: gravity gives tilt, a fix gives all else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.anchors import attitude_covariance
from buddyline.solver_service.track.inputs import AttitudeSeen, FixSeen, TrackNode
from buddyline.solver_service.track.output import of_offset
from buddyline.solver_service.track.shaking import SHAKE_RAD, SHOVE_MPS, Shaking
from buddyline.solver_service.track.state import (
    ACCEL_BIAS,
    CLOCK,
    DELAY,
    DEPTH_OFFSET,
    DEPTH_SCALE,
    GYRO_BIAS,
    LEVER,
    MOUNT,
    MOVING,
    NAV,
    PHI,
    R_,
    SHAKE,
    SHOVE,
    SIZE,
    V_,
    State,
    of_place,
)

# What is believed before the dive tells more, 1 sd.
SPEED_MPS: Final = 0.6
GYRO_BIAS_RADPS: Final = 0.008
ACCEL_BIAS_MPS2: Final = 0.15
MOUNT_RAD: Final = math.radians(1.0)
LEVER_TOLD_M: Final = 0.006
LEVER_UNTOLD_M: Final = 0.05
DELAY_TOLD_S: Final = 0.001
DELAY_UNTOLD_S: Final = 0.004
CLOCK_S: Final = 0.1
DEPTH_OFFSET_M: Final = 0.2
# Both gauges are told one density of the water; the sea's is 3 % above that of fresh water.
DEPTH_SCALE_SIGMA: Final = 0.015
# A later pass starts with BROAD_SIGMAS of what an earlier one has left, at least LEAST_BROAD in each error, and no more
# than the first two: the lights count anew.
BROAD_R_M: Final = 0.5
BROAD_TURN_RAD: Final = 0.15
BROAD_SIGMAS: Final = 4.0
LEAST_BROAD: Final = 0.005


def constants_of(
    nodes: tuple[TrackNode, TrackNode], R: Floats, r_m: Floats, clock_sigma_s: float = CLOCK_S
) -> tuple[State, Floats]:
    """Give a state at r_m (3,), R (2, 3, 3), at rest, with the constants as told, and the variances (SIZE,) of all
    but position and attitude."""
    state = State.at_rest(r_m, R).with_parts(
        lever_m=np.stack([np.zeros(3) if node.imu_m is None else node.imu_m for node in nodes]),
        delay_s=np.array([(node.imu_delay_ns or 0) * 1e-9 for node in nodes]),
    )
    sigma = np.zeros(SIZE)
    sigma[V_] = SPEED_MPS
    sigma[SHOVE] = SHOVE_MPS
    for i, node in enumerate(nodes):
        sigma[SHAKE[i]] = SHAKE_RAD
        sigma[GYRO_BIAS[i]] = GYRO_BIAS_RADPS
        sigma[ACCEL_BIAS[i]] = ACCEL_BIAS_MPS2
        sigma[MOUNT[i]] = MOUNT_RAD
        sigma[LEVER[i]] = LEVER_UNTOLD_M if node.imu_m is None else LEVER_TOLD_M
        sigma[DELAY[i]] = DELAY_UNTOLD_S if node.imu_delay_ns is None else DELAY_TOLD_S
    sigma[CLOCK] = clock_sigma_s
    sigma[DEPTH_OFFSET], sigma[DEPTH_SCALE] = DEPTH_OFFSET_M, DEPTH_SCALE_SIGMA
    return state, sigma**2


def enter_attitudes(P: Floats, of_a: Floats, relative: Floats) -> None:
    """Enter attitudes into a covariance: A's errs by of_a (3, 3), and B's by as much and by relative against A."""
    P[PHI[0], PHI[0]] = P[PHI[0], PHI[1]] = P[PHI[1], PHI[0]] = of_a
    P[PHI[1], PHI[1]] = of_a + relative


def broad_covariance(
    nodes: tuple[TrackNode, TrackNode],
    state: State,
    clock_sigma_s: float,
    known: Floats | None = None,
    shaking: Shaking | None = None,
    place_m: float = BROAD_R_M,
) -> Floats:
    """Give the covariance (SIZE, SIZE) of a state to start again from: it holds next to nothing of the lights yet.

    known (SIZE, SIZE): its covariance by an earlier pass, of which BROAD_SIGMAS are kept: from a broader start the
    first updates would be far from linear. shaking: as it was learned. place_m: 1 sd of the place.
    """
    _, variances = constants_of(nodes, state.R, state.r_m, clock_sigma_s)
    if shaking is not None:
        variances[NAV:MOVING] = np.repeat(shaking.variances, 3)
    P = np.diag(variances)
    P[R_, R_] = place_m**2 * np.eye(3)
    turn = BROAD_TURN_RAD**2 * np.eye(3)
    enter_attitudes(P, turn, turn)
    P = of_place(state, P)
    if known is not None:
        least = np.diag([LEAST_BROAD**2] * NAV)
        narrow = BROAD_SIGMAS**2 * known[:NAV, :NAV] + least
        P[:NAV, :NAV] = P[:NAV, :NAV] @ np.linalg.solve(P[:NAV, :NAV] + narrow, narrow)
        P = 0.5 * (P + P.T)
    return P


def tilt_of(force_mps2: Floats) -> Floats | None:
    """Give R_level_camera (3, 3) of a camera at rest by its specific force (3,), heading north; None where it tells
    nothing."""
    size = float(np.linalg.norm(force_mps2))
    if not 5.0 < size < 15.0:
        return None
    down = -force_mps2 / size
    ahead = np.array((0.0, 0.0, 1.0)) if abs(down[2]) < 0.9 else np.array((0.0, -1.0, 0.0))
    north = ahead - down * float(down @ ahead)
    north = north / np.linalg.norm(north)
    return np.stack((north, np.cross(down, north), down))


def state_from_fix(
    nodes: tuple[TrackNode, TrackNode],
    fix: FixSeen,
    attitude: AttitudeSeen | None,
    force_mps2: Floats | None,
    rates_radps: Sequence[Floats | None],
    clock_sigma_s: float,
) -> tuple[State, Floats] | None:
    """Start from a fix, with A's attitude by its message or else its accelerometer; None where neither tells.

    R_B = R_A R_a_b, r = R_A t: r errs by R_A dt, and phi_B = phi_A + R_A w. An unknown offset of the clocks adds to
    both (output.as_a_fix_sees_it). rates_radps: A's and B's turn rates (3,), None where a node has no inertial unit.
    Then nothing is added: such a start would drift off by guessed motion.
    """
    if attitude is not None:
        R_A = attitude.R_ned_body @ nodes[0].rig.R_body_camera
        level = attitude_covariance(attitude.R_ned_body, attitude.sigma_rad, 1.0, 1.0)
    else:
        tilt = None if force_mps2 is None else tilt_of(force_mps2)
        if tilt is None:
            return None
        R_A, level = tilt, np.diag((0.05, 0.05, math.pi)) ** 2
    state, variances = constants_of(nodes, np.stack((R_A, R_A @ fix.R_a_b)), R_A @ fix.t_a_b_m, clock_sigma_s)
    P = np.diag(variances)
    turn = np.kron(np.eye(2), R_A)
    # A fix's own covariance is the least; what it leaves out (frames apart, calibration) is a little more.
    from_fix = turn @ fix.covariance @ turn.T + np.diag([1e-4] * 3 + [1e-5] * 3)
    P[R_, R_] = from_fix[:3, :3]
    enter_attitudes(P, level, from_fix[3:, 3:])
    P[R_, PHI[1]] = from_fix[:3, 3:]
    P[PHI[1], R_] = from_fix[3:, :3]
    told = [R @ rate for R, rate in zip(state.R, rates_radps, strict=True) if rate is not None]
    if len(told) == 2:
        P += clock_sigma_s**2 * _by_unknown_clock(state, told[0] + told[1])
    return state, of_place(state, P)


def _by_unknown_clock(state: State, turning_radps: Floats) -> Floats:
    """Give what a clock offset of 1 s (1 sd) adds to the covariance (SIZE, SIZE) of a fix's plain errors.

    The offset's own variance is left out. The velocity is unknown, SPEED_MPS (1 sd). turning_radps (3,): the sum of
    both nodes' turn rates, level.
    """
    moved, swept, half_along = of_offset(state.r_m)
    by_way = np.zeros((SIZE, 3))
    by_way[R_], by_way[PHI[1]] = -moved, -swept
    by_clock = np.zeros(SIZE)
    by_clock[PHI[1]] = -half_along @ turning_radps
    covariance: Floats = SPEED_MPS**2 * by_way @ by_way.T + np.outer(by_clock, by_clock)
    covariance[CLOCK], covariance[:, CLOCK] = by_clock, by_clock
    return covariance
