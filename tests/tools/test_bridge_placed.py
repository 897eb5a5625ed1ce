"""`bridge`: a vehicle's place, its errors, and where on Earth it is."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from buddyline.protocol.messages import NodePose
from buddyline.solver_service.geometry.rotation import (
    Floats,
    rotation_exp,
    rotation_log,
)
from buddyline.tools.bridge.place import GeoPoint, on_earth
from buddyline.tools.bridge.placed import MAX_NODES, Placing, euler_covariance, euler_rad
from msgspec.structs import replace

from tests.tools.bridged import (
    COVARIANCE,
    P_NED,
    R_BODY_CAMERA,
    R_NED_A,
    R_NED_B,
    RNG,
    SIGMA_RAD,
    V_NED,
    estimate,
    oriented,
    placed_of,
    quaternion,
    rotation_of,
    take,
)
from tests.tools.evaluated import INFOS, info, pose, track
from tests.tools.watched import at, attitude, depth


class TestPlacing:
    @pytest.mark.parametrize(("vehicle", "sign", "R"), [("b", 1.0, R_NED_B), ("a", -1.0, R_NED_A)])
    def test_either_node_of_a_pair_is_placed_from_the_other(self, vehicle: str, sign: float, R: Floats) -> None:
        placed = placed_of(vehicle)
        np.testing.assert_allclose(placed.p_ned_m, sign * P_NED, atol=1e-9)
        np.testing.assert_allclose(placed.R_ned_body, R, atol=1e-9)
        np.testing.assert_allclose(placed.v_ned_mps, sign * V_NED, atol=1e-9)  # type: ignore[arg-type]
        assert (placed.reference, placed.depth_m, placed.stamp_ns) == ("ba"[vehicle == "b"], 12.5, at(5))

    @pytest.mark.parametrize("vehicle", ["a", "b"])
    def test_the_covariance_is_that_of_drawn_errors(self, vehicle: str) -> None:
        """Errors of pose and attitude are drawn, and the place is made anew from each: by sampling, not by formula."""
        placed = placed_of(vehicle)
        scale = 0.05  # small errors, so that the law is linear
        attitude_errors = RNG.normal(size=(20_000, 3)) * np.array(SIGMA_RAD) * scale
        pose_errors = RNG.multivariate_normal(np.zeros(6), COVARIANCE, 20_000) * scale
        R_a = R_NED_A @ R_BODY_CAMERA
        t, R_ab = R_a.T @ P_NED, R_a.T @ R_NED_B @ R_BODY_CAMERA
        roll, pitch, yaw = euler_rad(R_NED_A)
        drawn = []
        for (d_roll, d_pitch, d_yaw), error in zip(attitude_errors[:4000], pose_errors, strict=False):
            R_body = rotation_of(roll + d_roll, pitch + d_pitch, yaw + d_yaw)
            R = R_body @ R_BODY_CAMERA
            p = R @ (t + error[:3])
            R_b = R @ rotation_exp(error[3:]) @ R_ab @ R_BODY_CAMERA.T
            is_b = vehicle == "b"
            w = rotation_log((R_b if is_b else R_body) @ placed.R_ned_body.T)
            drawn.append(np.concatenate(((p if is_b else -p) - placed.p_ned_m, w)))
        sampled = np.cov(np.array(drawn).T) / scale**2
        sigmas = np.sqrt(np.diag(placed.covariance))
        np.testing.assert_allclose(
            sampled / np.outer(sigmas, sigmas), placed.covariance / np.outer(sigmas, sigmas), atol=0.08
        )

    def test_euler_angles_and_their_covariance_are_those_of_small_turns(self) -> None:
        placed = placed_of()
        J = np.zeros((3, 3))
        for axis in range(3):
            w = np.zeros(3)
            w[axis] = 1e-6
            moved, still = euler_rad(rotation_exp(w) @ placed.R_ned_body), euler_rad(placed.R_ned_body)
            J[:, axis] = np.subtract(moved, still) / 1e-6
        np.testing.assert_allclose(
            euler_covariance(placed)[3:, 3:], J @ placed.covariance[3:, 3:] @ J.T, rtol=1e-4, atol=1e-9
        )

    def test_without_attitude_or_calibration_it_says_what_is_missing(self) -> None:
        placing = Placing("b")
        assert take(placing, estimate()) is None
        assert "calibration of node a" in placing.why
        assert take(placing, *INFOS.values(), estimate()) is None
        assert "attitude of node a" in placing.why
        assert take(placing, oriented(), estimate()) is not None
        assert placing.why == ""

    @pytest.mark.parametrize(
        "absurd",
        [
            {"t_a_b_m": (0.0, 0.0, 1e39)},
            {"v_a_b_mps": (1e39, 0.0, 0.0)},
            {"covariance": [1e39] * 36},
            {"v_covariance": [1e39] * 9},
        ],
    )
    def test_numbers_that_no_receiver_can_take_are_no_place(self, absurd: dict[str, Any]) -> None:
        placing = Placing("b")
        assert take(placing, *INFOS.values(), oriented(), replace(estimate(), **absurd)) is None
        assert "out of numeric range" in placing.why
        assert take(placing, oriented(6), estimate(6)) is not None

    def test_an_absurd_depth_leaves_the_last_sound_one(self) -> None:
        sound, absurd = depth("b", at(4), 12.5), depth("b", at(5), 1e308)
        placed = take(Placing("b"), *INFOS.values(), oriented(), sound, absurd, estimate())
        assert placed is not None
        assert placed.depth_m == 12.5

    @pytest.mark.parametrize(("vehicle", "R"), [("b", R_NED_B), ("a", R_NED_A)])
    def test_the_depth_is_the_cameras_not_its_gauges_ports(self, vehicle: str, R: Floats) -> None:
        port_m = (0.1, 0.25, -0.12)
        infos = [replace(info, depth_port_m=port_m) for info in INFOS.values()]
        placed = take(Placing(vehicle), *infos, oriented(), depth(vehicle, at(5), 12.5), estimate())
        assert placed is not None
        assert placed.depth_m == pytest.approx(12.5 - (R @ R_BODY_CAMERA @ port_m)[2])

    def test_poses_count_only_where_no_track_is_fresh_and_the_late_track_never(self) -> None:
        placing = Placing("b")
        assert take(placing, *INFOS.values(), *(attitude("a", at(k)) for k in range(40)), pose(1)) is not None
        assert take(placing, track(2)) is not None
        assert take(placing, pose(3)) is None
        assert take(placing, track(4, mode="lag")) is None
        late = take(placing, pose(30))
        assert late is not None
        assert late.restarts == 1
        assert late.v_ned_mps is None

    def test_after_a_clock_was_set_back_places_go_on(self) -> None:
        placing = Placing("b")
        assert take(placing, *INFOS.values(), oriented(36_000), estimate(36_000)) is not None
        taken = [take(placing, oriented(k), estimate(k)) for k in range(10)]
        # One old message is none of a clock that was set back: they come late, too.
        assert taken[0] is None
        assert taken[-1] is not None
        assert taken[-1].restarts == 1
        # Nor does the end of the track from before keep the poses away.
        ended = Placing("b")
        assert take(ended, *INFOS.values(), oriented(36_000), estimate(36_000)) is not None
        assert [take(ended, attitude("a", at(k)), pose(k)) for k in range(10)][-1] is not None

    def test_a_third_nodes_clock_does_not_count(self) -> None:
        placed = take(Placing("b"), *INFOS.values(), oriented(), attitude("c", at(300)), estimate())
        assert placed is not None
        assert placed.behind_s == 0.0

    def test_invented_nodes_do_not_fill_the_memory_and_keep_no_place_away(self) -> None:
        placing = Placing("b", "a")
        for k in range(1000):
            assert take(placing, info(f"x{k}"), attitude(f"x{k}", at(5))) is None
        assert len(placing._infos) == len(placing._attitudes) == MAX_NODES
        assert take(placing, *INFOS.values(), oriented(), estimate()) is not None

    def test_other_pairs_are_not_taken(self) -> None:
        placing = Placing("b", "c")
        assert take(placing, *INFOS.values(), oriented(), estimate()) is None
        free = Placing("b")
        assert take(free, *INFOS.values(), oriented(), estimate()) is not None
        assert take(free, info("c"), replace(estimate(6), node_a="b", node_b="c")) is None

    def test_magnetic_north_becomes_true_by_the_declination(self) -> None:
        placed = placed_of(declination_rad=0.3)
        assert placed.is_north_true
        assert not placed_of().is_north_true
        np.testing.assert_allclose(placed.p_ned_m[:2], rotation_of(0, 0, 0.3)[:2, :2] @ P_NED[:2], atol=1e-9)
        assert placed.yaw_rad == pytest.approx((placed_of().yaw_rad + 0.3) % (2 * math.pi))
        known = Placing("b", declination_rad=0.3)
        infos = [info(node, declination_rad=0.05) for node in "ab"]
        same = take(known, *infos, oriented(), estimate())
        assert same is not None
        np.testing.assert_allclose(same.p_ned_m, P_NED, atol=1e-9)

    def test_a_node_s_pose_in_a_net_is_its_place(self) -> None:
        pose = NodePose(
            net="main", node="b", stamp_ns=at(1), p_m=(1.0, 2.0, 3.0), q_xyzw=quaternion(R_NED_B @ R_BODY_CAMERA),
            v_mps=(0.1, 0.0, 0.0), covariance=COVARIANCE.ravel().tolist(), fixed=False, mode="filter", age_s=0.0,
        )  # fmt: skip
        placed = take(Placing("b", net="main"), INFOS["b"], pose)
        assert placed is not None
        np.testing.assert_allclose(placed.R_ned_body, R_NED_B, atol=1e-9)
        np.testing.assert_allclose(placed.covariance, COVARIANCE, atol=1e-12)


class TestOnEarth:
    def test_metres_become_degrees_as_pyproj_has_them(self) -> None:
        pyproj = pytest.importorskip("pyproj")
        latitude, longitude = GeoPoint(-33.9, 151.2).moved(800.0, -600.0)
        azimuth, _, distance_m = pyproj.Geod(ellps="WGS84").inv(151.2, -33.9, longitude, latitude)
        assert distance_m == pytest.approx(1000.0, abs=0.2)
        assert azimuth == pytest.approx(math.degrees(math.atan2(-600.0, 800.0)), abs=0.01)

    def test_across_the_date_line(self) -> None:
        assert GeoPoint(0.0, 179.9999).moved(0.0, 100.0)[1] == pytest.approx(-179.9992, abs=1e-4)

    def test_a_boat_s_own_error_counts(self) -> None:
        placed = placed_of()
        earth = on_earth(placed, GeoPoint(47.5, 9.5, sigma_m=2.0))
        assert earth.sigma_north_m == pytest.approx(math.sqrt(placed.covariance[0, 0] + 4.0))
        assert earth.altitude_m == -12.5
