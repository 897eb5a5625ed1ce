"""Relative strapdown: both nodes' inertial samples move the state from one time to the next."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, skew
from buddyline.solver_service.track.shaking import SHAKEN_S, kept_share, shaking_noise
from buddyline.solver_service.track.state import (
    ACCEL_BIAS,
    DELAY,
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
    invariant_of_plain,
    orthonormal,
    plain_of_invariant,
)
from numpy.typing import NDArray

Bools: TypeAlias = NDArray[np.bool_]

# The specific force of a node that does not accelerate, level axes.
_AT_REST_MPS2: Final = np.array((0.0, 0.0, -9.80665))
_IDENTITY: Final[Floats] = np.eye(3)
_CONSTANT: Final = np.arange(SIZE) >= MOVING


@dataclass(frozen=True, eq=False)
class Noise:
    """Spectral densities of what drives one node: per sqrt(s) of the integral.

    gyro_rad, accel_mps: of the samples. gap_gyro_rad, gap_accel_mps: of the motion that no sample tells;
    gap_rate_radps, gap_tilt_rad, gap_heading_rad: without a unit, of the turn rate, which stands in place of the
    gyro's bias, and of the attitude filter's own error, which stands in place of the mount (by its stated sigmas,
    where it states any). gyro_bias_radps, accel_bias_mps2: of the biases' walk. A pair's track has learned walks, of
    the biases and without units (walking.py), the network these.
    """

    gyro_rad: float
    accel_mps: float
    gap_gyro_rad: float = 0.25
    gap_accel_mps: float = 0.3
    gap_rate_radps: float = 0.15
    gap_tilt_rad: float = 0.03
    gap_heading_rad: float = 0.012
    gyro_bias_radps: float = 2.5e-4
    accel_bias_mps2: float = 4e-3

    def scaled(self, unrest: float) -> Noise:
        """Return the same with the guessed motion's densities times unrest."""
        if unrest == 1.0:
            return self
        return replace(
            self,
            gap_accel_mps=unrest * self.gap_accel_mps,
            gap_rate_radps=unrest * self.gap_rate_radps,
            gap_gyro_rad=unrest * self.gap_gyro_rad,
        )


@dataclass(frozen=True, eq=False)
class Increment:
    """What one node's samples say between two times, and how its constants bear on it.

    R: its attitude at the end. dv_mps, dp_m (3,): its velocity gained, and its way gained over moving on unaccelerated
    (gravity left in: it cancels between the nodes). jacobian (9, SIZE): of attitude (left), dv, dp by the node's own
    attitude at the start and constants. gap_s: how much of the time no sample covers. rate_radps (3,): the turn rate
    at the end. without: whether there is no unit at all: the gyro's bias is then minus the turn rate. by_fast (9, 2):
    what a share of the fast part of force and of rate does to the same as the jacobian's rows; None where not known.
    sudden_rad: how far the camera itself may have turned as fast.
    """

    R: Floats
    dv_mps: Floats
    dp_m: Floats
    jacobian: Floats
    gap_s: float
    rate_radps: Floats
    without: bool = False
    by_fast: Floats | None = None
    sudden_rad: float = 0.0


def integrate(
    state: State,
    node: int,
    grid_s: Floats,
    force_mps2: Floats,
    rate_radps: Floats,
    told: Bools,
    slow_radps: Floats,
    fast: Floats | None = None,
) -> Increment:
    """Integrate one node's samples over a grid (M,) with values (M, 3) at its points, in camera axes, uncorrected.

    told (M - 1,): whether the accelerometer covers each interval; where not, the node moves on unaccelerated.
    slow_radps (2, 3): the turn rates at both ends without shaking, uncorrected. Delay and lever arm are told by them:
    by rates that are themselves shaken both would be fitted to the shaking. fast (M, 7): the fast part of force and
    rate, and the camera's sudden turn.
    """
    R0 = state.R[node]
    # Where no sample tells at all, bias and mount stand for other things (process_noise).
    mount = rotation_exp(state.mount_rad[node]) if told.any() else _IDENTITY
    w = (rate_radps - state.gyro_bias_radps[node]) @ mount.T
    f = (force_mps2 - state.accel_bias_mps2[node]) @ mount.T
    h = np.diff(grid_s)
    slow = (slow_radps - state.gyro_bias_radps[node]) @ mount.T
    w_mid, f_mid = 0.5 * (w[1:] + w[:-1]), 0.5 * (f[1:] + f[:-1])
    halves = rotation_exp(0.5 * h[:, None] * w_mid)
    starts, R = np.empty((len(h), 3, 3)), R0
    for j, turn in enumerate(halves @ halves):
        starts[j] = R
        R = R @ turn
    R, R_mid = orthonormal(R), starts @ halves
    # Once over all that is turned to level: mount, the crosses with rate and force, force.
    inner = np.empty((len(h), 3, 10))
    inner[:, :, 0:3], inner[:, :, 3:6], inner[:, :, 6:9] = mount, skew(w_mid), skew(f_mid)
    inner[:, :, 9] = f_mid
    turned = R_mid @ inner
    whole_told = bool(told.all())
    u = turned[:, :, 9] if whole_told else np.where(told[:, None], turned[:, :, 9], _AT_REST_MPS2)
    to_end = grid_s[-1] - 0.5 * (grid_s[1:] + grid_s[:-1])
    weights = np.stack((h, h * to_end))
    span = float(grid_s[-1] - grid_s[0])
    # Where no sample tells, the rates are an attitude filter's: it has a drift, but no mount, delay or lever arm.
    lever = state.lever_m[node] if whole_told else np.zeros(3)
    spin0, spin1 = np.array((R0, R)) @ skew(w[[0, -1]])
    arm0, arm1 = spin0 @ lever, spin1 @ lever
    swing = R @ lever - R0 @ lever - arm0 * span
    dv, dp = weights @ u
    dv = dv - (arm1 - arm0)
    dp = dp - swing

    # The attitude's error by gyro bias, mount and delay: at the middle of each interval, and at the end.
    passed = 1.0 - to_end / max(span, 1e-9)
    slow_turned = (R_mid @ (slow[0] + passed[:, None] * (slow[1] - slow[0]))[:, :, None])[:, :, 0]
    steps = turned[:, :, :6] * -h[:, None, None]
    if not whole_told:
        steps[:, :, 3:] *= told[:, None, None]
    whole = np.add.accumulate(steps, axis=0)
    by_attitude = np.empty((len(h), 3, 7))
    by_attitude[:, :, :6] = whole - 0.5 * steps
    by_attitude[:, :, 6] = (slow_turned - R0 @ slow[0]) * whole_told
    force_error = skew(-u) @ by_attitude
    force_error[:, :, 3:6] -= turned[:, :, 6:9]
    # Force changes as its axes turn, -w x f: gravity is nearly all of it.
    force_error[:, :, 6] += (skew(turned[:, :, 9]) @ slow_turned[:, :, None])[:, :, 0]
    of_force = weights * told
    both = (of_force @ force_error.reshape(len(h), 21)).reshape(2, 3, 7)
    by_bias = -(of_force @ turned[:, :, :3].reshape(len(h), 9)).reshape(2, 3, 3)
    # An error of attitude at the start turns all that the samples say, the lever arm's part excepted.
    by_turn = skew(np.array((arm1 - arm0, swing)) - of_force @ u)

    J = np.zeros((9, SIZE))
    J[0:3, PHI[node]] = _IDENTITY
    J[0:3, GYRO_BIAS[node]] = whole[-1, :, :3]
    J[0:3, MOUNT[node]] = whole[-1, :, 3:6]
    J[0:3, DELAY[node]] = (R @ slow[1] - R0 @ slow[0]) * whole_told
    for row, block in ((3, 0), (6, 1)):
        rows = slice(row, row + 3)
        J[rows, PHI[node]] = by_turn[block]
        J[rows, GYRO_BIAS[node]] = both[block][:, :3]
        J[rows, MOUNT[node]] = both[block][:, 3:6]
        J[rows, DELAY[node]] = both[block][:, 6]
        J[rows, ACCEL_BIAS[node]] = by_bias[block]
    # The lever arm's part is a difference of end points; of its errors, its own and the attitude's count.
    if whole_told:
        slow0, slow1 = np.array((R0, R)) @ skew(slow)
        J[3:6, LEVER[node]] = slow0 - slow1
        J[6:9, LEVER[node]] = R0 + slow0 * span - R
    gap = float(h @ ~told)
    by_fast = None
    if fast is not None and whole_told:
        fast_mid = 0.5 * (fast[1:] + fast[:-1])
        by_force, by_rate = (
            -(turned[:, :, :3] @ part[:, :, None])[:, :, 0] for part in (fast_mid[:, :3], fast_mid[:, 3:6])
        )
        turns = by_rate * h[:, None]
        swung = np.add.accumulate(turns, axis=0)
        tipped = np.cross(-u, swung - 0.5 * turns)
        by_fast = np.zeros((9, 2))
        by_fast[0:3, 1] = swung[-1]
        by_fast[3:9, 0] = (weights @ by_force).ravel()
        by_fast[3:9, 1] = (weights @ tipped).ravel()
    sudden_rad = 0.0 if fast is None else float(fast[:, 6].max())
    return Increment(R, dv, dp, J, gap, w[-1], by_fast=by_fast, sudden_rad=sudden_rad)


def propagate(state: State, parts: tuple[Increment, Increment], span_s: float) -> tuple[State, Floats]:
    """Move the state by both nodes' increments; return it and the rows (MOVING, SIZE) of its transition that are not 1.

    The errors are those of `State.plus`, at both ends. What the units were shaken by at the start is in the increments;
    a share of it is still there at the end (shaking.py).
    """
    a, b = parts
    kept = kept_share(span_s)
    dv, dp = b.dv_mps - a.dv_mps, b.dp_m - a.dp_m
    gone, back_s = 1.0 - kept, span_s - SHAKEN_S * (1.0 - kept)
    # Without a unit nothing is shaken.
    felt = np.array([not part.without for part in parts], dtype=np.float64)
    shake = felt[:, None] * state.shake_rad
    shove = felt.max() * state.shove_mps
    off = rotation_exp((state.R @ shake[:, :, None])[:, :, 0])
    R = off @ np.stack((a.R, b.R)) @ rotation_exp(-kept * shake)
    after = replace(
        state,
        r_m=state.r_m + state.v_mps * span_s + back_s * shove + dp,
        v_mps=state.v_mps + gone * shove + dv,
        R=R,
        shake_rad=kept * state.shake_rad,
        shove_mps=kept * state.shove_mps,
    )
    F = np.zeros((MOVING, SIZE))
    F[R_] = b.jacobian[6:9] - a.jacobian[6:9]
    F[V_] = b.jacobian[3:6] - a.jacobian[3:6]
    F[PHI[0]], F[PHI[1]] = a.jacobian[0:3], b.jacobian[0:3]
    F[R_, R_] = F[V_, V_] = _IDENTITY
    F[R_, V_] = span_s * _IDENTITY
    F[R_, SHOVE] = felt.max() * back_s * _IDENTITY
    F[V_, SHOVE] = felt.max() * gone * _IDENTITY
    F[SHOVE, SHOVE] = kept * _IDENTITY
    for node in (0, 1):
        F[PHI[node], SHAKE[node]] = felt[node] * (state.R[node] - kept * R[node])
        F[SHAKE[node], SHAKE[node]] = kept * _IDENTITY
    F[:, :MOVING] = F[:, :MOVING] @ plain_of_invariant(state)
    return after, invariant_of_plain(after) @ F


def moved_by_shares(after: State, parts: tuple[Increment, Increment]) -> Floats:
    """Give how a step's end is moved by a share of 1 of each fast part (MOVING, 4), in the errors of `State.plus`."""
    moved = np.zeros((MOVING, 4))
    for node, part in enumerate(parts):
        if part.by_fast is not None:
            columns = slice(2 * node, 2 * node + 2)
            sign = 1.0 if node else -1.0
            moved[PHI[node], columns] = part.by_fast[0:3]
            moved[V_, columns] = sign * part.by_fast[3:6]
            moved[R_, columns] = sign * part.by_fast[6:9]
    return invariant_of_plain(after) @ moved


def process_noise(
    after: State, parts: tuple[Increment, Increment], noises: tuple[Noise, Noise], shaking: Floats, span_s: float
) -> tuple[Floats, Floats, Floats]:
    """Give what a step adds to the covariance: of the moving errors (MOVING, MOVING), and of each other error
    (SIZE-MOVING,); and the parts in the first that shaking of the variances (3,) adds, (3, MOVING, MOVING)."""
    a, b = parts
    Q = np.zeros((MOVING, MOVING))
    walk = np.zeros(SIZE)
    force = 0.0
    for node, (part, noise) in enumerate(zip(parts, noises, strict=True)):
        force += noise.accel_mps**2 * span_s
        walk[ACCEL_BIAS[node]] = noise.accel_bias_mps2**2 * span_s
        if not part.without:
            force += noise.gap_accel_mps**2 * part.gap_s
            turn = noise.gyro_rad**2 * span_s + noise.gap_gyro_rad**2 * part.gap_s
            Q[PHI[node], PHI[node]] = turn * _IDENTITY
            walk[GYRO_BIAS[node]] = noise.gyro_bias_radps**2 * span_s
    _accelerated(Q, force, span_s)
    if a.without or b.without:
        whole = guessed_noise(parts, noises, span_s).sum(axis=0)
        Q += whole[:MOVING, :MOVING]
        walk += np.diag(whole) * _CONSTANT
    shaken = shaking_noise(after.R, shaking, span_s)
    for k, without in enumerate((a.without, b.without, a.without and b.without)):
        if without:
            shaken[k, :NAV] = shaken[k, :, :NAV] = 0.0
    T = invariant_of_plain(after)
    shaken = T @ shaken @ T.T
    return T @ Q @ T.T + shaken.sum(axis=0), walk[MOVING:], shaken


def guessed_noise(parts: tuple[Increment, Increment], noises: tuple[Noise, Noise], span_s: float) -> Floats:
    """Give what a step adds to the plain errors' covariance where nodes have no unit, (3, SIZE, SIZE).

    By their acceleration, by their turn rates' walk, and by that of their attitudes' slow error.
    """
    guessed = np.zeros((3, SIZE, SIZE))
    force = 0.0
    for node, (part, noise) in enumerate(zip(parts, noises, strict=True)):
        if part.without:
            force += noise.gap_accel_mps**2 * part.gap_s
            rate = noise.gap_rate_radps**2 * _IDENTITY
            guessed[1, PHI[node], PHI[node]] = span_s**3 / 3.0 * rate
            guessed[1, GYRO_BIAS[node], GYRO_BIAS[node]] = span_s * rate
            tilt, heading = noise.gap_tilt_rad**2, noise.gap_heading_rad**2
            guessed[2, MOUNT[node], MOUNT[node]] = span_s * np.diag((tilt, tilt, heading))
    _accelerated(guessed[0], force, span_s)
    return guessed


def _accelerated(Q: Floats, force: float, span_s: float) -> None:
    """Enter what a velocity's walk, of a variance (m/s)^2 by the step's end, adds to a covariance."""
    Q[V_, V_] = force * _IDENTITY
    Q[R_, V_] = Q[V_, R_] = 0.5 * span_s * force * _IDENTITY
    Q[R_, R_] = span_s * span_s / 3.0 * force * _IDENTITY


def predicted(P: Floats, F: Floats, Q: Floats, walk: Floats) -> Floats:
    """Give the covariance (SIZE, SIZE) after a step with the transition's rows F (MOVING, SIZE)."""
    across = F @ P
    after = P.copy()
    after[:MOVING, :MOVING] = across @ F.T + Q
    after[:MOVING, MOVING:] = across[:, MOVING:]
    after[MOVING:, :MOVING] = across[:, MOVING:].T
    index = np.arange(MOVING, SIZE)
    after[index, index] += walk
    return after
