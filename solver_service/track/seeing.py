"""What a picture tells an estimate: which candidates are lights, and where these say that the nodes are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from buddyline.solver_service.geometry.observation import STAMP_SIGMA_S
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track import anchors
from buddyline.solver_service.track.association import LIKELY, SURE, Association, Odds, associate, doubt_of, odds_of
from buddyline.solver_service.track.estimate import REFLECTED_S, Estimate
from buddyline.solver_service.track.inputs import TrackNode
from buddyline.solver_service.track.lights import (
    BLOCK,
    COLUMNS,
    Sight,
    in_picture,
    lasting_factor,
    light_positions,
    pixels_of,
    residuals,
    with_stamp,
)
from buddyline.solver_service.track.moving import KNOWN_CLOCK_S, TrackMoves
from buddyline.solver_service.track.scale import by_scale
from buddyline.solver_service.track.shaking import without_doubts
from buddyline.solver_service.track.smoother import Path
from buddyline.solver_service.track.state import (
    CLOCK,
    MOVING,
    NAV,
    R_,
    SIZE,
    V_,
    State,
    place_covariance,
)
from buddyline.solver_service.track.sudden import SuddenTurn, with_sudden
from buddyline.solver_service.track.trail import Chosen, Look
from buddyline.solver_service.track.visible import (
    EDGE_PX,
    INSIDE,
    by_last_picture,
    found_now,
    learn_found,
    share_within,
)
from numpy.typing import NDArray

# Both nodes' pictures of one trigger are less than this apart.
ONE_TRIGGER_S: Final = 0.03
# Without units, the place must also be known better than to this share of the range, 1 sd: the error of linearization
# looks like a walk, too.
WIDE_SHARE: Final = 0.02
# A wide estimate takes its lights in so many steps.
ABOUT_STEPS: Final = 4
# What a smoothed path's covariance leaves of a light's variance is this share of it at least: where it is known to some
# hundredths, and where to rounding.
LEAST_LEFT: Final = 0.02
ROUNDING: Final = 1e-8
_STILL: Final = np.eye(MOVING)


@dataclass(frozen=True, eq=False, slots=True)
class PassGuide:
    """What a whole pass over the dive knew at one picture, for the next pass to decide its lights again.

    path, step: of the pass. look: the picture.
    """

    path: Path
    step: int
    look: Look


@dataclass(frozen=True, eq=False, slots=True)
class BySight:
    """What a path says of one picture.

    y (K, L, 2), H (K, L, 2, C): residuals and Jacobians. odds: its candidates', within (L,): how likely each light is
    within it, both by the path without what the picture has told it. inside (L,): whether each is, as the path has it.
    """

    y: Floats
    H: Floats
    odds: Odds
    within: Floats
    inside: NDArray[np.bool_]


class TrackSights(TrackMoves):
    """Updates estimates by pictures. guides: by node and stamp of a picture."""

    def __init__(self, nodes: tuple[TrackNode, TrackNode]) -> None:
        super().__init__(nodes)
        self.guides: dict[tuple[int, int], PassGuide] = {}

    def guide_by(self, path: Path) -> None:
        """Tell what a pass knew at each picture."""
        for step, looks in enumerate(path.looks):
            for look in looks:
                self.guides[look.node, look.stamp_ns] = PassGuide(path, step, look)

    def _take_lights(self, estimate: Estimate, sight: Sight) -> tuple[Look, SuddenTurn | None]:
        """Update an estimate by a picture; give the lights used, and a sudden turn that they show."""
        observer, turn = sight.node, None
        camera = self.nodes[observer].rig.camera
        X, D, y, H = self._compared(sight, estimate.state, estimate.rates_radps, sight.t_s - estimate.t_s)
        exact = sight
        # Association and evidence of a start use the plain sigmas, so that all starts compete alike.
        if estimate.confirmed:
            sight = _widened(sight, H, estimate.covariance)
        detection = found_now(estimate, observer, sight.t_s)
        place = place_covariance(estimate.state, estimate.covariance)
        share = math.sqrt(place.trace()) / float(np.linalg.norm(estimate.state.r_m))
        wide, estimate.wide = share > 0.1, share > WIDE_SHARE
        within = share_within(
            camera, pixels_of(camera, X[0]), X[0], D[0], with_stamp(estimate.covariance[BLOCK]), EDGE_PX
        )
        inside = (within > INSIDE).tolist()
        guide = self.guides.get((observer, sight.stamp_ns))
        # A start that followed doubtful lights would seem better founded than it is.
        least = LIKELY if estimate.confirmed else SURE
        given = estimate.given.get((observer, sight.stamp_ns))
        if given is not None:
            found = Association(given, np.zeros(2), 0.0)
        elif guide is not None:
            [by_path] = self._by_path(guide.path, [(guide, exact)])
            found = by_path.odds.associate(sight.sigma_px, detection, within, least)
        else:
            clutter = sight.clutter / camera.area_px2
            rigs = self.nodes[observer].rig, self.nodes[1 - observer].rig

            def likely(P: Floats) -> Association:
                P = with_stamp(P[BLOCK])
                now, by_last = by_last_picture(estimate, sight, rigs, within, y, H, P)
                return associate(y, H, P, sight.sigma_px, detection, clutter, now, least, by_last)

            found, estimate.covariance, turn = with_sudden(estimate, self._turning_s(estimate), likely)
        if wide and found.chosen and estimate.confirmed:
            y, H = self._about(estimate, sight, counted(found.chosen, sight, estimate), guide)
        # What another estimate chose may be behind the camera by this one.
        if len(chosen := in_front(found.chosen, y)) < len(found.chosen):
            found = found._replace(chosen=chosen)
        estimate.trigger_lights = [seen for seen in estimate.trigger_lights if abs(sight.t_s - seen[0]) < ONE_TRIGGER_S]
        estimate.evidence += found.evidence
        estimate.evidence_by[observer] += found.evidence
        if found.chosen:
            estimate.missed[observer] = 0
        elif any(inside) and not wide:
            estimate.missed[observer] += 1
        estimate.last_seen = found.seen if all(inside) and not wide else None
        learn_found(estimate, observer, sight.t_s, detection, within, found)
        estimate.looks_away[observer] = not found.chosen
        if found.chosen:
            if not estimate.confirmed:
                estimate.used[observer, sight.stamp_ns] = found.chosen
                found = found._replace(chosen=_widened_lights(found.chosen, estimate, sight, H))
            found = found._replace(chosen=self._update_lights(estimate, found, y, H, sight))
            if estimate.unseen_by == observer:
                estimate.unseen_by = None
            if len(found.chosen) == 2:
                estimate.bars += 1
                estimate.bar_s = sight.t_s
                estimate.late_bars += sight.t_s > estimate.start_s + REFLECTED_S
            estimate.lit_pictures[observer] += 1
        return Look(observer, sight.stamp_ns, sight.t_s, found.chosen), turn

    def _turning_s(self, estimate: Estimate) -> dict[int, float]:
        """Give, of each node that may have begun to turn suddenly, how long passed between its last two pictures."""
        if self.guessed is not None or not estimate.confirmed:
            return {}
        return {node: self.between_pictures_s(node) for node in (0, 1) if estimate.without[node]}

    def _compared(
        self, sight: Sight, state: State, rates_radps: Floats, after_s: float
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Give the lights (camera frame) and how errors move them, residuals and Jacobians; after_s after a state."""
        lights_m = self.nodes[1 - sight.node].rig.lights_m
        X, D = light_positions(state, sight.node, lights_m, rates_radps, sight.dt_s + after_s)
        y, H = residuals(sight.bearings, sight.tangents, X, D)
        return X, D, y, H

    def _by_path(self, path: Path, seen: Sequence[tuple[PassGuide, Sight]]) -> list[BySight]:
        """Give what a path says of one node's pictures, and each picture's odds by the path without what it has told.

        That is taken out of the smoothed estimate: P' = P + K H P, K = P H^T (R - H P H^T)^-1. The difference is small
        where a picture tells far more than all others do. It is exact where the pass has kept its residuals; else it is
        formed with another Jacobian than the picture was used with, and is off by some hundredths of R.
        """
        observer, count = seen[0][1].node, max(len(sight.bearings) for _, sight in seen)
        at = np.array([guide.step for guide, _ in seen])
        bearings, tangents = np.zeros((len(seen), count, 3)), np.zeros((len(seen), count, 2, 3))
        sigma_px, dt_s = np.ones((len(seen), count)), np.empty((len(seen), count))
        for n, (guide, sight) in enumerate(seen):
            of = len(sight.bearings)
            bearings[n, :of], tangents[n, :of], sigma_px[n, :of] = sight.bearings, sight.tangents, sight.sigma_px
            dt_s[n, :of], dt_s[n, of:] = sight.dt_s, sight.dt_s[-1] if of else 0.0
            dt_s[n] += guide.look.t_s - path.t_s[guide.step]
        lights_m = self.nodes[1 - observer].rig.lights_m
        X, D = light_positions(State(path.states[at]), observer, lights_m, path.rates_radps[at], dt_s)
        y, H = residuals(bearings, tangents, X, D)
        P = path.covariance(at)
        # The rows of lights that a picture did not use stay 0, and tell nothing.
        H_used, y_used = np.zeros((len(seen), 4, len(COLUMNS) + 1)), np.zeros((len(seen), 4))
        R = np.ones((len(seen), 4))
        kept = [(n, guide.look.residuals) for n, (guide, _) in enumerate(seen) if guide.look.residuals is not None]
        for n, (guide, _) in enumerate(seen):
            for row, (k, light, variance) in enumerate(in_front(guide.look.chosen, y[n])):
                rows = slice(2 * row, 2 * row + 2)
                H_used[n, rows], y_used[n, rows], R[n, rows] = H[n, k, light], y[n, k, light], variance
        for n, left in kept:
            H_used[n, : len(left.y), :-1], y_used[n, : len(left.y)] = left.H, left.y
        H_used, late = H_used[..., :-1], STAMP_SIGMA_S * H_used[..., -1:]
        across = P @ H_used.swapaxes(1, 2)
        rest = R[:, :, None] * np.eye(4) + late * late.swapaxes(1, 2) - H_used @ across
        # No light leaves less than this share of its variance.
        least = np.full((len(seen), 1), LEAST_LEFT)
        for n, left in kept:
            rest[n, : len(left.y), : len(left.y)], least[n] = left.S, ROUNDING
        values, vectors = np.linalg.eigh(rest)
        values = np.maximum(values, least * np.where(H_used.any(axis=2), R, np.inf).min(axis=1, keepdims=True))
        inverse = (vectors / values[:, None]) @ vectors.swapaxes(1, 2)
        gain = across @ inverse
        P = P + gain @ across.swapaxes(1, 2)
        y_without = y + (H[..., :-1] @ (gain @ y_used[..., None])[:, None, None])[..., 0]
        # Candidates that a picture does not have are nowhere.
        y_without[~bearings.any(axis=2)] = np.inf
        camera, P = self.nodes[observer].rig.camera, with_stamp(P)
        odds = odds_of(y_without, H, P, sigma_px, np.array([sight.clutter / camera.area_px2 for _, sight in seen]))
        at = pixels_of(camera, X[:, 0])
        within = share_within(camera, at, X[:, 0], D[:, 0], P, EDGE_PX)
        return list(map(BySight, y, H, odds, within, in_picture(camera, at, EDGE_PX)))

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
            *_, y, H = self._compared(sight, state, estimate.rates_radps, after_s)
            y = y + H[..., :-1] @ error[COLUMNS]
            if left and (near := in_front(chosen, y)):
                error = anchors.kalman(estimate.covariance, *light_rows(near, y, H)).error
        return y, H

    def _update_lights(self, estimate: Estimate, found: Association, y: Floats, H: Floats, sight: Sight) -> Chosen:
        """Update an estimate by a picture's lights; return them with the variances that they counted with."""
        used = counted(found.chosen, sight, estimate)
        rows_H, rows_y, noise = light_rows(found.chosen, y, H)
        more = counted_more(found.chosen, used)
        doubts = doubts_of(found.chosen, sight) if estimate.confirmed else np.zeros(len(rows_y))
        other = 1 - sight.node
        lights_m = self.nodes[other].rig.lights_m[[light for _, light, _ in found.chosen]]
        # Where motion is guessed, errors that last are not counted in the noise, and a gap must not be made of them.
        apart_s = sight.t_s - float(estimate.lit_s[sight.node].max())
        lasting_s = max(float(sight.lasting_s[k]) for k, *_ in found.chosen)
        own = 1.0 / lasting_factor(lasting_s, apart_s) if any(estimate.without) else 1.0
        stretched = by_scale(rows_H, estimate.state, other, lights_m), own
        error, chi2 = told_by(estimate, rows_H, rows_y, noise, more, doubts, stretched)
        estimate.state = estimate.state.plus(error)
        estimate.lasting_dof += 2 * sum(float(sight.lasting_s[k]) > 0.0 for k, *_ in found.chosen)
        note_lit(estimate, sight, used)
        estimate.chi2 += chi2
        estimate.chi2_dof += len(rows_y)
        estimate.light_s, estimate.lit_m = max(estimate.light_s, sight.t_s), float(estimate.state.range_m)
        estimate.trigger_lights += [(sight.t_s, sight.node, light) for _, light, _ in found.chosen]
        return used

    def _apply(self, estimate: Estimate, H: Floats, y: Floats, noise: Floats) -> None:
        """Update an estimate by what is no light."""
        error, _ = told_by(estimate, H, y, noise)
        estimate.state = estimate.state.plus(error)


def told_by(
    estimate: Estimate,
    H: Floats,
    y: Floats,
    noise: Floats,
    more: Floats | None = None,
    doubts: Floats | None = None,
    stretched: tuple[Floats, float] | None = None,
    *,
    others: int = 0,
) -> tuple[Floats, float]:
    """Update all but an estimate's state; give the error (SIZE,) to add to that, and chi^2 of the residuals y (m,).

    more (m,): by how much variances count more than they are, in all but chi^2. doubts (m,): of lights, which teach
    shaking and shares: the part of their variances that stands for unlikely gross errors; shaking is learned without
    it. stretched: of lights, h (m,) as `scale.by_scale` gives it, and this picture's weight, below 1 where its errors
    are those of earlier pictures. others: how many rows, the first ones, are not of lights.
    """
    before = estimate.covariance
    if more is None or not more.any():
        error, estimate.covariance, chi2, S_inverse, gain = anchors.kalman(before, H, y, noise)
    else:
        error, estimate.covariance, _, S_inverse, gain = anchors.kalman(before, H, y, noise + np.diag(more))
        chi2 = float(y @ np.linalg.solve(H @ before @ H.T + noise, y))
    if estimate.learns and estimate.by_shares.any():
        moved = H @ estimate.by_shares
        if doubts is not None:
            estimate.shares = estimate.shares.taught(y, S_inverse, moved)
        estimate.by_shares = estimate.by_shares - gain @ moved
    if estimate.learns:
        moved = H @ estimate.by_scale
        if stretched is not None:
            moved = moved + stretched[0]
            estimate.scale = estimate.scale.taught(y, stretched[1] * S_inverse, moved)
        estimate.by_scale = estimate.by_scale - gain @ moved
    if estimate.follows_walk:
        learns = before[CLOCK, CLOCK] < KNOWN_CLOCK_S**2 and not (estimate.wide and any(estimate.without))
        estimate.walking = estimate.walking.taught(y, S_inverse, H, gain, learns=learns)
    # Depth and attitudes remove little of what shaking adds: to follow that would not be worth its time. Without the
    # gauges' offset, which is not followed, depth would even add to it, more each time.
    if doubts is not None:
        moving = H[:, :MOVING]
        sure = without_doubts(S_inverse, doubts)
        by = estimate.shaken[:, :NAV, :NAV], estimate.by_shaking[:NAV]
        estimate.shaking = estimate.shaking.taught(y, sure, moving[:, :NAV], *by)
        rest = _STILL - gain[:MOVING, others:] @ moving[others:]
        pulled = estimate.shaken @ (moving[others:].T @ (S_inverse @ y)[others:])
        estimate.by_shaking = rest @ (estimate.by_shaking + pulled.T)
        estimate.shaken = rest @ estimate.shaken @ rest.T
    return error, chi2


def light_rows(chosen: Chosen, y: Floats, H: Floats) -> tuple[Floats, Floats, Floats]:
    """Give Jacobians (2 N, SIZE), residuals (2 N,) and noise (2 N, 2 N) of a picture's chosen candidates.

    y, H: of all its candidates, as `residuals` gives them.
    """
    k, light, variances = map(np.array, zip(*chosen, strict=True))
    of_lights = H[k, light]
    rows_H = np.zeros((2 * len(chosen), SIZE))
    rows_H[:, COLUMNS] = of_lights[..., :-1].reshape(2 * len(chosen), -1)
    return rows_H, y[k, light].ravel(), noise_of(variances, of_lights[..., -1], np.zeros(len(chosen)))


def counted(chosen: Chosen, sight: Sight, estimate: Estimate) -> Chosen:
    """Give a picture's lights with the variances that they count with: their errors may be those of the last pictures.

    Where motion is guessed an estimate hardly reaches beyond one picture, and they count as they are. So do those of
    starts, which compete by what they explain.
    """
    if not estimate.confirmed or any(estimate.without):
        return chosen
    lasting_s, apart_s = sight.lasting_s.tolist(), (sight.t_s - estimate.lit_s[sight.node]).tolist()
    return tuple((k, light, variance * lasting_factor(lasting_s[k], apart_s[light])) for k, light, variance in chosen)


def counted_more(chosen: Chosen, used: Chosen) -> Floats:
    """Give by how much the variances of lights (2 N,) count more than they are."""
    more = [counts - variance for (*_, variance), (*_, counts) in zip(chosen, used, strict=True)]
    return np.array([more, more]).T.ravel()


def doubts_of(chosen: Chosen, sight: Sight) -> Floats:
    """Give what the variances of lights (2 N,) have for doubts, by `doubt_of`."""
    sigma_px = sight.sigma_px.tolist()
    return np.array([doubt_of(variance, sigma_px[k]) for k, _, variance in chosen for _ in (0, 1)])


def note_lit(estimate: Estimate, sight: Sight, used: Chosen) -> None:
    """Note when lights were used."""
    for _, light, _ in used:
        estimate.lit_s[sight.node, light] = sight.t_s


def noise_of(variances: Floats, by_time: Floats, pictures: NDArray[Any]) -> Floats:
    """Give the noise (2 N, 2 N) of lights: their own, and that of their pictures' stamps, which those of one share.

    variances (N,): px^2. by_time (N, 2): how they move in their pictures, px/s. pictures (N,): which one each is in.
    """
    late, of = STAMP_SIGMA_S * by_time.ravel(), pictures.repeat(2)
    noise: Floats = (late * (of[:, None] == of)) * late[:, None]
    noise.ravel()[:: len(noise) + 1] += variances.repeat(2)
    return noise


def stacked(rows: Sequence[tuple[Floats, Floats, Floats]]) -> tuple[Floats, Floats, Floats]:
    """Give Jacobians, residuals and noise of several independent measurements as those of one."""
    H, y = np.concatenate([each[0] for each in rows]), np.concatenate([each[1] for each in rows])
    noise = np.zeros((len(y), len(y)))
    ends = np.cumsum([len(each[1]) for each in rows]).tolist()
    for end, (*_, own) in zip(ends, rows, strict=True):
        noise[end - len(own) : end, end - len(own) : end] = own
    return H, y, noise


def in_front(chosen: Chosen, y: Floats) -> Chosen:
    """Return those candidates of lights that the residuals y (K, 2, 2) have in front of the camera."""
    return tuple(one for one in chosen if math.isfinite(y[one[0], one[1], 0]))


def _widened_lights(chosen: Chosen, start: Estimate, sight: Sight, H: Floats) -> Chosen:
    """Give a start's lights with the variances that move it: widened, if it began with a fix and has both units.

    Without units a start would drift off by guessed motion before it knows its velocity. One without a fix is replayed
    once it is confirmed, and needs the full weight of its lights until then.
    """
    if start.searched or any(start.without):
        return chosen
    more = _widened(sight, H, start.covariance).sigma_px ** 2 - sight.sigma_px**2
    return tuple((k, light, variance + float(more[k])) for k, light, variance in chosen)


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
