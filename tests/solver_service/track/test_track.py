"""The track on random dives: accuracy, honesty, causality, and what it does with bad input."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest
from buddyline.node.imu_means import ImuPacker
from buddyline.protocol.messages import Imu
from buddyline.solver_service.track import dive as dive_track
from buddyline.solver_service.track import settling
from buddyline.solver_service.track.dive import smooth
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.lag import TrackLag
from buddyline.solver_service.track.output import TrackRow
from buddyline.solver_service.track.records import NodeRecord, joined, last_ns
from buddyline.solver_service.track.smoother import Path, smoothed
from buddyline.solver_service.track.trail import Trail

from tests.solver_service.track.assignments import weigh
from tests.solver_service.track.dives import (
    EPOCH_NS,
    KnownDive,
    RestlessPair,
    Setting,
    bare_of,
    filter_of,
    fix_errors,
    make,
    score,
)

SHORT = Setting(seconds=12.0)


@pytest.fixture(scope="module")
def dive() -> KnownDive:
    return make(1, SHORT)


def same(one: list[TrackRow], two: list[TrackRow]) -> bool:
    return len(one) == len(two) and all(
        a.stamp_ns == b.stamp_ns and np.array_equal(a.t_a_b_m, b.t_a_b_m) and np.array_equal(a.covariance, b.covariance)
        for a, b in zip(one, two, strict=True)
    )


@pytest.mark.parametrize("poor", [False, True])
def test_whole_dive_beats_its_fixes_and_is_honest(poor: bool) -> None:
    dive = make(0, replace(SHORT, seconds=20.0, poor=poor))
    fixes = fix_errors(dive)
    judged = score(dive, smooth(dive.records, dive.fixes, dive.stamps_ns).rows)
    assert judged.covered >= 0.99
    assert judged.wrong == 0
    assert np.median(judged.errors_m) < 0.45 * np.median(fixes)
    assert np.percentile(judged.errors_m, 95) < 0.35 * np.percentile(fixes, 95)
    assert 0.4 < judged.nees < 2.0


@pytest.mark.parametrize("first", [0, 1])
def test_a_node_that_is_switched_off_before_the_other_costs_only_what_comes_after(dive: KnownDive, first: int) -> None:
    end_ns = dive.stamps_ns[-1] - 4_000_000_000
    cut = [record.between(0, end_ns) for record in dive.records]
    fixes, stamps_ns = (
        [fix for fix in dive.fixes if fix.stamp_ns < end_ns],
        [ns for ns in dive.stamps_ns if ns < end_ns],
    )
    one_cut = [record if k == 1 - first else cut[k] for k, record in enumerate(dive.records)]
    found, wanted = (smooth((a, b), fixes, stamps_ns) for a, b in (one_cut, cut))
    assert found.problems == []
    assert found.clock_sigma_s == pytest.approx(wanted.clock_sigma_s, rel=1e-3)
    [median_m, wanted_m] = (float(np.median(score(dive, one.rows).errors_m)) for one in (found, wanted))
    assert median_m == pytest.approx(wanted_m, rel=1e-3)


@pytest.mark.parametrize("node", [0, 1])
def test_a_node_that_is_off_for_a_while_gives_no_track_by_its_lamps_alone(node: int) -> None:
    """Whether it turns to the left or to the right meanwhile, the other one sees the same."""
    dive = make(21 + node, replace(SHORT, seconds=32.0))
    off_ns, on_ns = (EPOCH_NS + seconds * 1_000_000_000 for seconds in (11, 21))
    known = dive.records[node]
    known = joined([known.between(0, off_ns), known.between(on_ns, 2**62)])
    a, b = (known if k == node else record for k, record in enumerate(dive.records))
    fixes = [fix for fix in dive.fixes if not off_ns <= fix.stamp_ns < on_ns]
    live = filter_of((a, b), fixes)
    found = smooth((a, b), fixes, dive.stamps_ns)
    assert np.isfinite(found.clock_sigma_s)
    for rows in (live.advance(last_ns((a, b)), dive.stamps_ns), found.rows):
        judged = score(dive, rows)
        assert judged.wrong == 0
        assert 0.4 < judged.nees < 2.0
        assert judged.rows > 350
    assert any("told nothing" in said for said in live.problems)


def test_filter_covers_the_dive(dive: KnownDive) -> None:
    judged = score(dive, filter_of(dive.records, dive.fixes).advance(last_ns(dive.records), dive.stamps_ns))
    assert judged.covered >= 0.97
    assert judged.wrong == 0
    assert np.percentile(judged.errors_m, 95) < np.percentile(fix_errors(dive), 95)
    assert 0.4 < judged.nees < 2.0


def of_means(record: NodeRecord) -> NodeRecord:
    """What is left of a node's inertial samples on a slow link."""
    packer = ImuPacker()
    samples = zip(record.imu_stamps_ns.tolist(), record.accel_mps2.tolist(), record.gyro_radps.tolist(), strict=True)
    packed = [
        packer.add(Imu(node="a", stamp_ns=stamp_ns, accel_mps2=tuple(accel), gyro_radps=tuple(gyro)))
        for stamp_ns, accel, gyro in samples
    ]
    means = [one for message in packed if message is not None for one in message.samples()]
    return replace(
        record,
        imu_stamps_ns=np.array([one.stamp_ns for one in means]),
        accel_mps2=np.array([one.accel_mps2 for one in means]),
        gyro_radps=np.array([one.gyro_radps for one in means]),
    )


@pytest.mark.parametrize("poor", [pytest.param(False, marks=pytest.mark.slow), True])
def test_means_of_the_samples_carry_the_filter_as_the_samples_do(poor: bool) -> None:
    """Five frames a second, as over a poor tether."""
    dive = make(2, replace(SHORT, rate_hz=5.0, poor=poor))
    a, b = map(of_means, dive.records)
    assert len(a.imu_stamps_ns) < 0.21 * len(dive.records[0].imu_stamps_ns)
    by = [
        score(dive, filter_of(records, dive.fixes).advance(last_ns(dive.records), dive.stamps_ns))
        for records in (dive.records, (a, b))
    ]
    assert [one.wrong for one in by] == [0, 0]
    assert by[1].covered >= by[0].covered - 0.05
    assert np.median(by[1].errors_m) < 1.2 * np.median(by[0].errors_m)
    assert 0.4 < by[1].nees < 2.0


def test_without_attitudes_a_track_starts_with_the_first_fix(dive: KnownDive) -> None:
    a, b = (replace(record, attitudes=()) for record in dive.records)
    rows = filter_of((a, b), dive.fixes[5:]).advance(last_ns(dive.records), dive.stamps_ns)
    assert rows[0].stamp_ns >= dive.fixes[5].stamp_ns
    assert not filter_of((a, b), []).advance(last_ns(dive.records), dive.stamps_ns)


def fed(dive: KnownDive, order: random.Random | None, chunk_ns: int, window_ns: int = 400_000_000) -> list[TrackRow]:
    """Feed a live filter by pieces, each piece in any order."""
    a, b = dive.records
    track = TrackFilter(a.node, b.node)
    calls = []
    for node, record in enumerate(dive.records):
        for i, stamp in enumerate(record.imu_stamps_ns.tolist()):
            one = slice(i, i + 1)
            data = (node, record.imu_stamps_ns[one], record.accel_mps2[one], record.gyro_radps[one])
            calls.append((stamp, track.add_imu, data))
        calls += [(seen.stamp_ns, track.add_attitude, (node, seen)) for seen in record.attitudes]
        calls += [(seen.stamp_ns, track.add_depth, (node, seen)) for seen in record.depths]
        calls += [(frame.stamp_ns, track.add_frames, (node, [frame])) for frame in record.frames]
    calls += [(fix.stamp_ns, track.add_fix, (fix,)) for fix in dive.fixes]
    calls.sort(key=lambda call: call[0])
    if order:
        calls.sort(key=lambda call: call[0] + order.randrange(window_ns))
    rows: list[TrackRow] = []
    track.seconds(0, dive.stamps_ns[0])
    next_ns, done = dive.stamps_ns[0], 0
    for stamp, add, data in calls:
        while stamp > next_ns + 2 * window_ns:
            asked = [s for s in dive.stamps_ns if done < s <= next_ns]
            done = next_ns
            rows += track.advance(next_ns, asked)
            next_ns += chunk_ns
        add(*data)  # type: ignore[operator]
    end_ns = last_ns(dive.records)
    return rows + track.advance(end_ns, [s for s in dive.stamps_ns if s > done])


def test_live_gives_the_same_in_any_order_and_by_any_steps(dive: KnownDive) -> None:
    short = KnownDive(dive.records, dive.fixes, dive.stamps_ns[:80], dive.t_a_b_m, dive.R_a_b)
    whole = filter_of(dive.records, dive.fixes).advance(last_ns(dive.records), short.stamps_ns)
    assert same(fed(short, None, 100_000_000), whole)
    assert same(fed(short, random.Random(3), 70_000_000), whole)


def test_lag_is_better_than_the_filter(dive: KnownDive) -> None:
    track = filter_of(dive.records, dive.fixes)
    lag = TrackLag(track)
    lag.ask(dive.stamps_ns)
    rows: list[TrackRow] = []
    for now_ns in range(dive.stamps_ns[0], last_ns(dive.records), 100_000_000):
        track.advance(now_ns)
        rows += lag.rows()
    late = lag.finish()
    assert late[0].stamp_ns - rows[-1].stamp_ns == 50_000_000
    assert late[-1].stamp_ns > dive.stamps_ns[-1] - 200_000_000
    assert not lag.finish()
    rows += late
    judged = score(dive, rows)
    causal = filter_of(dive.records, dive.fixes).advance(last_ns(dive.records), dive.stamps_ns)
    assert judged.rows > 0.8 * len(dive.stamps_ns)
    assert np.percentile(judged.errors_m, 95) < np.percentile(score(dive, causal).errors_m, 95)
    assert 0.3 < judged.nees < 2.0


@pytest.mark.slow
def test_without_inertial_units(dive: KnownDive) -> None:
    bare = bare_of(dive)
    for records in ((bare[0], bare[1]), (dive.records[0], bare[1]), (bare[0], dive.records[1])):
        judged = score(dive, smooth(records, dive.fixes, dive.stamps_ns).rows)
        assert judged.covered >= 0.97
        assert judged.wrong == 0
        assert judged.nees < 2.5


@pytest.mark.slow
def test_compasses_that_wander_within_seconds_give_no_wrong_track() -> None:
    """Where each node sees one lamp for seconds, lateral place, heading and range are told by attitudes alone."""
    dive = make(301, Setting(seconds=40.0, near_m=4.0, far_m=8.0))
    judged = score(dive, smooth(bare_of(dive), dive.fixes, dive.stamps_ns).rows)
    assert judged.wrong == 0
    assert judged.nees < 1.6


@pytest.mark.parametrize(("dark_s", "worst_m"), [(2.0, 0.06), pytest.param(5.0, 0.15, marks=pytest.mark.slow)])
def test_seconds_of_darkness(dark_s: float, worst_m: float) -> None:
    dive = make(4, replace(SHORT, seconds=14.0 + dark_s, dark_s=(8.0, 8.0 + dark_s), near_m=4.0, far_m=8.0))
    judged = score(dive, smooth(dive.records, dive.fixes, dive.stamps_ns).rows)
    assert judged.wrong == 0
    assert judged.errors_m.max() < worst_m


@pytest.mark.parametrize(("seed", "node"), [(5, 1), (24, 0)])
def test_a_unit_that_is_silent_while_a_lamp_is_hidden(seed: int, node: int) -> None:
    """Its node's compass is off by degrees, and the other node's lamps come and go: no lamp is taken for another.

    The compass was believed to a degree and a half, and a lamp that was hidden for a second to be found next time.
    Seed 5 was off by 130 mrad for a second, stated as 1.
    """
    dive = make(seed, Setting(seconds=20.0))
    records = list(dive.records)
    seconds = (records[node].imu_stamps_ns - EPOCH_NS) * 1e-9
    kept = (seconds < 13.0) | (seconds > 15.0)
    records[node] = replace(
        records[node],
        imu_stamps_ns=records[node].imu_stamps_ns[kept],
        accel_mps2=records[node].accel_mps2[kept],
        gyro_radps=records[node].gyro_radps[kept],
    )
    judged = score(dive, smooth((records[0], records[1]), dive.fixes, dive.stamps_ns).rows)
    assert judged.wrong == 0
    assert judged.nees < 1.5


def test_passes_that_diverge_are_no_track(monkeypatch: pytest.MonkeyPatch) -> None:
    short = make(4, replace(SHORT, seconds=6.0))

    def diverging(steps: Trail, about: Path, **asked: bool) -> Path:
        """Its clocks are 0.7 s apart."""
        path = smoothed(steps, about, **asked)
        return replace(path, states=np.array([path.state(k).with_parts(clock_s=-0.7).row for k in range(len(path))]))

    assert list(smooth(short.records, short.fixes, short.stamps_ns).rows)
    monkeypatch.setattr(settling, "smoothed", diverging)
    found = smooth(short.records, short.fixes, short.stamps_ns)
    assert not list(found.rows)
    assert "contradict the first one" in found.problems[-1]


def test_a_beginning_that_is_carried_back_wrong_does_not_lead_the_second_pass_astray(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first start is 5 s late, and no light is seen before it: what is carried back is off by 40 % of the range."""
    dive = make(73, Setting(seconds=14.0, sigma_px=0.1, false=1))
    start_ns = EPOCH_NS + 5_000_000_000
    records = [
        replace(one, frames=[f for f in one.frames if not EPOCH_NS + 1_500_000_000 < f.stamp_ns < start_ns])
        for one in dive.records
    ]

    def wrong(path: Path) -> Path:
        states = path.states.copy()
        states[:-1, :3] *= 1.4
        return replace(path, states=states)

    before = dive_track._path_before
    monkeypatch.setattr(dive_track, "_path_before", lambda *given: (found := before(*given)) and wrong(found))
    fixes = [fix for fix in dive.fixes if fix.stamp_ns > start_ns]
    found = smooth((records[0], records[1]), fixes, dive.stamps_ns)
    judged = score(dive, found.rows)
    assert judged.wrong == 0
    assert judged.covered > 0.9
    assert judged.nees < 2.0
    assert abs(found.clock_offset_s) < 3.0 * found.clock_sigma_s


def test_a_wrong_fix_changes_nothing_for_long(dive: KnownDive) -> None:
    wrong = [
        FixSeen(fix.stamp_ns, fix.t_a_b_m + np.array((3.0, 0.0, 2.0)), fix.R_a_b, fix.covariance)
        if i in (20, 21, 22)
        else fix
        for i, fix in enumerate(dive.fixes)
    ]
    judged = score(dive, filter_of(dive.records, wrong).advance(last_ns(dive.records), dive.stamps_ns))
    assert judged.wrong == 0
    assert judged.covered >= 0.97


def test_a_track_that_began_wrong_is_replaced(dive: KnownDive) -> None:
    first = dive.fixes[0]
    wrong = FixSeen(first.stamp_ns, first.t_a_b_m + np.array((3.0, 0.0, 2.0)), first.R_a_b, first.covariance)
    rows = filter_of(dive.records, [wrong, *dive.fixes[1:]]).advance(last_ns(dive.records), dive.stamps_ns)
    judged = score(dive, rows)
    assert judged.wrong == 0
    assert judged.covered >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize("harm", ["nan", "false", "doubled", "gap", "stops", "no attitude", "no depth"])
def test_bad_input_costs_little(dive: KnownDive, harm: str) -> None:
    a, b = dive.records
    stamps, accel, gyro = b.imu_stamps_ns.copy(), b.accel_mps2.copy(), b.gyro_radps.copy()
    keep = np.ones(len(stamps), dtype=bool)
    if harm == "nan":
        accel[::7, 1] = np.nan
        gyro[::11] = np.inf
    elif harm == "false":
        accel[::90], gyro[50::90, 1], gyro[70::90] = 0.0, 8.7, np.random.default_rng(1).uniform(-9.0, 9.0, 3)
    elif harm == "doubled":
        stamps[1::50] = stamps[:-1:50][: len(stamps[1::50])]
    elif harm == "gap":
        keep[300:360] = False
    elif harm == "stops":
        keep[600:] = False
    attitudes = () if harm == "no attitude" else b.attitudes
    depths = () if harm == "no depth" else b.depths
    b = replace(
        b,
        imu_stamps_ns=stamps[keep],
        accel_mps2=accel[keep],
        gyro_radps=gyro[keep],
        attitudes=attitudes,
        depths=depths,
    )
    judged = score(dive, smooth((a, b), dive.fixes, dive.stamps_ns).rows)
    assert judged.covered >= 0.95
    assert judged.wrong == 0
    if harm in ("false", "doubled"):
        assert judged.nees < 1.3


@pytest.mark.slow
@pytest.mark.parametrize("poor", [False, True])
def test_many_dives(poor: bool) -> None:
    """Twenty dives of 30 s: the means over them, as no single short dive tells."""
    nees, ratios, wrong = [], [], 0
    for seed in range(20):
        dive = make(seed + 50, Setting(poor=poor))
        judged = score(dive, smooth(dive.records, dive.fixes, dive.stamps_ns).rows)
        fixes = fix_errors(dive)
        nees.append((judged.nees, judged.nees_position, judged.nees_rotation))
        errors = judged.errors_m
        ratios.append((np.median(errors) / np.median(fixes), np.percentile(errors, 95) / np.percentile(fixes, 95)))
        wrong += judged.wrong
    assert wrong == 0
    assert ((np.mean(nees, axis=0) > 0.75) & (np.mean(nees, axis=0) < 1.3)).all()
    assert (np.median(ratios, axis=0) < (0.35, 0.28)).all()


@pytest.mark.slow
def test_a_dead_lamp_and_no_fix_at_all() -> None:
    dive = make(6, replace(SHORT, seconds=16.0, dead=((1, 0),)))
    whole = make(6, replace(SHORT, seconds=16.0))
    result = smooth(dive.records, [], dive.stamps_ns)
    judged = score(replace(dive, fixes=whole.fixes), result.rows)
    assert judged.covered >= 0.8
    assert judged.wrong == 0


def test_nodes_that_do_not_face_each_other_get_no_track(dive: KnownDive) -> None:
    """Both look at a third's bar: the lights fit, the headings do not."""
    a, b = dive.records
    about_down = np.diag((-1.0, -1.0, 1.0))
    turned = [replace(seen, R_ned_body=about_down @ seen.R_ned_body) for seen in b.attitudes]
    track = filter_of((a, replace(b, attitudes=turned)), dive.fixes)
    assert not track.advance(last_ns(dive.records), dive.stamps_ns)
    assert any("attitudes and fixes contradict each other" in problem for problem in track.problems)
    assert filter_of(dive.records, dive.fixes).advance(last_ns(dive.records), dive.stamps_ns)


@pytest.mark.slow
def test_clock_and_depth_offset_nobody_told_of() -> None:
    dive = make(2, replace(SHORT, seconds=20.0, clock_s=0.3, depth_offset_m=0.5))
    result = smooth(dive.records, dive.fixes, dive.stamps_ns)
    judged = score(dive, result.rows)
    assert abs(result.clock_offset_s - 0.3) < 4.0 * result.clock_sigma_s < 0.05
    assert judged.wrong == 0
    assert judged.covered >= 0.98
    assert judged.nees < 2.0


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "clock_s"), [(911, 0.3), (912, -0.3)])
def test_units_off_their_mounts_do_not_hide_a_clock_offset(seed: int, clock_s: float) -> None:
    """Each pass finds a part of it; of the second dive the first one settles at a false offset."""
    dive = make(seed, Setting(seconds=60.0, poor=True, clock_s=clock_s))
    result = smooth(dive.records, dive.fixes, dive.stamps_ns)
    judged = score(dive, result.rows)
    assert abs(result.clock_offset_s - clock_s) < 4.0 * result.clock_sigma_s < 0.008
    assert judged.wrong == 0
    assert judged.covered >= 0.98
    assert judged.nees < 1.6


@pytest.mark.slow
def test_clocks_far_apart_without_inertial_units_give_no_track() -> None:
    dive = make(2, replace(SHORT, seconds=20.0, clock_s=0.3))
    result = smooth(bare_of(dive), dive.fixes, dive.stamps_ns)
    assert not result.rows
    assert any("clocks" in problem for problem in result.problems)


@pytest.mark.parametrize(
    "fault", ["clipped", *(pytest.param(fault, marks=pytest.mark.slow) for fault in ("g", "mount"))]
)
def test_a_faulty_unit_is_named_and_left_out(dive: KnownDive, fault: str) -> None:
    a, b = dive.records
    about = np.array(((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)))
    if fault == "g":
        b = replace(b, accel_mps2=b.accel_mps2 / 9.80665)
    elif fault == "mount":
        b = replace(b, accel_mps2=b.accel_mps2 @ about, gyro_radps=b.gyro_radps @ about)
    else:
        gyro = b.gyro_radps.copy()
        gyro[400:420, 1] = np.radians(250.0)
        b = replace(b, gyro_radps=gyro)
    result = smooth((a, b), dive.fixes, dive.stamps_ns)
    said = {"g": "g in place of m/s^2", "mount": "mounted otherwise", "clipped": "clipped"}[fault]
    assert any(said in problem and "node b" in problem for problem in result.problems)
    judged = score(dive, result.rows)
    assert judged.wrong == 0
    assert judged.covered >= 0.95


@pytest.mark.parametrize("harm", ["nothing", "one node", "pixels", "fixes", "frames twice", "attitudes", "no sensors"])
def test_absurd_input_never_crashes(dive: KnownDive, harm: str) -> None:
    a, b = dive.records
    fixes = list(dive.fixes)
    if harm == "nothing":
        a, b = (replace(r, frames=(), attitudes=(), depths=()) for r in (a, b))
        fixes = []
    elif harm == "one node":
        b = replace(b, frames=())
    elif harm == "pixels":
        spoilt = [
            replace(f, pixels=f.pixels * np.array((np.nan, 1e300)), sigma_px=0.0 * f.sigma_px) if i % 5 == 0 else f
            for i, f in enumerate(b.frames)
        ]
        b = replace(b, frames=spoilt)
    elif harm == "fixes":
        fixes[0] = replace(fixes[0], t_a_b_m=np.full(3, np.nan))
        fixes[3] = replace(fixes[3], covariance=np.zeros((6, 6)))
        fixes[6] = replace(fixes[6], covariance=np.full((6, 6), np.inf))
        fixes[9] = replace(fixes[9], t_a_b_m=np.full(3, 1e200))
    elif harm == "frames twice":
        b = replace(b, frames=[f for f in b.frames for _ in (0, 1)])
    elif harm == "attitudes":
        b = replace(b, attitudes=[replace(s, sigma_rad=0.0 * s.sigma_rad) for s in b.attitudes])
    else:
        bare = {"imu_stamps_ns": np.zeros(0, np.int64), "accel_mps2": np.zeros((0, 3)), "gyro_radps": np.zeros((0, 3))}
        a, b = (replace(r, attitudes=(), depths=(), **bare) for r in (a, b))
    rows = list(smooth((a, b), fixes, dive.stamps_ns).rows)
    assert all(np.isfinite(row.covariance).all() and np.isfinite(row.t_a_b_m).all() for row in rows)
    if rows:
        assert score(dive, rows).wrong == 0


def test_a_lamp_behind_the_camera_is_no_candidates() -> None:
    """However little a track knows: a covariance of kilometres once took all lights in the picture for such a lamp."""
    y = np.full((3, 2, 2), np.nan)
    y[:, 1] = 3.0
    H = np.random.default_rng(1).normal(0.0, 1e11, (3, 2, 2, 13))
    H[:, 1] = 1.0
    cases, logs = weigh(y, H, 1e7 * np.eye(13), np.full(3, 0.02), np.full(2, 0.9), 1e-6)
    assert all(of_first is None for of_first, _ in cases)
    assert len(cases) > 1
    assert np.isfinite(logs).all()


def test_rows_between_pictures_are_carried_between_the_clocks_by_their_own_turn_rates() -> None:
    """By those of the last picture, 0.05 s before, squared turn errors over variances were a third above those of equal
    clocks."""
    nees = np.zeros(2)
    for seed in range(1, 4):
        for of_clock, clock_s in enumerate((0.0, 0.02)):
            setting = replace(SHORT, seconds=16.0, clock_s=clock_s)
            dive = make(seed, setting, RestlessPair(np.random.default_rng(seed), setting))
            rows = filter_of(dive.records, dive.fixes).advance(dive.stamps_ns[-1], dive.stamps_ns)
            nees[of_clock] += score(dive, rows).nees_rotation / 3.0
    assert nees[1] < 1.15 * nees[0], nees


@pytest.mark.slow
@pytest.mark.parametrize("clock_s", [0.5, -0.8])
def test_clocks_more_than_half_a_second_apart(clock_s: float) -> None:
    for seed in range(4):
        dive = make(80 + seed, replace(SHORT, seconds=30.0, clock_s=clock_s))
        result = smooth(dive.records, dive.fixes, dive.stamps_ns)
        judged = score(dive, result.rows)
        assert judged.wrong == 0
        assert abs(result.clock_offset_s - clock_s) < 0.02 or judged.rows == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_a_live_track_of_clocks_half_a_second_apart_is_not_told(seed: int) -> None:
    dive = make(seed, replace(SHORT, seconds=14.0, clock_s=0.5, cabled=True))
    track = filter_of(dive.records, dive.fixes)
    rows = track.advance(dive.stamps_ns[-1], dive.stamps_ns)
    assert len(rows) < 0.3 * len(dive.stamps_ns)
    assert not rows or score(dive, rows).wrong == 0
    assert any("clocks are far apart" in problem or "poses contradict" in problem for problem in track.problems)


@pytest.mark.parametrize("whole", [False, True])
def test_rows_between_two_triggers_tell_the_lights_of_the_last_one(whole: bool) -> None:
    """Rows at 50 Hz of pictures at 5 Hz; from the fifth second to the seventh no light is in any picture."""
    dive = make(4, replace(SHORT, rate_hz=5.0, dark_s=(5.0, 7.0), false=0))
    first_ns = min(record.frames[0].stamp_ns for record in dive.records)
    stamps_ns = [first_ns + k * 20_000_000 for k in range(550)]
    if whole:
        rows = list(smooth(dive.records, dive.fixes, stamps_ns).rows)
    else:
        rows = filter_of(dive.records, dive.fixes).advance(last_ns(dive.records), stamps_ns)
    triggers: dict[int, set[int]] = {}
    for row in rows:
        number, since_ns = divmod(row.stamp_ns - first_ns, 200_000_000)
        # Both pictures of a trigger are taken within some milliseconds.
        if 20_000_000 <= since_ns <= 180_000_000:
            triggers.setdefault(number, set()).add(row.lights)
    assert len(triggers) > 45
    assert all(len(told) == 1 for told in triggers.values()), triggers
    dark = {row.lights for row in rows if 5.3 < (row.stamp_ns - EPOCH_NS) / 1e9 < 6.9}
    assert dark == {0}
    assert sum(told == {4} for told in triggers.values()) > len(triggers) // 4
