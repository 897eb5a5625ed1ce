"""How nodes without inertial units move, step by step: auxiliary residuals, and what is learned from them."""

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
from buddyline.solver_service.track.guessing import LEAST, MOST, NEAR, GuessedMotion
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.moving import TrackMoves
from buddyline.solver_service.track.output import TrackRow
from buddyline.solver_service.track.parts import parts_of
from buddyline.solver_service.track.records import pass_over
from buddyline.solver_service.track.relax import PassedOver, PathPass
from buddyline.solver_service.track.settling import _agreements, _without_refuted, settled
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.smoother import Path, smoothed
from buddyline.solver_service.track.state import MOVING, SIZE, V_, State
from buddyline.solver_service.track.trail import Look, Step, Trail
from buddyline.solver_service.track.walking import FIRST, Walking

from tests.solver_service.track.dives import KnownDive, Setting, bare_of, make

STEP_S = 0.1
COUNT = 60
CALM = FIRST[[2, 3, 3]]
LIT = Look(0, 0, 0.0, ((0, 0, 0.5),)), Look(1, 0, 0.0, ((0, 0, 0.5),))


def filtered(seen: Floats, walk: float, noise: float) -> Trail:
    """Filter velocities (N, 3) that are seen with a variance, and walk with another a step."""
    F, Q = np.eye(SIZE)[:MOVING], np.zeros((MOVING, MOVING))
    Q[V_, V_] = walk * np.eye(3)
    P, state = 1e-3 * np.eye(SIZE), State.at_rest(np.array((5.0, 0.0, 0.0)), np.tile(np.eye(3), (2, 1, 1)))
    steps = Trail()
    for k, v in enumerate(seen):
        before = state
        P = P.copy()
        P[V_, V_] += walk * np.eye(3)
        gain = P[V_, V_][0, 0] / (P[V_, V_][0, 0] + noise)
        state = state.moved(state.r_m, state.v_mps + gain * (v - state.v_mps), state.R)
        P[V_, V_] *= 1.0 - gain
        steps.append(
            Step(k * STEP_S, before.row, state.row, P, F, Q, np.zeros(SIZE - MOVING), np.zeros((2, 3)), 0.0, 0, ())
        )
    return steps


def test_auxiliary_residuals_are_those_of_the_whole_dive_at_once() -> None:
    """A step's noise is off by q s: the difference of two velocities by all that was seen, with its covariance."""
    walk, noise = 4e-3, 1e-2
    seen = np.random.default_rng(7).normal(0.0, 0.2, (COUNT, 3))
    found = smoothed(filtered(seen, walk, noise), auxiliary=True).auxiliary[1:, 0]
    apart = np.diff(np.eye(COUNT), axis=0)
    information = np.eye(COUNT) / noise + apart.T @ apart / walk
    information[0, 0] += 1.0 / (1e-3 + walk)
    covariance = np.linalg.inv(information)
    moved = apart @ covariance @ seen / noise
    assert found[:, 0] == pytest.approx((moved**2).sum(axis=1) / walk**2, rel=1e-6)
    left = np.diagonal(apart @ covariance @ apart.T)
    assert found[:, 1] == pytest.approx(3.0 * (walk - left) / walk**2, rel=1e-6)
    assert found[:, 2] == pytest.approx(walk)


@pytest.mark.parametrize("times", [0.3, 4.0])
def test_a_velocity_s_walk_is_found_whatever_was_believed(times: float) -> None:
    rng, noise = np.random.default_rng(11), 1e-3
    true = 0.5 * (times * CALM[0]) ** 2 * STEP_S
    seen = np.cumsum(rng.normal(0.0, np.sqrt(2.0 * true), (600, 3)), axis=0) + rng.normal(0.0, np.sqrt(noise), (600, 3))
    guessed = GuessedMotion.of(Walking())
    for _ in range(8):
        walk = 2.0 * guessed.calm[0] ** 2 * STEP_S
        path = smoothed(filtered(seen, walk, noise), auxiliary=True)
        guessed = guessed.relearned(path_of(path.auxiliary))
    assert guessed.calm[0] / CALM[0] == pytest.approx(times / np.sqrt(2.0), rel=0.1)


def path_of(
    auxiliary: Floats, *, without: tuple[bool, bool] = (True, True), looks: dict[int, tuple[Look, ...]] | None = None
) -> Path:
    """A path of which only what is learned from is there; each step has a light of both nodes, unless looks differ."""
    count, nothing = len(auxiliary), np.zeros(0)
    return Path(
        t_s=STEP_S * np.arange(count),
        light_s=nothing,
        lights=np.zeros(0, np.int64),
        rates_radps=nothing,
        states=nothing,
        halves=nothing,
        drawn=nothing,
        without=np.tile(without, (count, 1)),
        looks=[(looks or {}).get(k, LIT) for k in range(count)],
        oldest=nothing,
        auxiliary=auxiliary,
    )


def known(calm: Floats) -> GuessedMotion:
    return GuessedMotion(calm, np.zeros(1), calm[None])


def as_expected(densities: Floats) -> Floats:
    """Residuals of steps (N, 3) that are just as expected, where both nodes move by these densities."""
    walked = densities**2 * STEP_S * (2.0, 1.0, 1.0)
    return np.stack((np.full_like(walked, 3.0), np.full_like(walked, 3.0), walked), axis=-1)


def test_calm_walks_grow_and_shrink_as_all_residuals_ask_within_limits() -> None:
    told = as_expected(np.tile(CALM, (COUNT, 1)))
    told[:, :, 0] *= (2.0, 0.5, 1.0)
    found = known(CALM).relearned(path_of(told))
    assert found.calm == pytest.approx(CALM * np.sqrt((2.0, 0.5, 1.0)))
    told[:, :, 0] = 0.0
    shrunk = known(CALM)
    for _ in range(10):
        shrunk = shrunk.relearned(path_of(told))
    assert shrunk.calm == pytest.approx(LEAST)
    told[:, :, 0] = 1e6
    assert (known(0.99 * MOST).relearned(path_of(told)).densities <= MOST).all()


def test_a_sudden_turn_is_believed_there_alone_and_stays_believed() -> None:
    told = as_expected(np.tile(CALM, (COUNT, 1)))
    told[30, 1, 0] *= 10.0 * (2 * NEAR + 1)
    found = known(CALM).relearned(path_of(told))
    near = np.abs(np.arange(COUNT) - 30) <= NEAR
    assert (found.densities[near, 1] > 3.0 * CALM[1]).all()
    assert found.densities[~near, 1] == pytest.approx(found.calm[1])
    assert found.densities[:, [0, 2]] == pytest.approx(np.tile(found.calm[[0, 2]], (COUNT, 1)))
    assert found.at(29.96 * STEP_S) == pytest.approx(found.densities[30])
    # The next path has such a turn as is now expected.
    again = found.relearned(path_of(as_expected(found.densities)))
    assert again.densities[near, 1] == pytest.approx(found.densities[near, 1])
    # Once it is not seen any more, the step is calm again.
    told = as_expected(found.densities)
    told[20:41, 1, 0] = 0.0
    over = found.relearned(path_of(told))
    assert over.densities[near, 1] == pytest.approx(over.calm[1])


def test_a_node_that_sees_no_lamp_may_turn_as_at_first() -> None:
    dark = Look(1, 0, 0.0, ()), Look(0, 0, 0.0, ((0, 0, 0.5),))
    path = path_of(as_expected(np.tile(LEAST, (COUNT, 1))), looks={30: dark})
    found = known(LEAST).relearned(path).densities
    near = np.abs(np.arange(COUNT) - 30) <= NEAR
    assert found[near, 2] == pytest.approx(CALM[2])
    assert found[~near, 2] == pytest.approx(LEAST[2])
    assert found[:, :2] == pytest.approx(np.tile(LEAST[:2], (COUNT, 1)))


def test_a_node_that_tells_no_picture_may_turn_as_at_first_and_both_may_swim_off() -> None:
    """B is silent for a second; then both are for half a second."""
    looks = {k: LIT[:1] for k in range(20, 30)} | dict.fromkeys(range(40, 50), ())
    found = known(LEAST).relearned(path_of(as_expected(np.tile(LEAST, (COUNT, 1))), looks=looks)).densities
    # A light just before or after still tells how a node turns.
    assert found[23:27] == pytest.approx(np.tile((*LEAST[:2], CALM[2]), (4, 1)))
    assert found[43:47] == pytest.approx(np.tile(CALM, (4, 1)))
    told = [*range(22), *range(28, 42), *range(48, COUNT)]
    assert found[told] == pytest.approx(np.tile(LEAST, (len(told), 1)))


def test_steps_in_which_a_node_may_look_elsewhere_teach_nothing_of_the_calm_ones() -> None:
    """Their residuals are small, for they take more noise than there is."""
    told = as_expected(np.tile(CALM, (COUNT, 1)))
    told[12:, 2, 0] = 0.0
    looks = dict.fromkeys(range(8, COUNT), LIT[:1])
    assert known(CALM).relearned(path_of(told, looks=looks)).calm == pytest.approx(CALM)


def test_nothing_is_learned_of_a_node_that_has_a_unit() -> None:
    told = as_expected(np.tile(CALM, (COUNT, 1)))
    told[:, :, 0] *= 2.0
    found = known(CALM).relearned(path_of(told, without=(False, True)))
    assert found.calm == pytest.approx(CALM * (1.0, 1.0, np.sqrt(2.0)))


def test_each_node_turns_by_its_own_walk() -> None:
    a, b = make(4, Setting(seconds=3.0)).records
    moves = TrackMoves((a.node, b.node))
    moves.guessed = GuessedMotion(CALM, np.array((0.0, 1.0)), np.array(((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))))
    estimate = Estimate(0.0, State.at_rest(np.ones(3), np.tile(np.eye(3), (2, 1, 1))), np.eye(SIZE), 0.0)
    estimate.without = [True, True]
    for t_s, push, rates in ((-1.0, 0.1, (0.2, 0.3)), (0.5, 0.4, (0.5, 0.6)), (2.0, 0.4, (0.5, 0.6))):
        noises = moves._noises(estimate, t_s)
        assert [noise.gap_accel_mps for noise in noises] == [push, push]
        assert tuple(noise.gap_rate_radps for noise in noises) == rates


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
        fixes=[(first.between(fix.stamp_ns), fix) for fix in dive.fixes],
    )
    return smoothed(part.steps, auxiliary=True), part, known


def contradictions(path: Path, fixes: Sequence[tuple[float, FixSeen]]) -> int:
    return sum(not agrees for _, agrees in _agreements(path, fixes))


def test_a_pass_that_keeps_the_lights_learns_nothing_of_how_likely_they_are_found(bare: KnownDive) -> None:
    path, part, known = first_pass(bare)
    track = PathPass(known, path, part.detection, part.shaking, keeps=True)
    pass_over(track, known.records, ())
    assert (track.passed.detection == part.detection).all()
    assert track.passed.told > 200


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
