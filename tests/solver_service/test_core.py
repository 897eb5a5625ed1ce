"""The pure core: every trigger ends once, in any order of arrival, with the same result."""

import random
from collections import Counter

import msgspec
import numpy as np
import pytest
from buddyline.node.sim.dive import messages as simulated
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.messages import Attitude, Candidates, Depth, NodeInfo, Rejected, RelativePose, Truth
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.matcher import MAX_PENDING

from tests.solver_service.conftest import PERIOD_NS, START_NS, assert_same_outcomes, dive_messages


def core_of(*pair):
    return SolverCore(Settings(), [pair or ("a", "b")])


def matcher_of(core):
    (pair,) = core.pairs.values()
    return pair.matcher


def solve(messages, node_a="a", node_b="b"):
    core = core_of(node_a, node_b)
    results = [result for message in messages for result in core.handle(message)]
    return results + core.flush(), core


def triggers_of(messages):
    return {message.trigger for message in messages if isinstance(message, Candidates)}


def assert_each_ends_once(results, messages):
    assert Counter(result.trigger for result in results) == dict.fromkeys(triggers_of(messages), 1)


def test_poses_are_right_and_in_order(dive):
    messages, world = dive
    results, core = solve(messages)
    assert_each_ends_once(results, messages)
    assert [r.trigger for r in results] == sorted(r.trigger for r in results)
    poses = [r for r in results if isinstance(r, RelativePose)]
    assert len(poses) > 0.8 * len(results)
    assert core.counts["solved"] == len(poses)
    for pose in poses:
        truth = world.truth(pose.stamp_ns, pose.trigger)
        assert np.linalg.norm(np.subtract(pose.t_a_b_m, truth.t_a_b_m)) < 0.1 * pose.range_m
        assert {"attitude", "depth"} <= set(pose.checks)


def test_azimuth_and_inclination_point_at_b(dive):
    messages, world = dive
    poses = [r for r in solve(messages)[0] if isinstance(r, RelativePose)]
    for pose in poses[::7]:
        (_, t_a), (_, t_b) = (world.T_ned_camera(node, pose.stamp_ns) for node in ("a", "b"))
        north_m, east_m, down_m = t_b - t_a
        assert abs(np.angle(np.exp(1j * (pose.azimuth_rad - np.arctan2(east_m, north_m))))) < 0.35
        assert abs(pose.inclination_rad - np.arctan2(-down_m, np.hypot(north_m, east_m))) < 0.08


def test_same_result_in_any_order_within_the_window(dive):
    messages, _ = dive
    expected, _ = solve(messages)
    for seed in range(3):
        rng = random.Random(seed)
        # Each message is late by up to 150 ms of the dive, each stream in itself stays in order.
        delays = {}
        order = []
        for i, message in enumerate(messages):
            stream = (message.node, type(message))
            delays[stream] = max(delays.get(stream, 0), message.stamp_ns + rng.randrange(150_000_000))
            order.append((delays[stream], i))
        shuffled = [messages[i] for _, i in sorted(order)]
        assert shuffled != messages
        assert solve(shuffled)[0] == expected


def test_the_first_frame_too_waits_for_its_attitude_and_depth(dive):
    messages, _ = dive
    late = sorted(messages, key=lambda m: m.stamp_ns + (S_NS if isinstance(m, Attitude | Depth) else 0))
    assert solve(late)[0] == solve(messages)[0]


def test_frames_out_of_order_are_matched(dive):
    messages, _ = dive
    expected, _ = solve(messages)
    swapped = list(messages)
    places = [i for i, m in enumerate(swapped) if isinstance(m, Candidates) and m.node == "b"]
    for one, other in zip(places[4::6], places[5::6], strict=False):
        swapped[one], swapped[other] = swapped[other], swapped[one]
    results, core = solve(swapped)
    assert_each_ends_once(results, messages)
    assert matcher_of(core).late == 0
    assert_same_outcomes(results, expected)


def test_duplicates_change_nothing(dive):
    messages, _ = dive
    expected, _ = solve(messages)
    doubled = [copy for message in messages for copy in (message, message)]
    results, core = solve(doubled)
    assert results == expected
    assert matcher_of(core).duplicates + matcher_of(core).late == len(triggers_of(messages)) * 2


def test_lost_frames_are_unmatched_without_waiting(dive):
    messages, _ = dive
    lost = {m.trigger for m in messages if isinstance(m, Candidates)}
    lost = set(sorted(lost)[5::10])
    kept = [m for m in messages if not (isinstance(m, Candidates) and m.node == "b" and m.trigger in lost)]
    results, _ = solve(kept)
    assert_each_ends_once(results, messages)
    unmatched = {r.trigger for r in results if isinstance(r, Rejected) and r.reason == "unmatched"}
    assert unmatched == lost


def test_camera_that_skipped_a_trigger_is_known_at_once(dive):
    messages, _ = dive
    frames = [m for m in messages if isinstance(m, Candidates)]
    gone = sorted(triggers_of(frames))[10]
    core = core_of()
    seq = 0
    for message in messages:
        sent = message
        if isinstance(message, Candidates) and message.node == "b":
            if message.trigger == gone:
                continue
            sent = msgspec.structs.replace(message, seq=seq)
            seq += 1
        if any(isinstance(r, Rejected) and r.trigger == gone for r in core.handle(sent)):
            assert message.stamp_ns <= START_NS + (gone - START_NS // PERIOD_NS + 2) * PERIOD_NS
            return
    pytest.fail("the skipped trigger was never resolved")


def test_late_frame_ends_once_and_is_counted(dive):
    messages, _ = dive
    late = next(m for m in messages if isinstance(m, Candidates) and m.node == "b" and m.seq == 10)
    rest = [m for m in messages if m is not late]
    results, core = solve([*rest[: len(rest) // 2 + 300], late, *rest[len(rest) // 2 + 300 :]])
    assert_each_ends_once(results, messages)
    assert matcher_of(core).late == 1


def test_one_node_alone_expires_and_memory_is_bounded(dive):
    messages, _ = dive
    alone = [m for m in messages if m.node == "a"]
    core = core_of()
    results = []
    for message in alone:
        results += core.handle(message)
        assert core.pending <= 2 * 10 + 2
    results += core.flush()
    assert_each_ends_once(results, alone)
    assert {r.reason for r in results} == {"unmatched"}


def held_up(message, last):
    """When a message comes, ns: after five seconds of outage all at once, and then what comes last."""
    cut_ns, back_ns = START_NS + 3 * S_NS, START_NS + 8 * S_NS
    if not cut_ns <= message.stamp_ns < back_ns:
        return message.stamp_ns + (600 * MS_NS if message.stamp_ns >= back_ns else 0)
    late = message.node == "b" if last == "b" else isinstance(message, Attitude | Depth)
    return back_ns + (message.stamp_ns - cut_ns) // 10_000 + (500 * MS_NS if late else 0)


@pytest.mark.parametrize("last", ["b", "attitudes"])
def test_after_an_outage_what_comes_last_is_waited_for(last):
    """Five seconds of frames arrive at once, without the other node's or their attitudes: the poses are the same."""
    messages, _ = dive_messages(seconds=11.0)
    expected, _ = solve(messages)
    core = core_of()
    results = []
    for message in sorted(messages, key=lambda message: held_up(message, last)):
        results += core.handle(message, held_up(message, last))
    assert results + core.flush() == expected


def test_of_a_stored_dive_nothing_is_held_up(dive):
    """A dive may be played faster than it was made, and stand still in between."""
    frames = [m for m in dive[0] if m.node == "a" and isinstance(m, Candidates)]
    later_ns = 86_400 * S_NS
    core = core_of()
    core.handle(frames[0], frames[0].stamp_ns + later_ns)
    for frame in frames[1:]:
        core.handle(frame, frames[0].stamp_ns + later_ns + 5 * S_NS)
    assert core.counts["unmatched"] == len(frames) - 1 - 2 * S_NS // PERIOD_NS


def test_old_frames_again_and_again_hold_nothing_up():
    """With a sensor that has stopped: it is given up after three seconds, and then no frame waits."""
    messages, _ = dive_messages(seconds=9.0)
    core, frames = core_of(), []
    for message in messages:
        if isinstance(message, Depth) and message.stamp_ns > START_NS + S_NS:
            continue
        core.handle(message, message.stamp_ns)
        if isinstance(message, Candidates):
            frames.append(message)
            core.handle(frames[-50:][0], message.stamp_ns)
            behind_ns = message.stamp_ns - matcher_of(core)._newest_resolved * PERIOD_NS
            assert message.stamp_ns < START_NS + 5 * S_NS or behind_ns < 500 * MS_NS


def test_a_link_by_fits_and_starts_keeps_nobody_waiting_for_long():
    """A's frames come 1.3 s late at most, all 1.3 s together; b has gone."""
    messages, _ = dive_messages(seconds=30.0, sensors=False)
    core = core_of()
    waited_s = []
    for message in messages:
        if message.node == "a" and isinstance(message, Candidates):
            received_ns = START_NS + -(-(message.stamp_ns - START_NS) // (1300 * MS_NS)) * 1300 * MS_NS
            waited_s += [(received_ns - result.stamp_ns) / S_NS for result in core.handle(message, received_ns)]
    assert len(waited_s) > 200
    assert max(waited_s) < 6.0


def test_a_live_frame_waits_two_seconds_for_a_silent_node(dive):
    messages, _ = dive
    core = core_of()
    core.handle(next(m for m in messages if m.node == "b" and isinstance(m, NodeInfo)), START_NS)
    for message in messages:
        if message.node == "a":
            given_up = core.handle(message, message.stamp_ns + 50 * MS_NS)
            waited_s = [(message.stamp_ns - result.stamp_ns) / S_NS for result in given_up]
            assert all(2.0 < s < 2.0 + 2 * PERIOD_NS / S_NS for s in waited_s)
    assert core.counts["unmatched"] > 20


@pytest.mark.parametrize("live", [True, False])
@pytest.mark.parametrize("rate_hz", [10, 1])
def test_a_node_that_dies_before_its_last_attitude_holds_nobody_up(live, rate_hz):
    """B's attitude ends 0.15 s before its last frame, and it sends nothing more; a goes on."""
    messages, _ = dive_messages(seconds=16.0, period_ns=S_NS // rate_hz)
    dies_ns = START_NS + 4 * S_NS
    core, waits_s, frames = core_of(), [], []
    for message in messages:
        ends_ns = dies_ns - (150 * MS_NS if isinstance(message, Attitude | Depth) else 0)
        if message.node == "b" and message.stamp_ns > ends_ns:
            continue
        frames += [message] if isinstance(message, Candidates) else []
        now_ns = message.stamp_ns + 50 * MS_NS
        results = core.handle(message, now_ns) if live else core.handle(message)
        waits_s += [(message.stamp_ns - result.stamp_ns) / S_NS for result in results]
    assert max(waits_s) < 3.5 if live else max(waits_s) < 3.5 + 2 / rate_hz
    assert core.pending <= 3 * rate_hz
    assert len(waits_s) + core.pending == len(triggers_of(frames))


@pytest.mark.parametrize("live", [True, False])
def test_frames_taken_thirty_seconds_apart_are_never_matched(live):
    """B's clock jumps ahead by 30 s, and b ends soon after; half a minute later a comes to the same triggers."""
    messages, _ = dive_messages(seconds=36.0, sensors=False)
    ahead = 30 * S_NS // PERIOD_NS
    core, results, jumped = core_of(), [], set()
    for message in messages:
        sent = message
        if message.node == "b" and message.stamp_ns > START_NS + 3 * S_NS:
            continue
        if message.node == "b" and isinstance(message, Candidates) and message.stamp_ns > START_NS + 2 * S_NS:
            sent = msgspec.structs.replace(
                message, stamp_ns=message.stamp_ns + 30 * S_NS, trigger=message.trigger + ahead
            )
            jumped.add(sent.trigger)
        results += core.handle(sent, message.stamp_ns + 50 * MS_NS) if live else core.handle(sent)
    results += core.flush()
    assert len(jumped) == 10
    assert {result.reason for result in results if result.trigger in jumped} <= {"unmatched", "late"}


def test_what_waits_when_a_clock_is_set_has_its_outcome(dive):
    """A alone, whose clock is set back by an hour: the frames of its last seconds wait for b then."""
    messages, _ = dive
    frames = [m for m in messages if isinstance(m, Candidates) and m.node == "a"]
    hour_ns = 3600 * S_NS
    back = [
        msgspec.structs.replace(m, stamp_ns=m.stamp_ns - hour_ns, trigger=m.trigger - hour_ns // PERIOD_NS)
        for m in frames
    ]
    results, _ = solve([*frames, *back])
    assert_each_ends_once(results, [*frames, *back])


def test_a_node_that_appears_later_is_paired_with_what_the_others_still_hold(dive):
    messages, _ = dive
    core = SolverCore(Settings())
    ordered = sorted(messages, key=lambda m: (m.node == "b", m.stamp_ns))
    results = [result for message in ordered for result in core.handle(message, START_NS + 7 * S_NS)] + core.flush()
    assert_each_ends_once(results, messages)
    assert list(core.pairs) == [("a", "b")]
    assert sum(isinstance(r, RelativePose) for r in results) > 0.8 * len(results)


def test_a_node_without_lamps_is_in_no_pair_though_its_frames_came_first(dive):
    """Live a frame may overtake the calibration, which then says that c has a camera alone."""
    messages, _ = dive
    frames = [msgspec.structs.replace(m, node="c") for m in messages if m.node == "b" and isinstance(m, Candidates)]
    info = next(m for m in messages if isinstance(m, NodeInfo) and m.node == "b")
    core = SolverCore(Settings())
    first = [next(m for m in messages if isinstance(m, NodeInfo) and m.node == "a"), *frames[:3]]
    assert [result for message in first for result in core.handle(message)] == []
    assert list(core.pairs) == [("a", "c")]
    core.handle(msgspec.structs.replace(info, node="c", role="camera"))
    assert list(core.pairs) == []
    others = sorted([*messages, *frames[3:]], key=lambda m: (m.stamp_ns, isinstance(m, Candidates)))
    results = [result for message in others for result in core.handle(message)] + core.flush()
    assert list(core.pairs) == [("a", "b")]
    assert {(result.node_a, result.node_b) for result in results} == {("a", "b")}
    assert_each_ends_once(results, messages)


def test_three_nodes_give_each_pair_what_it_gives_alone(dive):
    """C is b over again: pair a, c gives what a, b gives, and b, c has its outcomes."""
    messages, _ = dive
    renamed = [msgspec.structs.replace(m, node="c") for m in messages if m.node == "b"]
    three = sorted([*messages, *renamed], key=lambda m: (m.stamp_ns, isinstance(m, Candidates)))
    core = SolverCore(Settings())
    found = {nodes: [] for nodes in (("a", "b"), ("a", "c"), ("b", "c"))}
    for result in [result for message in three for result in core.handle(message)] + core.flush():
        found[result.node_a, result.node_b].append(result)
    alone, _ = solve(sorted(messages, key=lambda m: (m.stamp_ns, isinstance(m, Candidates))))
    assert found["a", "b"] == alone
    assert [msgspec.structs.replace(result, node_b="b") for result in found["a", "c"]] == alone
    for results in found.values():
        assert_each_ends_once(results, messages)


def test_together_or_one_by_one_gives_the_same(dive):
    messages, _ = dive
    expected, _ = solve(messages)
    core = core_of()
    results = [r for at in range(0, len(messages), 97) for r in core.handle_many(messages[at : at + 97])]
    assert_same_outcomes(results + core.flush(), expected)


def test_without_calibration_every_trigger_says_so(dive):
    messages, _ = dive
    results, _ = solve([m for m in messages if not (isinstance(m, NodeInfo) and m.node == "b")])
    assert_each_ends_once(results, messages)
    assert {r.reason for r in results} == {"no_info"}
    assert "b" in results[0].detail


def test_calibration_of_another_size_is_refused(dive):
    messages, _ = dive
    wrong = [msgspec.structs.replace(m, width_px=1640) if isinstance(m, NodeInfo) else m for m in messages]
    results, _ = solve(wrong)
    assert {r.reason for r in results} == {"no_info"}
    assert "820x616" in results[0].detail


def test_two_nodes_of_one_id_are_a_duplicate(dive):
    messages, _ = dive
    frames = [m for m in messages if isinstance(m, Candidates) and m.node == "a"]
    imposters = [msgspec.structs.replace(m, boot="other", blobs=[]) for m in frames]
    mixed = []
    for message in messages:
        mixed.append(message)
        if isinstance(message, Candidates) and message.node == "a":
            mixed.append(imposters[frames.index(message)])
    results, _ = solve(mixed)
    assert_each_ends_once(results, messages)
    assert {r.reason for r in results} == {"duplicate"}


def test_sensors_that_stop_do_not_stop_the_poses(dive):
    messages, _ = dive
    half = START_NS + 3_000_000_000
    cut = [m for m in messages if not (isinstance(m, Attitude | Depth) and m.stamp_ns > half)]
    results, _ = solve(cut)
    assert_each_ends_once(results, messages)
    late = [r for r in results if isinstance(r, RelativePose) and r.stamp_ns > half + 500_000_000]
    assert late
    assert not any("attitude" in r.checks for r in late)


def test_clock_set_back_an_hour_is_followed(dive):
    messages, _ = dive
    hour = 36_000
    back = [
        msgspec.structs.replace(
            m,
            stamp_ns=m.stamp_ns - hour * PERIOD_NS,
            **({"trigger": m.trigger - hour, "seq": m.seq + 1000} if isinstance(m, Candidates) else {}),
        )
        for m in messages
        if not isinstance(m, NodeInfo)
    ]
    results, _ = solve([*messages, *back])
    assert_each_ends_once(results, [*messages, *back])
    after = [r for r in results if r.trigger < START_NS // PERIOD_NS]
    assert sum(isinstance(r, RelativePose) for r in after) > 0.7 * len(after)


def test_frame_an_hour_ahead_ends_alone(dive):
    messages, _ = dive
    frame = next(m for m in messages if isinstance(m, Candidates) and m.seq == 20)
    ahead = msgspec.structs.replace(frame, stamp_ns=frame.stamp_ns + 3600 * 10**9, trigger=frame.trigger + 36_000)
    at = messages.index(frame)
    results, _ = solve([*messages[:at], ahead, *messages[at:]])
    assert_each_ends_once(results, [*messages, ahead])
    assert [r.reason for r in results if r.trigger == ahead.trigger] == ["late"]
    assert sum(isinstance(r, RelativePose) for r in results) > 0.8 * len(results)


def test_other_nodes_are_not_used(dive):
    messages, _ = dive
    stranger = [msgspec.structs.replace(m, node="c") for m in messages if isinstance(m, Candidates)][:10]
    expected, _ = solve(messages)
    results, core = solve([*messages[:100], *stranger, *messages[100:]])
    assert results == expected
    assert core.unused == {"c": 10}


def test_pending_is_bounded_against_a_flood(dive):
    messages, _ = dive
    frame = next(m for m in messages if isinstance(m, Candidates))
    core = core_of()
    for k in range(2 * MAX_PENDING):
        core.handle(msgspec.structs.replace(frame, trigger=frame.trigger + k, seq=2 * k, blobs=[]))
    assert core.pending <= MAX_PENDING


def test_same_id_twice_is_refused():
    with pytest.raises(ValueError, match="same id"):
        core_of("a", "a")


def test_without_sensors_it_still_solves():
    messages, world = dive_messages(sensors=False, seed=5)
    results, _ = solve(messages)
    assert_each_ends_once(results, messages)
    poses = [r for r in results if isinstance(r, RelativePose)]
    assert len(poses) > 0.5 * len(results)
    for pose in poses:
        assert "upright_assumed" in pose.checks
        truth = world.truth(pose.stamp_ns, pose.trigger)
        assert np.linalg.norm(np.subtract(pose.t_a_b_m, truth.t_a_b_m)) < 0.1 * pose.range_m


def test_a_false_candidate_that_fits_badly_gives_no_pose_without_attitudes():
    scenario = Scenario("basin", seed=5008, start_ns=START_NS, miss_share=0.2, other_lamps=3)
    world = World(scenario)
    found = [message for _, _, message in simulated(world, DivePlan(seconds=5.0, rate_hz=8))]
    core = SolverCore(Settings(), [("a", "b")])
    results = core.handle_many([m for m in found if isinstance(m, NodeInfo | Candidates)]) + core.flush()
    truths = {m.trigger: m.t_a_b_m for m in found if isinstance(m, Truth)}
    poses = [one for one in results if isinstance(one, RelativePose)]
    assert len(poses) > 5
    for pose in poses:
        assert np.linalg.norm(np.subtract(pose.t_a_b_m, truths[pose.trigger])) < 0.1 * pose.range_m
