"""The estimates that are followed while nothing is confirmed: starts without a fix, forks, and a second, exact pass."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Final

import numpy as np
from buddyline.solver_service.track.association import Association
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.inputs import TrackNode
from buddyline.solver_service.track.intake import newest_before
from buddyline.solver_service.track.lamps import LampWatch
from buddyline.solver_service.track.lights import BLOCK, Sight, with_stamp
from buddyline.solver_service.track.lone import fits, state_of
from buddyline.solver_service.track.moving import HOLD_S
from buddyline.solver_service.track.search import starts
from buddyline.solver_service.track.seeing import in_front
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.smoother import smoothed
from buddyline.solver_service.track.start import constants_of, enter_attitudes
from buddyline.solver_service.track.state import PHI, R_, State, of_place, place_covariance
from buddyline.solver_service.track.stepping import TICK_S, TrackSteps
from buddyline.solver_service.track.trail import Chosen, Trail
from buddyline.solver_service.track.window import gathered

# A start without a fix: how often one is tried, how long after the last fix, for how long it and how many are kept.
SEARCH_EVERY_S: Final = 0.45
SEARCH_BESIDE_S: Final = 2.0
SEARCH_AFTER_S: Final = 3.0
SEARCH_PATIENCE_S: Final = 8.0
MAX_TENTATIVE: Final = 24
# A track is perhaps wrong where so many pictures of one node on end show no light, while the other's do.
ONE_SIDED: Final = 30
# Pictures are kept for so long, and since the start of each estimate without a fix that is followed: for its replay.
SIGHTS_S: Final = 2.0
# A start from single lamps looks at so many seconds, so often; each of their lamps is found so likely, any other so.
WINDOW_S: Final = 14.0
LEAST_WINDOW_S: Final = 13.5
WINDOW_EVERY_S: Final = 3.0
LIT: Final = 0.9
UNLIT: Final = 0.05
# A start that waits for the other node is followed with each of its candidates as each light, where chi^2 (2 degrees of
# freedom) is below the gate. The share is the prior probability of each.
FORK_GATE: Final = 12.0
FORK_SHARE: Final = 0.2
# The noise of the lights that a start is made of: one in thirty is off by many pixels.
START_PX: Final = 2.5
# A replay starts with these sigmas: a share of the range, rad, or so many of the learned sigmas where that is more.
REPLAY_SHARE: Final = 0.1
REPLAY_RAD: Final = 0.15
REPLAY_SIGMAS: Final = 3.0
REPLAYS: Final = 2


class TrackPool(TrackSteps):
    """Holds the main estimate and its challengers, and finds starts without a fix.

    searches: whether any may start without a fix.
    """

    def __init__(self, nodes: tuple[TrackNode, TrackNode], keep_s: float, clock_sigma_s: float) -> None:
        super().__init__(nodes, keep_s)
        self.clock_sigma_s = clock_sigma_s
        self.main: Estimate | None = None
        self.challengers: list[Estimate] = []
        self.searches = True
        self.lamps = LampWatch()
        self._sights: deque[tuple[float, Sight]] = deque()
        self._searched_s, self._searched_of, self._windowed_s = -np.inf, 1, -np.inf
        self._fix_s = -np.inf

    def _estimates(self) -> list[Estimate]:
        return ([self.main] if self.main else []) + self.challengers

    def _remember(self, t_s: float, sight: Sight) -> None:
        """Keep the pictures that a start may be replayed with."""
        self._sights.append((t_s, sight))
        followed_s = [one.start_s for one in self._estimates() if one.searched and not one.confirmed]
        span_s = SIGHTS_S if self.main and self.main.confirmed else WINDOW_S
        while self._sights[0][0] < min([t_s - span_s, *followed_s]):
            self._sights.popleft()

    def _replayed(self, estimate: Estimate) -> Estimate:
        """Give an estimate anew from its start, with its lights decided again by all pictures since.

        A start's first updates are far from linear. They leave too small a covariance, and then lights that do not fit
        are missed. The first pass begins with the present state, taken back to the start. The next pass begins with the
        smoothed state of the first.
        """
        again, path = estimate, None
        keep_s, self._keep_s = self._keep_s, math.inf
        for _ in range(REPLAYS):
            state = self._rewound(estimate, estimate.start_s) if path is None else path.state(0)
            again = self._begun_again(estimate, state, again.shaking, estimate.used if path is None else {})
            for t_s, sight in self._sights:
                if estimate.start_s <= t_s <= estimate.t_s:
                    self._step(again, t_s, sight)
                    if path is not None and again.last_seen is not None:
                        self.lamps.take(1 - sight.node, t_s, again.last_seen)
            path = smoothed(again.steps)
            self.guide_by(path)
        self._keep_s = keep_s
        self.guides = {}
        return estimate.copied(
            t_s=again.t_s,
            state=again.state,
            covariance=again.covariance,
            shaking=again.shaking,
            chi2=again.chi2,
            chi2_dof=again.chi2_dof,
            lit_m=again.lit_m,
            steps=again.steps if keep_s else Trail(),
            attitude_s=again.attitude_s,
            depth_s=again.depth_s,
            rates_radps=again.rates_radps,
            # Fixes that contradicted it did so before it was replayed.
            contradicted=0,
            gap_chi2=0.0,
        )

    def _begun_again(
        self, estimate: Estimate, state: State, shaking: Shaking, given: dict[tuple[int, int], Chosen]
    ) -> Estimate:
        """Give an estimate's start from a state of that time, broad. shaking: as learned. given: the lights to use."""
        learned = REPLAY_SIGMAS * np.sqrt(np.diag(estimate.covariance))
        place = REPLAY_SIGMAS * np.sqrt(np.diag(place_covariance(estimate.state, estimate.covariance)))
        range_m = float(np.linalg.norm(state.r_m))
        untold, variances = constants_of(self.nodes, state.R, state.r_m, self.clock_sigma_s)
        # What was learned of the constants is learned anew: the same lights must not count twice.
        state = untold.moved(state.r_m, state.v_mps, state.R)
        P = np.diag(variances)
        P[R_, R_] = np.diag(np.maximum(place, REPLAY_SHARE * range_m) ** 2)
        enter_attitudes(P, REPLAY_RAD**2 * np.eye(3), np.diag(np.maximum(learned[PHI[1]], REPLAY_RAD) ** 2))
        begun = Estimate(
            estimate.start_s,
            state,
            of_place(state, P),
            estimate.start_s,
            given=given,
            searched=True,
            shaking=shaking,
            detection=estimate.detection.copy(),
        )
        self._open(begun)
        return begun

    def _rewound(self, estimate: Estimate, to_s: float) -> State:
        """Give the state at an earlier time: the samples, taken off again."""
        state, t_s = estimate.state, estimate.t_s
        while t_s > to_s + 1e-6:
            since_s = max(to_s, t_s - TICK_S)
            span_s = t_s - since_s
            # Where it came from follows from how far it has turned, whatever it was turned to.
            at = replace(estimate, t_s=since_s, state=state.moved(state.r_m, state.v_mps, np.stack((np.eye(3),) * 2)))
            R = state.R @ np.swapaxes(self.increments(at, t_s).R, 1, 2)
            at.state = state.moved(state.r_m, state.v_mps, R)
            parts = self.increments(at, t_s)
            v_mps = state.v_mps - (parts.dv_mps[1] - parts.dv_mps[0])
            state = state.moved(state.r_m - v_mps * span_s - (parts.dp_m[1] - parts.dp_m[0]), v_mps, R)
            t_s = since_s
        return state.with_parts(shake_rad=0.0, shove_mps=0.0)

    def _search(self, t_s: float, sight: Sight) -> None:
        """Start from this picture alone, where nothing is confirmed, or what is explains one node's pictures only."""
        every_s = SEARCH_EVERY_S
        if self.main and self.main.confirmed:
            every_s = SEARCH_BESIDE_S if max(self.main.missed) > ONE_SIDED and min(self.main.missed) == 0 else math.inf
        # Of both nodes in turn: one of them sees a single light where a lamp of the other is dead.
        again = sight.node == self._searched_of
        if not self.searches or t_s - self._searched_s < (2 if again else 1) * every_s:
            return
        if self._fix_s == -np.inf:
            self._fix_s = t_s - SEARCH_AFTER_S + 0.5
        if t_s - self._fix_s < SEARCH_AFTER_S:
            return
        of_a, of_b = (newest_before(of_node, t_s + HOLD_S) for of_node in self.attitudes)
        if of_a is None or of_b is None or max(t_s - of_a[0], t_s - of_b[0]) > 0.2:
            return
        self._searched_s, self._searched_of = t_s, sight.node
        attitudes = of_a[1], of_b[1]
        for state, P, lights in starts(self.nodes, sight, attitudes, self.clock_sigma_s):
            estimate = Estimate(
                t_s,
                state,
                P,
                t_s,
                attitude_s=[t_s, t_s],
                skip_s=0.006,
                patience_s=SEARCH_PATIENCE_S,
                unseen_by=1 - sight.node,
                searched=True,
            )
            self._force(estimate, sight, tuple((k, light, START_PX**2) for light, k in enumerate(lights)))
            if self.main and self.main.confirmed:
                estimate.baseline = self.main.evidence
                estimate.detection = self.main.detection.copy()
            self._open(estimate)
            self.challengers.append(estimate)

    def _search_window(self, t_s: float) -> None:
        """Start from single lamps, where nothing is confirmed for long; of a whole dive only.

        Such a start is linear enough only when the whole dive is passed over again and again.
        """
        since_s = max(t_s - WINDOW_S, self._sights[0][0] - 0.001)
        followed = self.main is not None and self.main.confirmed
        if followed or not self.searches or t_s - since_s < LEAST_WINDOW_S or math.isfinite(self._keep_s):
            return
        if t_s - self._fix_s < SEARCH_AFTER_S or t_s - self._windowed_s < WINDOW_EVERY_S:
            return
        self._windowed_s = t_s
        sights = [sight for at_s, sight in self._sights if at_s > since_s]
        window = gathered(self.nodes, self.samples, self.attitudes, self.depths, sights, since_s)
        if window is None:
            return
        pool = [one for one in self._estimates() if not one.lone]
        try:
            found = [(fit, *state_of(window, fit, self.clock_sigma_s)) for fit in fits(window)]
        except np.linalg.LinAlgError:
            return
        for fit, state, P in found:
            estimate = Estimate(
                since_s,
                state,
                P,
                since_s,
                patience_s=WINDOW_S + SEARCH_PATIENCE_S,
                searched=True,
                lone=True,
                detection=np.full((2, 2), UNLIT),
            )
            for node in (0, 1):
                estimate.detection[node, fit.seen[node][0, 2]] = LIT
            self._open(estimate)
            for sight in sights:
                self._follow(estimate, sight.t_s, sight)
            pool.append(estimate)
        self.main, self.challengers = None, pool

    def _follow(self, estimate: Estimate, t_s: float, sight: Sight) -> None:
        """Bring an estimate that is not confirmed to a picture."""
        self._step(estimate, t_s, sight)
        estimate.evidence_history.append((t_s, estimate.evidence))
        if estimate.last_seen is not None:
            estimate.seen_history.append((1 - sight.node, t_s, estimate.last_seen))

    def _fork(self, estimate: Estimate, t_s: float, sight: Sight) -> None:
        """Follow each candidate of the node that has not yet told anything as each light, as estimates of their own."""
        if len(self.challengers) > 3 * MAX_TENTATIVE:
            return
        self._step(estimate, t_s, None)
        state, rates_radps, P = estimate.state, estimate.rates_radps, with_stamp(estimate.covariance[BLOCK])
        *_, y, H = self._compared(sight, state, rates_radps, sight.t_s - estimate.t_s)
        log_clutter = math.log(sight.clutter / self.nodes[sight.node].rig.camera.area_px2)
        for k in range(len(y)):
            for light in (0, 1):
                if not np.isfinite(y[k, light]).all():
                    continue
                S = H[k, light] @ P @ H[k, light].T + sight.sigma_px[k] ** 2 * np.eye(2)
                chi2 = float(y[k, light] @ np.linalg.solve(S, y[k, light]))
                if chi2 > FORK_GATE:
                    continue
                child = estimate.copied(unseen_by=None)
                chosen = ((k, light, START_PX**2),)
                # With a heading 17 degrees off, one linear step ends 22 px beside the light, with a sigma of 3 px.
                near_y, near_H = self._about(child, sight, chosen, None)
                if not in_front(chosen, near_y):
                    continue
                spread = float(np.linalg.det(S))
                if spread <= 0.0:
                    raise ArithmeticError("a light's place without a covariance")
                gain = -0.5 * chi2 - 0.5 * math.log(spread) - math.log(2.0 * math.pi) - log_clutter
                child.evidence += gain + math.log(FORK_SHARE)
                self._update_lights(child, Association(chosen, np.ones(2), 0.0), near_y, near_H, sight)
                child.used[sight.node, sight.stamp_ns] = chosen
                child.looks_away[sight.node] = False
                self._amend_step(child)
                self.challengers.append(child)

    def _force(self, estimate: Estimate, sight: Sight, chosen: Chosen) -> None:
        """Update a start by the lights of the picture that it is made of."""
        *_, y, H = self._compared(sight, estimate.state, estimate.rates_radps, sight.t_s - estimate.t_s)
        if np.isfinite([y[k, light] for k, light, _ in chosen]).all():
            self._update_lights(estimate, Association(chosen, np.ones(2), 0.0), y, H, sight)
            estimate.used[sight.node, sight.stamp_ns] = chosen
