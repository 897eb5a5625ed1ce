"""Live tracks in their first seconds: none is wrong for long, and rows end with the messages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from buddyline.node.sim.dive import messages
from buddyline.node.sim.scenario import ENVIRONMENTS, DivePlan, Environment, InertialGrade, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import LightTruth, NodePose, RelativePose, Track, Truth
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.track import filter as track_filter
from buddyline.solver_service.track.filter import MEAN_CONTRADICTS
from buddyline.solver_service.tracking import TrackSettings
from buddyline.tools.evaluation.tracks import TrackFigures, tracks_figures
from buddyline.tools.evaluation.truth import TruthTrack

from tests.solver_service.track.dives import EPOCH_NS, Setting, filter_of, make

SECONDS = 4.0


def live(
    seed: int, grade: InertialGrade | None, water: Environment | None = None, rate_hz: float = 10.0
) -> tuple[list[Track], TrackFigures]:
    """Solve a dive's first seconds as they come; return the live rows and their figures."""
    water = water or ENVIRONMENTS[seed % len(ENVIRONMENTS)]
    scenario = Scenario(water, seed=seed, start_ns=EPOCH_NS, inertial=grade or "poor")
    world, plan = World(scenario), DivePlan(seconds=SECONDS, rate_hz=rate_hz, imu=grade is not None)
    core = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset(("filter",))))
    told = (one for _, _, one in messages(world, plan) if not isinstance(one, Truth | LightTruth | NodePose))
    found = [*core.handle_many(told), *core.flush()]
    rows = [one for one in found if isinstance(one, Track)]
    poses = [one for one in found if isinstance(one, RelativePose)]
    [figures] = tracks_figures(rows, poses, TruthTrack([world.truth(row.stamp_ns, 0) for row in rows]))
    return rows, figures


@pytest.mark.parametrize(("seed", "grade"), [(22011, "poor"), (22044, "poor"), (22078, "good")])
def test_a_start_is_not_wrong(seed: int, grade: InertialGrade) -> None:
    """An outlier among the first lights, a shaken unit, or an unknown clock led these astray by up to a metre."""
    _, figures = live(seed, grade)
    assert figures.wrong == 0
    assert figures.nees6.mean is not None
    assert figures.nees6.mean < 1.7 * 6.0


@pytest.mark.slow
@pytest.mark.parametrize("grade", ["good", "poor"])
def test_starts_err_as_they_say(grade: InertialGrade) -> None:
    """Dives that none of this was made with."""
    every = [live(seed, grade)[1] for seed in range(31000, 31030)]
    nees = [one.nees6.mean / 6.0 for one in every if one.nees6.mean is not None]
    assert sum(one.wrong for one in every) <= 0.001 * sum(one.samples for one in every)
    assert 0.6 < np.mean(nees) < 1.4


def test_a_wide_start_without_a_fix_gives_way_to_a_fix() -> None:
    """The first pose comes after 0.9 s, when many starts without one are followed.

    All 105 poses of the minute agreed with one that had lost the lights, for it was so wide. So no other start began,
    and the dive had no track.
    """
    rows, figures = live(9302, None, "lake", 3.0)
    assert rows[0].stamp_ns - EPOCH_NS < 2.5 * S_NS
    assert figures.wrong == 0


@pytest.mark.parametrize(("seed", "water"), [(9301, "basin"), (9303, "cavern"), (9308, "lake")])
def test_the_next_fix_tells_a_start_that_cannot_find_the_lights(seed: int, water: Environment) -> None:
    """A third of a second after a fix nothing says where a diver without a unit has swum: every light is doubtful."""
    rows, figures = live(seed, None, water, 3.0)
    assert rows[0].stamp_ns - EPOCH_NS < 2 * S_NS
    assert figures.wrong == 0


def test_rows_end_with_the_last_message() -> None:
    """Without inertial units a track could go on by itself, and the nodes turn as nobody told."""
    rows, _ = live(22032, None)
    assert SECONDS - 0.15 < (rows[-1].stamp_ns - EPOCH_NS) / S_NS <= SECONDS + 0.051


@pytest.mark.parametrize(
    ("sigmas", "limit", "contradicted"),
    [(4.5, MEAN_CONTRADICTS, True), (4.5, np.inf, False), (1.0, MEAN_CONTRADICTS, False)],
)
def test_fixes_that_are_off_for_long_contradict_a_track(
    sigmas: float, limit: float, contradicted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By their mean; without a limit for that they do not, for each is within what one fix may be off."""
    monkeypatch.setattr(track_filter, "MEAN_CONTRADICTS", limit)
    dive = make(2, Setting(seconds=8.0))
    sound = dive.fixes[:12]
    # A fix may be off by a centimetre beside its own sigma.
    off_m = [sigmas * np.hypot(0.01, np.sqrt(fix.covariance[0, 0])) * np.eye(3)[0] for fix in dive.fixes[12:]]
    off = [replace(fix, t_a_b_m=fix.t_a_b_m + by_m) for fix, by_m in zip(dive.fixes[12:], off_m, strict=True)]
    track = filter_of(dive.records, sound + off)
    track.advance(sound[-1].stamp_ns + S_NS // 10)
    assert track.main is not None
    assert track.main.contradicted == 0
    said = f"{track.both}: poses contradict the live track"
    track.advance(off[4].stamp_ns)
    assert track.withheld() is contradicted
    assert said not in track.problems
    track.advance(off[11].stamp_ns)
    assert track.withheld() is contradicted
    assert (said in track.problems) is contradicted


def test_gross_fixes_leave_the_sound_one_after_them_agreeing() -> None:
    """Another diver's bar gave them: each contradicts by itself, and tells nothing of the track."""
    dive = make(2, Setting(seconds=8.0))
    gross = [replace(fix, t_a_b_m=2.0 * fix.t_a_b_m) for fix in dive.fixes[12:15]]
    track = filter_of(dive.records, [*dive.fixes[:12], *gross, *dive.fixes[15:]])
    track.advance(gross[-1].stamp_ns + 60_000_000)
    assert track.main is not None
    assert track.main.contradicted == 3
    track.advance(dive.fixes[15].stamp_ns + 60_000_000)
    assert track.main.contradicted == 0
