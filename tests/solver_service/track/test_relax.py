"""Passes about a path: they end where the dive says, not where the path was; one lamp of each node is enough."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track import relax, seeing
from buddyline.solver_service.track.association import odds_of
from buddyline.solver_service.track.dive import smooth
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.inputs import FrameSeen
from buddyline.solver_service.track.lights import COLUMNS, Sight, with_stamp
from buddyline.solver_service.track.parts import parts_of
from buddyline.solver_service.track.records import feed, pass_over
from buddyline.solver_service.track.relax import PassedOver, PathPass
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.smoother import Path, smoothed
from buddyline.solver_service.track.state import MOVING, NAV, PHI, R_, SIZE, V_
from buddyline.solver_service.track.walking import Walking

from tests.solver_service.track.assignments import weigh
from tests.solver_service.track.dives import EPOCH_NS, KnownDive, Setting, bare_of, filter_of, make, score
from tests.solver_service.track.test_settling import first_pass


def passed_about(dive: KnownDive, path: Path) -> Path:
    epoch_ns = EPOCH_NS - EPOCH_NS % 86_400_000_000_000
    known = PassedOver(dive.records, epoch_ns, 0, np.zeros((2, 2)), Walking())
    track = PathPass(known, path, np.full((2, 2), 0.9), Shaking())
    pass_over(track, dive.records, ())
    return smoothed(track.passed.steps, path)


def off_by(path: Path, error: Floats) -> Path:
    """A path that is off, says so, and has used no light."""
    states = np.stack([path.state(k).plus(error).row for k in range(len(path))])
    looks = [tuple(look._replace(chosen=()) for look in of_step) for of_step in path.looks]
    return replace(path, states=states, halves=1e3 * path.halves, looks=looks)


def moved(old: Path, new: Path) -> float:
    """The mean chi^2 of a pose's twelve errors from one path to another, over twelve."""
    errors = [new.state(k).minus(old.state(k))[:NAV] for k in range(len(new))]
    covariances = [new.covariance(k)[:NAV, :NAV] for k in range(len(new))]
    chi2 = [error @ np.linalg.solve(P, error) for error, P in zip(errors, covariances, strict=True)]
    return float(np.mean(chi2)) / NAV


def test_passes_about_a_path_that_is_off_end_at_the_same_path() -> None:
    dive = make(5, Setting(seconds=6.0, false=0))
    first = filter_of(dive.records, dive.fixes)
    pass_over(first, dive.records, dive.fixes)
    right = passed_about(dive, passed_about(dive, smoothed(parts_of(first)[0].steps)))
    error = np.zeros(SIZE)
    error[R_] = 0.05 * right.state(0).r_m
    error[PHI[0]] = error[PHI[1]] = (0.0, 0.0, 0.1)
    error[PHI[1]] += (0.02, 0.0, -0.02)
    path = off_by(right, error)
    for _ in range(3):
        path = passed_about(dive, path)
    assert moved(path, right) < 0.01


def test_a_pass_believes_little_of_where_its_path_begins_in_the_dark() -> None:
    """It is what the pass before made of the same lights and samples: believed, they would count twice.

    Before the first light samples alone tell the place, linearly. So one pass comes back to the same path.
    """
    dive = make(5, Setting(seconds=9.0, false=0, near_m=1.2, far_m=1.6))
    first = filter_of(dive.records, dive.fixes)
    pass_over(first, dive.records, dive.fixes)
    path, lit_ns = smoothed(parts_of(first)[0].steps), EPOCH_NS + 6_000_000_000
    looks = [tuple(look._replace(chosen=look.chosen * (look.stamp_ns >= lit_ns)) for look in of) for of in path.looks]
    a, b = (replace(one, frames=[dark_until(lit_ns, frame) for frame in one.frames]) for one in dive.records)
    dive, right = replace(dive, records=(a, b)), replace(path, looks=looks)
    for _ in range(4):
        right = passed_about(dive, right)
    lit = next(k for k, of in enumerate(right.looks) if any(look.chosen for look in of))
    left_s = np.maximum(right.t_s[lit - 1] - right.t_s, 0.0)[:, None]
    v_mps, states = np.array((0.03, -0.02, 0.0)), right.states.copy()
    states[:, R_] -= v_mps * left_s
    states[:, V_] += v_mps * (left_s > 0.0)
    again = passed_about(dive, replace(right, states=states))
    moved_m, left_m = (np.linalg.norm(one[0, R_] - right.states[0, R_]) for one in (states, again.states))
    assert moved_m > 0.15
    assert left_m < 0.02 * moved_m


def dark_until(lit_ns: int, frame: FrameSeen) -> FrameSeen:
    """Leave a frame without candidates before a time."""
    if frame.stamp_ns >= lit_ns:
        return frame
    return replace(frame, pixels=frame.pixels[:0], sigma_px=frame.sigma_px[:0], lasting_s=frame.lasting_s[:0])


def test_what_shaking_adds_to_the_covariance_stays_a_part_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Depths beside lights once made it grow without end: a dive of seven minutes lost its track."""
    shares: list[float] = []

    def told_by(estimate: Estimate, *measured: Floats, **options: Any) -> tuple[Floats, float]:
        told = seeing.told_by(estimate, *measured, **options)
        shaken = np.diagonal(estimate.shaken, axis1=1, axis2=2)
        shares.append(float((shaken / np.diag(estimate.covariance)[:MOVING]).max()))
        return told

    monkeypatch.setattr(relax, "told_by", told_by)
    dive = make(5, Setting(seconds=40.0))
    assert smooth(dive.records, dive.fixes, dive.stamps_ns).rows
    assert max(shares) < 1.001


def test_a_path_may_go_on_after_the_last_picture() -> None:
    dive = make(5, Setting(seconds=4.0, false=0))
    first = filter_of(dive.records, dive.fixes)
    pass_over(first, dive.records, dive.fixes)
    path = smoothed(parts_of(first)[0].steps)
    last_ns = EPOCH_NS + 3_000_000_000
    records = [replace(one, frames=[f for f in one.frames if f.stamp_ns < last_ns]) for one in dive.records]
    shorter = passed_about(replace(dive, records=(records[0], records[1])), path)
    assert 5 < len(shorter) < len(path) - 5
    assert moved(path, shorter) < 1.0


def test_pictures_are_weighed_together_by_all_the_dive_but_themselves() -> None:
    """Each as by the information filter's own algebra: what the picture told is subtracted from the information."""
    dive = make(7, Setting(seconds=6.0))
    first = filter_of(dive.records, dive.fixes)
    pass_over(first, dive.records, dive.fixes)
    path = smoothed(parts_of(first)[0].steps)
    again = filter_of(dive.records, ())
    for node, record in enumerate(dive.records):
        feed(again, node, record)
    again.guide_by(path)
    sights = {(sight.node, sight.stamp_ns): sight for _, _, _, sight in again._events if isinstance(sight, Sight)}
    counts = set()
    for node in (0, 1):
        seen = [(guide, sights[key]) for key, guide in again.guides.items() if key[0] == node]
        for (guide, sight), by_path in zip(seen, again._by_path(path, seen), strict=True):
            odds = by_path.odds
            k, after_s = guide.step, guide.look.t_s - float(path.t_s[guide.step])
            *_, y, H = again._compared(sight, path.state(k), path.rates_radps[k], after_s)
            information, told = np.linalg.inv(path.covariance(k)), np.zeros(len(COLUMNS))
            if guide.look.chosen:
                rows_H, rows_y, noise = seeing.light_rows(guide.look.chosen, y, H)
                weighted = np.linalg.solve(noise, rows_H[:, COLUMNS])
                information, told = information - weighted.T @ rows_H[:, COLUMNS], -weighted.T @ rows_y
            P = np.linalg.inv(information)
            clutter = sight.clutter / again.nodes[node].rig.camera.area_px2
            detection = np.array((0.9, 0.8))
            left_over = y - H[..., :-1] @ (P @ told)
            cases, logs = weigh(left_over, H, with_stamp(P), sight.sigma_px, detection, clutter)
            found, weighed = odds.weighed(detection)
            # Which of two that hardly differ stands first may change by rounding.
            assert sorted(map(str, found)) == sorted(map(str, cases))
            by_case = dict(zip(map(str, cases), logs, strict=True))
            assert weighed == pytest.approx([by_case[str(case)] for case in found], abs=1e-4)
            counts.add((len(sight.bearings), len(guide.look.chosen)))
    assert len(counts) > 5


def test_a_false_candidate_is_no_light_where_a_path_hardly_knows_where_the_lights_are() -> None:
    """In a second without light: a lamp that is known to hundreds of pixels need not be in the picture at all."""
    dive = make(6, Setting(seconds=6.0, near_m=2.0, far_m=3.0, false=1, dark_s=(3.0, 4.0)))
    first = filter_of(dive.records, dive.fixes)
    pass_over(first, dive.records, dive.fixes)
    path = smoothed(parts_of(first)[0].steps)
    dark = [k for k, seen in enumerate(path.looks) if seen and not any(look.chosen for look in seen)]
    halves = path.halves.copy()
    halves[dark] *= 1e5
    wide = replace(path, halves=halves)
    epoch_ns = EPOCH_NS - EPOCH_NS % 86_400_000_000_000
    often = np.full((2, 2), 0.97)
    known = PassedOver(dive.records, epoch_ns, 0, np.zeros((2, 2)), Walking())
    track = PathPass(known, wide, often.copy(), Shaking())
    for node, record in enumerate(dive.records):
        feed(track, node, record)
    sights = {(sight.node, sight.stamp_ns): sight for _, _, _, sight in track._events if isinstance(sight, Sight)}
    within, candidates = [], 0
    for key, guide in track.guides.items():
        if guide.step in dark:
            sight = sights[key]
            [by_path] = track._by_path(wide, [(guide, sight)])
            # What a picture without lights teaches is forgotten.
            track.passed.detection, track.passed.shown_s = often.copy(), [-np.inf, -np.inf]
            assert track._associated(sight, by_path).chosen == ()
            within.append(by_path.within)
            candidates += len(sight.bearings)
    assert candidates > 10
    assert 0.2 < np.mean(within) < 0.8


def test_what_a_slow_dive_says_of_a_picture_without_it_is_exact() -> None:
    """A third of a second without a unit: the picture tells far more than all others, and must be taken out whole."""
    dive = make(9, Setting(seconds=12.0, rate_hz=3.0, near_m=4.0, far_m=8.0, false=0))
    dive = replace(dive, records=bare_of(dive))
    path, part, known = first_pass(dive)

    def passed(about: Path) -> tuple[PathPass, Path]:
        track = PathPass(known, about, part.detection, part.shaking, keeps=True)
        pass_over(track, known.records, ())
        return track, smoothed(track.passed.steps, about)

    track, whole = passed(path)
    track.guide_by(whole)
    for node, record in enumerate(dive.records):
        feed(track, node, record)
    sights = {(sight.node, sight.stamp_ns): sight for _, _, _, sight in track._events if isinstance(sight, Sight)}
    spreads: list[float] = []
    for key, guide in list(track.guides.items())[4::9]:
        if len(guide.look.chosen) < 2:
            continue
        [by_path] = track._by_path(whole, [(guide, sights[key])])
        without = [
            tuple(look._replace(chosen=()) if (look.node, look.stamp_ns) == key else look for look in looks)
            for looks in path.looks
        ]
        _, other = passed(replace(path, looks=without))
        step, after_s = guide.step, guide.look.t_s - float(whole.t_s[guide.step])
        *_, y, H = track._compared(sights[key], other.state(step), other.rates_radps[step], after_s)
        clutter = np.array([sights[key].clutter])
        [exact] = odds_of(
            y[None], H[None], with_stamp(other.covariance(step))[None], sights[key].sigma_px[None], clutter
        )
        # The lights stand elsewhere by the other path, where the same errors move them a little otherwise.
        assert by_path.odds.spread_px2 == pytest.approx(exact.spread_px2, rel=0.05)
        assert np.abs(by_path.odds.y_px - exact.y_px).max() < 0.05 * np.sqrt(exact.spread_px2).max()
        spreads.append(float(np.sqrt(exact.spread_px2).max()))
    assert len(spreads) > 3
    assert max(spreads) > 10.0


@pytest.mark.slow
def test_a_dive_with_one_lamp_of_each_node_has_a_track() -> None:
    """Nothing tells the range in any one picture, nor which lamps are lit."""
    setting = Setting(seconds=24.0, poor=True)
    dive = make(6, replace(setting, dead=((0, 1), (1, 1))))
    smooth_track = smooth(dive.records, (), dive.stamps_ns)
    judged = score(replace(dive, fixes=make(6, setting).fixes), smooth_track.rows)
    assert judged.covered > 0.5
    assert judged.wrong == 0
    assert judged.nees < 3.0
    assert {(node, light) for node, light, _ in smooth_track.dark} == {(0, 1), (1, 1)}
