"""The track as messages: the same in any order of arrival, honest against truth, none where nothing is known."""

import random
import re
from itertools import groupby

import msgspec
import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, Depth, Expect, Imu, NodeInfo, Rejected, RelativePose, Track
from buddyline.protocol.topics import TRACK, TRACK_LAG, key_of
from buddyline.solver_service import core, tracking
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.network.filter import NetFilter
from buddyline.solver_service.streams import NodeStream
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.tracking import PairTracker, TrackSettings
from msgspec import UNSET
from msgspec.structs import replace

from tests.soak.shared import simulated
from tests.solver_service.conftest import dive_messages
from tests.solver_service.test_headings import turned


def tracks_of(messages, *modes, rate_hz=20.0, receive=False):
    solver = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset(modes), rate_hz))
    results = []
    for message in messages:
        results += solver.handle(message, message.stamp_ns + S_NS // 50 if receive else None)
    results += solver.flush()
    return [one for one in results if isinstance(one, Track)], solver


@pytest.fixture(scope="module")
def inertial_dive():
    return dive_messages(seconds=12.0, imu=True)


@pytest.fixture(scope="module")
def filtered(inertial_dive):
    return tracks_of(inertial_dive[0], "filter")[0]


@pytest.mark.parametrize("node", ["a", "b"])
def test_poses_and_tracks_say_that_north_is_in_doubt_where_compasses_contradict_each_other(inertial_dive, node):
    messages, world = inertial_dive
    solver = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset(("filter", "lag", "smooth"))))
    found = solver.handle_many([turned(message, node, 30.0) for message in messages]) + solver.flush()
    kinds = {}
    for one in found:
        if isinstance(one, Track | RelativePose):
            north, east, _ = (world.T_ned_camera("a", one.stamp_ns)[0] @ world.truth(one.stamp_ns, 0).t_a_b_m).tolist()
            off_rad = np.remainder(one.azimuth_rad - np.arctan2(east, north) + np.pi, 2.0 * np.pi) - np.pi
            mode = one.mode if isinstance(one, Track) else "pose"
            kinds.setdefault(mode, []).append((off_rad, one.sigma_azimuth_rad))
    assert kinds.keys() == {"pose", "filter", "lag", "smooth"}
    for mode, told in kinds.items():
        off_rad, sigma_rad = np.abs(told).T
        # Half of the gap at least, and no longer what a compass of 3 to 5 degrees states.
        assert np.radians(10.0) < sigma_rad.min(), mode
        assert sigma_rad.max() < np.radians(35.0), mode
        assert (off_rad < 2.5 * sigma_rad).all(), mode


def test_a_wrong_start_does_not_withhold_the_track_that_replaces_it(inertial_dive):
    """Compasses 36 degrees apart: a start without a fix puts the clocks apart. It gives way to the first pose."""
    messages, _ = inertial_dive
    solver = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset(("filter",))))
    found = solver.handle_many([turned(message, "b", 30.0) for message in messages]) + solver.flush()
    first_ns = min(one.stamp_ns for one in found if isinstance(one, RelativePose))
    assert min(one.stamp_ns for one in found if isinstance(one, Track)) < first_ns + S_NS


def rejected(stamp_ns):
    return Rejected(node_a="a", node_b="b", stamp_ns=stamp_ns, trigger=stamp_ns, reason="ambiguous", detail="")


def errors_m(tracks, world):
    return [np.linalg.norm(np.subtract(one.t_a_b_m, world.truth(one.stamp_ns, 0).t_a_b_m)) for one in tracks]


def test_the_live_filter_gives_the_same_track_however_messages_are_interleaved(inertial_dive, filtered):
    messages, _ = inertial_dive
    expected = filtered
    rng = random.Random(1)
    late_ns = {kind: rng.randrange(0, S_NS // 5) for kind in ("a", "b", Imu, Depth, Candidates)}
    shuffled = sorted(messages, key=lambda m: m.stamp_ns + late_ns.get(type(m), 0) + late_ns[m.node])
    # All calibrations first: without one there is no track yet.
    shuffled.sort(key=lambda message: not isinstance(message, NodeInfo))
    found, _ = tracks_of(shuffled, "filter", receive=True)
    assert len(found) == len(expected) > 100
    for one, other in zip(found, expected, strict=True):
        assert one.stamp_ns == other.stamp_ns
        np.testing.assert_allclose(one.t_a_b_m, other.t_a_b_m, atol=1e-9)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-12)


@pytest.fixture(scope="module")
def five_seconds(inertial_dive):
    messages, _ = inertial_dive
    messages = [message for message in messages if message.stamp_ns < messages[0].stamp_ns + 5 * S_NS]
    return messages, tracks_of(messages, "filter", "lag")[0]


@pytest.mark.parametrize("late_s", [0.6, 1.5, 2.5])
def test_a_track_waits_for_inertial_samples_that_come_after_the_pictures(five_seconds, late_s):
    messages, expected = five_seconds
    late = sorted(messages, key=lambda m: m.stamp_ns + (round(late_s * S_NS) if isinstance(m, Imu) else 0))
    found, core = tracks_of(late, "filter", "lag")
    assert sorted((one.mode, one.stamp_ns) for one in found) == sorted((one.mode, one.stamp_ns) for one in expected)
    for one, other in zip(*([row for row in rows if row.mode == "filter"] for rows in (found, expected)), strict=True):
        np.testing.assert_allclose(one.t_a_b_m, other.t_a_b_m, atol=1e-9)
    assert core.pairs["a", "b"].tracker.problems == []


def test_no_row_of_the_lag_is_left_out_however_many_messages_come_at_once(inertial_dive):
    # Some pictures are lost, and others come a little early or late.
    rng = random.Random(2)
    triggers = sorted({m.trigger for m in inertial_dive[0] if isinstance(m, Candidates)})
    late_ns = {trigger: rng.randrange(-S_NS // 100, S_NS // 100) for trigger in triggers}
    messages = [
        replace(m, stamp_ns=m.stamp_ns + late_ns[m.trigger]) if isinstance(m, Candidates) else m
        for m in inertial_dive[0]
        if not (isinstance(m, Candidates) and late_ns[m.trigger] % 8 == 0)
    ]
    core = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset(("lag",)), 20.0))
    stamps_ns = [one.stamp_ns for one in core.handle_many(messages) + core.flush() if isinstance(one, Track)]
    assert stamps_ns[-1] - stamps_ns[0] > 9 * S_NS
    assert np.diff(stamps_ns).tolist() == [S_NS // 20] * (len(stamps_ns) - 1)


def test_inertial_samples_that_come_too_late_are_counted_and_named_while_they_do(inertial_dive):
    messages, _ = inertial_dive
    began_ns = messages[0].stamp_ns

    def arrival_ns(message):
        late = isinstance(message, Imu) and message.node == "a" and message.stamp_ns < began_ns + 3 * S_NS // 2
        return message.stamp_ns + (4 * S_NS if late else 0)

    seen = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset(("filter",)), 20.0))
    statuses = {}
    for message in sorted(messages, key=arrival_ns):
        seen.handle(message)
        second = (arrival_ns(message) - began_ns) // S_NS
        if second not in statuses:
            statuses[second] = seen.report(message.stamp_ns, 0, 0, [])[0]
    named = [second for second, status in statuses.items() if "samples of node a come too late" in status.problem]
    assert not any("samples of node b" in status.problem for status in statuses.values())
    assert named == list(range(5, 11))
    assert statuses[3].late_imu is UNSET
    assert 50 < statuses[5].late_imu < statuses[11].late_imu <= 150


def test_inertial_samples_that_come_again_a_second_later_are_not_late(five_seconds):
    """As where a publisher sends again what may have been lost."""
    messages, _ = five_seconds
    again = [(message.stamp_ns + S_NS, message) for message in messages if isinstance(message, Imu)]
    solver = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset(("filter",)), 20.0))
    timed = [(message.stamp_ns + S_NS // 50, message) for message in messages]
    for receive_ns, message in sorted([*timed, *again], key=lambda one: one[0]):
        solver.handle(message, receive_ns)
    (status,) = solver.report(receive_ns, receive_ns, 0, [])
    assert status.late_imu is UNSET
    assert "too late" not in status.problem


def test_a_track_goes_on_without_inertial_samples_and_says_so(inertial_dive):
    messages, world = inertial_dive
    gap_ns = [messages[0].stamp_ns + seconds * S_NS for seconds in (3, 7)]
    gappy = [m for m in messages if not (isinstance(m, Imu) and m.node == "a" and gap_ns[0] < m.stamp_ns < gap_ns[1])]
    found, core = tracks_of(gappy, "filter")
    inside = [one for one in found if gap_ns[0] < one.stamp_ns < gap_ns[1]]
    assert len(inside) > 0.9 * 4 * 20
    off_m = np.array(errors_m(inside, world))
    sigma_m = np.sqrt([one.covariance[0] + one.covariance[7] + one.covariance[14] for one in inside])
    assert (off_m < 4.0 * sigma_m + 0.002).mean() > 0.98
    said = [problem for problem in core.pairs["a", "b"].tracker.problems if "inertial samples are missing" in problem]
    assert len(said) == 1
    # It was so, and ended: the solver's status tells of what lasts.
    assert said[0].startswith("node a:")
    assert said[0].endswith("(ended)")
    assert not any("inertial" in status.problem for status in core.report(messages[-1].stamp_ns, 0, 0, []))


def test_a_track_begins_with_the_first_pose_however_many_messages_come_at_once():
    messages, _ = dive_messages(seconds=4.0, imu=True)
    expected, _ = tracks_of(messages, "smooth")
    core = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset(("smooth",)), 20.0))
    results = core.handle_many(messages) + core.flush()
    found = [one for one in results if isinstance(one, Track)]
    first_ns = min(one.stamp_ns for one in results if isinstance(one, RelativePose))
    assert found[0].stamp_ns <= first_ns + S_NS // 20
    assert [one.stamp_ns for one in found] == [one.stamp_ns for one in expected]
    for one, other in zip(found, expected, strict=True):
        # On some processors, triggers that are solved together give other last digits than single ones.
        sigma_m = np.sqrt(np.diag(np.reshape(one.covariance, (6, 6)))[:3])
        assert np.abs(np.subtract(one.t_a_b_m, other.t_a_b_m)).max() < 1e-4 * sigma_m.min()


def test_a_smoothed_track_is_told_once(five_seconds):
    tracks, solver = tracks_of(five_seconds[0], "smooth")
    assert len(tracks) > 80
    assert not [one for one in solver.flush() if isinstance(one, Track)]
    assert solver.pairs["a", "b"].tracker.clocks() is None


def test_each_mode_is_better_than_the_one_before_it_and_says_how_good_it_is(inertial_dive, filtered):
    messages, world = inertial_dive
    medians_m = []
    for mode in ("filter", "lag", "smooth"):
        tracks = filtered if mode == "filter" else tracks_of(messages, mode)[0]
        assert {one.mode for one in tracks} == {mode}
        off_m = np.array(errors_m(tracks, world))
        sigma_m = np.sqrt([one.covariance[0] + one.covariance[7] + one.covariance[14] for one in tracks])
        assert (off_m < 4.0 * sigma_m + 0.002).mean() > 0.98
        medians_m.append(float(np.median(off_m)))
    assert medians_m[2] < medians_m[0]
    assert medians_m[1] < 1.1 * medians_m[0]


def test_live_tracks_go_by_their_own_topics_on_a_grid_of_their_rate(inertial_dive):
    tracks, _ = tracks_of(inertial_dive[0], "filter", "lag", rate_hz=25.0)
    assert {key_of(one) for one in tracks} == {TRACK.key("a", "b"), TRACK_LAG.key("a", "b")}
    for mode in ("filter", "lag"):
        stamps_ns = [one.stamp_ns for one in tracks if one.mode == mode]
        assert {stamp_ns % 40_000_000 for stamp_ns in stamps_ns} == {0}
        assert stamps_ns == sorted(set(stamps_ns))


def test_the_clocks_offset_in_a_live_status_is_a_plain_number(inertial_dive):
    """As numpy's it ended each solver that writes a status file."""
    _, solver = tracks_of(inertial_dive[0], "filter")
    status = solver.pairs["a", "b"].report(0, 0, [], 0, [])
    assert type(status.clock_skew_s) is float
    assert msgspec.json.encode(status)


def test_angles_to_north_need_an_attitude():
    with_attitude, _ = dive_messages(seconds=4.0, imu=True)
    without = [message for message in with_attitude if type(message).__name__ not in ("Attitude", "Depth")]
    for messages, known in ((with_attitude, True), (without, False)):
        tracks, _ = tracks_of(messages, "smooth")
        assert tracks
        assert all(isinstance(one.azimuth_rad, float) is known for one in tracks)


def test_without_a_pose_there_is_no_track():
    messages, _ = dive_messages(seconds=3.0, imu=True)
    blind = [replace(m, blobs=[]) if isinstance(m, Candidates) else m for m in messages]
    assert tracks_of(blind, "filter", "lag", "smooth")[0] == []


@pytest.mark.parametrize("mode", ["smooth", "filter"])
@pytest.mark.parametrize(
    ("seen", "told", "said"),
    [
        ("ab", "b", "no track: node a told neither attitudes nor inertial samples, so a pose starts none"),
        ("", "a", "no track: no pose starts one, nor do lights without attitudes of b"),
        ("", "ab", "no track: no pose starts one, and lights with both attitudes fit no start"),
    ],
)
def test_a_dive_without_a_track_says_why(mode, seen, told, said):
    """seen: the nodes whose candidates have blobs; told: those with attitudes."""
    messages = [
        replace(one, blobs=[]) if isinstance(one, Candidates) and one.node not in seen else one
        for one in dive_messages(seconds=3.0)[0]
        if one.node in told or isinstance(one, Candidates | NodeInfo)
    ]
    tracks, solver = tracks_of(messages, mode)
    assert tracks == []
    assert (solver.counts["solved"] > 0) == (seen == "ab")
    pair = solver.pairs["a", "b"]
    assert pair.tracker.problems == [said]
    assert pair.report(0, 0, [], 0, [], over=True).problem.endswith(said)


@pytest.mark.parametrize("mode", ["smooth", "filter"])
@pytest.mark.parametrize(
    ("b_from", "said"),
    [
        (15, "no track: no trigger has pictures of both a and b"),
        (14, "no track: one pose is too few to start one; name logs of more seconds in which both saw each other"),
    ],
)
def test_nodes_that_hardly_told_at_the_same_time_are_named_as_such(mode, b_from, said):
    """a tells its first 15 triggers, b those from b_from on."""
    messages = dive_messages(seconds=3.0)[0]
    first = min(one.trigger for one in messages if isinstance(one, Candidates))
    kept = [
        one
        for one in messages
        if not isinstance(one, Candidates)
        or (one.trigger - first < 15 if one.node == "a" else one.trigger - first >= b_from)
    ]
    tracks, solver = tracks_of(kept, mode)
    assert tracks == []
    assert solver.pairs["a", "b"].tracker.problems == [said]


def test_the_status_of_a_whole_dive_names_problems_that_ended_before_it_did(inertial_dive):
    start_ns = inertial_dive[0][0].stamp_ns
    in_g = [
        replace(one, accel_mps2=tuple(x / 9.80665 for x in one.accel_mps2))
        if isinstance(one, Imu) and one.node == "b" and one.stamp_ns < start_ns + 4 * S_NS
        else one
        for one in inertial_dive[0]
    ]
    pair = tracks_of(in_g, "filter")[1].pairs["a", "b"]
    assert re.search(r"g in place of m/s\^2; not used \(ended\)", pair.report(0, 0, [], 0, [], over=True).problem)
    assert "g in place" not in pair.report(0, 0, [], 0, []).problem


@pytest.mark.parametrize("mode", ["smooth", "filter"])
def test_pictures_of_another_size_than_the_calibration_s_make_no_track(inertial_dive, mode):
    halved = [
        replace(one, width_px=1640, height_px=1232) if isinstance(one, Candidates) and one.node == "b" else one
        for one in inertial_dive[0]
    ]
    tracks, solver = tracks_of(halved, mode)
    assert tracks == []
    assert solver.counts["no_info"] > 100
    said = "pictures of node b are 1640x1232 px, its calibration 820x616: they are not used"
    assert solver.health.of_dive(("a", "b")) == [said]


def test_the_network_takes_no_picture_of_another_size_than_the_calibration_s(monkeypatch):
    taken = {}

    def noted(self, index, frames):
        taken.setdefault(self.nodes[index].name, []).extend(frames)

    monkeypatch.setattr(NetFilter, "add_frames", noted)
    messages = [
        replace(one, width_px=1640, height_px=1232) if isinstance(one, Candidates) and one.node == "c" else one
        for one in simulated(3, 5.0, 2.0, imu=False)
    ]
    solver = SolverCore(Settings(), track=TrackSettings(frozenset(("filter",))))
    solver.handle_many(messages)
    solver.flush()
    assert (len(taken["a"]) > 5, len(taken["b"]) > 5, taken["c"]) == (True, True, [])


@pytest.mark.parametrize("crowded", [False, True])
def test_one_of_many_pairs_has_no_track_before_its_first_pose(crowded):
    """Alone, lights and attitudes start a track; among many, whose bars are in every picture, only poses do."""
    messages, _ = dive_messages(seconds=9.0, imu=True)
    streams = {node: NodeStream(node) for node in "ab"}
    tracker = PairTracker(streams["a"], streams["b"], TrackSettings(frozenset(("filter",))))
    tracker.crowded = crowded
    stamps_ns = []
    for message in messages:
        stream = streams[message.node]
        if isinstance(message, NodeInfo):
            stream.add_info(message)
        elif isinstance(message, Candidates):
            stream.add_frame(message, (), None)
            stamps_ns += [message.stamp_ns] * (message.node == "a")
        else:
            stream.add_sample(message)
    found = [tracker.take([rejected(ns)]) for ns in stamps_ns]
    assert any(found) is not crowded


def told_of_a_and_b(messages, chosen=None):
    settings = TrackSettings(frozenset(("filter", "lag")), expect=True)
    solver = SolverCore(Settings(), chosen, track=settings)
    told = []
    for _, together in groupby(messages, lambda one: one.stamp_ns * 20 // S_NS):
        told += solver.handle_many(together)
    tracks = [one for one in told if isinstance(one, Track) and (one.node_a, one.node_b) == ("a", "b")]
    return tracks, [one for one in told if isinstance(one, Expect) and {one.node, one.seen} == {"a", "b"}]


@pytest.mark.parametrize("absurd", [False, True])
def test_pairs_are_told_of_together_as_each_alone(monkeypatch, absurd):
    """To the last bit; also where the values of one are out of numeric range, so that all are told of one by one."""
    messages = simulated(3, 10.0, 4.0, imu=True)
    alone = told_of_a_and_b([one for one in messages if one.node in "ab"], [("a", "b")])
    assert all(len(each) > 20 for each in alone)
    if absurd:

        def fails(*_):
            raise ArithmeticError

        monkeypatch.setattr(tracking, "work_out", fails)
    assert told_of_a_and_b(messages) == alone


def test_a_track_goes_on_after_absurd_values(inertial_dive):
    messages, _ = inertial_dive
    half = len(messages) // 2
    broken = [
        replace(m, depth_m=1e308) if isinstance(m, Depth) and half < i < half + 60 else m
        for i, m in enumerate(messages)
    ]
    tracks, _ = tracks_of(broken, "filter")
    assert all(np.isfinite(one.covariance).all() for one in tracks)
    assert tracks[-1].stamp_ns > messages[-1].stamp_ns - 2 * S_NS


@pytest.mark.parametrize("mode", ["filter", "smooth"])
def test_only_what_absurd_values_lead_to_begins_the_track_anew(monkeypatch, mode):
    """A fault of this program must not look like a lack of poses."""
    messages, _ = dive_messages(seconds=1.5, imu=True)

    def fail_with(error):
        def fails(*_):
            raise error

        owner, name = (TrackFilter, "coming") if mode == "filter" else (tracking, "smooth")
        monkeypatch.setattr(owner, name, fails)

    fail_with(np.linalg.LinAlgError("Singular matrix"))
    tracks, core = tracks_of(messages, mode)
    assert tracks == []
    said = "values from a or b were out of numeric range (Singular matrix): the track started anew"
    assert core.pairs["a", "b"].tracker.problems == [said]
    fail_with(ValueError("a fault"))
    with pytest.raises(ValueError, match="a fault"):
        tracks_of(messages, mode)


@pytest.mark.slow
def test_a_changed_calibration_ends_one_track_and_begins_another(inertial_dive):
    messages, world = inertial_dive
    middle_ns = messages[0].stamp_ns + 6 * S_NS
    info = next(message for message in messages if isinstance(message, NodeInfo) and message.node == "a")
    moved = replace(info, stamp_ns=middle_ns, sigma_px=2.0 * info.sigma_px, depth_port_m=(0.0, 0.0, 0.01))
    changed = sorted([*messages, moved], key=lambda message: message.stamp_ns)
    tracks, _ = tracks_of(changed, "smooth")
    before, after = ([one for one in tracks if (one.stamp_ns < middle_ns) is early] for early in (True, False))
    assert len(before) > 80
    assert len(after) > 80
    assert np.median(errors_m(tracks, world)) < 0.05


def test_a_track_of_one_of_many_pairs_begins_with_the_pose_after_a_rest(inertial_dive, monkeypatch):
    monkeypatch.setattr(core, "CROWD", 2)
    messages = [m for m in inertial_dive[0] if m.stamp_ns < inertial_dive[0][0].stamp_ns + 9 * S_NS]
    start_ns = messages[0].stamp_ns + 6 * S_NS
    blind = [replace(m, blobs=[]) if isinstance(m, Candidates) and m.stamp_ns < start_ns else m for m in messages]
    tracks, _ = tracks_of(blind, "filter")
    assert start_ns <= tracks[0].stamp_ns < start_ns + S_NS
    assert len(tracks) > 35
    assert max(errors_m(tracks[20:], inertial_dive[1])) < 0.15
