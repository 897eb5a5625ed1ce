"""How an estimate moves from one time to the next: by inertial samples, or by what else tells its turning."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track import anchors
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.guessing import GuessedMotion
from buddyline.solver_service.track.inputs import TrackNode
from buddyline.solver_service.track.intake import TrackIntake
from buddyline.solver_service.track.samples import Samples
from buddyline.solver_service.track.state import (
    CLOCK,
    GYRO_BIAS,
    MOUNT,
    MOVING,
    PHI,
    SHAKE,
    SIZE,
    State,
    invariant_of_plain,
)
from buddyline.solver_service.track.strapdown import (
    Bools,
    Carried,
    Increments,
    Noise,
    SampleGrid,
    guessed_noise,
    integrate,
    kept_shares,
    moved_by_shares,
    predicted,
    process_noise,
    propagate,
)
from numpy.typing import NDArray

# How far past an event samples may lie and still count for it: the unit's delay, and one sample to interpolate to.
HOLD_S: Final = 0.05
# Two pictures nearer than this share a step: the state is carried over so short a time by its rates.
TOGETHER_S: Final = 0.005
# The clocks' offset is believed where it is known better than this, 1 sd. Only then is learned how much the biases
# walk: an unknown offset looks like a walk.
KNOWN_CLOCK_S: Final = 0.008
# A node that is carried on for less than this keeps its turn rate.
LITTLE_CARRIED_S: Final = 0.003
MAX_DELAY_S: Final = 0.03
# How fast a node without an inertial unit turns, and how far off its attitude may be, 1 sd.
WITHOUT_RADPS: Final = 0.25
WITHOUT_RAD: Final = 0.03
# Beyond this chi^2 (3 degrees of freedom, a chance of 0.01) a node without a unit is taken to have begun to turn, by
# at most so much: a head turned by 45 degrees in a second speeds up by 4 rad/s^2.
STARTLED: Final = 11.3
# While a node's pictures show no light it may look elsewhere, and its compass alone tells its turning, late: its turn
# rate is taken to walk so much then, rad/s per root s, three times its first value.
AWAY_RATE: Final = 0.45
# A turn shows as residuals of one sign before any single one is that large: they are summed, each with LASTING of the
# next one's weight. The sum's variance is SUMMED times one residual's.
LASTING: Final = 0.6
SUMMED: Final = 1.0 / (1.0 - LASTING**2)
MOST_GAP_RATE: Final = 4.0
Number = TypeVar("Number", np.float64, np.bool_)


@dataclass(frozen=True, eq=False)
class Excerpt:
    """One node's samples between two times, as in SampleGrid: times_s (M,), values (M, 13), told (M - 1,).

    onward_radps (3,), slow_radps (2, 3). without: whether there is no unit at all.
    """

    times_s: Floats
    values: Floats
    told: Bools
    onward_radps: Floats
    slow_radps: Floats
    without: bool


def excerpt(samples: Samples, delay_s: float, from_s: float, to_s: float, carried_s: float = 0.0) -> Excerpt:
    """Give a node's samples from one time to the next, by its own clock's delay.

    carried_s: for how long the node is then carried on, to the other node's clock.
    """
    known_s = to_s + HOLD_S
    shift = min(max(delay_s, -MAX_DELAY_S), MAX_DELAY_S)
    times_s, values, told = samples.between(from_s + shift, to_s + shift, known_s)
    without = not told.any() and not samples.near(to_s + shift, known_s)
    if without:
        values[:, :6] = 0.0
    slow = values[[0, -1], 3:6]
    for end, each_s in ((0, from_s + shift), (-1, to_s + shift)):
        rate = samples.slow_rate(each_s, known_s)
        if rate is not None:
            slow[end] = rate
    onward = values[-1, 3:6]
    if abs(carried_s) > LITTLE_CARRIED_S and not without:
        onward = _mean_rate(samples, to_s + shift, known_s, carried_s)
    return Excerpt(times_s, values, told, onward, slow, without)


def _mean_rate(samples: Samples, at_s: float, known_s: float, carried_s: float) -> Floats:
    """Give the mean turn rate (3,) while a node is carried on from at_s.

    Lights are carried over all of the clocks' offset, rows over half of it: the mean is over two thirds.
    """
    first_s, last_s = sorted((at_s, min(at_s + 2.0 / 3.0 * carried_s, known_s)))
    times_s, values, _ = samples.between(first_s, last_s, known_s)
    steps = (times_s[1:] - times_s[:-1]) / (times_s[-1] - times_s[0])
    return np.asarray(0.5 * steps @ (values[1:, 3:6] + values[:-1, 3:6]))


def integrated(state: Carried, of_nodes: Sequence[Excerpt], *, by_shares: bool = False) -> Increments:
    """Integrate the samples of nodes, each with its own state and times."""
    every = _padded([one.values for one in of_nodes])
    grid = SampleGrid(
        _padded([one.times_s for one in of_nodes]),
        every[..., :6],
        _padded([one.told for one in of_nodes]),
        np.array([one.onward_radps for one in of_nodes]),
        np.array([one.slow_radps for one in of_nodes]),
        every[..., 6:12] if by_shares else None,
    )
    without = np.array([one.without for one in of_nodes])
    return replace(integrate(state, grid), without=without, sudden_rad=every[..., 12].max(axis=1))


def increments(
    of_nodes: Sequence[Samples],
    state: Carried,
    from_s: float,
    to_s: float,
    *,
    carried_s: Sequence[float] | None = None,
    by_shares: bool = False,
) -> Increments:
    """Integrate the samples of a state's nodes from one time to the next, each by its own clock's delay.

    carried_s: for how long each is then carried on. by_shares: whether to tell what shares of the samples' fast
    parts do.
    """
    found = [
        excerpt(samples, delay_s, from_s, to_s, carried)
        for samples, delay_s, carried in zip(
            of_nodes, state.delay_s.tolist(), carried_s or [0.0] * len(of_nodes), strict=True
        )
    ]
    return integrated(state, found, by_shares=by_shares and any(samples.parted for samples in of_nodes))


def to_other_clocks(state: State) -> tuple[float, float]:
    """Give by how much A and B are carried on to the times at which the other's pictures show them."""
    offset_s = float(state.clock_s)
    return -offset_s, offset_s


def sudden_rate(y: Floats, S: Floats, turning_off: Floats, span_s: float) -> tuple[float, Floats]:
    """Give the random walk of a node's turn rate in a step of span_s, rad/s per root s: 0 without a sudden turn.

    y (3,), S (3, 3): an attitude's residual and its covariance. turning_off (3,): the lasting part of the residuals
    before, in sigmas; the second result is the same for the next step.
    """
    whitened = np.linalg.solve(np.linalg.cholesky(S), y)
    lasting = whitened + LASTING * turning_off
    if max(float(whitened @ whitened), float(lasting @ lasting) / SUMMED) < STARTLED:
        return 0.0, lasting
    return min(math.sqrt(float(y @ y) / max(span_s, TOGETHER_S) ** 3), MOST_GAP_RATE), np.zeros(3)


def _padded(rows: Sequence[NDArray[Number]]) -> NDArray[Number]:
    """Give nodes' rows (N, M, ...), the last one repeated where another node has more: intervals of no length."""
    most = max(map(len, rows))
    return np.array([row if len(row) == most else row[np.minimum(np.arange(most), len(row) - 1)] for row in rows])


class TrackMoves(TrackIntake):
    """Moves estimates by the samples that have come in.

    unrest: how much of the guessed motion's noise is taken. guessed: how nodes without units move, where a path has
    told it of each step; else that is learned on the way.
    """

    nodes: tuple[TrackNode, TrackNode]

    def __init__(self, nodes: tuple[TrackNode, TrackNode]) -> None:
        super().__init__(nodes)
        self.unrest = 1.0
        self.guessed: GuessedMotion | None = None

    def increments(self, estimate: Estimate, t_s: float) -> Increments:
        """Integrate both nodes from the estimate's time to t_s."""
        carried_s = to_other_clocks(estimate.state)
        return increments(
            self.samples, estimate.state, estimate.t_s, t_s, carried_s=carried_s, by_shares=estimate.learns
        )

    def _with_sudden(self, variances: Floats, sudden_rad: Floats) -> Floats:
        """Give the variances (3,) of shaking with what the shares take off a camera's own sudden turns."""
        lost = [samples.shares[1] * turn for samples, turn in zip(self.samples, sudden_rad, strict=True)]
        widened: Floats = variances + np.square((*lost, 0.0))
        return widened

    def _noises(self, estimate: Estimate, t_s: float) -> tuple[Noise, Noise]:
        # What a pass over a dive that is over is given is cautious already.
        logs = estimate.walking.cautious_logs if estimate.learns else estimate.walking.logs
        gyro, accel, push, rate, wander = np.exp(0.5 * logs).tolist()
        if self.guessed is not None:
            push, *rates = self.guessed.at(t_s).tolist()
        else:
            rates = [max(rate, AWAY_RATE) if away else rate for away in estimate.looks_away]
        noises = []
        for node in (0, 1):
            noise = self.samples[node].noise(t_s).scaled(self.unrest)
            noise = noise._replace(gyro_bias_radps=gyro, accel_bias_mps2=accel)
            if estimate.without[node]:
                noise = noise._replace(gap_accel_mps=push, gap_rate_radps=rates[node])
                stated = self.turning[node].stated(t_s)
                if stated is not None:
                    tilt, heading = stated
                    noise = noise._replace(tilt_rad=tilt, gap_tilt_rad=wander * tilt, gap_heading_rad=wander * heading)
            noises.append(noise)
        return noises[0], noises[1]

    def _move(self, estimate: Estimate, t_s: float) -> tuple[Floats, Floats, Floats]:
        span_s = t_s - estimate.t_s
        parts = self.increments(estimate, t_s)
        a, b = self._noises(estimate, t_s)
        # Where a unit stops or comes back, its angle in the mount begins anew.
        shares = kept_shares(parts.without, (a, b), span_s) * (parts.without == estimate.without)
        after, F = propagate(estimate.state, parts, span_s, shares)
        noises = self._startled(estimate, after, F, 0, a, t_s), self._startled(estimate, after, F, 1, b, t_s)
        learned = estimate.shaking.variances
        shaking = self._with_sudden(learned, parts.sudden_rad)
        Q, walk, shaken = process_noise(after, parts, noises, shaking, span_s, shares)
        onward = F[:, :MOVING]
        estimate.shaken = onward @ estimate.shaken @ onward.T + (learned / shaking)[:, None, None] * shaken
        estimate.by_shaking = onward @ estimate.by_shaking
        if parts.by_fast is not None:
            by_shares = estimate.by_shares.copy()
            by_shares[:MOVING] = F @ estimate.by_shares + moved_by_shares(after, parts.by_fast)
            estimate.by_shares = by_shares
        if estimate.learns:
            estimate.by_scale = np.concatenate((F @ estimate.by_scale, estimate.by_scale[MOVING:]))
        without_a, without_b = parts.without.tolist()
        if self._follows_walk(estimate):
            guessed, moved = self._guessed(estimate, after, F, parts, (a, b), noises, span_s, shares)
            estimate.walking = estimate.walking.stepped(F, walk, (not without_a, not without_b), guessed, moved)
        for node, without in enumerate((without_a, without_b)):
            if without != estimate.without[node]:
                # The unit has stopped, or come back: its constants and what stands in their place are told anew.
                estimate.without[node] = without
                walk[GYRO_BIAS[node].start - MOVING : GYRO_BIAS[node].stop - MOVING] += WITHOUT_RADPS**2
                walk[MOUNT[node].start - MOVING : MOUNT[node].stop - MOVING] += WITHOUT_RAD**2
                stated = self.turning[node].stated(t_s)
                if without and stated is not None:
                    # From now on the mount's place has the heading's slow error, which may be all of what is stated.
                    walk[MOUNT[node].stop - 1 - MOVING] += stated[1] ** 2
        estimate.covariance = predicted(estimate.covariance, F, Q, walk)
        estimate.state, estimate.t_s = after, t_s
        estimate.rates_radps = parts.rate_radps
        return F, Q, walk

    @staticmethod
    def _follows_walk(estimate: Estimate) -> bool:
        """Whether derivatives by the walks are carried along: from when they are first learned on, without a break."""
        if estimate.confirmed and estimate.learns and estimate.covariance[CLOCK, CLOCK] < KNOWN_CLOCK_S**2:
            estimate.follows_walk = True
        return estimate.follows_walk

    @staticmethod
    def _guessed(
        estimate: Estimate,
        after: State,
        F: Floats,
        parts: Increments,
        noises: tuple[Noise, Noise],
        taken: tuple[Noise, Noise],
        span_s: float,
        shares: Floats,
    ) -> tuple[Floats | None, Floats]:
        """Give what a step adds to the derivatives by the walks of nodes without units: of covariance and state.

        Of a sudden turn, or while a node looks away, nothing is learned of its turning. Of a tilt error q that decays,
        q1 = k q0 + n, var n = s^2 (1 - k^2), the logarithm of k is minus a number times the walk's variance:
        dk = k ln k, dvar n = -2 k^2 ln k s^2 dlog.
        """
        drift = np.zeros(SIZE)
        if not parts.without.any():
            return None, drift
        guessed = guessed_noise(parts, noises, span_s, shares)
        for node in (0, 1):
            if estimate.looks_away[node] or taken[node].gap_rate_radps != noises[node].gap_rate_radps:
                guessed[1, PHI[node], PHI[node]] = guessed[1, GYRO_BIAS[node], GYRO_BIAS[node]] = 0.0
            if parts.without[node]:
                k = float(shares[node])
                log_k = math.log(k) if k > 0.0 else 0.0
                guessed[2, SHAKE[node], SHAKE[node]] *= -2.0 * k * k * log_k / max(1.0 - k * k, 1e-12)
                drift[SHAKE[node]] = log_k
        T = invariant_of_plain(after)
        guessed[:, :MOVING, :MOVING] = T @ guessed[:, :MOVING, :MOVING] @ T.T
        onward = predicted(estimate.covariance, F, np.zeros((MOVING, MOVING)), np.zeros(SIZE - MOVING))
        less = drift[:, None] * onward
        guessed[2] += less + less.T
        for node in (0, 1):
            drift[SHAKE[node]] *= after.shake_rad[node]
        return guessed, drift

    def _startled(self, estimate: Estimate, after: State, F: Floats, node: int, noise: Noise, to_s: float) -> Noise:
        """Return the noise of a step to to_s; more of it where a node without a unit turns otherwise than it did.

        A diver who looks away turns within tenths of a second as he has not for minutes: attitude messages say so.
        """
        near = self.turning[node].at(to_s, to_s + HOLD_S) if estimate.without[node] and self.guessed is None else None
        if near is None:
            return noise
        R_level_camera, variances = near
        y = anchors.attitude_residual(after, node, R_level_camera)[0] - after.mount_rad[node] - after.shake_rad[node]
        H = F[PHI[node]] + F[SHAKE[node]]
        H[:, MOUNT[node]] += np.eye(3)
        span_s = to_s - estimate.t_s
        walks = (noise.gap_tilt_rad, noise.gap_tilt_rad, noise.gap_heading_rad)
        S = H @ estimate.covariance @ H.T + np.diag(np.square(walks) * span_s)
        S += noise.gap_rate_radps**2 * span_s**3 / 3.0 * np.eye(3) + (R_level_camera * variances) @ R_level_camera.T
        rate, estimate.turning_off[node] = sudden_rate(y, S, estimate.turning_off[node], span_s)
        return noise._replace(gap_rate_radps=max(noise.gap_rate_radps, rate))

    def _predict(self, estimate: Estimate, t_s: float) -> tuple[State, Floats, Floats]:
        """Return state, covariance and turn rates (2, 3) at t_s, within TOGETHER_S those of now."""
        span_s = t_s - estimate.t_s
        if span_s <= TOGETHER_S:
            return estimate.state, estimate.covariance, estimate.rates_radps
        parts = self.increments(estimate, t_s)
        noises = self._noises(estimate, t_s)
        shares = kept_shares(parts.without, noises, span_s) * (parts.without == estimate.without)
        after, F = propagate(estimate.state, parts, span_s, shares)
        shaking = self._with_sudden(estimate.shaking.variances, parts.sudden_rad)
        Q, walk, _ = process_noise(after, parts, noises, shaking, span_s, shares)
        return after, predicted(estimate.covariance, F, Q, walk), parts.rate_radps
