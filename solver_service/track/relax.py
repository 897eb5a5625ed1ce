"""A whole dive at once, linear about an earlier pass's path: Gauss-Newton by a filter and a smoother of its errors.

A filter is linear at its own estimates, of which the first of a dive are the worst. Here every step and every light is
linear about the path of the pass before, and all that moves is the error against that path: a linear problem, solved
exactly. Repeated (`settling.py`), it comes to the likeliest path of the dive. How a known path goes on and where it has
the lights does not depend on what is filtered, so that is worked out for many steps at once.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.ahead import told_steps
from buddyline.solver_service.track.association import LIKELY, SURE, Association
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.guessing import GuessedMotion
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.lamps import LampWatch
from buddyline.solver_service.track.lights import COLUMNS, Sight
from buddyline.solver_service.track.moving import HOLD_S
from buddyline.solver_service.track.records import Records
from buddyline.solver_service.track.seeing import (
    ONE_TRIGGER_S,
    BySight,
    PassGuide,
    counted,
    counted_more,
    doubts_of,
    in_front,
    light_rows,
    note_lit,
    stacked,
    told_by,
)
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.smoother import Path
from buddyline.solver_service.track.start import CLOCK_S, broad_covariance, constants_of
from buddyline.solver_service.track.state import MOVING, State, place_covariance
from buddyline.solver_service.track.stepping import DEPTH_GATE, TrackSteps
from buddyline.solver_service.track.strapdown import (
    integrate,
    noise_of_steps,
    of_nodes,
    of_pairs,
    predicted,
    propagate,
    sampled,
)
from buddyline.solver_service.track.trail import Look, Residuals, Step
from buddyline.solver_service.track.visible import found_now, learn_found
from buddyline.solver_service.track.walking import Walking

# The prior of the first place has this share of the range as sigma, and at least so many of the path's sigmas. It is
# centred where the path begins, which the same lights and samples have told: a narrow prior would count them twice.
# With a far wider one rounding would spoil the first steps.
BROAD_SHARE: Final = 0.5
PATH_SIGMAS: Final = 10.0
# Where motion is guessed, and pictures are further apart than this, the next one tells little of this one.
SOON_S: Final = 0.3
# Noise and units are judged by the samples of two seconds.
KEPT_S: Final = 3.0


@dataclass(frozen=True, eq=False)
class PassedOver:
    """What a first pass has told of a dive, beside its path.

    epoch_ns: of the path's times. clock_ns: how far B's clock is believed ahead. shares (2, 2): as `take_off` takes
    them. walking: how far biases walk. unrest, guessed: as in TrackMoves; guessed is learned anew from pass to pass.
    clock_sigma_s: 1 sd of the clocks' offset. fixes: each at its time, in order, where motion is guessed. lasting:
    whether most lights' errors last.
    """

    records: Records
    epoch_ns: int
    clock_ns: int
    shares: Floats
    walking: Walking
    unrest: float = 1.0
    guessed: GuessedMotion | None = None
    clock_sigma_s: float = CLOCK_S
    fixes: Sequence[tuple[float, FixSeen]] = ()
    lasting: bool = False


@dataclass(frozen=True, eq=False)
class _ToldStep:
    """A step that samples tell, about a path.

    F (MOVING, SIZE), walk (SIZE - MOVING,), rates_radps (2, 3): how it goes on; missed (SIZE,): by what error it misses
    the path. Q (MOVING, MOVING): noise, of which shaken (3, MOVING, MOVING) is what units add that are shaken as at the
    start of its run. lost (3,): what the samples' shares take off a camera's own turns, over that shaking.
    """

    F: Floats
    Q: Floats
    walk: Floats
    shaken: Floats
    rates_radps: Floats
    missed: Floats
    lost: Floats


class PathPass(TrackSteps):
    """Filters the errors against a path, whose steps it repeats.

    detection (2, 2): how likely each light is found. keeps: whether the path's lights are kept, not decided again.
    passed: the estimate, to be smoothed about the same path.
    """

    def __init__(
        self, known: PassedOver, path: Path, detection: Floats, shaking: Shaking, *, keeps: bool = False
    ) -> None:
        super().__init__((known.records[0].node, known.records[1].node), keep_s=math.inf)
        self.epoch_ns, self.clock_ns = known.epoch_ns, known.clock_ns
        self.unrest, self.guessed = known.unrest, known.guessed
        self.take_off(known.shares)
        self.lamps = LampWatch()
        self.guide_by(path)
        first, start_s = path.state(0), float(path.t_s[0])
        # Constants are believed as at first, whatever a pass before made of the same lights.
        told, _ = constants_of(self.nodes, first.R, first.r_m, known.clock_sigma_s)
        path_m = float(np.sqrt(np.trace(place_covariance(first, path.covariance(0)))))
        place_m = max(BROAD_SHARE * float(first.range_m), PATH_SIGMAS * path_m)
        P = broad_covariance(self.nodes, first, known.clock_sigma_s, shaking=shaking, place_m=place_m)
        self.passed = Estimate(
            start_s,
            first,
            P,
            start_s,
            confirmed=True,
            light_s=start_s,
            # The start need not have been made of lights.
            lit_m=math.inf,
            detection=detection.copy(),
            shaking=shaking,
            walking=known.walking,
            learns=False,
        )
        self._path, self._k, self._off, self._keeps = path, 0, told.minus(first), keeps
        self._open(self.passed)
        self.passed.steps.last = self.passed.steps.last._replace(before=self._off, after=self._off)
        # The shaking that a run's steps are worked out with.
        self._shaking = shaking.variances

    def advance(self, to_ns: int) -> None:
        """Go on to to_ns, up to which all has been added."""
        end_s = self.seconds(0, to_ns) - HOLD_S
        # Pictures between which no unit is found faulty, or well again.
        run: list[tuple[PassGuide, Sight]] = []
        while self._events and self._events[0][0] <= end_s:
            t_s, _, _, sight = heapq.heappop(self._events)
            trusted = [samples.trusted for samples in self.samples]
            self._check_units(t_s)
            now = [samples.trusted for samples in self.samples]
            if run and now != trusted:
                self._trust(trusted)
                self._take_run(run)
                self._trust(now)
                run = []
            guide = self.guides.get((sight.node, sight.stamp_ns)) if isinstance(sight, Sight) else None
            if guide is not None and isinstance(sight, Sight):
                run.append((guide, sight))
        if run:
            self._take_run(run)
        self._forget_before(self.passed.t_s - KEPT_S)

    def _trust(self, trusted: Sequence[bool]) -> None:
        for samples, well in zip(self.samples, trusted, strict=True):
            samples.trusted = well

    def _take_run(self, guided: Sequence[tuple[PassGuide, Sight]]) -> None:
        by_step: dict[int, list[tuple[Sight, BySight]]] = {}
        for node in (0, 1):
            of_node = [one for one in guided if one[1].node == node]
            found = self._by_path(self._path, of_node) if of_node else []
            for (guide, sight), by_path in zip(of_node, found, strict=True):
                by_step.setdefault(guide.step, []).append((sight, by_path))
        last, steps = max(by_step), self.passed.steps
        told = self._told_to(last)
        if self._k in by_step:
            steps.last = self._seen(steps.last, by_step[self._k])
        while self._k < last:
            step = self._next(told.get(self._k))
            steps.append(self._seen(step, by_step.get(self._k, ())))
            steps.pack()

    def _told_to(self, last: int) -> dict[int, _ToldStep]:
        """Work out the steps to the path's last one, where samples tell them, by the step that each starts from."""
        path, first, main = self._path, self._k, self.passed
        if last == first:
            return {}
        times_s, delays_s = path.t_s[first : last + 1], path.state(first).delay_s
        steps = told_steps(self.samples, delays_s, times_s)
        if not len(steps.told):
            return {}
        at = first + steps.told
        states, span_s = State(path.states[at]), np.diff(times_s)[steps.told]
        parts = of_pairs(integrate(of_nodes(states), replace(steps.grid, fast=None)))
        after, F = propagate(states, parts, span_s)
        noises = [self._noises(main, t_s) for t_s in path.t_s[at + 1].tolist()]
        densities, variances = np.stack([sampled(each) for each in noises], axis=1), main.shaking.variances
        Q, walk, shaken = noise_of_steps(after, parts, densities, np.tile(variances, (len(at), 1)), span_s)
        missed = after.minus(State(path.states[at + 1]))
        sudden_rad = steps.values[..., 12].max(axis=2)
        lost = np.array([self._with_sudden(np.zeros(3), turn) for turn in sudden_rad]) / variances
        self._shaking = variances
        rows = zip(F, Q, walk, shaken, parts.rate_radps, missed, lost, strict=True)
        return {k: _ToldStep(*row) for k, row in zip(at.tolist(), rows, strict=True)}

    def _next(self, told: _ToldStep | None) -> Step:
        """Go to the path's next step: its state there, and how far off that what is filtered is."""
        main, path = self.passed, self._path
        self._k += 1
        at_s, there = float(path.t_s[self._k]), path.state(self._k)
        if told is None or any(main.without):
            F, Q, walk = self._move(main, at_s)
            missed = main.state.minus(there)
        else:
            F, walk, missed = told.F, told.walk, told.missed
            learned = main.shaking.variances / self._shaking
            Q = told.Q + np.tensordot(learned + told.lost - 1.0, told.shaken, 1)
            onward = F[:, :MOVING]
            main.shaken = onward @ main.shaken @ onward.T + learned[:, None, None] * told.shaken
            main.by_shaking = onward @ main.by_shaking
            main.covariance = predicted(main.covariance, F, Q, walk)
            main.t_s, main.rates_radps = at_s, told.rates_radps
        main.state = there
        before = self._off + missed
        before[:MOVING] += F @ self._off - self._off[:MOVING]
        self._off = before
        self._take_attitude(main, at_s)
        self._take_turning(main, at_s)
        return Step(at_s, before, before, main.covariance, F, Q, walk, main.rates_radps, main.status)

    def _seen(self, step: Step, seen: Sequence[tuple[Sight, BySight]]) -> Step:
        """Take the depths and the pictures of a step together."""
        main = self.passed
        rows: list[tuple[Floats, Floats, Floats]] = []
        more: list[Floats] = []
        doubts: list[Floats] = []
        looks: list[Look] = []
        lights: list[tuple[float, int, int]] = []
        depth = self._depth_of(main, step.t_s)
        if depth is not None:
            y, H, variance = depth
            off = float(y[0] - H[0] @ self._off)
            if off * off < DEPTH_GATE * (float(H[0] @ main.covariance @ H[0]) + variance):
                rows.append((H, y, np.array(((variance,),))))
                more.append(np.zeros(1))
                doubts.append(np.zeros(1))
        for sight, by_path in seen:
            main.trigger_lights = [one for one in main.trigger_lights if abs(sight.t_s - one[0]) < ONE_TRIGGER_S]
            found = self._associated(sight, by_path)
            counts = found.chosen if self._keeps else counted(found.chosen, sight, main)
            residuals = None
            if found.chosen:
                more.append(counted_more(found.chosen, counts))
                doubts.append(doubts_of(found.chosen, sight))
                note_lit(main, sight, counts)
                H, y, noise = light_rows(found.chosen, by_path.y, by_path.H)
                rows.append((H, y, noise))
                if self.guessed is not None:
                    residuals = Residuals(y, noise + np.diag(more[-1]), H[:, COLUMNS])
                used = [(sight.t_s, sight.node, light) for _, light, _ in found.chosen]
                lights += used
                main.trigger_lights += used
                main.lit_pictures[sight.node] += 1
            looks.append(Look(sight.node, sight.stamp_ns, sight.t_s, counts, residuals))
        if rows:
            H, y, noise = stacked(rows)
            others = len(y) - 2 * len(lights)
            y, of_lights = y - H @ self._off, np.concatenate(doubts) if lights else None
            error, chi2 = told_by(main, H, y, noise, np.concatenate(more), of_lights, others=others)
            self._off = self._off + error
            if lights:
                main.chi2 += chi2
                main.chi2_dof += len(y)
                main.light_s = max(main.light_s, *(t_s for t_s, _, _ in lights))
        return step._replace(
            after=self._off, covariance=main.covariance, status=main.status, looks=(*step.looks, *looks)
        )

    def _associated(self, sight: Sight, by_path: BySight) -> Association:
        """Decide which of a picture's candidates are lights, by the path, or keep those that the path has."""
        main, observer = self.passed, sight.node
        if self._keeps:
            # What the path says of the others is not believed, nor is anything learned from it.
            kept = self.guides[observer, sight.stamp_ns].look.chosen
            return Association(in_front(kept, by_path.y), np.zeros(2), 0.0)
        detection = found_now(main, observer, sight.t_s)
        # What is likely, but not sure, is taken where the next picture comes soon and tells whether it was right.
        slow = self.guessed is not None and sight.t_s - main.shown_s[observer] > SOON_S
        least = SURE if slow else LIKELY
        found = by_path.odds.associate(sight.sigma_px, detection, by_path.within, least)
        main.evidence += found.evidence
        learn_found(main, observer, sight.t_s, detection, by_path.inside.astype(float), found)
        if by_path.inside.all():
            self.lamps.take(1 - observer, sight.t_s, found.seen)
        return found._replace(chosen=in_front(found.chosen, by_path.y))

    def _apply(self, estimate: Estimate, H: Floats, y: Floats, noise: Floats) -> None:
        error, _ = told_by(estimate, H, y - H @ self._off, noise)
        self._off = self._off + error
