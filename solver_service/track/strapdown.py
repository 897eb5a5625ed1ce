"""Relative strapdown: both nodes' inertial samples move the state from one time to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Final, NamedTuple, Protocol, TypeAlias

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


class Noise(NamedTuple):
    """Spectral densities of what drives one node: per sqrt(s) of the integral.

    gyro_rad, accel_mps: of the samples. gap_gyro_rad, gap_accel_mps: of the motion that no sample tells;
    gap_rate_radps, gap_tilt_rad, gap_heading_rad: without a unit, of the turn rate, which stands in place of the
    gyro's bias, and of the attitude filter's own error, which stands in place of the mount (by its stated sigmas,
    where it states any); tilt_rad: the sigma of its tilt, which a pair's track lets it not exceed (`kept_shares`).
    gyro_bias_radps, accel_bias_mps2: of the biases' walk. A pair's track has learned walks, of the biases and without
    units (walking.py), the network these.
    """

    gyro_rad: float
    accel_mps: float
    gap_gyro_rad: float = 0.25
    gap_accel_mps: float = 0.3
    gap_rate_radps: float = 0.15
    gap_tilt_rad: float = 0.03
    gap_heading_rad: float = 0.012
    tilt_rad: float = 0.03
    gyro_bias_radps: float = 2.5e-4
    accel_bias_mps2: float = 4e-3

    def scaled(self, unrest: float) -> Noise:
        """Return the same with the guessed motion's densities times unrest."""
        if unrest == 1.0:
            return self
        return self._replace(
            gap_accel_mps=unrest * self.gap_accel_mps,
            gap_rate_radps=unrest * self.gap_rate_radps,
            gap_gyro_rad=unrest * self.gap_gyro_rad,
        )


# Where an increment's errors stand in its Jacobian: of the node's own attitude and constants.
_PHI, _GYRO_BIAS, _ACCEL_BIAS, _MOUNT, _LEVER = (slice(k, k + 3) for k in range(0, 15, 3))
_DELAY: Final = 15
OWN: Final = 16
# Where a pair's increments, their rows and columns as in their Jacobians, stand in its transition. A's motion counts
# against B's.
_ROWS: Final = np.array([np.r_[PHI[node], V_, R_] for node in (0, 1)])[:, :, None]
_COLUMNS: Final = np.array(
    [np.r_[PHI[node], GYRO_BIAS[node], ACCEL_BIAS[node], MOUNT[node], LEVER[node], DELAY[node]] for node in (0, 1)]
)[:, None, :]
_SIGNS: Final = np.ones((2, 9, 1))
_SIGNS[0, 3:] = -1.0


class Carried(Protocol):
    """What the strapdown of nodes (N) starts from: attitudes (N, 3, 3), and constants (N, 3), (N,)."""

    @property
    def R(self) -> Floats:
        """Of each camera to level."""

    @property
    def gyro_bias_radps(self) -> Floats:
        """Camera axes, as all constants."""

    @property
    def accel_bias_mps2(self) -> Floats:
        """What the accelerometers show too much."""

    @property
    def mount_rad(self) -> Floats:
        """The small turns from the units' axes, as stated, to the true ones."""

    @property
    def lever_m(self) -> Floats:
        """The units' places."""

    @property
    def delay_s(self) -> Floats:
        """The units' stamps minus true time."""


@dataclass(frozen=True, eq=False)
class NodesCarried:
    """What nodes (N) start from that are not those of one state."""

    R: Floats
    gyro_bias_radps: Floats
    accel_bias_mps2: Floats
    mount_rad: Floats
    lever_m: Floats
    delay_s: Floats


@dataclass(frozen=True, eq=False)
class SampleGrid:
    """Samples of nodes (N) between two times, at points (M) of each node's own grid, in camera axes, uncorrected.

    times_s (N, M); values (N, M, 6): force and rate there. told (N, M - 1): whether the accelerometer covers each
    interval; where not, the node moves on unaccelerated. onward_radps (N, 3): the turn rates by which nodes are carried
    on from the end. slow_radps (N, 2, 3): the turn rates at both ends without shaking. Delay and lever arm are told by
    them: by rates that are themselves shaken both would be fitted to the shaking. fast (N, M, 6): the fast part of the
    values; None where it is not asked for.
    """

    times_s: Floats
    values: Floats
    told: Bools
    onward_radps: Floats
    slow_radps: Floats
    fast: Floats | None = None


@dataclass(frozen=True, eq=False)
class Increments:
    """What nodes' samples (N nodes) say between two times, and how their constants bear on it.

    R (N, 3, 3): attitudes at the end. dv_mps, dp_m (N, 3): velocity gained, and way gained over moving on
    unaccelerated (gravity left in: it cancels between the nodes). jacobian (N, 9, OWN): of attitude (left), dv, dp by
    the node's own attitude at the start, gyro bias, accelerometer bias, mount, lever arm and delay. gap_s (N,): how
    much of the time no sample covers. rate_radps (N, 3): the turn rates at the end. by_fast (N, 9, 2): what a share of
    the fast part of force and of rate does to the same as the jacobian's rows; None where not known. without (N,):
    whether there is no unit at all: the gyro's bias is then minus the turn rate. sudden_rad (N,): how far the camera
    itself may have turned as fast.
    """

    R: Floats
    dv_mps: Floats
    dp_m: Floats
    jacobian: Floats
    gap_s: Floats
    rate_radps: Floats
    by_fast: Floats | None
    without: Bools
    sudden_rad: Floats


def integrate(state: Carried, grid: SampleGrid) -> Increments:
    """Integrate the samples of nodes (N), each over its own grid."""
    R0, t, told = state.R, grid.times_s, grid.told
    count, points = t.shape
    # 1 for nodes whose intervals are all told.
    whole: Floats = np.asarray(told.all(axis=1, keepdims=True), np.float64)
    # Where no sample tells at all, bias and mount stand for other things (process_noise).
    mount = rotation_exp(state.mount_rad * told.any(axis=1, keepdims=True))
    to_true = mount.swapaxes(1, 2)
    biases = np.concatenate((state.accel_bias_mps2, state.gyro_bias_radps), axis=1)
    unbiased = (grid.values - biases[:, None]).reshape(count, 2 * points, 3)
    values = (unbiased @ to_true).reshape(count, points, 6)
    rates = np.concatenate((grid.onward_radps[:, None], grid.slow_radps), axis=1)
    rates = (rates - state.gyro_bias_radps[:, None]) @ to_true
    onward, slow = rates[:, :1], rates[:, 1:]
    h = t[:, 1:] - t[:, :-1]
    middle = 0.5 * (values[:, 1:] + values[:, :-1])
    f_mid, w_mid = middle[:, :, :3], middle[:, :, 3:]
    halves = rotation_exp(0.5 * h[:, :, None] * w_mid)
    turns = halves @ halves
    starts, R = np.empty_like(turns), R0
    for j in range(points - 1):
        starts[:, j] = R
        R = R @ turns[:, j]
    R, R_mid = orthonormal(R), starts @ halves
    # Once over all that is turned to level: mount, the crosses with rate and force, force.
    inner = np.empty((count, points - 1, 3, 10))
    inner[..., 0:3], inner[..., 9] = mount[:, None], f_mid
    crosses = skew(middle.reshape(count, points - 1, 2, 3))
    inner[..., 3:6], inner[..., 6:9] = crosses[:, :, 1], crosses[:, :, 0]
    turned = R_mid @ inner
    u = np.where(told[:, :, None], turned[..., 9], _AT_REST_MPS2)
    to_end = t[:, -1:] - 0.5 * (t[:, 1:] + t[:, :-1])
    weights = np.empty((count, 2, points - 1))
    weights[:, 0], weights[:, 1] = h, h * to_end
    span = t[:, -1:] - t[:, :1]
    # Where no sample tells, the rates are an attitude filter's: it has a drift, but no mount, delay or lever arm.
    ends = np.empty((count, 2, 3, 3))
    ends[:, 0], ends[:, 1] = R0, R
    lever = (state.lever_m * whole)[:, None, :, None]
    arms = (ends @ skew(values[:, [0, -1], 3:]) @ lever)[..., 0]
    placed = (ends @ lever)[..., 0]
    swept = np.empty((count, 2, 3))
    swept[:, 0], swept[:, 1] = arms[:, 1] - arms[:, 0], placed[:, 1] - placed[:, 0] - arms[:, 0] * span
    gained = weights @ u - swept

    # The attitude's error by gyro bias, mount and delay: at the middle of each interval, and at the end.
    passed = 1.0 - to_end / np.maximum(span, 1e-9)
    slow_mid = slow[:, :1] + passed[:, :, None] * (slow[:, 1:] - slow[:, :1])
    slow_turned = (R_mid @ slow_mid[..., None])[..., 0]
    slow_ends = (ends @ slow[..., None])[..., 0]
    steps = turned[..., :6] * -h[:, :, None, None]
    steps[..., 3:] *= told[:, :, None, None]
    summed = np.add.accumulate(steps, axis=1)
    by_attitude = np.empty((count, points - 1, 3, 7))
    by_attitude[..., :6] = summed - 0.5 * steps
    by_attitude[..., 6] = (slow_turned - slow_ends[:, :1]) * whole[:, :, None]
    by_turning = skew(-u)
    force_error = by_turning @ by_attitude
    force_error[..., 3:6] -= turned[..., 6:9]
    # Force changes as its axes turn, -w x f: gravity is nearly all of it.
    force_error[..., 6] += (skew(turned[..., 9]) @ slow_turned[..., None])[..., 0]
    of_force = weights * told[:, None]
    both = (of_force @ force_error.reshape(count, points - 1, 21)).reshape(count, 2, 3, 7)

    J = np.zeros((count, 9, OWN))
    J[:, 0:3, _PHI] = _IDENTITY
    J[:, 0:3, _GYRO_BIAS] = summed[:, -1, :, :3]
    J[:, 0:3, _MOUNT] = summed[:, -1, :, 3:]
    J[:, 0:3, _DELAY] = (slow_ends[:, 1] - slow_ends[:, 0]) * whole
    moved = np.zeros((count, 2, 3, OWN))
    # An error of attitude at the start turns all that the samples say, the lever arm's part excepted.
    moved[..., _PHI] = skew(swept - of_force @ u)
    moved[..., _GYRO_BIAS], moved[..., _MOUNT], moved[..., _DELAY] = both[..., :3], both[..., 3:6], both[..., 6]
    by_bias = of_force @ turned[..., :3].reshape(count, points - 1, 9)
    moved[..., _ACCEL_BIAS] = -by_bias.reshape(count, 2, 3, 3)
    # The lever arm's part is a difference of end points; of its errors, its own and the attitude's count.
    spun = ends @ skew(slow) * whole[:, :, None, None]
    moved[:, 0, :, _LEVER] = spun[:, 0] - spun[:, 1]
    moved[:, 1, :, _LEVER] = (R0 - R) * whole[:, :, None] + spun[:, 0] * span[:, :, None]
    J[:, 3:] = moved.reshape(count, 6, OWN)

    by_fast = None
    if grid.fast is not None and whole.any():
        fast_mid = 0.5 * (grid.fast[:, 1:] + grid.fast[:, :-1]).reshape(count, points - 1, 2, 3)
        by_share = -(turned[..., :3] @ fast_mid.swapaxes(2, 3))
        by_turn = by_share[..., 1] * h[:, :, None]
        swung = np.add.accumulate(by_turn, axis=1)
        tipped = (by_turning @ (swung - 0.5 * by_turn)[..., None])[..., 0]
        by_fast = np.zeros((count, 9, 2))
        by_fast[:, 0:3, 1] = swung[:, -1]
        by_fast[:, 3:, 0] = (weights @ by_share[..., 0]).reshape(count, 6)
        by_fast[:, 3:, 1] = (weights @ tipped).reshape(count, 6)
        by_fast *= whole[:, :, None]
    return Increments(
        R=R,
        dv_mps=gained[:, 0],
        dp_m=gained[:, 1],
        jacobian=J,
        gap_s=np.add.reduce(h * ~told, axis=1),
        rate_radps=onward[:, 0],
        by_fast=by_fast,
        without=np.zeros(count, dtype=bool),
        sudden_rad=np.zeros(count),
    )


def of_nodes(states: State) -> NodesCarried:
    """Give what the nodes (2 N) of a batch of pairs' states (N) start from."""
    every = (getattr(states, each.name) for each in fields(NodesCarried))
    return NodesCarried(*(each.reshape(-1, *each.shape[2:]) for each in every))


def of_pairs(found: Increments) -> Increments:
    """Give the increments of nodes (2 N) as those of a batch of pairs: each array (N, 2, ...)."""
    told = {name: each for name, each in vars(found).items() if each is not None}
    return replace(found, **{name: each.reshape(-1, 2, *each.shape[1:]) for name, each in told.items()})


def kept_shares(without: Bools, noises: tuple[Noise, Noise], span_s: float) -> Floats:
    """Give the shares (2,) of the units' angles in their mounts that are left after a step.

    Where there is no unit, the angle is how far an attitude filter's tilt is off. It changes within seconds, but stays
    as large as stated: it decays as fast as fits its walk, with the time constant 2 tilt^2 / walk^2.
    """
    swings = [math.exp(-0.5 * span_s * (noise.gap_tilt_rad / max(noise.tilt_rad, 1e-9)) ** 2) for noise in noises]
    return np.where(without, swings, kept_share(span_s))


def propagate(
    state: State, parts: Increments, span_s: float | Floats, shares: Floats | None = None
) -> tuple[State, Floats]:
    """Move the state by both nodes' increments; return it and the rows (MOVING, SIZE) of its transition that are not 1.

    The errors are those of `State.plus`, at both ends. What the units were shaken by at the start is in the increments;
    a share of it is still there at the end (shaking.py). shares (2,): of the angles, as `kept_shares` gives them; 0
    where an angle has nothing to do with what it was. By default both nodes have a unit. A batch of states has leading
    axes, and so have increments, spans and shares.
    """
    span = np.asarray(span_s)[..., None]
    kept = kept_share(span)
    kept_angle = np.repeat(kept, 2, axis=-1) if shares is None else shares
    dv, dp = (moved[..., 1, :] - moved[..., 0, :] for moved in (parts.dv_mps, parts.dp_m))
    # Without a unit nothing is shaken.
    felt = (~parts.without & (kept_angle > 0.0)).astype(np.float64)
    any_felt = felt.max(axis=-1, keepdims=True)
    gone, back_s = any_felt * (1.0 - kept), any_felt * (span - SHAKEN_S * (1.0 - kept))
    shake = felt[..., None] * state.shake_rad
    off = rotation_exp((state.R @ shake[..., None])[..., 0])
    R = off @ parts.R @ rotation_exp(-kept_angle[..., None] * shake)
    after = state.moved(
        state.r_m + state.v_mps * span + back_s * state.shove_mps + dp, state.v_mps + gone * state.shove_mps + dv, R
    )
    after.shake_rad[...] *= kept_angle[..., None]
    after.shove_mps[...] *= kept
    F = np.zeros((*parts.without.shape[:-1], MOVING, SIZE))
    F[..., _ROWS, _COLUMNS] = _SIGNS * parts.jacobian
    F[..., R_, R_] = F[..., V_, V_] = _IDENTITY
    F[..., R_, V_] = span[..., None] * _IDENTITY
    F[..., R_, SHOVE] = back_s[..., None] * _IDENTITY
    F[..., V_, SHOVE] = gone[..., None] * _IDENTITY
    F[..., SHOVE, SHOVE] = kept[..., None] * _IDENTITY
    swung = felt[..., None, None] * (state.R - kept_angle[..., None, None] * R)
    for node in (0, 1):
        F[..., PHI[node], SHAKE[node]] = swung[..., node, :, :]
        F[..., SHAKE[node], SHAKE[node]] = kept_angle[..., node, None, None] * _IDENTITY
    F[..., :MOVING] = F[..., :MOVING] @ plain_of_invariant(state)
    return after, invariant_of_plain(after) @ F


def moved_by_shares(after: State, by_fast: Floats) -> Floats:
    """Give how a step's end is moved by a share of 1 of each fast part (MOVING, 4), in the errors of `State.plus`.

    by_fast (2, 9, 2): as in Increments.
    """
    moved = np.zeros((MOVING, 4))
    for node in (0, 1):
        moved[_ROWS[node, :, 0], 2 * node : 2 * node + 2] = _SIGNS[node] * by_fast[node]
    return invariant_of_plain(after) @ moved


def process_noise(
    after: State, parts: Increments, noises: tuple[Noise, Noise], shaking: Floats, span_s: float, shares: Floats
) -> tuple[Floats, Floats, Floats]:
    """Give what a step adds to the covariance: of the moving errors (MOVING, MOVING), and of each other error
    (SIZE-MOVING,); and the parts in the first that shaking of the variances (3,) adds, (3, MOVING, MOVING).
    shares (2,): as `propagate` takes them."""
    guessed = guessed_noise(parts, noises, span_s, shares).sum(axis=0) if parts.without.any() else None
    return noise_of_steps(after, parts, sampled(noises), shaking, span_s, guessed)


def sampled(noises: tuple[Noise, Noise]) -> Floats:
    """Give the densities (6, 2) of nodes that have units: of rates, forces, both in gaps, and both biases' walks."""
    a, b = noises
    return np.array(
        (
            (a.gyro_rad, b.gyro_rad),
            (a.accel_mps, b.accel_mps),
            (a.gap_gyro_rad, b.gap_gyro_rad),
            (a.gap_accel_mps, b.gap_accel_mps),
            (a.gyro_bias_radps, b.gyro_bias_radps),
            (a.accel_bias_mps2, b.accel_bias_mps2),
        )
    )


def noise_of_steps(
    after: State,
    parts: Increments,
    densities: Floats,
    shaking: Floats,
    span_s: float | Floats,
    guessed: Floats | None = None,
) -> tuple[Floats, Floats, Floats]:
    """Give what `process_noise` does; all may have leading axes, for a batch of steps.

    densities (6, 2): as `sampled` gives them, of a batch (6, ..., 2). guessed (SIZE, SIZE): what nodes without a unit
    add, None where all have one.
    """
    span, felt = np.asarray(span_s)[..., None], ~parts.without
    gyro, accel, gap_gyro, gap_accel, gyro_walk, accel_walk = densities * densities
    turn = felt * (gyro * span + gap_gyro * parts.gap_s)
    force = np.add.reduce(accel * span + felt * gap_accel * parts.gap_s, axis=-1)
    Q = np.zeros((*felt.shape[:-1], MOVING, MOVING))
    for node in (0, 1):
        Q[..., PHI[node], PHI[node]] = turn[..., node, None, None] * _IDENTITY
    _accelerated(Q, force, span_s)
    walk = np.zeros((*felt.shape[:-1], SIZE))
    for biases, walked in ((GYRO_BIAS, felt * gyro_walk * span), (ACCEL_BIAS, accel_walk * span)):
        walk[..., biases[0]], walk[..., biases[1]] = walked[..., :1], walked[..., 1:]
    if guessed is not None:
        Q += guessed[..., :MOVING, :MOVING]
        walk += np.diagonal(guessed, axis1=-2, axis2=-1) * _CONSTANT
    shaken = shaking_noise(after.R, shaking, span_s)
    if parts.without.any():
        still = np.concatenate((parts.without, parts.without.all(axis=-1, keepdims=True)), axis=-1)
        shaken[still, :NAV] = 0.0
        shaken[still, :, :NAV] = 0.0
    T = invariant_of_plain(after)
    back = T.swapaxes(-1, -2)
    shaken = T[..., None, :, :] @ shaken @ back[..., None, :, :]
    return T @ Q @ back + np.add.reduce(shaken, axis=-3), walk[..., MOVING:], shaken


def guessed_noise(parts: Increments, noises: tuple[Noise, Noise], span_s: float, shares: Floats) -> Floats:
    """Give what a step adds to the plain errors' covariance where nodes have no unit, (3, SIZE, SIZE).

    By their acceleration, by their turn rates' walk, and by their attitudes' slow error: tilt and heading.
    """
    guessed = np.zeros((3, SIZE, SIZE))
    force = 0.0
    for node, noise in enumerate(noises):
        if parts.without[node]:
            force += noise.gap_accel_mps**2 * float(parts.gap_s[node])
            rate = noise.gap_rate_radps**2 * _IDENTITY
            guessed[1, PHI[node], PHI[node]] = span_s**3 / 3.0 * rate
            guessed[1, GYRO_BIAS[node], GYRO_BIAS[node]] = span_s * rate
            tilted = noise.tilt_rad**2 * (1.0 - float(shares[node]) ** 2)
            guessed[2, SHAKE[node], SHAKE[node]] = np.diag((tilted, tilted, 0.0))
            guessed[2, MOUNT[node], MOUNT[node]] = np.diag((0.0, 0.0, span_s * noise.gap_heading_rad**2))
    _accelerated(guessed[0], force, span_s)
    return guessed


def _accelerated(Q: Floats, force: float | Floats, span_s: float | Floats) -> None:
    """Enter what a velocity's walk, of a variance (m/s)^2 by the step's end, adds to a covariance."""
    span, walked = np.asarray(span_s)[..., None, None], np.asarray(force)[..., None, None] * _IDENTITY
    Q[..., V_, V_] = walked
    Q[..., R_, V_] = Q[..., V_, R_] = 0.5 * span * walked
    Q[..., R_, R_] = span * span / 3.0 * walked


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
