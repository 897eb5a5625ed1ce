"""An estimate's steps: from picture to picture, with what each sensor adds."""

from __future__ import annotations

import heapq
import math
from abc import abstractmethod
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp
from buddyline.solver_service.track import anchors
from buddyline.solver_service.track.ahead import StepsAhead, steps_ahead
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.inputs import TrackNode
from buddyline.solver_service.track.intake import newest_before
from buddyline.solver_service.track.lights import Sight
from buddyline.solver_service.track.moving import HOLD_S, TOGETHER_S
from buddyline.solver_service.track.seeing import TrackSights
from buddyline.solver_service.track.state import MOUNT, MOVING, SHAKE, SIZE
from buddyline.solver_service.track.strapdown import Increments
from buddyline.solver_service.track.trail import EstimateStatus, Look, Step

# So many steps are integrated together at most.
MOST_TOGETHER: Final = 64
# Longest step without a frame.
TICK_S: Final = 0.1
ATTITUDE_EVERY_S: Final = 0.5
# A depth that is four sigmas off is left out.
DEPTH_GATE: Final = 16.0


class TrackSteps(TrackSights):
    """Brings estimates from picture to picture. keep_s: for how long their steps are kept.

    passes: whether this is a pass over a dive that is over, whose next pictures wait: their steps are then integrated
    together, which moves the result by some thousandths of a sigma.
    """

    def __init__(self, nodes: tuple[TrackNode, TrackNode], keep_s: float) -> None:
        super().__init__(nodes)
        self._keep_s = keep_s
        self.passes = False
        self._ahead: StepsAhead | None = None
        self._together = 1
        self._ports = np.stack([node.rig.depth_port_m for node in nodes])

    @abstractmethod
    def advance(self, to_ns: int) -> object:
        """Go on to to_ns, up to which all has been added."""

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
        turn = None
        if sight is not None:
            look, turn = self._take_lights(estimate, sight)
            looks = (look,)
        if not self._keep_s:
            return
        estimate.steps.drop_before(t_s - self._keep_s)
        if together:
            self._amend_step(estimate, looks)
        else:
            estimate.steps.append(
                Step(
                    t_s=t_s,
                    before=before.row,
                    after=estimate.state.row,
                    covariance=estimate.covariance,
                    F=moved[0],
                    Q=moved[1],
                    walk=moved[2],
                    rates_radps=estimate.rates_radps,
                    status=estimate.status,
                    looks=looks,
                )
            )
            if math.isinf(self._keep_s):
                estimate.steps.pack()
        if turn is not None:
            estimate.steps.last = turn.added_to_step(estimate.steps.last)

    @staticmethod
    def _amend_step(estimate: Estimate, looks: tuple[Look, ...] = ()) -> None:
        """Write an estimate's present state into its last step, if it keeps steps. looks: of further pictures."""
        if estimate.steps:
            last = estimate.steps.last
            estimate.steps.last = last._replace(
                after=estimate.state.row,
                covariance=estimate.covariance,
                status=estimate.status,
                looks=last.looks + looks,
            )

    def increments(self, estimate: Estimate, t_s: float) -> Increments:
        """Integrate both nodes from the estimate's time to t_s; in a pass, together with later steps."""
        if not (self.passes and estimate.confirmed) or any(estimate.without):
            return super().increments(estimate, t_s)
        step, ahead = (estimate.t_s, t_s), self._ahead
        by_shares = estimate.learns and any(samples.parted for samples in self.samples)
        if ahead is None or step not in ahead.at or ahead.by_shares != by_shares or not ahead.fits(estimate.state):
            # Where the constants move, or other steps come than were expected, fewer are integrated together.
            used_up = ahead is not None and not ahead.at
            self._together = min(2 * self._together, MOST_TOGETHER) if used_up else max(self._together // 2, 1)
            ahead = steps_ahead(self.samples, estimate.state, self._coming(step), by_shares=by_shares)
            self._ahead = ahead if step in ahead.at else None
        at = ahead.at.pop(step, None)
        return super().increments(estimate, t_s) if at is None else ahead.increments(estimate.state, at)

    def _coming(self, step: tuple[float, float]) -> list[float]:
        """Give a step's times, and those of the steps after it, by the pictures that wait."""
        times_s = list(step)
        for t_s, _, _, what in heapq.nsmallest(3 * self._together, self._events):
            if isinstance(what, Sight) and t_s - times_s[-1] >= TOGETHER_S:
                while t_s - times_s[-1] > 1.5 * TICK_S and len(times_s) <= self._together:
                    times_s.append(times_s[-1] + TICK_S)
                times_s.append(t_s)
        return times_s[: self._together + 1]

    def _take_depth(self, estimate: Estimate, t_s: float) -> None:
        told = self._depth_of(estimate, t_s)
        if told is None:
            return
        y, H, noise = told
        if y[0] ** 2 < DEPTH_GATE * (float((H @ estimate.covariance @ H.T)[0, 0]) + noise):
            self._apply(estimate, H, y, np.array([[noise]]))

    def _depth_of(self, estimate: Estimate, t_s: float) -> tuple[Floats, Floats, float] | None:
        """Give y (1,), H (1, SIZE) and the variance of both gauges' newest depths; None if they were taken before."""
        of_a, of_b = (newest_before(of_node, t_s) for of_node in self.depths)
        if of_a is None or of_b is None:
            return None
        (time_a, a), (time_b, b) = of_a, of_b
        time_s = max(time_a, time_b)
        if min(time_a, time_b) <= estimate.depth_s or t_s - time_s > 0.3 or abs(time_a - time_b) > 0.2:
            return None
        estimate.depth_s = time_s
        y, H = anchors.depth_residual(estimate.state, b.depth_m - a.depth_m, t_s - 0.5 * (time_a + time_b), self._ports)
        # Between the two messages a diver may rise or sink, by some 0.3 m/s.
        return y, H, a.sigma_m**2 + b.sigma_m**2 + (0.3 * (time_a - time_b)) ** 2 + 1e-6

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
            estimate.take_compass(node, float(y[2]), float(seen.sigma_rad[2] ** 2))
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
            row, rates = estimate.state.row, estimate.rates_radps
            status = EstimateStatus(estimate.light_s, estimate.lit_m)
            estimate.steps.append(Step(estimate.t_s, row, row, estimate.covariance, *still, rates, status))
