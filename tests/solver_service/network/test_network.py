"""The network on simulated dives of four nodes: what it says of each node, and how true that is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal, NoReturn

import numpy as np
import pytest
from buddyline.node.sim import dive as simulation
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Candidates, FixedPlace, LightTruth, Message, NodeInfo, NodePose, Truth
from buddyline.solver_service.config import SolveConfig, track_settings
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.rotation import (
    Floats,
    matrix_to_quat,
    quat_to_matrix,
    rotation_exp,
    rotation_log,
)
from buddyline.solver_service.network import filter as filter_module
from buddyline.solver_service.network.estimate import NetEstimate
from buddyline.solver_service.network.filter import NetFilter
from buddyline.solver_service.tracking import Coming, PairTracker
from buddyline.tools.evaluation.network import network_figures
from msgspec.structs import replace

START_NS = 1_764_000_000_000_000_000
HZ = 10.0


def dive(seed: int, seconds: float, *, imu: bool = True, **scenario: Any) -> tuple[World, list[Message]]:
    scenario = {"more_nodes": ("c", "d"), "fixed_nodes": ("a",)} | scenario
    world = World(Scenario(seed=seed, start_ns=START_NS, **scenario))
    told = [message for _, _, message in simulation.messages(world, DivePlan(seconds=seconds, imu=imu))]
    return world, [message for message in told if not isinstance(message, Truth | LightTruth | NodePose)]


def solved(
    messages: list[Message], together: int = 2000, mode: str = "filter", hz: float = HZ
) -> tuple[list[NodePose], SolverCore]:
    """Solve as a stored dive, so many messages at a time."""
    core = SolverCore(SolveConfig().settings("test"), None, track=track_settings(mode, hz))
    found = []
    for start in range(0, len(messages), together):
        found += core.handle_many(messages[start : start + together])
    found += core.flush()
    return [one for one in found if isinstance(one, NodePose)], core


def errors(world: World, poses: list[NodePose], origin: str | None = None) -> dict[str, Floats]:
    """By node: errors of place (m), turn (rad), and their squares by the covariance over 6, (N, 3)."""
    out: dict[str, list[tuple[float, float, float]]] = {}
    for pose in poses:
        true = world.node_truth(pose.node, pose.stamp_ns, "main")
        zero = np.zeros(3)
        if origin is not None:
            # All clocks but the first node's are ahead.
            apart_ns = ((origin != "a") - (pose.node != "a")) * world.scenario.clock_offset_ns
            zero = np.array(world.node_truth(origin, pose.stamp_ns + apart_ns, "main").p_m)
        turn = quat_to_matrix(np.array(true.q_xyzw)) @ quat_to_matrix(np.array(pose.q_xyzw)).T
        e = np.concatenate((np.array(true.p_m) - zero - pose.p_m, rotation_log(turn)))
        P = np.array(pose.covariance).reshape(6, 6) + 1e-12 * np.eye(6)
        squared = float(e @ np.linalg.solve(P, e)) / 6.0
        out.setdefault(pose.node, []).append((float(np.linalg.norm(e[:3])), float(np.linalg.norm(e[3:])), squared))
    return {node: np.array(rows) for node, rows in out.items()}


@pytest.fixture(scope="module", autouse=True)
def no_tracks_of_pairs() -> Iterator[None]:
    """The network uses none of them, and they take two thirds of the time."""
    with pytest.MonkeyPatch.context() as patch:
        for name, told in (("follow", Coming()), ("tell", []), ("finish", [])):
            patch.setattr(PairTracker, name, lambda *_, told=told: told)
        yield


@pytest.fixture(scope="module")
def four() -> tuple[World, list[Message], list[NodePose]]:
    world, messages = dive(3, 6.0)
    poses, _ = solved(messages)
    return world, messages, poses


def test_all_nodes_are_in_the_fixed_nodes_frame(four: tuple[World, list[Message], list[NodePose]]) -> None:
    world, _, poses = four
    found = errors(world, poses)
    assert sorted(found) == ["a", "b", "c", "d"]
    assert {pose.fixed for pose in poses if pose.node == "a"} == {True}
    for node in "bcd":
        assert len(found[node]) > 45
        assert np.median(found[node][:, 0]) < 0.03
        assert found[node][:, 0].max() < 0.15
        assert 0.3 < found[node][:, 2].mean() < 1.6


def test_the_network_does_not_depend_on_how_much_comes_at_once(
    four: tuple[World, list[Message], list[NodePose]],
) -> None:
    _, messages, poses = four
    by_turns, _ = solved(first_seconds(messages, 2.0), together=90)
    keyed = {(one.node, one.stamp_ns): one for one in by_turns if one.stamp_ns < START_NS + 1_500_000_000}
    once = [one for one in poses if one.stamp_ns < START_NS + 1_500_000_000]
    assert len(keyed) == len(once) > 20
    for one in once:
        assert keyed[one.node, one.stamp_ns].p_m == pytest.approx(one.p_m, abs=1e-6)


def test_pictures_of_a_trigger_tell_together_what_they_tell_one_after_another(
    four: tuple[World, list[Message], list[NodePose]], monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = first_seconds(four[1], 3.0)
    together = between_triggers(solved(messages, hz=20.0)[0])
    monkeypatch.setattr(NetFilter, "_beside", lambda *_: [])
    alone = between_triggers(solved(messages, hz=20.0)[0])
    assert together.keys() == alone.keys()
    off, ratios = [], []
    for key, one in alone.items():
        own, other = (np.trace(np.array(row.covariance).reshape(6, 6)[:3, :3]) for row in (one, together[key]))
        off.append(np.linalg.norm(np.array(together[key].p_m) - one.p_m) / np.sqrt(own))
        ratios.append(other / own)
    assert np.median(off) < 0.15
    # Where one order takes a light that the other leaves out, a row or two differ by more.
    assert np.percentile(off, 95.0) < 0.3
    assert max(off) < 0.8
    assert np.median(ratios) == pytest.approx(1.0, abs=0.01)


def between_triggers(poses: list[NodePose]) -> dict[tuple[str, int], NodePose]:
    """The rows between two triggers, which count all pictures of the last one either way."""
    return {(one.node, one.stamp_ns): one for one in poses if one.stamp_ns % (S_NS // 10)}


def test_the_smoothed_network_is_better_than_the_filter_and_as_honest(
    four: tuple[World, list[Message], list[NodePose]],
) -> None:
    world, messages, poses = four
    smooth, _ = solved(first_seconds(messages, 3.0), mode="smooth")
    assert {pose.mode for pose in smooth} == {"smooth"}
    told = {(pose.node, pose.stamp_ns) for pose in smooth}
    filtered = [pose for pose in poses if (pose.node, pose.stamp_ns) in told]
    assert len(filtered) >= 4 * 25
    before, after = errors(world, filtered), errors(world, smooth)
    for node in "bcd":
        assert np.sqrt(np.square(after[node][:, 0]).mean()) < 0.8 * np.sqrt(np.square(before[node][:, 0]).mean())
        assert 0.3 < after[node][:, 2].mean() < 1.8


@pytest.mark.slow
def test_the_smoothed_rows_of_the_beginning_count_what_the_dive_tells_of_shaking(
    four: tuple[World, list[Message], list[NodePose]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its units are screwed to their cameras: attitudes are known better than before the dive has told so."""
    messages = first_seconds(four[1], 3.0)
    told = sigma_rad(solved(messages, mode="smooth")[0])
    monkeypatch.setattr(filter_module, "REHEARSED_S", 0.0)
    untold = sigma_rad(solved(messages, mode="smooth")[0])
    assert told.keys() == untold.keys()
    assert all(told[node] < 0.97 * untold[node] for node in told)


@pytest.mark.parametrize(
    ("evidence", "walked"), [((0.0, 0.0, 0.0), 0.8), ((-90.0, 0.0, 0.0), 0.506), ((9.0, 0.0, -9.0), 2.0)]
)
def test_walks_count_by_how_well_they_explain_the_dives_beginning(
    evidence: tuple[float, ...], walked: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    net = NetFilter(smooths=True)

    def trial(_: NetFilter, of: float) -> NetEstimate:
        found = NetEstimate(net)
        found.evidence = dict(zip(filter_module.WALKS.tolist(), evidence, strict=True))[of]
        return found

    monkeypatch.setattr(NetFilter, "_trial", trial)
    net._push(net.since_epoch(START_NS), filter_module.ROW, (START_NS,))
    net.advance(START_NS)
    net.finish()
    assert net.main.walked == pytest.approx(walked, rel=1e-3)
    assert net.main.copied().walked == net.main.walked


@pytest.mark.slow
def test_a_dive_with_steady_units_tells_that_their_biases_hardly_walk() -> None:
    _, messages = dive(7501, 10.0, inertial="good")
    core = solved(messages, mode="smooth")[1]
    assert core.network is not None
    assert core.network._filter.main.walked < 0.5


def sigma_rad(poses: list[NodePose]) -> dict[str, float]:
    """The moving nodes' mean sigma of their attitudes in the first second."""
    found: dict[str, list[float]] = {}
    for pose in poses:
        if not pose.fixed and pose.stamp_ns < START_NS + S_NS:
            variance = np.trace(np.array(pose.covariance).reshape(6, 6)[3:, 3:])
            found.setdefault(pose.node, []).append(float(np.sqrt(variance)))
    return {node: float(np.mean(sigmas)) for node, sigmas in found.items()}


def test_without_a_fixed_node_the_frame_moves_with_one() -> None:
    world, messages = dive(4, 3.0, fixed_nodes=())
    poses, _ = solved(messages)
    at_zero = {pose.node for pose in poses if pose.p_m == (0.0, 0.0, 0.0)}
    assert len(at_zero) == 1
    found = errors(world, poses, at_zero.pop())
    assert sorted(found) == ["a", "b", "c", "d"]
    # Only the compasses say where north is.
    assert all(rows[:, 0].max() < 1.0 and rows[:, 2].mean() < 2.0 for rows in found.values())


@pytest.mark.parametrize("mode", ["filter", "smooth"])
def test_a_network_says_that_north_is_in_doubt_where_compasses_contradict_each_other(mode: str) -> None:
    """The wrong compass spoke first: headings were off by 7 to 10 of the sigmas told."""
    world, messages = dive(8100, 6.0, more_nodes=("c",), fixed_nodes=())
    poses, core = solved([turned(one, "b", 30.0) for one in messages], mode=mode)
    assert core.network is not None
    assert [one for one in core.network.problems if one.startswith("b: its compass is ")]
    found = errors(world, poses, next(pose.node for pose in poses if pose.p_m == (0.0, 0.0, 0.0)))
    for node in "abc":
        P = np.array([pose.covariance for pose in poses if pose.node == node]).reshape(-1, 6, 6)
        off_m, off_rad, _ = found[node].T
        assert off_rad.mean() > 0.3
        assert (off_rad < 2.5 * np.sqrt(P[:, 5, 5])).all()
        assert (off_m <= 2.5 * np.sqrt(np.trace(P[:, :3, :3], axis1=1, axis2=2))).all()


def turned(message: Message, node: str, off_deg: float) -> Message:
    """A node's compass is off."""
    if not isinstance(message, Attitude) or message.node != node:
        return message
    off = rotation_exp(np.array((0.0, 0.0, np.radians(off_deg))))
    x, y, z, w = matrix_to_quat(off @ quat_to_matrix(np.array(message.q_ned_body_xyzw))).tolist()
    return replace(message, q_ned_body_xyzw=(x, y, z, w))


@pytest.mark.slow
def test_nodes_without_inertial_units_are_followed_when_they_turn_away() -> None:
    """Their compasses tell a turn late: the network lost its members, or was metres off."""
    judged = []
    for seed in (12, 14):
        world, messages = dive(seed, 30.0, more_nodes=("c",), fixed_nodes=(), imu=False)
        poses, _ = solved(messages)
        judged += network_figures(poses, [world.node_truth(pose.node, pose.stamp_ns, "main") for pose in poses])
    assert len(judged) == 6
    assert sum(one.wrong for one in judged) == 0
    # Of 300 triggers; half of the nodes had 112 to 166 rows.
    assert min(one.samples for one in judged) > 250
    assert max(one.nees6.mean or 0.0 for one in judged) < 1.5 * 6.0


def test_without_inertial_units_fixed_nodes_may_have_a_north_of_their_own() -> None:
    """The angle from the compasses' north is no turn: taken for one at every step, it made nodes metres off."""
    world, messages = dive(13, 8.0, more_nodes=("c",), fixed_nodes=("a",), imu=False)
    R = rotation_exp(np.array((0.0, 0.0, np.radians(40.0))))

    def turned(q_xyzw: tuple[float, ...]) -> Any:
        return tuple(matrix_to_quat(R @ quat_to_matrix(np.array(q_xyzw))).tolist())

    def elsewhere(info: NodeInfo) -> NodeInfo:
        assert isinstance(info.fixed, FixedPlace)
        x, y, z = (R @ np.array(info.fixed.p_m)).tolist()
        return replace(info, fixed=replace(info.fixed, p_m=(x, y, z), q_xyzw=turned(info.fixed.q_xyzw)))

    poses, _ = solved(changed(messages, "a", elsewhere))
    found: dict[str, list[float]] = {}
    for pose in poses:
        true = world.node_truth(pose.node, pose.stamp_ns, "main")
        found.setdefault(pose.node, []).append(float(np.linalg.norm(R @ np.array(true.p_m) - pose.p_m)))
    assert sorted(found) == ["a", "b", "c"]
    assert all(len(off_m) > 65 and np.median(off_m) < 0.05 for off_m in found.values())


def test_a_fixed_node_that_comes_after_the_others_holds_the_frame(
    four: tuple[World, list[Message], list[NodePose]],
) -> None:
    """Its calibration may be heard when the network of the others has begun."""
    world, messages, _ = four
    late_ns = messages[0].stamp_ns + 3 * S_NS
    late = [one for one in messages if isinstance(one, NodeInfo) and one.node == "a" and one.stamp_ns < late_ns]
    rest = [one for one in first_seconds(messages, 5.0) if one not in late]
    at = next(i for i, one in enumerate(rest) if one.stamp_ns > late_ns)
    poses, _ = solved([*rest[:at], *late, *rest[at:]], together=50)
    after = [one for one in poses if one.stamp_ns > late_ns + S_NS]
    assert {one.node for one in after} == {"a", "b", "c", "d"}
    assert {one.fixed for one in after if one.node == "a"} == {True}
    assert all(np.median(rows[:, 0]) < 0.05 for rows in errors(world, after).values())


def test_two_nodes_make_no_network_unless_one_is_fixed() -> None:
    _, messages = dive(5, 1.0, more_nodes=(), fixed_nodes=(), imu=False)
    assert solved(messages)[0] == []
    _, messages = dive(5, 2.5, more_nodes=(), fixed_nodes=("a",))
    assert {pose.node for pose in solved(messages)[0]} == {"a", "b"}


def test_a_lamp_that_blinks_is_no_lamp_that_is_often_missed() -> None:
    world, messages = dive(3, 2.0, blink_slot_ns=100_000_000)
    poses, core = solved(messages)
    found = errors(world, poses)
    assert sorted(found) == ["a", "b", "c", "d"]
    assert max(np.median(rows[:, 0]) for rows in found.values()) < 0.05
    assert core.network is not None
    # Dark in three pictures of ten, a left lamp would be found in 0.68 of them.
    found_of = {pair: core.network.detection(*pair) for pair in core.network.seen()}
    assert found_of.keys() >= {("a", "b"), ("a", "d"), ("b", "a")}
    assert min(*found_of["a", "b"], *found_of["a", "d"], *found_of["b", "a"]) > 0.78


def first_seconds(messages: list[Message], seconds: float) -> list[Message]:
    return [message for message in messages if getattr(message, "stamp_ns", 0) < START_NS + round(seconds * 1e9)]


def changed(messages: list[Message], node: str, change: Callable[[NodeInfo], NodeInfo]) -> list[Message]:
    return [
        change(message) if isinstance(message, NodeInfo) and message.node == node else message for message in messages
    ]


@pytest.mark.slow
def test_places_far_from_zero_cost_nothing(four: tuple[World, list[Message], list[NodePose]]) -> None:
    """Coordinates of a country's grid: thousands of kilometres."""
    _, messages, poses = four

    def moved(info: NodeInfo) -> NodeInfo:
        x, y, z = info.fixed.p_m
        return replace(info, fixed=replace(info.fixed, p_m=(x + 6.5e6, y + 5e5, z)))

    far, _ = solved(changed(first_seconds(messages, 2.0), "a", moved))
    near = {(one.node, one.stamp_ns): one for one in poses}
    assert len(far) > 40
    for one in far:
        if one.stamp_ns > START_NS + 1_500_000_000:
            continue
        x, y, z = near[one.node, one.stamp_ns].p_m
        assert one.p_m == pytest.approx((x + 6.5e6, y + 5e5, z), abs=1e-3)


@pytest.mark.parametrize("role", ["lights", "camera"])
def test_a_fixed_node_of_lamps_or_of_a_camera_alone_is_used(role: Literal["lights", "camera"]) -> None:
    """Node c stands on a tripod; it is in no pair, but its lamps are seen, or it sees those of others."""
    world, messages = dive(3, 3.0, fixed_nodes=("a", "c"))
    messages = changed(messages, "c", lambda info: replace(info, role=role))
    if role == "lights":
        messages = [one for one in messages if isinstance(one, NodeInfo) or getattr(one, "node", "") != "c"]
    poses, core = solved(messages)
    assert sorted(core.pairs) == [("a", "b"), ("a", "d"), ("b", "d")]
    assert core.network is not None
    seen = core.network.seen()
    assert (("b", "c") in seen, ("c", "b") in seen) == (role == "lights", role == "camera")
    found = errors(world, poses)
    assert sorted(found) == ["a", "b", "c", "d"]
    assert all(np.median(found[node][:, 0]) < 0.05 for node in "bd")


@pytest.mark.slow
def test_absurd_values_end_nothing() -> None:
    world, messages = dive(6, 3.0)
    spoilt: list[Message] = []
    for message in messages:
        if isinstance(message, Candidates) and message.node == "b" and message.blobs and message.seq % 10 == 5:
            absurd = replace(message.blobs[0], sigma_px=1e300)
            spoilt.append(replace(message, blobs=[absurd, *message.blobs[1:]]))
        else:
            spoilt.append(message)
    poses, _ = solved(spoilt)
    found = errors(world, poses)
    assert all(np.median(found[node][:, 0]) < 0.1 for node in "bcd")


@pytest.mark.parametrize("error", [ValueError("a fault"), np.linalg.LinAlgError("Singular matrix")])
def test_only_what_absurd_values_lead_to_begins_the_network_anew(
    error: ValueError, four: tuple[World, list[Message], list[NodePose]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fault of this program must not look like a lack of poses."""

    def fails(*_: object) -> NoReturn:
        raise error

    monkeypatch.setattr(NetFilter, "advance", fails)
    messages = first_seconds(four[1], 0.5)
    if not isinstance(error, np.linalg.LinAlgError):
        with pytest.raises(ValueError, match="a fault"):
            solved(messages)
        return
    poses, core = solved(messages)
    assert poses == []
    assert core.network is not None
    assert core.network.problems == ["values were out of numeric range (Singular matrix): the network started anew"]


@pytest.mark.slow
@pytest.mark.parametrize("grade", ["good", "poor"])
def test_networks_err_as_they_say(grade: str) -> None:
    """Means over six dives of 20 s: wanted are NEES / 6 of 0.8 to 1.3, and next to none wrong."""
    found = []
    for seed in range(20, 26):
        world, messages = dive(seed, 20.0, inertial=grade)
        found.append(errors(world, solved(messages)[0]))
    means = np.array([[one[node][:, 2].mean() for node in "bcd"] for one in found])
    assert 0.65 < means.mean() < 1.3, means
    assert all(one[node][:, 0].max() < 0.4 for one in found for node in "bcd")


@pytest.mark.slow
def test_a_node_that_is_off_has_no_place_by_its_lamps_alone() -> None:
    """Whether it turns to the left or to the right meanwhile, the others see the same."""
    world, messages = dive(31, 24.0)
    off_ns, on_ns = START_NS + 8 * S_NS, START_NS + 18 * S_NS
    heard = [one for one in messages if getattr(one, "node", "") != "b" or not off_ns <= one.stamp_ns < on_ns]
    for mode in ("filter", "smooth"):
        found = errors(world, solved(heard, mode=mode)[0])
        assert 120 < len(found["b"]) < 200
        assert found["b"][:, 2].mean() < 2.0
        assert len(found["c"]) > 200


@pytest.mark.slow
def test_a_fixed_node_that_moves_is_named() -> None:
    """Node c, which moves, is said to be fixed where it was at the start."""
    world, messages = dive(7, 8.0, more_nodes=("c",))

    def stands(info: NodeInfo) -> NodeInfo:
        start = world.node_truth("c", START_NS, "main")
        return replace(info, fixed=FixedPlace(p_m=start.p_m, q_xyzw=start.q_xyzw))

    _, core = solved(changed(messages, "c", stands))
    assert core.network is not None
    assert any("fixed node c moved" in problem for problem in core.network.problems), core.network.problems
    _, core = solved(first_seconds(messages, 4.0))
    assert core.network is not None
    assert core.network.problems == []


def test_nodes_of_two_nets_are_said() -> None:
    _, messages = dive(8, 1.0, more_nodes=("c",), fixed_nodes=("a", "c"), imu=False)
    messages = changed(messages, "c", lambda info: replace(info, fixed=replace(info.fixed, net="other")))
    _, core = solved(messages)
    assert core.network is not None
    assert core.network.problems == ["fixed nodes name the nets main and other: all are taken for one frame"]


def test_fixed_nodes_whose_places_contradict_each_other_are_named() -> None:
    """Two frames of one name, say: b is said to stand a metre from where a sees it."""
    _, messages = dive(5, 2.5, more_nodes=(), fixed_nodes=("a", "b"), imu=False)
    _, core = solved(messages)
    assert core.network is not None
    assert core.network.problems == []

    def aside(info: NodeInfo) -> NodeInfo:
        x, y, z = info.fixed.p_m
        return replace(info, fixed=replace(info.fixed, p_m=(x + 0.7, y + 0.7, z)))

    _, core = solved(changed(messages, "b", aside))
    assert core.network is not None
    assert core.network.problems == ["fixed nodes a and b: what they see of each other contradicts their places"]


def test_a_fixed_node_moved_aside_is_named_though_its_sensors_cannot_tell() -> None:
    """Nodes a and c stand side by side, and do not see each other; b sees both, and c is not where it is said to be."""
    _, messages = dive(9, 2.5, more_nodes=("c",), fixed_nodes=("a", "c"), imu=False)

    def aside(info: NodeInfo) -> NodeInfo:
        x, y, z = info.fixed.p_m
        return replace(info, fixed=replace(info.fixed, p_m=(x + 0.7, y + 0.7, z)))

    _, core = solved(changed(messages, "c", aside))
    assert core.network is not None
    said = "poses of b and c contradict the network: has fixed node c moved, or is it another's bar?"
    assert said in core.network.problems
