"""A whole dive at once, linear about an earlier pass's path: Gauss-Newton by a filter and a smoother of its errors.

A track of one lamp each begins with a range that is a fifth off. A filter that is linear at its own estimates goes
astray from there. Here every step and every light is linear about the path of the pass before, and all that moves is
the error against that path: a linear problem, solved exactly. Repeated, it comes to the likeliest path of the dive.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.inputs import TrackNode
from buddyline.solver_service.track.lights import Sight
from buddyline.solver_service.track.records import Records, pass_over
from buddyline.solver_service.track.search import FURTHEST_M
from buddyline.solver_service.track.seeing import PassGuide
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.smoother import Path, smoothed
from buddyline.solver_service.track.start import BROAD_TURN_RAD, constants_of
from buddyline.solver_service.track.state import MOVING, NAV, PHI, R_, of_place
from buddyline.solver_service.track.trail import Look, Step

# What is believed of the place at first, 1 sd, as a share of the range.
BROAD_SHARE: Final = 0.5
# A track that began with single lamps, or late, is passed over so often at most, until a pass moves no pose by so
# many sigmas. It is one where chi^2 of each residual is below UNFIT, on average, and it takes LEAST_TOLD of the lights
# of the first.
LONE_PASSES: Final = 12
STAYS_SIGMAS: Final = 0.3
LOOKED_AT: Final = 10
UNFIT: Final = 1.5
LEAST_TOLD: Final = 0.5


class PathFilter(TrackFilter):
    """Filters the errors against a path, whose steps it repeats.

    detection (2, 2): how likely each light is found. passed: the estimate, to be smoothed about the same path.
    """

    def __init__(self, nodes: tuple[TrackNode, TrackNode], path: Path, detection: Floats, shaking: Shaking) -> None:
        super().__init__(*nodes, keep_s=math.inf)
        self.restarts = False
        self._path = path
        self.guide_by(path)
        first = path.state(0)
        # Constants and walks are believed as at first, whatever a pass before made of the same lights: where that went
        # astray it has learned too small a walk.
        told, variances = constants_of(nodes, first.R, first.r_m)
        P = np.diag(variances)
        P[R_, R_] = (BROAD_SHARE * float(np.linalg.norm(first.r_m))) ** 2 * np.eye(3)
        level = BROAD_TURN_RAD**2 * np.eye(3)
        P[PHI[0], PHI[0]] = P[PHI[0], PHI[1]] = P[PHI[1], PHI[0]] = level
        P[PHI[1], PHI[1]] = level + BROAD_TURN_RAD**2 * np.eye(3)
        start_s = float(path.t_s[0])
        self._off = told.minus(first)
        self.passed = self.main = Estimate(
            start_s,
            first,
            of_place(first, P),
            start_s,
            confirmed=True,
            light_s=start_s,
            detection=detection.copy(),
            shaking=shaking,
            learns=False,
        )
        self._k = 0
        self._open(self.passed)
        self._close(self.passed)

    def _take_sight(self, t_s: float, sight: Sight) -> None:
        self._check_units(t_s)
        guide = self.guides.get((sight.node, sight.stamp_ns))
        if guide is None:
            return
        while self._k < guide.step:
            self._next(self.passed)
        self._see(self.passed, sight, guide)

    def _next(self, main: Estimate) -> None:
        """Go to the path's next step: its state there, and how far off that what is filtered is."""
        self._k += 1
        at_s, there = float(self._path.t_s[self._k]), self._path.state(self._k)
        F, Q, walk = self._move(main, at_s)
        off = self._off.copy()
        off[:MOVING] = F @ self._off
        self._off = off + main.state.minus(there)
        main.state = there
        before = there.plus(self._off)
        self._take_depth(main, at_s)
        self._take_attitude(main, at_s)
        after = there.plus(self._off)
        step = Step(at_s, before, after, main.covariance, F, Q, walk, main.rates_radps, main.light_s, main.lights)
        main.steps.append(step)
        main.steps.pack()

    def _close(self, main: Estimate) -> None:
        """Write what the last step's pictures have told into it."""
        main.steps.last = replace(
            main.steps.last,
            after=main.state.plus(self._off),
            covariance=main.covariance,
            light_s=main.light_s,
            lights=main.lights,
        )

    def _see(self, main: Estimate, sight: Sight, guide: PassGuide) -> None:
        observer = sight.node
        found = self._odds(guide, sight).associate(sight.sigma_px, main.detection[observer])
        main.evidence += found.evidence
        for light in (0, 1):
            old = main.detection[observer, light]
            main.detection[observer, light] = min(max(old + 0.05 * (found.seen[light] - old), 0.02), 0.97)
        _, y, H = self._compared(sight, main.state, main.rates_radps, sight.t_s - main.t_s)
        self.lamps.take(1 - observer, sight.t_s, found.seen)
        if found.chosen:
            self._update_lights(main, found, y, H, sight)
            main.told_by[observer] += 1
        self._close(main)
        looks = (*main.steps.last.looks, Look(observer, sight.stamp_ns, sight.t_s, found.chosen))
        main.steps.last = replace(main.steps.last, looks=looks)

    def _apply(  # type: ignore[override]
        self, estimate: Estimate, H: Floats, y: Floats, noise: Floats, *, teaches: bool = False
    ) -> float:
        at = estimate.state
        chi2 = TrackFilter._apply(estimate, H, y - H @ self._off, noise, teaches=teaches)
        self._off = self._off + estimate.state.minus(at)
        estimate.state = at
        return chi2


def settled(
    path: Path, detection: Floats, told: int, records: Records, clock_ns: int, shaking: Shaking, shares: Floats
) -> tuple[PathFilter, Path] | None:
    """Pass over a dive about the last pass's path until that does not move; None where it does not settle.

    told: the pictures that the first pass used.
    """
    for _ in range(LONE_PASSES):
        track = PathFilter((records[0].node, records[1].node), path, detection, shaking)
        track.clock_ns = clock_ns
        track.take_off(shares)
        pass_over(track, records, ())
        found = track.passed
        old, path, detection = path, smoothed(found.steps, path), found.detection
        if not bool(np.isfinite(path.states).all()):
            return None
        if _stays(old, path):
            fits = found.surprise < UNFIT * found.told and sum(found.told_by) > LEAST_TOLD * told
            near = np.linalg.norm(path.states[:, R_], axis=1).max() < FURTHEST_M
            return (track, path) if fits and near else None
    return None


def _stays(old: Path, new: Path) -> bool:
    """Whether a pass over a dive has left each pose where the pass before had it, by its covariance."""
    for k in range(0, len(new), LOOKED_AT):
        moved = new.state(k).minus(old.state(k))[:NAV]
        if not moved @ np.linalg.solve(new.covariance(k)[:NAV, :NAV], moved) < NAV * STAYS_SIGMAS**2:
            return False
    return True
