"""Passes over dives without inertial units: when they end, and what speaks against them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track import dive as dive_module
from buddyline.solver_service.track import settling
from buddyline.solver_service.track.association import LIKELY, SURE, Association, Odds
from buddyline.solver_service.track.dive import smooth
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.guessing import GuessedMotion
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.lights import COLUMNS
from buddyline.solver_service.track.output import TrackRow
from buddyline.solver_service.track.parts import parts_of
from buddyline.solver_service.track.records import pass_over
from buddyline.solver_service.track.relax import PassedOver, PathPass
from buddyline.solver_service.track.settling import _agreements, _stays, _without_refuted, settled
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.smoother import Path, smoothed
from buddyline.solver_service.track.state import NAV, SIZE, State
from buddyline.solver_service.track.trail import Trail

from tests.solver_service.track.dives import KnownDive, Setting, bare_of, make


@pytest.fixture(scope="module")
def bare() -> KnownDive:
    """Six seconds of two nodes without inertial units, one of whose fixes is damaged."""
    dive = make(4, Setting(seconds=6.0, near_m=4.0, far_m=8.0))
    damaged = replace(dive.fixes[0], t_a_b_m=np.full(3, np.nan))
    return replace(dive, records=bare_of(dive), fixes=[damaged, *dive.fixes])


def test_what_the_first_pass_has_found_is_told_though_the_dive_is_passed_over_again(bare: KnownDive) -> None:
    found = smooth(bare.records, bare.fixes, bare.stamps_ns)
    assert any("out of numeric range" in problem for problem in found.problems)
    assert list(found.rows)


def test_passes_that_use_fewer_pictures_than_the_first_are_not_taken(
    bare: KnownDive, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rows() -> list[TrackRow]:
        return list(smooth(bare.records, bare.fixes, bare.stamps_ns).rows)

    def settle_nowhere(*_: object, **__: object) -> None:
        """No pass settles."""

    again = rows()
    monkeypatch.setattr(settling, "GUESSING_TOLD", 1.5)
    refused = rows()
    monkeypatch.setattr(dive_module, "settled", settle_nowhere)
    first = rows()
    places = [np.array([row.t_a_b_m for row in of]) for of in (again, refused, first)]
    assert np.abs(places[1] - places[2]).max() == 0.0
    assert np.abs(places[0] - places[2]).max() > 1e-4


def first_pass(dive: KnownDive) -> tuple[Path, Estimate, PassedOver]:
    """Give the path of a filter's pass over a dive, its estimate, and what the passes that follow begin with."""
    first = TrackFilter(dive.records[0].node, dive.records[1].node, keep_s=math.inf, clock_sigma_s=0.003)
    pass_over(first, dive.records, dive.fixes)
    [part] = parts_of(first)
    known = PassedOver(
        dive.records,
        first.epoch_ns or 0,
        0,
        np.zeros((2, 2)),
        part.walking,
        guessed=GuessedMotion.of(part.walking),
        clock_sigma_s=0.003,
        fixes=[(first.pair_seconds(fix.stamp_ns), fix) for fix in dive.fixes],
    )
    return smoothed(part.steps, auxiliary=True), part, known


def contradictions(path: Path, fixes: Sequence[tuple[float, FixSeen]]) -> int:
    return sum(not agrees for _, agrees in _agreements(path, fixes))


def test_a_pass_that_keeps_the_lights_learns_nothing_of_how_likely_they_are_found(bare: KnownDive) -> None:
    path, part, known = first_pass(bare)
    track = PathPass(known, path, part.detection, part.shaking, keeps=True)
    pass_over(track, known.records, ())
    assert (track.passed.detection == part.detection).all()
    assert track.passed.chi2_dof > 200


@pytest.mark.parametrize(("ambiguous", "least", "most"), [(True, 0.0, 1e-9), (False, 0.12, 0.4)])
def test_a_pass_does_not_learn_which_lamp_is_hidden_from_one_that_may_be_either(
    bare: KnownDive, monkeypatch: pytest.MonkeyPatch, ambiguous: bool, least: float, most: float
) -> None:
    path, part, known = first_pass(bare)
    told = Association((), np.array((0.3, 0.7)), 0.0, ambiguous)
    monkeypatch.setattr(Odds, "associate", lambda *_: told)
    track = PathPass(known, path, np.full((2, 2), 0.5), part.shaking)
    pass_over(track, known.records, ())
    apart = np.ptp(track.passed.detection, axis=1)
    assert (least <= apart).all()
    assert (apart < most).all()


def test_a_whole_dives_passes_know_its_fixes(bare: KnownDive, monkeypatch: pytest.MonkeyPatch) -> None:
    counts: list[tuple[int, int]] = []

    def noted(path: Path, detection: Floats, shaking: Shaking, known: PassedOver, *told: int, doubtful: bool) -> None:
        far = [(t_s, replace(fix, t_a_b_m=1.5 * fix.t_a_b_m)) for t_s, fix in known.fixes]
        counts.append((contradictions(path, known.fixes), contradictions(path, far)))

    monkeypatch.setattr(dive_module, "settled", noted)
    smooth(bare.records, bare.fixes, bare.stamps_ns)
    [(as_told, moved)] = counts
    assert as_told == 0
    assert moved > 5


def test_the_first_pass_keeps_the_lights_and_those_after_it_decide_again(
    bare: KnownDive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the odds speak for no light at all: all that is used has been kept."""
    path, part, known = first_pass(bare)
    used: list[int] = []

    def settles_third(_: Path, new: Path, __: float) -> bool:
        used.append(sum(bool(look.chosen) for looks in new.looks for look in looks))
        return len(used) == 3

    monkeypatch.setattr(Odds, "associate", lambda *_: Association((), np.zeros(2), 0.0))
    monkeypatch.setattr(settling, "GUESSING_PASSES", 1)
    monkeypatch.setattr(settling, "_stays", settles_third)
    settled(path, part.detection, part.shaking, known, 0, doubtful=False)
    assert used == [sum(bool(look.chosen) for looks in path.looks for look in looks), 0, 0]


def test_passes_go_on_while_they_contradict_more_fixes_than_the_first_path(
    bare: KnownDive, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, part, known = first_pass(bare)
    assert contradictions(path, known.fixes) == 0
    far = [(t_s, replace(fix, t_a_b_m=1.5 * fix.t_a_b_m)) for t_s, fix in known.fixes]
    # One of them is damaged: it tells nothing.
    assert contradictions(path, far) == len(far) - 1 > 5
    assert contradictions(path, [(t_s + 1e3, fix) for t_s, fix in far]) == 0
    counts: list[int] = []

    def contradicted(*_: object) -> int:
        counts.append(int(1 <= len(counts) < 4))
        return counts[-1]

    monkeypatch.setattr(settling, "GUESSING_PASSES", 1)
    monkeypatch.setattr(settling, "_stays", lambda *_: True)
    monkeypatch.setattr(settling, "_contradictions", contradicted)
    assert settled(path, part.detection, part.shaking, known, 0, doubtful=False) is not None
    # The first path's own; three passes that contradict one fix more; the one that is taken.
    assert counts == [0, 1, 1, 1, 0]


def test_lights_between_two_near_fixes_that_agree_are_not_kept_where_one_between_contradicts(bare: KnownDive) -> None:
    path, _, known = first_pass(bare)
    damaged, *fixes = known.fixes
    assert _without_refuted(path, _agreements(path, [damaged, *fixes])) is None
    n = len(fixes) // 2
    (before_s, _), (at_s, fix), (after_s, _) = fixes[n - 1 : n + 2]
    fixes[n] = at_s, replace(fix, t_a_b_m=1.5 * fix.t_a_b_m)
    lighter = _without_refuted(path, _agreements(path, fixes))
    assert lighter is not None
    for t_s, was, now in zip(path.t_s.tolist(), path.looks, lighter.looks, strict=True):
        # Both pictures of a fix are some milliseconds from its time.
        if before_s + 0.02 < t_s < after_s - 0.02:
            assert not any(look.chosen for look in now)
        else:
            assert now == was
    # None agrees after it; the next ones that agree are far off.
    for told in (fixes[: n + 1], [fixes[0], fixes[n], fixes[-1]]):
        assert _without_refuted(path, _agreements(path, told)) is None


def test_lights_that_a_fix_refutes_are_kept_if_the_fix_is_wrong(
    bare: KnownDive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It contradicts what all other lights tell, too, and two passes show that."""
    pictures: list[int] = []

    class CountedPass(PathPass):
        def __init__(self, known: PassedOver, path: Path, *args: Any, **options: Any) -> None:
            pictures.append(sum(bool(look.chosen) for looks in path.looks for look in looks))
            super().__init__(known, path, *args, **options)

    monkeypatch.setattr(settling, "PathPass", CountedPass)
    _, *fixes = bare.fixes
    n = len(fixes) // 2
    wrong = [*fixes[:n], replace(fixes[n], t_a_b_m=1.5 * fixes[n].t_a_b_m), *fixes[n + 1 :]]
    right_rows = list(smooth(bare.records, fixes, bare.stamps_ns).rows)
    passes, pictures[:] = list(pictures), []
    wrong_rows = list(smooth(bare.records, wrong, bare.stamps_ns).rows)
    assert pictures[2:] == passes
    assert 0 < passes[0] - pictures[0] < 10
    places = [np.array([row.t_a_b_m for row in rows]) for rows in (right_rows, wrong_rows)]
    assert (places[1] == places[0]).all()


@pytest.mark.parametrize("lasting", [False, True])
def test_rows_are_as_sure_as_both_steps_unless_errors_of_lights_last(bare: KnownDive, *, lasting: bool) -> None:
    path, part, known = first_pass(bare)
    found = settled(path, part.detection, part.shaking, replace(known, lasting=lasting), 0, doubtful=False)
    assert found is not None
    assert (found[1].across is None) == lasting


@pytest.mark.parametrize("lasting_s", [0.0, 1.3])
def test_a_whole_dives_passes_know_whether_errors_of_its_lights_last(
    bare: KnownDive, monkeypatch: pytest.MonkeyPatch, lasting_s: float
) -> None:
    told: list[bool] = []

    def noted(path: Path, detection: Floats, shaking: Shaking, known: PassedOver, *_: int, doubtful: bool) -> None:
        told.append(known.lasting)

    monkeypatch.setattr(dive_module, "settled", noted)
    a, b = (
        replace(record, frames=[replace(f, lasting_s=np.full(len(f.pixels), lasting_s)) for f in record.frames])
        for record in bare.records
    )
    smooth((a, b), bare.fixes, bare.stamps_ns)
    assert told == [lasting_s > 0.0]


@pytest.mark.parametrize(("rate_hz", "least"), [(10.0, LIKELY), (3.0, SURE)])
def test_doubtful_lights_are_taken_where_pictures_come_soon_after_each_other(
    monkeypatch: pytest.MonkeyPatch, rate_hz: float, least: float
) -> None:
    dive = make(9, Setting(seconds=12.0, rate_hz=rate_hz, near_m=4.0, far_m=8.0, false=0))
    path, part, known = first_pass(replace(dive, records=bare_of(dive)))
    asked: list[float] = []

    def noted(odds: Odds, sigma_px: Floats, detection: Floats, within: Floats, least: float) -> Association:
        asked.append(least)
        return associate(odds, sigma_px, detection, within, least)

    associate = Odds.associate
    monkeypatch.setattr(Odds, "associate", noted)
    pass_over(PathPass(known, path, part.detection, part.shaking), known.records, ())
    # Before each node's first picture there was none.
    assert len(asked) > 20
    assert sum(one != least for one in asked) <= 2


@pytest.mark.parametrize(
    ("poses", "far", "farthest", "stays"),
    [
        (99, 0, 0.0, True),
        (99, 1, 1.2, False),
        (100, 1, 1.9, True),
        (100, 1, 2.1, False),
        (399, 3, 1.2, True),
        (399, 4, 1.2, False),
    ],
)
def test_passes_end_when_a_pass_moves_a_hundredth_of_the_poses_at_most(
    poses: int, far: int, farthest: float, stays: bool
) -> None:
    """By more than a sigma, and none by two."""
    P, count = np.diag(np.linspace(1e-6, 4e-6, len(COLUMNS))), settling.LOOKED_AT * poses
    still = State.at_rest(np.array((5.0, 0.0, 0.0)), np.tile(np.eye(3), (2, 1, 1)))
    error = np.zeros((count, SIZE))
    error[:, :NAV] = 0.99 * np.sqrt(P.diagonal()[:NAV])
    error[: settling.LOOKED_AT * far, :NAV] *= farthest / 0.99
    halves = np.tile(P[np.triu_indices(len(P))], (count, 1))
    was = replace(smoothed(Trail()), t_s=np.arange(count), states=np.tile(still.row, (count, 1)), halves=halves)
    moved = replace(was, states=State(was.states).plus(error).row)
    assert _stays(was, moved, 1.0) is stays
