"""How an estimate moves from picture to picture, and what each sensor adds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp
from buddyline.solver_service.track import anchors
from buddyline.solver_service.track.association import Association, associate
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.inputs import TrackNode
from buddyline.solver_service.track.intake import TrackIntake, newest_before
from buddyline.solver_service.track.lights import (
    BLOCK,
    COLUMNS,
    Sight,
    in_picture,
    light_positions,
    pixel_of,
    residuals,
)
from buddyline.solver_service.track.samples import Samples
from buddyline.solver_service.track.smoother import Path
from buddyline.solver_service.track.state import (
    CLOCK,
    GYRO_BIAS,
    MOUNT,
    MOVING,
    NAV,
    PHI,
    R_,
    SHAKE,
    SIZE,
    V_,
    State,
    invariant_of_plain,
    place_covariance,
)
from buddyline.solver_service.track.strapdown import (
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
from buddyline.solver_service.track.trail import Chosen, Look, Step
from numpy.typing import NDArray

# How far past an event samples may lie and still count for it: the unit's delay, and one sample to interpolate to.
HOLD_S: Final = 0.05
# Longest step without a frame.
TICK_S: Final = 0.1
# Two pictures nearer than this share a step: the state is carried over so short a time by its rates.
TOGETHER_S: Final = 0.005
# Both nodes' pictures of one trigger are less than this apart.
ONE_TRIGGER_S: Final = 0.03
ATTITUDE_EVERY_S: Final = 0.5
# A light nearer to the picture's edge need not be found: part of its spot is outside.
EDGE_PX: Final = 2.0
# The clocks' offset is believed where it is known better than this, 1 sd. Only then is learned how much the biases
# walk: an unknown offset looks like a walk.
KNOWN_CLOCK_S: Final = 0.008
# Without units, the place must also be known better than to this share of the range, 1 sd: the error of linearization
# looks like a walk, too.
WIDE_SHARE: Final = 0.02
MAX_DELAY_S: Final = 0.03
# How fast a node without an inertial unit turns, and how far off its attitude may be, 1 sd.
WITHOUT_RADPS: Final = 0.25
WITHOUT_RAD: Final = 0.03
# Beyond this chi^2 (3 degrees of freedom, a chance of 0.01) a node without a unit is taken to have begun to turn, by
# at most so much: a head turned by 45 degrees in a second speeds up by 4 rad/s^2.
STARTLED: Final = 11.3
# A turn shows as residuals of one sign before any single one is that large: they are summed, each with LASTING of the
# next one's weight. The sum's variance is SUMMED times one residual's.
LASTING: Final = 0.6
SUMMED: Final = 1.0 / (1.0 - LASTING**2)
MOST_GAP_RATE: Final = 4.0
# A wide estimate takes its lights in so many steps.
ABOUT_STEPS: Final = 4
_STILL: Final = np.eye(MOVING)
Number = TypeVar("Number", np.float64, np.bool_)


@dataclass(frozen=True, eq=False, slots=True)
class PassGuide:
    """What a whole pass over the dive knew at one picture, for the next pass to decide its lights again.

    path, step: of the pass. look: the picture.
    """

    path: Path
    step: int
    look: Look


def increments(
    of_nodes: Sequence[Samples], state: Carried, from_s: float, to_s: float, *, by_shares: bool = False
) -> Increments:
    """Integrate the samples of a state's nodes from one time to the next, each by its own clock's delay.

    by_shares: whether to tell what shares of the samples' fast parts do.
    """
    known_s = to_s + HOLD_S
    without = np.zeros(len(of_nodes), dtype=bool)
    slow = np.empty((len(of_nodes), 2, 3))
    grids, values, told = [], [], []
    for node, (samples, delay_s) in enumerate(zip(of_nodes, state.delay_s.tolist(), strict=True)):
        shift = min(max(delay_s, -MAX_DELAY_S), MAX_DELAY_S)
        times_s, at, covered = samples.between(from_s + shift, to_s + shift, known_s)
        without[node] = not covered.any() and not samples.near(to_s + shift, known_s)
        if without[node]:
            at[:, :6] = 0.0
        for end, each_s in ((0, from_s + shift), (-1, to_s + shift)):
            rate = samples.slow_rate(each_s, known_s)
            slow[node, end] = at[end, 3:6] if rate is None else rate
        grids.append(times_s)
        values.append(at)
        told.append(covered)
    every = _padded(values)
    fast = every[..., 6:12] if by_shares and any(samples.parted for samples in of_nodes) else None
    parts = integrate(state, SampleGrid(_padded(grids), every[..., :6], _padded(told), slow, fast))
    return replace(parts, without=without, sudden_rad=every[..., 12].max(axis=1))


def _padded(rows: Sequence[NDArray[Number]]) -> NDArray[Number]:
    """Give nodes' rows (N, M, ...), the last one repeated where another node has more: intervals of no length."""
    most = max(map(len, rows))
    return np.array([row if len(row) == most else row[np.minimum(np.arange(most), len(row) - 1)] for row in rows])


class TrackSteps(TrackIntake):
    """Moves estimates by what has come in. unrest: how much of the guessed motion's noise is taken.

    guides: by node and stamp of a picture.
    """

    nodes: tuple[TrackNode, TrackNode]

    def __init__(self, nodes: tuple[TrackNode, TrackNode], keep_s: float) -> None:
        super().__init__(nodes)
        self.unrest = 1.0
        self.guides: dict[tuple[int, int], PassGuide] = {}
        self._keep_s = keep_s
        self._ports = np.stack([node.rig.depth_port_m for node in nodes])

    def guide_by(self, path: Path) -> None:
        """Tell what a pass knew at each picture."""
        for step, looks in enumerate(path.looks):
            for look in looks:
                self.guides[look.node, look.stamp_ns] = PassGuide(path, step, look)

    def increments(self, estimate: Estimate, t_s: float) -> Increments:
        """Integrate both nodes from the estimate's time to t_s."""
        return increments(self.samples, estimate.state, estimate.t_s, t_s, by_shares=estimate.learns)

    def _with_sudden(self, variances: Floats, sudden_rad: Floats) -> Floats:
        """Give the variances (3,) of shaking with what the shares take off a camera's own sudden turns."""
        lost = [samples.shares[1] * turn for samples, turn in zip(self.samples, sudden_rad, strict=True)]
        widened: Floats = variances + np.square((*lost, 0.0))
        return widened

    def _noises(self, estimate: Estimate, t_s: float) -> tuple[Noise, Noise]:
        gyro, accel, push, rate, wander = estimate.walking.densities.tolist()
        noises = []
        for node in (0, 1):
            noise = self.samples[node].noise(t_s).scaled(self.unrest)
            noise = replace(noise, gyro_bias_radps=gyro, accel_bias_mps2=accel)
            if estimate.without[node]:
                noise = replace(noise, gap_accel_mps=push, gap_rate_radps=rate)
                stated = self.turning[node].stated(t_s)
                if stated is not None:
                    tilt, heading = stated
                    noise = replace(noise, tilt_rad=tilt, gap_tilt_rad=wander * tilt, gap_heading_rad=wander * heading)
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
        if parts.by_fast is not None:
            by_shares = estimate.by_shares.copy()
            by_shares[:MOVING] = F @ estimate.by_shares + moved_by_shares(after, parts.by_fast)
            estimate.by_shares = by_shares
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

        Of a sudden turn, nothing is learned. Of a tilt error q that decays, q1 = k q0 + n, var n = s^2 (1 - k^2), the
        logarithm of k is minus a number times the walk's variance: dk = k ln k, dvar n = -2 k^2 ln k s^2 dlog.
        """
        drift = np.zeros(SIZE)
        if not parts.without.any():
            return None, drift
        guessed = guessed_noise(parts, noises, span_s, shares)
        if taken != noises:
            guessed[1] = 0.0
        for node in (0, 1):
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
        near = self.turning[node].at(to_s, to_s + HOLD_S) if estimate.without[node] else None
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
        whitened = np.linalg.solve(np.linalg.cholesky(S), y)
        lasting = whitened + LASTING * estimate.turning_off[node]
        estimate.turning_off[node] = lasting
        if max(float(whitened @ whitened), float(lasting @ lasting) / SUMMED) < STARTLED:
            return noise
        estimate.turning_off[node] = np.zeros(3)
        rate = math.sqrt(float(y @ y) / max(span_s, TOGETHER_S) ** 3)
        return replace(noise, gap_rate_radps=max(noise.gap_rate_radps, min(rate, MOST_GAP_RATE)))

    def _step(self, estimate: Estimate, t_s: float, sight: Sight | None) -> None:
        """Bring an estimate to t_s, by ticks where that is long, and update it."""
        while t_s - estimate.t_s > 1.5 * TICK_S:
            self._step(estimate, estimate.t_s + TICK_S, None)
        together = sight is not None and t_s - estimate.t_s < TOGETHER_S and bool(estimate.steps or not self._keep_s)
        looks: tuple[Look, ...] = ()
        if not together:
            moved = self._move(estimate, t_s)
            before = estimate.state
            self._take_depth(estimate, t_s)
            self._take_attitude(estimate, t_s)
            self._take_turning(estimate, t_s)
        if sight is not None:
            looks = (self._take_lights(estimate, sight),)
        if not self._keep_s:
            return
        estimate.steps.drop_before(t_s - self._keep_s)
        if together:
            last = estimate.steps.last
            estimate.steps.last = replace(
                last,
                after=estimate.state,
                covariance=estimate.covariance,
                light_s=estimate.light_s,
                lights=estimate.lights,
                looks=last.looks + looks,
            )
        else:
            estimate.steps.append(
                Step(
                    t_s=t_s,
                    before=before,
                    after=estimate.state,
                    covariance=estimate.covariance,
                    F=moved[0],
                    Q=moved[1],
                    walk=moved[2],
                    rates_radps=estimate.rates_radps,
                    light_s=estimate.light_s,
                    lights=estimate.lights,
                    looks=looks,
                )
            )
            if math.isinf(self._keep_s):
                estimate.steps.pack()

    def _take_lights(self, estimate: Estimate, sight: Sight) -> Look:
        observer = sight.node
        camera = self.nodes[observer].rig.camera
        X, y, H = self._compared(sight, estimate.state, estimate.rates_radps, sight.t_s - estimate.t_s)
        # Starts are weighed by their evidence: one that doubts its own clock must not explain more with it.
        if estimate.confirmed:
            sight = _widened(sight, H, estimate.covariance)
        detection = estimate.detection[observer]
        place = place_covariance(estimate.state, estimate.covariance)
        share = math.sqrt(place.trace()) / float(np.linalg.norm(estimate.state.r_m))
        wide, estimate.wide = share > 0.1, share > WIDE_SHARE
        if wide:
            inside = [True, True]
        else:
            inside = [in_picture(camera, pixel_of(camera, X[0, light]), EDGE_PX) for light in (0, 1)]
            detection = detection * np.where(inside, 1.0, 0.02)
        clutter = sight.clutter / camera.area_px2
        guide = self.guides.get((observer, sight.stamp_ns))
        given = estimate.given.get((observer, sight.stamp_ns))
        if given is not None:
            found = Association(given, np.zeros(2), 0.0)
        elif guide is None:
            found = associate(y, H, estimate.covariance[BLOCK], sight.sigma_px, detection, clutter)
        else:
            found = associate(*self._without(guide, sight), sight.sigma_px, detection, clutter)
        if wide and found.chosen and estimate.confirmed:
            y, H = self._about(estimate, sight, found.chosen, guide)
        # What another estimate chose may be behind the camera by this one.
        found = replace(found, chosen=_in_front(found.chosen, y))
        estimate.trigger = [seen for seen in estimate.trigger if abs(sight.t_s - seen[0]) < ONE_TRIGGER_S]
        estimate.evidence += found.evidence
        estimate.evidence_by[observer] += found.evidence
        if any(inside) and not wide:
            estimate.missed[observer] = 0 if found.chosen else estimate.missed[observer] + 1
        estimate.last_seen = found.seen if all(inside) and not wide else None
        for light in (0, 1):
            if inside[light]:
                old = estimate.detection[observer, light]
                estimate.detection[observer, light] = min(max(old + 0.05 * (found.seen[light] - old), 0.02), 0.97)
        if found.chosen:
            self._update_lights(estimate, found, y, H, sight)
            if not estimate.confirmed:
                estimate.used[observer, sight.stamp_ns] = found.chosen
            if estimate.unseen_by == observer:
                estimate.unseen_by = None
            if len(found.chosen) == 2:
                estimate.bars += 1
                estimate.bar_s = sight.t_s
            estimate.told_by[observer] += 1
        return Look(observer, sight.stamp_ns, sight.t_s, found.chosen)

    def _compared(
        self, sight: Sight, state: State, rates_radps: Floats, after_s: float
    ) -> tuple[Floats, Floats, Floats]:
        """Give the lights (camera frame), residuals and Jacobians of a picture after_s after a state."""
        lights_m = self.nodes[1 - sight.node].rig.lights_m
        X, D = light_positions(state, sight.node, lights_m, rates_radps, sight.dt_s + after_s)
        y, H = residuals(sight.bearings, sight.tangents, X, D)
        return X, y, H

    def _without(self, guide: PassGuide, sight: Sight) -> tuple[Floats, Floats, Floats]:
        """Give residuals, Jacobians and covariance by all the dive but this picture.

        The picture's own part is taken out of the smoothed estimate: P' = P + K H P, K = P H^T (R - H P H^T)^-1.
        """
        path, step = guide.path, guide.step
        after_s = guide.look.t_s - float(path.t_s[step])
        _, y, H = self._compared(sight, path.state(step), path.rates_radps[step], after_s)
        P = path.covariance(step)
        chosen = _in_front(guide.look.chosen, y)
        if chosen:
            H_used = np.concatenate([H[k, light] for k, light, _ in chosen])
            y_used = np.concatenate([y[k, light] for k, light, _ in chosen])
            R = np.diag(np.repeat([variance for _, _, variance in chosen], 2))
            across = P @ H_used.T
            rest = R - H_used @ across
            # Rounding, and pictures that share a step, can leave less than nothing.
            values, vectors = np.linalg.eigh(rest)
            inverse = (vectors / np.maximum(values, 0.02 * R[0, 0])) @ vectors.T
            gain = across @ inverse
            P = P + gain @ across.T
            y = y + H @ (gain @ y_used)
        return y, H, P

    def _about(
        self, estimate: Estimate, sight: Sight, chosen: Chosen, guide: PassGuide | None
    ) -> tuple[Floats, Floats]:
        """Give residuals and Jacobians by the estimate's errors, but linear where the chosen lights say it is.

        After seconds without light one linear step from the prediction ends far from the lights, with the sigma of a
        sound one. These steps (Gauss-Newton, the iterated update) begin where an earlier pass, if any, had the nodes.
        """
        error = np.zeros(SIZE) if guide is None else guide.path.state(guide.step).minus(estimate.state)
        error[NAV:] = 0.0
        for left in reversed(range(ABOUT_STEPS)):
            state, after_s = estimate.state.plus(error), sight.t_s - estimate.t_s
            _, y, H = self._compared(sight, state, estimate.rates_radps, after_s)
            y = y + H @ error[COLUMNS]
            if left and (near := _in_front(chosen, y)):
                error = anchors.kalman(estimate.covariance, *_rows(near, y, H))[0]
        return y, H

    def _update_lights(self, estimate: Estimate, found: Association, y: Floats, H: Floats, sight: Sight) -> None:
        rows_H, rows_y, noise = _rows(found.chosen, y, H)
        chi2 = self._apply(estimate, rows_H, rows_y, noise, teaches=True)
        estimate.surprise += chi2
        estimate.told += len(rows_y)
        estimate.light_s = max(estimate.light_s, sight.t_s)
        estimate.trigger += [(sight.t_s, sight.node, light) for _, light, _ in found.chosen]

    @staticmethod
    def _apply(estimate: Estimate, H: Floats, y: Floats, noise: Floats, *, teaches: bool = False) -> float:
        before = estimate.covariance
        error, estimate.covariance, chi2, S_inverse, gain = anchors.kalman(before, H, y, noise)
        estimate.state = estimate.state.plus(error)
        if estimate.by_shares.any():
            moved = H @ estimate.by_shares
            if teaches:
                estimate.shares = estimate.shares.taught(y, S_inverse, moved)
            estimate.by_shares = estimate.by_shares - gain @ moved
        if estimate.follows_walk:
            learns = before[CLOCK, CLOCK] < KNOWN_CLOCK_S**2 and not (estimate.wide and any(estimate.without))
            estimate.walking = estimate.walking.taught(y, S_inverse, H, gain, learns=learns)
        # Depth and attitudes remove little of what shaking adds: to follow that would not be worth its time.
        if teaches:
            moving = H[:, :MOVING]
            estimate.shaking = estimate.shaking.taught(y, S_inverse, moving[:, :NAV], estimate.shaken[:, :NAV, :NAV])
            rest = _STILL - gain[:MOVING] @ moving
            estimate.shaken = rest @ estimate.shaken @ rest.T
        return chi2

    def _take_depth(self, estimate: Estimate, t_s: float) -> None:
        of_a, of_b = (newest_before(of_node, t_s) for of_node in self.depths)
        if of_a is None or of_b is None:
            return
        (time_a, a), (time_b, b) = of_a, of_b
        time_s = max(time_a, time_b)
        if min(time_a, time_b) <= estimate.depth_s or t_s - time_s > 0.3 or abs(time_a - time_b) > 0.2:
            return
        estimate.depth_s = time_s
        y, H = anchors.depth_residual(estimate.state, b.depth_m - a.depth_m, t_s - 0.5 * (time_a + time_b), self._ports)
        # Between the two messages a diver may rise or sink, by some 0.3 m/s.
        noise = a.sigma_m**2 + b.sigma_m**2 + (0.3 * (time_a - time_b)) ** 2 + 1e-6
        variance = float((H @ estimate.covariance @ H.T)[0, 0]) + noise
        if y[0] ** 2 < 16.0 * variance:
            self._apply(estimate, H, y, np.array([[noise]]))

    def _take_attitude(self, estimate: Estimate, t_s: float) -> None:
        for node in (0, 1):
            found = newest_before(self.attitudes[node], t_s)
            since = t_s - estimate.attitude_s[node]
            if found is None or since < ATTITUDE_EVERY_S or t_s - found[0] > 0.1:
                continue
            time_s, seen = found
            first = estimate.attitude_s[node] == -np.inf
            estimate.attitude_s[node] = t_s
            camera = self.level_camera(node, seen)
            turn = estimate.rates_radps[node] * (t_s - time_s)
            y, H = anchors.attitude_residual(estimate.state, node, camera @ rotation_exp(turn))
            factors = (1.0, 1.0) if first else (2.0 * anchors.TILT_TIME_S / since, 2.0 * anchors.HEADING_TIME_S / since)
            noise = anchors.attitude_covariance(seen.R_ned_body, seen.sigma_rad, *factors)
            S = noise + (H @ estimate.covariance @ H.T)
            chi2 = float(y @ np.linalg.solve(S, y))
            if chi2 > 16.0:
                noise = noise * (chi2 / 4.0)
            self._apply(estimate, H, y, noise)

    def _take_turning(self, estimate: Estimate, t_s: float) -> None:
        """Update a node without an inertial unit by its attitude as it is at t_s, which may be off by a slow error."""
        for node in (0, 1):
            near = self.turning[node].at(t_s, t_s + HOLD_S) if estimate.without[node] else None
            if near is None:
                continue
            R_level_camera, variances = near
            y, H = anchors.attitude_residual(estimate.state, node, R_level_camera)
            y = y - estimate.state.mount_rad[node] - estimate.state.shake_rad[node]
            H[:, MOUNT[node]] = H[:, SHAKE[node]] = np.eye(3)
            noise = (R_level_camera * variances) @ R_level_camera.T
            S = noise + (H @ estimate.covariance @ H.T)
            if float(y @ np.linalg.solve(S, y)) < 30.0:
                self._apply(estimate, H, y, noise)

    def _open(self, estimate: Estimate) -> None:
        if self._keep_s:
            still = np.eye(SIZE)[:MOVING], np.zeros((MOVING, MOVING)), np.zeros(SIZE - MOVING)
            state, rates = estimate.state, estimate.rates_radps
            first = Step(estimate.t_s, state, state, estimate.covariance, *still, rates, estimate.light_s, 0)
            estimate.steps.append(first)

    def _predict(
        self, estimate: Estimate, t_s: float, least_s: float = 0.0, parts: Increments | None = None
    ) -> tuple[State, Floats]:
        """Return state and covariance at t_s. parts: `increments` to there, where they are known already."""
        span_s = t_s - estimate.t_s
        if span_s <= least_s:
            return estimate.state, estimate.covariance
        parts = self.increments(estimate, t_s) if parts is None else parts
        noises = self._noises(estimate, t_s)
        shares = kept_shares(parts.without, noises, span_s) * (parts.without == estimate.without)
        after, F = propagate(estimate.state, parts, span_s, shares)
        shaking = self._with_sudden(estimate.shaking.variances, parts.sudden_rad)
        Q, walk, _ = process_noise(after, parts, noises, shaking, span_s, shares)
        return after, predicted(estimate.covariance, F, Q, walk)


def _rows(chosen: Chosen, y: Floats, H: Floats) -> tuple[Floats, Floats, Floats]:
    """Give Jacobians (2 N, SIZE), residuals (2 N,) and noise of the chosen candidates, of y and H of all."""
    rows_H = np.zeros((2 * len(chosen), SIZE))
    rows_H[:, COLUMNS] = np.concatenate([H[k, light] for k, light, _ in chosen])
    rows_y = np.concatenate([y[k, light] for k, light, _ in chosen])
    return rows_H, rows_y, np.diag(np.repeat([variance for _, _, variance in chosen], 2))


def _in_front(chosen: Chosen, y: Floats) -> Chosen:
    """Return those candidates of lights that the residuals y (K, 2, 2) have in front of the camera."""
    return tuple(one for one in chosen if np.isfinite(y[one[0], one[1]]).all())


def _widened(sight: Sight, H: Floats, P: Floats) -> Sight:
    """Give a picture whose sigmas hold what its Jacobians H (K, L, 2, C) leave out of the clock.

    In A's pictures B stands at r + c v. Where both the clock c and the velocity v are unknown their product's variance,
    var c var v + cov(c, v)^2, is no part of H P H^T: a track would believe a wrong offset within its first second.
    """
    if sight.node or not len(H):
        return sight
    unknown = P[CLOCK, CLOCK] * P[V_, V_] + np.outer(P[V_, CLOCK], P[V_, CLOCK])
    by_place = H[0, 0, :, R_]
    variance_px2 = 0.5 * float(np.trace(by_place @ unknown @ by_place.T))
    return replace(sight, sigma_px=np.sqrt(sight.sigma_px**2 + variance_px2))
