"""The simulated world against the known answers, itself, and OpenCV's camera model."""

import dataclasses
from itertools import pairwise

import cv2
import numpy as np
import pytest
from buddyline.node.sim import rotation
from buddyline.node.sim.camera import pinhole, project
from buddyline.node.sim.inertial import ACCEL_SIGMA_MPS2, FIELD_NED_T, GRADES, GRAVITY_MPS2, Grade
from buddyline.node.sim.rig import R_BODY_CAMERA
from buddyline.node.sim.scenario import ENVIRONMENTS, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.blinking import lit
from buddyline.protocol.codec import decode, encode
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CameraModel, Candidates
from msgspec.structs import replace

S_NS = 1_000_000_000
START_NS = 1_764_000_000 * S_NS

IDEAL = CameraModel(model="pinhole", fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, distortion=[0.0] * 5)
BAR_M = np.array([[-0.44, 0.0, 0.0], [0.44, 0.0, 0.0]])

# The known answers of the geometry: B's L and R in A's image, A's L and R in B's image, t_a_b, q_a_b_xyzw.
KNOWN = [
    ([(0.146666667, 0), (-0.146666667, 0)], [(0.146666667, 0), (-0.146666667, 0)], (0, 0, 3), (0, 1, 0, 0)),
    (
        [(0.213946836, -0.065641060), (-0.130688691, -0.107801620)],
        [(-0.027276404, 0.066572102), (-0.391258192, 0.022986838)],
        (0.086917, -0.217889, 2.488970),
        (-0.068008, 0.991236, 0.015693, -0.112158),
    ),
    (
        [(-0.140747047, 0.098411310), (-0.213026419, 0.115301572)],
        [(0.280244394, -0.167743946), (0.204346354, -0.150186560)],
        (-2.072363, 1.254342, 11.752954),
        (0.088540, 0.972430, 0.021367, 0.214670),
    ),
]


@pytest.mark.parametrize(("in_a", "in_b", "t_a_b_m", "q_a_b_xyzw"), KNOWN)
def test_the_forward_model_gives_the_known_answers(in_a, in_b, t_a_b_m, q_a_b_xyzw):
    R_a_b = rotation.from_quaternion(q_a_b_xyzw / np.linalg.norm(q_a_b_xyzw))
    t_a_b_m = np.array(t_a_b_m, float)
    # The poses are printed to six digits.
    np.testing.assert_allclose(project(BAR_M @ R_a_b.T + t_a_b_m, IDEAL), in_a, atol=2e-6)
    np.testing.assert_allclose(project((BAR_M - t_a_b_m) @ R_a_b, IDEAL), in_b, atol=2e-6)


def _points(rng, n=200):
    return rng.uniform((-1.2, -1.0, 1.5), (1.2, 1.0, 9.0), (n, 3))


def test_the_pinhole_agrees_with_opencv():
    points = _points(np.random.default_rng(1))
    camera = CameraModel(
        model="pinhole", fx_px=900.0, fy_px=910.0, cx_px=400.0, cy_px=310.0,
        distortion=[-0.21, 0.08, 0.001, -0.002, 0.01],
    )  # fmt: skip
    K = np.array([[900.0, 0, 400], [0, 910, 310], [0, 0, 1]])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(camera.distortion))
    np.testing.assert_allclose(project(points, camera), theirs.reshape(-1, 2), atol=1e-9)


def test_the_fisheye_agrees_with_opencv():
    points = _points(np.random.default_rng(2))
    camera = CameraModel(
        model="fisheye", fx_px=500.0, fy_px=505.0, cx_px=400.0, cy_px=310.0,
        distortion=[0.03, -0.01, 0.004, -0.001],
    )  # fmt: skip
    K = np.array([[500.0, 0, 400], [0, 505, 310], [0, 0, 1]])
    theirs, _ = cv2.fisheye.projectPoints(
        points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, np.array(camera.distortion)
    )
    np.testing.assert_allclose(project(points, camera), theirs.reshape(-1, 2), atol=1e-9)


def test_no_point_behind_the_camera_or_beyond_the_fold_has_a_pixel():
    folding = CameraModel(
        model="pinhole", fx_px=900.0, fy_px=900.0, cx_px=400.0, cy_px=300.0,
        distortion=[-0.5, 0.0, 0.0, 0.0, 0.0],
    )  # fmt: skip
    pixels = project(np.array([[0.1, 0.1, -2.0], [2.0, 0.0, 1.0], [0.2, 0.1, 1.0]]), folding)
    assert np.isnan(pixels).any(axis=1).tolist() == [True, True, False]


@pytest.mark.parametrize("camera", [None, "distorted"])
def test_light_truth_is_the_projection_of_the_truth(camera):
    """The published truth, description and pictures agree: nothing of the motion is used here."""
    distorted = pinhole(820, 616)
    distorted.distortion[:3] = [-0.2, 0.05, 0.001]
    world = World(Scenario(seed=4, camera_b=distorted if camera else None, rig_sigma_m=0.02))
    infos = {node: world.info(node, 0, S_NS) for node in "ab"}
    for stamp_ns in range(0, 40 * S_NS, 3 * S_NS + 7):
        truth = world.truth(stamp_ns, 0)
        R_a_b, t_a_b_m = rotation.from_quaternion(truth.q_a_b_xyzw), np.array(truth.t_a_b_m)
        for viewer, other in ("ab", "ba"):
            for light in world.light_truth(viewer, stamp_ns, 0).lights:
                point_m = np.array(getattr(infos[other], f"light_{light.name}_m"))
                seen_m = R_a_b @ point_m + t_a_b_m if viewer == "a" else (point_m - t_a_b_m) @ R_a_b
                K = np.array([[904.0, 0, 409.5], [0, 904, 307.5], [0, 0, 1]])
                pixel, _ = cv2.projectPoints(
                    seen_m[None], np.zeros(3), np.zeros(3), K, np.array(infos[viewer].camera.distortion)
                )
                np.testing.assert_allclose((light.u_px, light.v_px), pixel.ravel(), atol=1e-6)


def test_truth_follows_from_both_poses_in_ned():
    world = World(Scenario(seed=2, start_ns=START_NS))
    stamp_ns = START_NS + 12_345_678_901
    R_ned_a, t_ned_a = world.T_ned_camera("a", stamp_ns)
    R_ned_b, t_ned_b = world.T_ned_camera("b", stamp_ns)
    truth = world.truth(stamp_ns, 0)
    np.testing.assert_allclose(truth.t_a_b_m, R_ned_a.T @ (t_ned_b - t_ned_a), atol=1e-12)
    np.testing.assert_allclose(rotation.from_quaternion(truth.q_a_b_xyzw), R_ned_a.T @ R_ned_b, atol=1e-12)
    facing = (R_ned_a[:, 2] @ R_ned_b[:, 2], t_ned_a[2])
    assert facing[0] < -0.5
    assert facing[1] > 5.0


def test_true_poses_in_ned_are_those_of_the_pair_also_with_clocks_apart():
    drift = 1e-4
    world = World(Scenario(seed=2, start_ns=START_NS, more_nodes=("c",), clock_offset_ns=S_NS, clock_drift=drift))
    since_ns = 3 * S_NS
    ahead_ns = round(S_NS + drift * since_ns)
    # Each by its own clock, at one instant.
    poses = {
        node: world.node_truth(node, START_NS + since_ns + (0 if node == "a" else ahead_ns), "main") for node in "abc"
    }
    for pair in ("ab", "bc"):
        # Midway between the pair's clocks.
        stamp_ns = sum(poses[node].stamp_ns for node in pair) // 2
        a, b = (poses[node] for node in pair)
        R_ned_a = rotation.from_quaternion(a.q_xyzw)
        truth = world.truth(stamp_ns, 0, (pair[0], pair[1]))
        np.testing.assert_allclose(truth.t_a_b_m, R_ned_a.T @ np.subtract(b.p_m, a.p_m), atol=1e-7)
    b = poses["b"]
    later = world.node_truth("b", b.stamp_ns + S_NS // 100, "main")
    np.testing.assert_allclose(later.p_m, np.add(b.p_m, np.array(b.v_mps) / 100), atol=1e-3)


def test_two_worlds_agree_in_any_order_of_calls():
    one, two = (World(Scenario(environment="basin", seed=9, start_ns=START_NS)) for _ in range(2))
    stamps = [START_NS + k * 700_000_001 for k in range(12)]

    def answers(world, order):
        return {
            (s, node): (
                encode(world.attitude(node, s)),
                encode(world.depth(node, s)),
                encode(world.imu(node, s)),
                encode(world.candidates(node, s, 0, 0, "x")),
                encode(world.truth(s, 0)),
            )
            for s in order
            for node in ("a", "b")
        }

    assert answers(one, stamps) == answers(two, stamps[::-1])
    picture = one.render("b", stamps[3])
    two.render("b", stamps[7])
    np.testing.assert_array_equal(picture, two.render("b", stamps[3]))


def test_each_seed_gives_another_dive():
    truths = {World(Scenario(seed=seed)).truth(5 * S_NS, 0).t_a_b_m for seed in range(5)}
    assert len(truths) == 5


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_the_dive_stays_in_the_water_and_within_its_ranges(environment):
    scenario = Scenario(environment=environment, seed=3)
    world = World(scenario)
    floor_m = scenario.water.floor_depth_m or np.inf
    ranges_m = []
    for stamp_ns in range(0, 120 * S_NS, S_NS // 2):
        depths_m = [world.T_ned_camera(node, stamp_ns)[1][2] for node in "ab"]
        assert min(depths_m) > 0.2
        assert max(depths_m) < floor_m - 0.2
        ranges_m.append(np.linalg.norm(world.truth(stamp_ns, 0).t_a_b_m))
    assert min(ranges_m) < scenario.range_min_m + 0.3
    assert scenario.far_m * 0.8 < max(ranges_m) < scenario.far_m + 0.5


def test_lights_are_in_view_most_of_the_time():
    world = World(Scenario(seed=5))
    all_four = []
    for stamp_ns in range(0, 200 * S_NS, 2 * S_NS):
        lights = [x for node in "ab" for x in world.light_truth(node, stamp_ns, 0).lights]
        all_four.append(sum(light.visible for light in lights) == 4)
    assert 0.5 < np.mean(all_four) < 0.95


def _unit_ned_m(world, stamp_ns):
    R, t = world.T_ned_camera("b", stamp_ns)
    return t + R @ world.info("b", stamp_ns, S_NS).imu_m


EXACT = Grade(
    lever_sigma_m=0.0, misalignment_rad=0.0, delay_ns=(0, 0), gyro_bias_radps=0.0, accel_bias_mps2=0.0,
    gyro_walk_radps=0.0, accel_walk_mps2=0.0, shake_mps2=0.0, shake_radps=0.0,
)  # fmt: skip


@pytest.mark.parametrize("off", [{"misalignment_rad": 0.02}, {"delay_ns": (4_000_000, 4_000_000)}])
def test_a_poor_inertial_unit_is_turned_and_late_by_what_its_grade_says(monkeypatch, off):
    monkeypatch.setattr("buddyline.node.sim.inertial.GYRO_SIGMA_RADPS", 0.0)
    monkeypatch.setitem(GRADES, "good", EXACT)
    exact = World(Scenario(seed=6))
    monkeypatch.setitem(GRADES, "good", dataclasses.replace(EXACT, **off))
    other = World(Scenario(seed=6))
    late_ns = off.get("delay_ns", (0,))[0]
    true_s = [1.0 + 0.1 * k for k in range(50)]
    stamps = [round(t_s * S_NS) for t_s in true_s]
    rates = np.array([exact._sensors[0].unit.sample(stamp, t_s)[1] for stamp, t_s in zip(stamps, true_s, strict=True)])
    seen = np.array(
        [
            other._sensors[0].unit.sample(stamp, t_s + late_ns / S_NS)[1]
            for stamp, t_s in zip(stamps, true_s, strict=True)
        ]
    )
    if late_ns:
        np.testing.assert_allclose(seen, rates, atol=1e-9)
    else:
        turned = np.linalg.norm(np.cross(seen, rates), axis=1) / np.linalg.norm(rates, axis=1) ** 2
        assert 0.25 * 0.02 < turned.max() < 1.001 * 0.02


def test_a_shaken_inertial_unit_is_worse_than_a_good_one():
    off_mps2 = []
    for grade in ("good", "fair", "poor"):
        world = World(Scenario(seed=6, inertial=grade))
        samples = [np.linalg.norm(world.imu("b", S_NS + k * S_NS // 100).accel_mps2) for k in range(300)]
        off_mps2.append(np.std(np.diff(samples)))
    assert min(off_mps2[1:]) > 1.1 * off_mps2[0]


def test_the_inertial_sensor_measures_the_motion():
    world = World(Scenario(seed=6))
    dt_s, n = 0.01, 300
    stamps = [round((1 + k * dt_s) * S_NS) for k in range(n + 1)]
    imu = [world.imu("b", stamp_ns) for stamp_ns in stamps]
    R_ned_body = [world.T_ned_camera("b", stamp_ns)[0] @ R_BODY_CAMERA.T for stamp_ns in stamps]
    # Turn rates add up to the turn.
    R = R_ned_body[0]
    for sample, after in pairwise(imu):
        rate = (np.array(sample.gyro_radps) + after.gyro_radps) / 2
        R = R @ cv2.Rodrigues(rate * dt_s)[0]
    assert np.linalg.norm(rotation.to_vector(R.T @ R_ned_body[-1])) < 0.01 * n * dt_s
    # The integral of specific force in NED plus gravity is the change of velocity; the field is constant in NED.
    force = np.mean([R @ s.accel_mps2 for R, s in zip(R_ned_body, imu, strict=True)], axis=0)
    field = np.mean([R @ s.mag_t for R, s in zip(R_ned_body, imu, strict=True)], axis=0)
    grade = GRADES["good"]
    begin_mps, end_mps = (
        (_unit_ned_m(world, at_ns + S_NS // 100) - _unit_ned_m(world, at_ns - S_NS // 100)) / 0.02
        for at_ns in (stamps[0], stamps[-1])
    )
    unsure = 4 * ACCEL_SIGMA_MPS2 / n**0.5 + 3 * grade.accel_bias_mps2 + grade.misalignment_rad * GRAVITY_MPS2
    np.testing.assert_allclose(force, (end_mps - begin_mps) / (n * dt_s) - (0, 0, GRAVITY_MPS2), atol=unsure)
    np.testing.assert_allclose(field, FIELD_NED_T, atol=0.1e-6)


def _euler(R):
    return np.array([np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0]), np.arctan2(R[1, 0], R[0, 0])])


def test_attitude_and_depth_errors_match_their_sigmas():
    """Normalized errors over many seeds: their mean square is 1."""
    squares = []
    for seed in range(40):
        world = World(Scenario(seed=seed))
        for stamp_ns in range(0, 60 * S_NS, 20 * S_NS):
            attitude, depth = world.attitude("a", stamp_ns), world.depth("a", stamp_ns)
            R, t = world.T_ned_camera("a", stamp_ns)
            error = _euler(rotation.from_quaternion(attitude.q_ned_body_xyzw)) - _euler(R @ R_BODY_CAMERA.T)
            error = (error + np.pi) % (2 * np.pi) - np.pi
            port_m = t + R @ np.array(world.info("a", 0, S_NS).depth_port_m)
            squares.append([*(error / attitude.sigma_rad) ** 2, ((depth.depth_m - port_m[2]) / 0.02) ** 2])
    np.testing.assert_allclose(np.mean(squares, axis=0), 1.0, atol=0.35)


def test_a_magnetometer_that_is_off_turns_the_heading_and_nothing_else():
    good, off = World(Scenario(seed=1)), World(Scenario(seed=1, magnetometer_off_rad=np.pi / 2))
    for node, expected in (("a", 0.0), ("b", np.pi / 2)):
        R, R_off = (rotation.from_quaternion(w.attitude(node, S_NS).q_ned_body_xyzw) for w in (good, off))
        np.testing.assert_allclose(R_off @ R.T, rotation.from_euler(0, 0, expected), atol=1e-12)


def test_a_clock_offset_shifts_what_b_sees_and_the_truth_by_half():
    offset_ns = 50_000_000
    good, off = World(Scenario(seed=1)), World(Scenario(seed=1, clock_offset_ns=offset_ns))
    stamp_ns = 9 * S_NS
    assert good.truth(stamp_ns, 0) == replace(off.truth(stamp_ns + offset_ns // 2, 0), stamp_ns=stamp_ns)
    assert good.light_truth("a", stamp_ns, 0) == off.light_truth("a", stamp_ns, 0)
    shifted = off.light_truth("b", stamp_ns + offset_ns, 0)
    assert shifted.lights == good.light_truth("b", stamp_ns, 0).lights


def test_candidate_errors_match_their_sigmas():
    scenario = Scenario(seed=8, gross_share=0.0, miss_share=0.0, false_lights=0, other_lamps=0, sigma_px=0.5)
    world = World(scenario)
    errors = []
    for k in range(150):
        stamp_ns = k * S_NS // 2
        lights = [light for light in world.light_truth("a", stamp_ns, 0).lights if light.visible]
        blobs = decode(encode(world.candidates("a", stamp_ns, k, k, "x")), Candidates).blobs
        assert len(blobs) <= len(lights)
        for blob in blobs:
            assert blob.sigma_px == 0.5
            errors.append(min(((blob.u_px - x.u_px, blob.v_px - x.v_px) for x in lights), key=lambda e: np.hypot(*e)))
    assert len(errors) > 150
    np.testing.assert_allclose(np.std(errors, axis=0), 0.5, rtol=0.15)


def test_false_lights_and_misses_are_as_many_as_asked_for():
    world = World(Scenario(seed=8, miss_share=1.0, false_lights=7))
    assert [len(world.candidates("a", k * S_NS, k, k, "x").blobs) for k in range(5)] == [7] * 5
    many = World(Scenario(seed=8, miss_share=1.0, false_lights=70)).candidates("a", 0, 0, 0, "x")
    assert (len(many.blobs), many.truncated) == (64, 6)


def test_rows_are_exposed_one_after_another():
    still = World(Scenario(seed=8))
    rolling = World(Scenario(seed=8, row_time_ns=30_000))
    stamp_ns = 10 * S_NS
    for light in rolling.light_truth("a", stamp_ns, 0).lights:
        row_ns = stamp_ns + round((light.v_px - 307.5) * 30_000)
        at_row = {x.name: x for x in still.light_truth("a", row_ns, 0).lights}[light.name]
        assert light.u_px == pytest.approx(at_row.u_px, abs=1e-3)
        assert light.v_px == pytest.approx(at_row.v_px, abs=1e-3)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"environment": "bathtub"}, "environment"),
        ({"trajectory": "loops"}, "trajectory"),
        ({"node_a": "A/b"}, "node id"),
        ({"node_b": "a"}, "node_b"),
        ({"range_min_m": 9.0, "range_max_m": 5.0}, "range_max_m"),
        ({"baseline_a_m": 0.0}, "baseline_a_m"),
        ({"miss_share": 1.5}, "miss_share"),
        ({"sigma_px": float("nan")}, "sigma_px"),
    ],
)
def test_what_cannot_be_simulated_is_refused_by_name(wrong, named):
    with pytest.raises(BuddylineError, match=named):
        Scenario(**wrong)


def test_an_unknown_node_is_refused():
    with pytest.raises(BuddylineError, match="'c'"):
        World(Scenario()).depth("c", 0)


@pytest.mark.parametrize("offset_ns", [0, 40_000_000])
def test_a_blinking_lamp_is_dark_by_its_own_nodes_clock(offset_ns):
    slot_ns = S_NS // 10
    world = World(
        Scenario(start_ns=START_NS, blink_slot_ns=slot_ns, interruptions=False, clock_offset_ns=offset_ns, miss_share=0)
    )
    blink = world.info("b", START_NS, slot_ns).blink
    seen = []
    for k in range(1, 21):
        # Middle of a's slots, on a's clock; b's slots are as much earlier as its clock is ahead.
        stamp_ns = START_NS + k * slot_ns
        lights = {one.name: one.visible for one in world.light_truth("a", stamp_ns, k).lights}
        assert lights["right"]
        assert lights["left"] == lit(blink, stamp_ns + offset_ns)[0]
        seen.append(lights["left"])
    assert seen.count(False) == 6


def test_a_fixed_nodes_survey_is_off_as_its_sigmas_say():
    """Over 40 worlds of two fixed nodes: each of 240 errors of the place, and of the attitude, over its sigma."""
    places, turns = [], []
    for seed in range(40):
        world = World(Scenario(seed=seed, start_ns=START_NS, fixed_nodes=("a", "b")))
        for node in "ab":
            fixed = world.info(node, START_NS, S_NS).fixed
            true = world.node_truth(node, START_NS, "main")
            turn = rotation.from_quaternion(true.q_xyzw) @ rotation.from_quaternion(fixed.q_xyzw).T
            places.append((np.array(true.p_m) - fixed.p_m) / fixed.sigma_m)
            turns.append(rotation.to_vector(turn) / fixed.sigma_rad)
    # 1 +- 0.15 is over 3 sd of the chance of 240.
    assert np.std(places) == pytest.approx(1.0, abs=0.15)
    assert np.std(turns) == pytest.approx(1.0, abs=0.15)
