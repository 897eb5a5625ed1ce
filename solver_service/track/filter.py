"""The causal filter: messages in the order of time, one estimate at every step."""

from __future__ import annotations

import bisect
import heapq
import math
from dataclasses import dataclass, field, replace
from typing import Final, TypeVar

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log
from buddyline.solver_service.track import anchors
from buddyline.solver_service.track.association import Association, associate
from buddyline.solver_service.track.inputs import AttitudeSeen, DepthSeen, FixSeen, Frame, Stamps, TrackNode
from buddyline.solver_service.track.lights import COLUMNS, Sight, in_picture, light_positions, residuals, sight_of
from buddyline.solver_service.track.output import TrackRow, at_one_time, pose_of, row_of
from buddyline.solver_service.track.samples import Samples
from buddyline.solver_service.track.search import starts
from buddyline.solver_service.track.start import CLOCK_S, state_from_fix
from buddyline.solver_service.track.state import GYRO_BIAS, MOUNT, NAV, SIZE, State
from buddyline.solver_service.track.strapdown import Increment, Noise, integrate, predicted, process_noise, propagate
from buddyline.solver_service.track.turning import Turning
from buddyline.solver_service.track.units import clipped, fault_of

# How far past an event samples may lie and still count for it: the unit's delay, and one sample to interpolate to.
HOLD_S: Final = 0.05
# Longest step without a frame.
TICK_S: Final = 0.1
# Two pictures nearer than this share a step: the state is carried over so short a time by its rates.
TOGETHER_S: Final = 0.005
ATTITUDE_EVERY_S: Final = 0.5
# Log odds by which a track must explain its pictures better than clutter, or a challenger better than the track.
CONFIRMED: Final = 25.0
REPLACED: Final = 20.0
MUTUAL: Final = 7.0
BARS: Final = 4
CHALLENGE_S: Final = 4.0
GIVEN_UP: Final = -15.0
# A confirmed track is given up when no light has told of it for so long and its place is this share of the range off.
LOST_S: Final = 3.0
LOST_SHARE: Final = 0.3
LOST_RANGE_M: Final = 10.0
# A start without a fix: how often one is tried, how long after the last fix, for how long it and how many are kept.
SEARCH_EVERY_S: Final = 0.45
SEARCH_AFTER_S: Final = 3.0
SEARCH_PATIENCE_S: Final = 8.0
MAX_TENTATIVE: Final = 12
# The noise of the lights that a start is made of: one in thirty is off by many pixels.
START_PX: Final = 2.5
# What iron near a compass, or haste, adds to an attitude's sigmas (roll, pitch, yaw) when a start is checked.
IRON_RAD: Final = np.radians((1.0, 1.0, 8.0))
# chi^2 (6 degrees of freedom) beyond which a fix contradicts: a chance of 1e-5.
CONTRADICTS: Final = 33.0
MAX_DELAY_S: Final = 0.03
CHECK_EVERY_S: Final = 2.0
REJECTED_TO_SAY: Final = 10
REFUSED_TO_SAY: Final = 10
LEAST_SIGMA_RAD: Final = 1e-3
UNTOLD_SIGMA_RAD: Final = np.radians((1.5, 1.5, 6.0))
# No fix's numbers, in m, rad and their squares, are as large.
BEYOND: Final = 1e4
# How fast a node without an inertial unit turns, and how far off its attitude may be, 1 sd.
WITHOUT_RADPS: Final = 0.25
WITHOUT_RAD: Final = 0.03
Seen = TypeVar("Seen", AttitudeSeen, DepthSeen)
# What is older than this is dropped in a live filter.
MEMORY_S: Final = 5.0
_BLOCK: Final = np.ix_(COLUMNS, COLUMNS)


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a track as the smoother needs it.

    before: predicted; after, covariance: with what was seen at t_s. F (NAV, SIZE), Q (NAV, NAV), walk: how it came here
    from the step before. rates_radps (2, 3). lights: of how many lights its picture told, 0 where none.
    """

    t_s: float
    before: State
    after: State
    covariance: Floats
    F: Floats
    Q: Floats
    walk: Floats
    rates_radps: Floats
    light_s: float
    lights: int
    looks: tuple[Look, ...] = ()


@dataclass(frozen=True, eq=False)
class Look:
    """One picture within a step, and the lights that were used: (candidate, light, variance)."""

    sight: Sight
    chosen: tuple[tuple[int, int, float], ...]


@dataclass(frozen=True, eq=False)
class Guide:
    """What a whole pass over the dive knew at one picture: for the next pass to decide its lights again.

    after_s: the picture's time after the pass's step.
    """

    after_s: float
    state: State
    covariance: Floats
    rates_radps: Floats
    chosen: tuple[tuple[int, int, float], ...]


@dataclass(eq=False)
class Estimate:
    """One hypothesis of where the nodes are, and how well it has explained the pictures since its start.

    evidence: log odds over clutter; evidence_by: of each node's pictures. baseline: the main estimate's, at the start.

    detection (2, 2): by observer and light, how likely the light is found where it is in the picture.
    """

    t_s: float
    state: State
    covariance: Floats
    start_s: float
    evidence: float = 0.0
    evidence_by: list[float] = field(default_factory=lambda: [0.0, 0.0])
    baseline: float = 0.0
    detection: Floats = field(default_factory=lambda: np.full((2, 2), 0.8))
    rates_radps: Floats = field(default_factory=lambda: np.zeros((2, 3)))
    light_s: float = -np.inf
    trigger: list[tuple[float, int, int]] = field(default_factory=list)
    attitude_s: list[float] = field(default_factory=lambda: [-np.inf, -np.inf])
    depth_s: float = -np.inf
    steps: list[Step] = field(default_factory=list)
    confirmed: bool = False
    surprise: float = 0.0
    told: int = 0
    end_s: float = np.inf
    skip_s: float = 0.02
    patience_s: float = CHALLENGE_S
    unseen_by: int | None = None
    searched: bool = False
    bars: int = 0
    told_by: list[int] = field(default_factory=lambda: [0, 0])
    without: list[bool] = field(default_factory=lambda: [False, False])


class TrackFilter:
    """The track of nodes a (0) and b (1). Samples and events may be added in any order before `advance` passes them.

    keep_s: for how long steps are kept to smooth over; inf: all. clock_sigma_s: how far B's clock may be off, 1 sd.
    """

    def __init__(
        self, node_a: TrackNode, node_b: TrackNode, *, keep_s: float = 0.0, clock_sigma_s: float = CLOCK_S
    ) -> None:
        self.nodes = (node_a, node_b)
        self.problems: list[str] = []
        self.main: Estimate | None = None
        self.challengers: list[Estimate] = []
        self.now_s = -np.inf
        self.epoch_ns: int | None = None
        self.clock_ns = 0
        self.finished: list[Estimate] = []
        self._count = 0
        self._searched_s = -np.inf
        self._checked_s = -np.inf
        self._refused = 0
        self._fix_s = -np.inf
        self._waiting: list[Estimate] = []
        self.restarts = True
        self.unrest = 1.0
        self.clock_sigma_s = clock_sigma_s
        self.guides: dict[tuple[int, int], Guide] = {}
        self._keep_s = keep_s
        self.samples = (Samples(), Samples())
        self._attitudes: tuple[list[tuple[float, AttitudeSeen]], list[tuple[float, AttitudeSeen]]] = ([], [])
        self._depths: tuple[list[tuple[float, DepthSeen]], list[tuple[float, DepthSeen]]] = ([], [])
        self._events: list[tuple[float, int, int, Sight | FixSeen | int]] = []
        self._turning = (Turning(), Turning())
        self._ports = np.stack([node.rig.depth_port_m for node in self.nodes])

    # -- what comes in

    def seconds(self, node: int, stamp_ns: int) -> float:
        """Give a stamp of a node as s since the epoch, on A's clock as first believed."""
        if self.epoch_ns is None:
            self.epoch_ns = stamp_ns - stamp_ns % 86_400_000_000_000
        return (stamp_ns - (self.clock_ns if node else 0) - self.epoch_ns) * 1e-9

    def between(self, stamp_ns: int) -> float:
        """Give a stamp between both clocks, as those of fixes and rows are, as `seconds` does."""
        return self.seconds(0, stamp_ns - self.clock_ns // 2)

    def add_imu(self, node: int, stamps_ns: Stamps, accel_mps2: Floats, gyro_radps: Floats) -> None:
        """Take inertial samples (N,), (N, 3), (N, 3) in the body frame."""
        if not len(stamps_ns):
            return
        self.seconds(node, int(stamps_ns[0]))
        assert self.epoch_ns is not None
        times_s = np.asarray(stamps_ns - (self.clock_ns if node else 0) - self.epoch_ns, np.float64) * 1e-9
        R_body_camera = self.nodes[node].rig.R_body_camera
        with np.errstate(invalid="ignore", over="ignore"):
            values = np.hstack((accel_mps2 @ R_body_camera, gyro_radps @ R_body_camera))
            values[clipped(gyro_radps), 3:] = np.nan
        self.samples[node].add(times_s, values)

    def add_attitude(self, node: int, seen: AttitudeSeen) -> None:
        """Take an attitude message; sigmas that no attitude filter reaches are taken for unknown."""
        if not (seen.sigma_rad > LEAST_SIGMA_RAD).all():
            seen = replace(seen, sigma_rad=np.maximum(seen.sigma_rad, UNTOLD_SIGMA_RAD))
            self._report(f"node {'ab'[node]}: attitude sigmas of nothing are taken for unknown")
        t_s = self.seconds(node, seen.stamp_ns)
        bisect.insort(self._attitudes[node], (t_s, seen), key=_time_of)
        self._turning[node].add(t_s, self.level_camera(node, seen))

    def add_depth(self, node: int, seen: DepthSeen) -> None:
        """Take a depth message."""
        bisect.insort(self._depths[node], (self.seconds(node, seen.stamp_ns), seen), key=_time_of)

    def add_frame(self, node: int, frame: Frame) -> None:
        """Take a picture's candidates."""
        t_s = self.seconds(node, frame.stamp_ns)
        dt_s = np.zeros(len(frame.pixels))
        if len(frame.dt_ns):
            dt_s += frame.dt_ns * 1e-9
        sight = sight_of(self.nodes[node].rig, node, frame.stamp_ns, t_s, frame.pixels, frame.sigma_px, dt_s)
        self._push(t_s, 1 + node, sight)

    def add_fix(self, fix: FixSeen) -> None:
        """Take a pose that one trigger's lights gave by themselves; one beyond all measure is left out."""
        numbers = np.concatenate((fix.t_a_b_m.ravel(), fix.R_a_b.ravel(), fix.covariance.ravel()))
        if not np.isfinite(numbers).all() or np.abs(numbers).max() > BEYOND:
            self._report("nodes a and b: fixes beyond all measure are left out")
            return
        self._push(self.between(fix.stamp_ns), 0, fix)

    def _push(self, t_s: float, kind: int, what: Sight | FixSeen | int) -> None:
        # The count keeps two of a kind at one time in their order: they cannot be compared.
        self._count += 1
        heapq.heappush(self._events, (t_s, kind, self._count, what))

    # -- what goes on

    def advance(self, to_ns: int, outputs_ns: list[int] | None = None) -> list[TrackRow]:
        """Go on to to_ns, up to which all has been added; return the track at the asked stamps in between.

        Events within HOLD_S of to_ns wait for the next call, so that the result does not depend on how often it is
        called.
        """
        end_s = self.seconds(0, to_ns) - HOLD_S
        rows: list[TrackRow] = []
        for stamp_ns in outputs_ns or ():
            self._push(self.between(stamp_ns), 3, stamp_ns)
        while self._events and self._events[0][0] <= end_s:
            t_s, _, _, what = heapq.heappop(self._events)
            if isinstance(what, int):
                row = self._row(t_s, what)
                if row is not None:
                    rows.append(row)
            elif isinstance(what, FixSeen):
                self._take_fix(t_s, what)
            else:
                self._take_sight(t_s, what)
        if math.isfinite(self._keep_s):
            self._forget_before(end_s - MEMORY_S)
        return rows

    def _forget_before(self, t_s: float) -> None:
        """Drop what no step will look at again."""
        for node in (0, 1):
            self.samples[node].forget_before(t_s)
            self._turning[node].forget_before(t_s)
            for items in (self._attitudes[node], self._depths[node]):
                while len(items) > 1 and items[0][0] < t_s:
                    items.pop(0)

    def _estimates(self) -> list[Estimate]:
        return ([self.main] if self.main else []) + self.challengers

    def increments(self, estimate: Estimate, t_s: float) -> tuple[Increment, Increment]:
        """Integrate both nodes from the estimate's time to t_s."""
        state = estimate.state
        parts = []
        for node in (0, 1):
            shift = float(np.clip(state.delay_s[node], -MAX_DELAY_S, MAX_DELAY_S))
            grid, values, told = self.samples[node].between(estimate.t_s + shift, t_s + shift, t_s + HOLD_S)
            without = not told.any() and not self.samples[node].near(t_s + shift, t_s + HOLD_S)
            if without:
                values = np.zeros_like(values)
            part = integrate(state, node, grid, values[:, :3], values[:, 3:], told)
            parts.append(replace(part, without=True) if without else part)
        return parts[0], parts[1]

    def _noises(self, t_s: float) -> tuple[Noise, Noise]:
        a, b = (self.samples[node].noise(t_s).scaled(self.unrest) for node in (0, 1))
        return a, b

    def _move(self, estimate: Estimate, t_s: float) -> tuple[Floats, Floats, Floats]:
        span_s = t_s - estimate.t_s
        parts = self.increments(estimate, t_s)
        noises = self._noises(t_s)
        after, F = propagate(estimate.state, parts, span_s)
        Q, walk = process_noise(after, parts, noises, span_s)
        for node, part in enumerate(parts):
            if part.without != estimate.without[node]:
                # The unit has stopped, or come back: its constants and what stands in their place are told anew.
                estimate.without[node] = part.without
                walk[GYRO_BIAS[node].start - NAV : GYRO_BIAS[node].stop - NAV] += WITHOUT_RADPS**2
                walk[MOUNT[node].start - NAV : MOUNT[node].stop - NAV] += WITHOUT_RAD**2
        estimate.covariance = predicted(estimate.covariance, F, Q, walk)
        estimate.state, estimate.t_s = after, t_s
        estimate.rates_radps = np.stack((parts[0].rate_radps, parts[1].rate_radps))
        return F, Q, walk

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
        while estimate.steps and estimate.steps[0].t_s < t_s - self._keep_s:
            estimate.steps.pop(0)
        lights = sum(len(look.chosen) for look in looks)
        if together:
            last = estimate.steps[-1]
            estimate.steps[-1] = replace(
                last,
                after=estimate.state,
                covariance=estimate.covariance,
                light_s=estimate.light_s,
                lights=last.lights + lights,
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
                    lights=lights,
                    looks=looks,
                )
            )

    def _take_lights(self, estimate: Estimate, sight: Sight) -> Look:
        observer = sight.node
        lights_m = self.nodes[1 - observer].rig.lights_m
        camera = self.nodes[observer].rig.camera
        offset_s = sight.t_s - estimate.t_s
        X, D = light_positions(estimate.state, observer, lights_m, estimate.rates_radps, sight.dt_s + offset_s)
        detection = estimate.detection[observer].copy()
        wide = estimate.covariance[:3, :3].trace() > (0.1 * float(np.linalg.norm(estimate.state.r_m))) ** 2
        if wide:
            inside = [True, True]
        else:
            at = X[0] if len(X) else self._expected(estimate, observer)
            inside = [in_picture(camera, at[light]) for light in (0, 1)]
            detection = detection * np.where(inside, 1.0, 0.02)
        clutter = max(len(sight.index) - 1.0, 1.0) / camera.area_px2
        y, H = residuals(sight.bearings, sight.tangents, X, D)
        guide = self.guides.get((sight.stamp_ns, observer))
        if guide is None:
            found = associate(y, H, estimate.covariance[_BLOCK], sight.sigma_px, detection, clutter)
        else:
            found = associate(*self._without(guide, sight), sight.sigma_px, detection, clutter)
        estimate.evidence += found.evidence
        estimate.evidence_by[observer] += found.evidence
        for light in (0, 1):
            if inside[light]:
                old = estimate.detection[observer, light]
                estimate.detection[observer, light] = min(max(old + 0.05 * (found.seen[light] - old), 0.02), 0.97)
        if found.chosen:
            self._update_lights(estimate, found, y, H, sight)
            if estimate.unseen_by == observer:
                estimate.unseen_by = None
            estimate.bars += len(found.chosen) == 2
            estimate.told_by[observer] += 1
        return Look(sight, found.chosen)

    def _expected(self, estimate: Estimate, observer: int) -> Floats:
        lights_m = self.nodes[1 - observer].rig.lights_m
        X, _ = light_positions(estimate.state, observer, lights_m, estimate.rates_radps, np.zeros(1))
        at: Floats = X[0]
        return at

    def _without(self, guide: Guide, sight: Sight) -> tuple[Floats, Floats, Floats]:
        """Give residuals, Jacobians and covariance by all the dive but this picture.

        The picture's own part is taken out of the smoothed estimate: P' = P + K H P, K = P H^T (R - H P H^T)^-1.
        """
        lights_m = self.nodes[1 - sight.node].rig.lights_m
        dt_s = sight.dt_s + guide.after_s
        X, D = light_positions(guide.state, sight.node, lights_m, guide.rates_radps, dt_s)
        y, H = residuals(sight.bearings, sight.tangents, X, D)
        P = guide.covariance
        if guide.chosen:
            H_used = np.concatenate([H[k, light] for k, light, _ in guide.chosen])
            y_used = np.concatenate([y[k, light] for k, light, _ in guide.chosen])
            R = np.diag(np.repeat([variance for _, _, variance in guide.chosen], 2))
            across = P @ H_used.T
            rest = R - H_used @ across
            # Rounding, and pictures that share a step, can leave less than nothing.
            values, vectors = np.linalg.eigh(rest)
            inverse = (vectors / np.maximum(values, 0.02 * R[0, 0])) @ vectors.T
            gain = across @ inverse
            P = P + gain @ across.T
            y = y + H @ (gain @ y_used)
        return y, H, P

    def _update_lights(self, estimate: Estimate, found: Association, y: Floats, H: Floats, sight: Sight) -> None:
        rows_y = np.concatenate([y[k, light] for k, light, _ in found.chosen])
        rows_H = np.zeros((len(rows_y), SIZE))
        rows_H[:, COLUMNS] = np.concatenate([H[k, light] for k, light, _ in found.chosen])
        noise = np.diag(np.repeat([variance for _, _, variance in found.chosen], 2))
        estimate.surprise += self._apply(estimate, rows_H, rows_y, noise)
        estimate.told += len(rows_y)
        estimate.light_s = max(estimate.light_s, sight.t_s)
        estimate.trigger = [seen for seen in estimate.trigger if sight.t_s - seen[0] < 0.03]
        estimate.trigger += [(sight.t_s, sight.node, light) for _, light, _ in found.chosen]

    @staticmethod
    def _apply(estimate: Estimate, H: Floats, y: Floats, noise: Floats) -> float:
        error, estimate.covariance, chi2 = anchors.kalman(estimate.covariance, H, y, noise)
        estimate.state = estimate.state.plus(error)
        return chi2

    def _take_depth(self, estimate: Estimate, t_s: float) -> None:
        of_a, of_b = (newest_before(of_node, t_s) for of_node in self._depths)
        if of_a is None or of_b is None:
            return
        (time_a, a), (time_b, b) = of_a, of_b
        time_s = max(time_a, time_b)
        if min(time_a, time_b) <= estimate.depth_s or t_s - time_s > 0.3 or abs(time_a - time_b) > 0.2:
            return
        estimate.depth_s = time_s
        y, H = anchors.depth_residual(estimate.state, b.depth_m - a.depth_m, t_s - 0.5 * (time_a + time_b), self._ports)
        noise = a.sigma_m**2 + b.sigma_m**2 + (0.3 * (time_a - time_b)) ** 2 + 1e-6
        variance = float((H @ estimate.covariance @ H.T)[0, 0]) + noise
        if y[0] ** 2 < 16.0 * variance:
            self._apply(estimate, H, y, np.array([[noise]]))

    def _take_attitude(self, estimate: Estimate, t_s: float) -> None:
        for node in (0, 1):
            found = newest_before(self._attitudes[node], t_s)
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
            near = self._turning[node].at(t_s, t_s + HOLD_S) if estimate.without[node] else None
            if near is None:
                continue
            R_level_camera, variances = near
            y, H = anchors.attitude_residual(estimate.state, node, R_level_camera)
            y = y - estimate.state.mount_rad[node]
            H[:, MOUNT[node]] = np.eye(3)
            noise = (R_level_camera * variances) @ R_level_camera.T
            S = noise + (H @ estimate.covariance @ H.T)
            if float(y @ np.linalg.solve(S, y)) < 30.0:
                self._apply(estimate, H, y, noise)

    def level_camera(self, node: int, seen: AttitudeSeen) -> Floats:
        """Give R_level_camera of an attitude message."""
        R: Floats = seen.R_ned_body @ self.nodes[node].rig.R_body_camera
        return R

    # -- start, confirmation, restart

    def _check_units(self, t_s: float) -> None:
        """Every seconds, say what is wrong with a unit; it is not used until it is well again."""
        if t_s - self._checked_s < CHECK_EVERY_S:
            return
        # At the dive's start there is little to judge by: at every picture, until there is enough.
        if min(len(samples.last(t_s, CHECK_EVERY_S)) for samples in self.samples) > 100:
            self._checked_s = t_s
        for node, samples in enumerate(self.samples):
            seen = newest_before(self._attitudes[node], t_s)
            down = None
            if seen is not None and t_s - seen[0] < 0.5:
                down = self.level_camera(node, seen[1])[2]
            fault = fault_of("ab"[node], samples.last(t_s, CHECK_EVERY_S)[:, :3], down)
            samples.trusted = fault is None
            if fault is not None:
                self._report(fault)
            if samples.rejected > REJECTED_TO_SAY:
                self._report(f"node {'ab'[node]}: inertial samples not finite, clipped or sent twice are left out")

    def _report(self, problem: str) -> None:
        """Add a problem, each kind once."""
        kind = problem.split(":")[0:1] + problem.split(":")[-1:]
        if all(known.split(":")[0:1] + known.split(":")[-1:] != kind for known in self.problems):
            self.problems.append(problem)

    def _take_sight(self, t_s: float, sight: Sight) -> None:
        self._check_units(t_s)
        if self._waiting and t_s >= self._waiting[0].t_s:
            if self.main is not None:
                self.finished.append(self.main)
            self.main = self._waiting.pop(0)
        for estimate in self._estimates():
            if t_s >= estimate.t_s and t_s > estimate.start_s + estimate.skip_s and t_s < estimate.end_s:
                if estimate.unseen_by == sight.node and not estimate.confirmed:
                    self._fork(estimate, t_s, sight)
                self._step(estimate, t_s, sight)
        self._judge(t_s)
        self._search(t_s, sight)

    def _take_fix(self, t_s: float, fix: FixSeen) -> None:
        if not self.restarts:
            return
        self._fix_s = t_s
        agreed = False
        for estimate in self._estimates():
            if self._agrees(estimate, t_s, fix):
                agreed = True
        if agreed:
            return
        started = self._start(t_s, fix)
        if started is None:
            return
        if self.main is None:
            self.main = started
        else:
            started.baseline = self.main.evidence
            self.challengers.append(started)
            self.challengers = self.challengers[-3:]

    def _agrees(self, estimate: Estimate, t_s: float, fix: FixSeen) -> bool:
        row = self._predict(estimate, t_s, TOGETHER_S)
        t_a_b, covariance, _, _ = pose_of(*row, estimate.rates_radps)
        R_a_b = at_one_time(row[0], estimate.rates_radps).R
        R_a_b = R_a_b[0].T @ R_a_b[1]
        gap = np.concatenate((fix.t_a_b_m - t_a_b, rotation_log(fix.R_a_b @ R_a_b.T)))
        S = covariance + fix.covariance + np.diag([1e-4] * 3 + [1e-5] * 3)
        return float(gap @ np.linalg.solve(S, gap)) < CONTRADICTS

    def _start(self, t_s: float, fix: FixSeen) -> Estimate | None:
        attitudes = [newest_before(of_node, t_s + HOLD_S) for of_node in self._attitudes]
        force = self.samples[0].between(t_s - 0.5, t_s, t_s)[1][:, :3].mean(0) if len(self.samples[0]) else None
        made = state_from_fix(self.nodes, fix, attitudes[0][1] if attitudes[0] else None, force, self.clock_sigma_s)
        if made is None:
            return None
        state, covariance = made
        if attitudes[1] is not None and not self._faces(state, covariance, attitudes[1][1]):
            self._refused += 1
            if self._refused == REFUSED_TO_SAY:
                self._report(
                    "nodes a and b: attitudes and fixes contradict each other: another's lights, or a wrong mount"
                )
            return None
        estimate = Estimate(t_s, state, covariance, t_s)
        if attitudes[0] is not None:
            estimate.attitude_s[0] = t_s
        estimate.light_s = t_s
        self._open(estimate)
        return estimate

    def _faces(self, state: State, P: Floats, seen: AttitudeSeen) -> bool:
        """Whether B's attitude in a state is one that its message allows, its compass off by iron at worst.

        Two nodes that both look at a third's bar fit each other's lights, but not each other's headings.
        """
        y, H = anchors.attitude_residual(state, 1, self.level_camera(1, seen))
        noise = anchors.attitude_covariance(seen.R_ned_body, np.hypot(seen.sigma_rad, IRON_RAD), 1.0, 1.0)
        return float(y @ np.linalg.solve(noise + H @ P @ H.T, y)) < CONTRADICTS

    def _open(self, estimate: Estimate) -> None:
        if self._keep_s:
            still = np.eye(SIZE)[:NAV], np.zeros((NAV, NAV)), np.zeros(SIZE - NAV)
            state, rates = estimate.state, estimate.rates_radps
            first = Step(estimate.t_s, state, state, estimate.covariance, *still, rates, estimate.light_s, 0)
            estimate.steps.append(first)

    def begin(self, t_s: float, end_s: float, state: State, P: Floats) -> None:
        """Start from a state that is known beforehand, confirmed; a later one takes over at its time."""
        estimate = Estimate(
            t_s, state, P, t_s, confirmed=True, end_s=end_s, skip_s=0.0, evidence=CONFIRMED, light_s=t_s
        )
        self._open(estimate)
        self._waiting.append(estimate)

    def _judge(self, t_s: float) -> None:
        """Confirm, replace or give up, by how well each estimate has explained the pictures."""
        main = self.main
        if main is not None and main.confirmed and t_s - main.light_s > LOST_S and self.restarts:
            range_m = float(np.linalg.norm(main.state.r_m))
            sigma_m = math.sqrt(float(np.trace(main.covariance[:3, :3])))
            if sigma_m > LOST_SHARE * min(range_m, LOST_RANGE_M):
                # Nothing is told of it any more: another start is as good.
                main.end_s = main.light_s + 1.0
                main.steps = [step for step in main.steps if step.t_s < main.end_s]
                self.finished.append(main)
                self.main = main = None
        if main is not None and main.confirmed:
            for challenger in self.challengers:
                gained = main.evidence - challenger.baseline
                if challenger.evidence > max(gained, 0.0) + REPLACED and min(challenger.evidence_by) > MUTUAL:
                    main.end_s = challenger.start_s
                    main.steps = [step for step in main.steps if step.t_s < main.end_s]
                    self.finished.append(main)
                    self.main = challenger
                    self.challengers = []
                    challenger.confirmed = True
                    return
            self.challengers = [c for c in self.challengers if t_s - c.start_s < CHALLENGE_S and c.evidence > GIVEN_UP]
            return
        if not self.restarts:
            return
        pool = sorted(self._estimates(), key=lambda estimate: -estimate.evidence)
        alive: list[Estimate] = []
        for estimate in pool:
            over = t_s - estimate.start_s > estimate.patience_s and (alive or estimate.evidence < CONFIRMED)
            if estimate.evidence < GIVEN_UP or over:
                continue
            if not any(_alike(estimate, better) for better in alive):
                alive.append(estimate)
        alive = alive[:MAX_TENTATIVE]
        self.main, self.challengers = (alive[0], alive[1:]) if alive else (None, [])
        rival = max((c.evidence for c in self.challengers), default=0.0)
        # Both must see each other: who sees a third's bar alone is in front of nobody.
        best = self.main
        if best and best.evidence > max(rival, 0.0) + CONFIRMED and min(best.evidence_by) > MUTUAL:
            # A start without a fix may be of chance lights; whole bars, and lights in both pictures, are no chance.
            best.confirmed = not best.searched or (best.bars >= BARS and min(best.told_by) >= BARS)

    def _search(self, t_s: float, sight: Sight) -> None:
        """Start from this picture alone, where nothing is confirmed."""
        if not self.restarts or (self.main and self.main.confirmed) or t_s - self._searched_s < SEARCH_EVERY_S:
            return
        if self._fix_s == -np.inf:
            self._fix_s = t_s - SEARCH_AFTER_S + 0.5
        if t_s - self._fix_s < SEARCH_AFTER_S:
            return
        of_a, of_b = (newest_before(of_node, t_s + HOLD_S) for of_node in self._attitudes)
        if of_a is None or of_b is None or max(t_s - of_a[0], t_s - of_b[0]) > 0.2:
            return
        self._searched_s = t_s
        for state, P, lights in starts(self.nodes, sight, (of_a[1], of_b[1]), self.clock_sigma_s):
            estimate = Estimate(t_s, state, P, t_s, skip_s=0.006, patience_s=SEARCH_PATIENCE_S)
            estimate.unseen_by = 1 - sight.node
            estimate.searched = True
            estimate.attitude_s = [t_s, t_s]
            estimate.rates_radps = np.zeros((2, 3))
            self._force(estimate, sight, lights)
            self._open(estimate)
            self.challengers.append(estimate)

    def _fork(self, estimate: Estimate, t_s: float, sight: Sight) -> None:
        """Follow each candidate of the node that has not yet told anything as each light, as estimates of their own."""
        if len(self.challengers) > 3 * MAX_TENTATIVE:
            return
        base = replace(
            estimate,
            detection=estimate.detection.copy(),
            trigger=list(estimate.trigger),
            attitude_s=list(estimate.attitude_s),
            without=list(estimate.without),
            evidence_by=list(estimate.evidence_by),
            told_by=list(estimate.told_by),
            steps=list(estimate.steps),
            unseen_by=None,
        )
        self._step(base, t_s, None)
        lights_m = self.nodes[1 - sight.node].rig.lights_m
        offset_s = sight.dt_s + (t_s - base.t_s)
        X, D = light_positions(base.state, sight.node, lights_m, base.rates_radps, offset_s)
        y, H = residuals(sight.bearings, sight.tangents, X, D)
        log_clutter = math.log(max(len(y) - 1.0, 1.0) / self.nodes[sight.node].rig.camera.area_px2)
        for k in range(len(y)):
            for light in (0, 1):
                if not np.isfinite(y[k, light]).all():
                    continue
                S = H[k, light] @ base.covariance[_BLOCK] @ H[k, light].T + sight.sigma_px[k] ** 2 * np.eye(2)
                chi2 = float(y[k, light] @ np.linalg.solve(S, y[k, light]))
                if chi2 > 12.0:
                    continue
                child = replace(
                    base,
                    detection=base.detection.copy(),
                    trigger=list(base.trigger),
                    attitude_s=list(base.attitude_s),
                    without=list(base.without),
                    steps=list(base.steps),
                )
                gain = -0.5 * chi2 - 0.5 * math.log(np.linalg.det(S)) - math.log(2.0 * math.pi) - log_clutter
                child.evidence += gain + math.log(0.2)
                child.evidence_by = list(base.evidence_by)
                child.told_by = list(base.told_by)
                chosen = ((k, light, START_PX**2),)
                self._update_lights(child, Association(chosen, np.ones(2), 0.0, 0), y, H, sight)
                if child.steps:
                    child.steps[-1] = replace(child.steps[-1], after=child.state, covariance=child.covariance)
                self.challengers.append(child)

    def _force(self, estimate: Estimate, sight: Sight, lights: tuple[int, int]) -> None:
        lights_m = self.nodes[1 - sight.node].rig.lights_m
        X, D = light_positions(estimate.state, sight.node, lights_m, estimate.rates_radps, sight.dt_s)
        y, H = residuals(sight.bearings, sight.tangents, X, D)
        chosen = tuple((k, light, START_PX**2) for light, k in enumerate(lights))
        self._update_lights(estimate, Association(chosen, np.ones(2), 0.0, 0), y, H, sight)

    # -- what goes out

    def _predict(self, estimate: Estimate, t_s: float, least_s: float = 0.0) -> tuple[State, Floats]:
        span_s = t_s - estimate.t_s
        if span_s <= least_s:
            return estimate.state, estimate.covariance
        parts = self.increments(estimate, t_s)
        after, F = propagate(estimate.state, parts, span_s)
        Q, walk = process_noise(after, parts, self._noises(t_s), span_s)
        return after, predicted(estimate.covariance, F, Q, walk)

    def _row(self, t_s: float, stamp_ns: int) -> TrackRow | None:
        if self.main is None or not self.main.confirmed or t_s < self.main.t_s:
            return None
        main = self.main
        while t_s - main.t_s > 1.5 * TICK_S:
            self._step(main, main.t_s + TICK_S, None)
        state, P = self._predict(main, t_s)
        return row_of(
            stamp_ns, state, P, main.rates_radps, len({(n, i) for _, n, i in main.trigger}), t_s - main.light_s
        )


def _alike(one: Estimate, other: Estimate) -> bool:
    """Whether two estimates are of one pose: a twentieth of the range and 0.06 rad."""
    if one.unseen_by != other.unseen_by:
        return False
    range_m = float(np.linalg.norm(other.state.r_m))
    first, second = (e.state.R[0].T @ e.state.r_m for e in (one, other))
    if np.linalg.norm(first - second) > 0.05 * range_m:
        return False
    turned, meant = (e.state.R[0].T @ e.state.R[1] for e in (one, other))
    return float(np.linalg.norm(rotation_log(turned @ meant.T))) < 0.06


def _time_of(item: tuple[float, object]) -> float:
    return item[0]


def newest_before(items: list[tuple[float, Seen]], t_s: float) -> tuple[float, Seen] | None:
    """Give the last of (time, message) at or before t_s, None where there is none."""
    at = bisect.bisect_right(items, t_s, key=_time_of)
    return items[at - 1] if at else None
