"""Passes over a dive, each about the last one's path, until the path stays; and what speaks against such a path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.output import CONTRADICTS, fix_chi2
from buddyline.solver_service.track.records import last_ns, pass_over
from buddyline.solver_service.track.relax import PassedOver, PathPass
from buddyline.solver_service.track.search import FURTHEST_M
from buddyline.solver_service.track.seeing import ONE_TRIGGER_S
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.smoother import Path, smoothed
from buddyline.solver_service.track.state import NAV, R_, State
from numpy.typing import NDArray

# A dive is passed over so often at most, until a pass moves no pose by so many sigmas: the next one would move none by
# much more than a tenth of that. Of a long dive's many poses some mostly move further, and would cost another pass over
# all of it: so a hundredth may move twice as far. Tracks that began with single lamps, or late, settle more slowly.
PASSES: Final = 24
STAYS_SIGMAS: Final = 1.0
MAY_MOVE: Final = 0.01
DOUBTFUL_SIGMAS: Final = 0.3
LOOKED_AT: Final = 10
# Where motion is guessed, a dive is passed over so often at least, for each pass learns more of it. The first pass
# keeps the lights: by the motion that a filter guesses, half of a node's pictures may seem to have none. The last pass
# must use this share of the pictures that the first path used, of each node: one that uses fewer has gone astray.
GUESSING_PASSES: Final = 4
GUESSING_TOLD: Final = 0.95
# One that contradicts more fixes than the first path, by more than this share of all, has gone astray, too.
MORE_CONTRADICTED: Final = 0.01
# A doubtful track may settle at a wrong path. There is a track where chi^2 of each residual is below UNFIT, on average,
# and the last pass uses LEAST_TOLD of the first one's pictures.
UNFIT: Final = 1.5
LEAST_TOLD: Final = 0.5
# Where a dive's passes have settled with the clocks so far and so many sigmas off what they assumed, the dive is passed
# over again with what they found: of an offset they find a part. Further off, the path is no place to be linear about.
LEFT_CLOCK_S: Final = 0.002
LEFT_SIGMAS: Final = 2.0
LOST_CLOCK_S: Final = 0.02
# A fix may refute a path's lights between two fixes that agree with it, if these are no further apart.
REFUTED_S: Final = 4.0
# The first pass is without these lights, the second decides them again. A fix that contradicts the second is wrong.
REFUTING_PASSES: Final = 2


@dataclass(frozen=True, eq=False)
class _Asked:
    """What is asked of the last pass over a dive.

    doubtful: whether the first path may have been far off throughout. lit_pictures: in how many the first pass used a
    light. used (2,): the same of A and of B, by its path. contradicted: so many fixes may contradict the last path.
    Where more do, passes go on up to that of number patience, and end without a track.
    """

    doubtful: bool
    lit_pictures: int
    used: NDArray[np.int64]
    contradicted: float
    patience: int = PASSES


def settled(
    path: Path, detection: Floats, shaking: Shaking, known: PassedOver, lit_pictures: int, *, doubtful: bool
) -> tuple[PathPass, Path] | None:
    """Pass over a dive about the last pass's path until that does not move; None where it does not settle.

    lit_pictures: in how many the first pass used a light. doubtful: whether the path may be far off throughout. Where
    motion is guessed, each pass has what its path tells of it. Lights that fixes refute are left out at first; if as
    many fixes contradict what is found then, all begins again with those lights.
    """
    agreements = _agreements(path, known.fixes)
    against, lighter = _contradictions(agreements), _without_refuted(path, agreements)
    asked = _Asked(doubtful, lit_pictures, _used(path), against + MORE_CONTRADICTED * len(known.fixes))
    if lighter is not None:
        fewer = replace(asked, contradicted=against - 1, patience=REFUTING_PASSES)
        again = _settled(lighter, detection, shaking, known, fewer)
        if again is not None:
            return again
    return _settled(path, detection, shaking, known, asked)


def _settled(
    path: Path, detection: Floats, shaking: Shaking, known: PassedOver, asked: _Asked
) -> tuple[PathPass, Path] | None:
    """Pass over a dive about a path; None where that does not settle, or the last pass is not what is asked."""
    start_ns, end_ns = (known.epoch_ns + round(t_s * 1e9) for t_s in (path.t_s[0], path.t_s[-1]))
    a, b = known.records
    shift_ns = known.clock_ns
    records = (
        a.between(start_ns - S_NS, end_ns + S_NS),
        b.between(start_ns - S_NS + shift_ns, end_ns + S_NS + shift_ns),
    )
    doubtful, guesses = asked.doubtful, known.guessed is not None
    for count in range(1, PASSES + 1):
        if known.guessed is not None:
            known = replace(known, guessed=known.guessed.relearned(path))
        # Only the last pass's rows need this.
        path = replace(path, across=None)
        track = PathPass(known, path, detection, shaking, keeps=guesses and count == 1)
        pass_over(track, records, ())
        passed = track.passed
        about, detection = path, passed.detection
        path = smoothed(passed.steps, about, auxiliary=guesses, across=not (guesses and known.lasting), uses_up=True)
        if not bool(np.isfinite(path.states).all()):
            return None
        learned = not guesses or count >= GUESSING_PASSES
        stays = learned and _stays(about, path, DOUBTFUL_SIGMAS if doubtful else STAYS_SIGMAS)
        del about  # The next pass needs the memory.
        if stays or count == asked.patience:
            contradicted = _contradictions(_agreements(path, known.fixes)) > asked.contradicted
            if contradicted and count >= asked.patience:
                return None
            stays = stays and not contradicted
        if stays:
            left_s = path.state(-1).clock_s
            # What a doubtful track, or one without a gyro, tells of the clocks is little, and less than it believes.
            tells = not doubtful and not guesses
            if tells and max(LEFT_CLOCK_S, LEFT_SIGMAS * clock_sigma_s(path)) < abs(left_s) < LOST_CLOCK_S:
                known, path = replace(known, clock_ns=known.clock_ns + round(left_s * 1e9)), path.later(left_s)
                continue
            fits = passed.chi2 < UNFIT * passed.chi2_dof and sum(passed.lit_pictures) > LEAST_TOLD * asked.lit_pictures
            fits = fits and not (guesses and (_used(path) < GUESSING_TOLD * asked.used).any())
            # A path may end long before the dive does: what is wrong at its end may have ended.
            track.goes_on_to(track.seconds(0, last_ns(known.records) - S_NS))
            near = np.linalg.norm(path.states[:, R_], axis=1).max() < FURTHEST_M
            return (track, path) if near and (fits or not (doubtful or guesses)) else None
    return None


def _agreements(path: Path, fixes: Sequence[tuple[float, FixSeen]]) -> list[tuple[float, bool]]:
    """Tell which fixes, each at its time, agree with a path: with its nearest step, carried on to that time."""
    found = []
    for t_s, fix in fixes:
        after = min(max(int(path.t_s.searchsorted(t_s)), 1), len(path) - 1)
        k = after - int(t_s - path.t_s[after - 1] < path.t_s[after] - t_s)
        on_s = t_s - path.t_s[k]
        if abs(on_s) < ONE_TRIGGER_S:
            step, rates_radps = path.state(k), path.rates_radps[k]
            state = step.moved(step.r_m + on_s * step.v_mps, step.v_mps, step.R @ rotation_exp(on_s * rates_radps))
            chi2 = fix_chi2(state, path.covariance(k), rates_radps, fix)
            # That of a damaged fix is not a number.
            if not math.isnan(chi2):
                found.append((t_s, chi2 <= CONTRADICTS))
    return found


def _contradictions(agreements: Sequence[tuple[float, bool]]) -> int:
    return sum(not agrees for _, agrees in agreements)


def _without_refuted(path: Path, agreements: Sequence[tuple[float, bool]]) -> Path | None:
    """Give a path without the lights that it used between two fixes that agree with it, where one between does not.

    Not where those two are further apart than REFUTED_S: the rest of the dive tells too little of what lies between.
    None where no light is refuted.
    """
    agree_s = np.array([-math.inf, *(t_s for t_s, agrees in agreements if agrees), math.inf])
    against = np.searchsorted(agree_s, [t_s for t_s, agrees in agreements if not agrees])
    after = np.searchsorted(agree_s, path.t_s)
    before_s, after_s = agree_s[after - 1], agree_s[after]
    away_s = np.minimum(path.t_s - before_s, after_s - path.t_s)
    refuted = np.isin(after, against) & (after_s - before_s < REFUTED_S) & (away_s > ONE_TRIGGER_S)
    if not any(look.chosen for k in np.flatnonzero(refuted).tolist() for look in path.looks[k]):
        return None
    looks = [
        tuple(look._replace(chosen=()) for look in seen) if drops else seen
        for seen, drops in zip(path.looks, refuted.tolist(), strict=True)
    ]
    return replace(path, looks=looks)


def _used(path: Path) -> NDArray[np.int64]:
    """Count the pictures of A and of B (2,) in which a path uses a light."""
    used = [look.node for looks in path.looks for look in looks if look.chosen]
    return np.bincount(np.array(used, dtype=np.int64), minlength=2)


def clock_sigma_s(path: Path) -> float:
    """Give 1 sd of the clocks' offset at a path's end."""
    return math.sqrt(path.covariance(-1)[NAV, NAV])


def _stays(old: Path, new: Path, sigmas: float) -> bool:
    """Whether a pass over a dive has left each pose, but MAY_MOVE of them, within so many sigmas of the pass before's.

    Those are within twice as many.
    """
    at = np.arange(0, len(new), LOOKED_AT)
    moved = State(new.states[at]).minus(State(old.states[at]))[:, :NAV, None]
    chi2 = moved.swapaxes(1, 2) @ np.linalg.solve(new.covariance(at)[:, :NAV, :NAV], moved)
    limit = NAV * sigmas**2
    return bool((chi2 < 4.0 * limit).all() and (chi2 >= limit).sum() <= MAY_MOVE * len(at))
