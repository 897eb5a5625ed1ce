"""`bridge`: places, their errors, and what autopilots, plotters and HTTP clients read of them."""

from __future__ import annotations

import json
import math
import re
import shutil
import socket
import subprocess
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import encode
from buddyline.protocol.envelope import open_envelope
from buddyline.protocol.messages import Attitude, Message, NodePose, Track
from buddyline.protocol.topics import key_of
from buddyline.protocol.zenoh_bus import connect, open_hub
from buddyline.solver_service.geometry.rotation import (
    Floats,
    matrix_to_quat,
    quat_to_matrix,
    rotation_exp,
    rotation_log,
)
from buddyline.tools.bridge.http_api import Answers, HttpApi
from buddyline.tools.bridge.nmea import angle, checksum, place_of, sentences
from buddyline.tools.bridge.place import GeoPoint, on_earth
from buddyline.tools.bridge.placed import Placed, Placing, euler_covariance, euler_rad
from msgspec.structs import replace

from tests.processes import REPOSITORY, Process, free_endpoint
from tests.tools.evaluated import INFOS, info, track
from tests.tools.watched import at, attitude, depth, solver_status, status

RNG = np.random.default_rng(7)
R_BODY_CAMERA = quat_to_matrix(np.array((0.5, 0.5, 0.5, 0.5)))
PLACE = GeoPoint(47.5, 9.5)


def random_rotation() -> Floats:
    return rotation_exp(RNG.normal(size=3))


def random_covariance(n: int, scale: float = 0.01) -> Floats:
    mixed = RNG.normal(size=(n, n)) * scale
    covariance: Floats = mixed @ mixed.T
    return covariance


R_NED_A, R_NED_B = random_rotation(), random_rotation()
P_NED = np.array([2.0, -1.0, 0.7])
V_NED = np.array([0.3, 0.2, -0.1])
COVARIANCE, V_COVARIANCE = random_covariance(6), random_covariance(3)
SIGMA_RAD = (0.01, 0.02, 0.05)


def quaternion(R: Floats) -> tuple[float, float, float, float]:
    x, y, z, w = matrix_to_quat(R).tolist()
    return x, y, z, w


def estimate(k: int = 5, p_ned: Floats = P_NED, R_ned_b: Floats = R_NED_B) -> Track:
    """The track at trigger k of a b at p_ned from a, whose bodies stand as R_NED_A and R_ned_b."""
    R_a = R_NED_A @ R_BODY_CAMERA
    return track(
        k,
        t_m=tuple((R_a.T @ p_ned).tolist()),
        q_a_b_xyzw=quaternion(R_a.T @ R_ned_b @ R_BODY_CAMERA),
        covariance=COVARIANCE.ravel().tolist(),
        v_a_b_mps=tuple((R_a.T @ V_NED).tolist()),
        v_covariance=V_COVARIANCE.ravel().tolist(),
    )


def oriented(k: int = 5) -> Attitude:
    return Attitude(node="a", stamp_ns=at(k), q_ned_body_xyzw=quaternion(R_NED_A), sigma_rad=SIGMA_RAD)


def take(placing: Placing, *messages: Message) -> Placed | None:
    placed = None
    for message in messages:
        key = f"buddyline/net/main/{message.node}" if isinstance(message, NodePose) else key_of(message)
        if isinstance(message, NodePose):
            placed = placing._in_net(message)
            continue
        placed = placing.take(open_envelope(key, encode(message), at(0)))
    return placed


def placed_of(vehicle: str = "b", **how: Any) -> Placed:
    placed = take(Placing(vehicle, **how), *INFOS.values(), oriented(), depth(vehicle, at(5), 12.5), estimate())
    assert placed is not None
    return placed


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

    def test_poses_count_only_where_no_track_is_fresh_and_the_late_track_never(self) -> None:
        from tests.tools.evaluated import pose

        placing = Placing("b")
        assert take(placing, *INFOS.values(), *(attitude("a", at(k)) for k in range(40)), pose(1)) is not None
        assert take(placing, track(2)) is not None
        assert take(placing, pose(3)) is None
        assert take(placing, track(4, mode="lag")) is None
        late = take(placing, pose(30))
        assert late is not None
        assert late.restarts == 1
        assert late.v_ned_mps is None

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


def rotation_of(roll: float, pitch: float, yaw: float) -> Floats:
    R: Floats = (
        rotation_exp(np.array([0.0, 0.0, yaw]))
        @ rotation_exp(np.array([0.0, pitch, 0.0]))
        @ rotation_exp(np.array([roll, 0.0, 0.0]))
    )
    return R


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


class TestNmea:
    def test_checksums_are_the_standard_s(self) -> None:
        assert checksum("GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,") == "47"

    def test_angles_never_show_sixty_minutes(self) -> None:
        assert angle(47.99999999999, "NS") == "4800.000000,N"
        assert angle(-9.5, "EW") == "00930.000000,W"

    def test_a_plotter_reads_what_was_meant(self) -> None:
        pynmea2 = pytest.importorskip("pynmea2")
        placed = placed_of(declination_rad=0.0)
        earth = on_earth(placed, PLACE)
        read = {line[1:6]: pynmea2.parse(line, check=True) for line in sentences(placed, earth)}
        assert set(read) == {"GPGGA", "GPGST", "RATLL", "RATTM", "HEHDT"}
        assert read["GPGGA"].latitude == pytest.approx(earth.latitude_deg, abs=1e-8)
        assert read["GPGGA"].longitude == pytest.approx(earth.longitude_deg, abs=1e-8)
        assert float(read["GPGGA"].altitude) == -12.5
        stamp = datetime.fromtimestamp(placed.stamp_ns / S_NS, UTC)
        assert read["GPGGA"].timestamp.replace(microsecond=0) == stamp.timetz().replace(microsecond=0)
        assert float(read["GPGST"].std_dev_latitude) == pytest.approx(earth.sigma_north_m, abs=1e-3)
        assert float(read["GPGST"].std_dev_longitude) == pytest.approx(earth.sigma_east_m, abs=1e-3)
        ttm = read["RATTM"].data
        assert float(ttm[1]) == pytest.approx(math.hypot(*P_NED[:2]) / 1e3, abs=1e-5)
        assert float(ttm[2]) == pytest.approx(math.degrees(math.atan2(P_NED[1], P_NED[0])) % 360, abs=0.06)
        assert ttm[3] == "T"
        assert float(ttm[4]) == pytest.approx(3.6 * math.hypot(*V_NED[:2]), abs=0.01)
        assert float(read["HEHDT"].heading) == pytest.approx(math.degrees(placed.yaw_rad), abs=0.06)

    def test_magnetic_headings_are_not_called_true(self) -> None:
        placed = placed_of()
        read = {line[1:6]: line.split(",") for line in sentences(placed, None)}
        assert set(read) == {"RATTM", "HCHDM"}
        assert read["RATTM"][4] == "R"
        bearing = math.atan2(P_NED[1], P_NED[0]) - euler_rad(R_NED_A)[2]
        assert float(read["RATTM"][3]) == pytest.approx(math.degrees(bearing) % 360, abs=0.06)

    def test_a_boat_s_place_comes_from_whole_valid_sentences_alone(self) -> None:
        good = "$GPGGA,123519,4807.038,N,01131.000,W,1,08,0.9,545.4,M,46.9,M,,*55"
        place = place_of(good)
        assert place is not None
        assert (place.latitude_deg, place.longitude_deg) == pytest.approx((48.1173, -11.516667), abs=1e-5)
        assert place.sigma_m == pytest.approx(0.9 * 2.5 / math.sqrt(2))
        for bad in (
            good.replace("4807", "4808"),
            good[:30],
            "",
            line("GPGGA,123519,,,,,0,00,,,M,,M,,"),
            line("GPGGA,123519,9907.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"),
            line("GPRMC,123519,V,4807.038,N,01131.000,E,0,0,230394,,"),
        ):
            assert place_of(bad) is None, bad
        assert place_of(line("GPRMC,123519,A,4807.038,N,01131.000,E,0,0,230394,,")) is not None


def line(body: str) -> str:
    return f"${body}*{checksum(body)}"


class TestMavlink:
    @pytest.fixture
    def mavlink(self) -> Any:
        return pytest.importorskip("pymavlink.dialects.v20.ardupilotmega", reason="pymavlink is not installed")

    @staticmethod
    def received(mavlink: Any, placed: list[Placed], kinds: tuple[str, ...]) -> list[Any]:
        """Send the packets over UDP on loopback; return what pymavlink's parser reads of them."""
        from buddyline.tools.bridge.command import Datagrams
        from buddyline.tools.bridge.mavlink import MavlinkTranslation

        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.bind(("127.0.0.1", 0))
            receiver.settimeout(30.0)
            sender = Datagrams("--mavlink", f"127.0.0.1:{receiver.getsockname()[1]}")
            translation = MavlinkTranslation(kinds, 42)
            packets = [p for one in placed for p in translation.packets(one, on_earth(one, PLACE))]
            packets += [translation.heartbeat(), translation.origin(PLACE)]
            for packet in packets:
                sender.send(packet)
            sender.close()
            parser = mavlink.MAVLink(None)
            read = [message for _ in packets for message in parser.parse_buffer(receiver.recv(65535))]
        assert {(m.get_srcSystem(), m.get_srcComponent()) for m in read} == {(42, 197)}
        assert [m.get_seq() for m in read] == list(range(len(read)))
        return read

    def test_odometry_has_ardupilot_s_frames_body_velocity_and_covariances(self, mavlink: Any) -> None:
        placed = placed_of()
        odometry, heartbeat, origin = self.received(mavlink, [placed], ("odometry",))
        assert odometry.get_type() == "ODOMETRY"
        assert (odometry.frame_id, odometry.child_frame_id) == (20, 12)
        assert odometry.time_usec == at(5) // 1000
        np.testing.assert_allclose((odometry.x, odometry.y, odometry.z), P_NED, rtol=1e-6)
        w, x, y, z = odometry.q
        np.testing.assert_allclose(quat_to_matrix(np.array((x, y, z, w))), R_NED_B, atol=1e-6)
        np.testing.assert_allclose((odometry.vx, odometry.vy, odometry.vz), R_NED_B.T @ V_NED, atol=1e-6)
        assert math.isnan(odometry.rollspeed)
        upper = np.array(odometry.pose_covariance)
        np.testing.assert_allclose(upper[[0, 6, 11]], np.diag(placed.covariance)[:3], rtol=1e-5)
        np.testing.assert_allclose(upper[[15, 18, 20]], np.diag(euler_covariance(placed))[3:], rtol=1e-5)
        of_velocity = R_NED_B.T @ placed.v_covariance @ R_NED_B
        np.testing.assert_allclose(np.array(odometry.velocity_covariance)[[0, 6, 11]], np.diag(of_velocity), rtol=1e-5)
        assert 1 <= odometry.quality <= 100
        assert odometry.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_VISION
        assert (heartbeat.type, heartbeat.autopilot) == (18, 8)
        assert (origin.target_system, origin.latitude, origin.longitude) == (42, 475_000_000, 95_000_000)

    def test_a_position_estimate_is_in_north_east_down_with_euler_angles(self, mavlink: Any) -> None:
        estimated = self.received(mavlink, [placed_of()], ("estimate",))[0]
        np.testing.assert_allclose((estimated.x, estimated.y, estimated.z), P_NED, rtol=1e-6)
        R = rotation_of(estimated.roll, estimated.pitch, estimated.yaw)
        np.testing.assert_allclose(R, R_NED_B, atol=1e-6)
        assert len(estimated.covariance) == 21

    def test_deltas_add_up_to_the_way_and_no_compass_counts(self, mavlink: Any) -> None:
        steps = [P_NED + k * np.array([0.01, -0.02, 0.005]) for k in range(5)]
        turns = [R_NED_B @ rotation_exp(np.array([0.01, 0.02, -0.03]) * k) for k in range(5)]
        for bias_rad in (None, 0.7):
            placing = Placing("b", declination_rad=bias_rad)
            take(placing, *INFOS.values())
            placed = [take(placing, oriented(k), estimate(k, steps[k], turns[k])) for k in range(5)]
            read = self.received(mavlink, placed, ("delta",))  # type: ignore[arg-type]
            deltas = [m for m in read if m.get_type() == "VISION_POSITION_DELTA"]
            assert [m.time_delta_usec for m in deltas] == [100_000] * 4
            for k, m in enumerate(deltas, start=1):
                np.testing.assert_allclose(m.angle_delta, (0.01, 0.02, -0.03), atol=1e-6)
                np.testing.assert_allclose(m.position_delta, turns[k].T @ (steps[k] - steps[k - 1]), atol=1e-6)

    def test_no_delta_spans_a_gap(self, mavlink: Any) -> None:
        placing = Placing("b")
        take(placing, *INFOS.values())
        placed = [take(placing, oriented(k), estimate(k)) for k in (0, 1, 8)]
        read = self.received(mavlink, placed, ("delta",))  # type: ignore[arg-type]
        assert [m.get_type() for m in read].count("VISION_POSITION_DELTA") == 1

    def test_gps_input_has_place_velocity_accuracy_and_gps_time(self, mavlink: Any) -> None:
        placed = placed_of(declination_rad=0.0)
        earth = on_earth(placed, PLACE)
        gps = self.received(mavlink, [placed], ("gps",))[0]
        assert (gps.lat, gps.lon) == (round(earth.latitude_deg * 1e7), round(earth.longitude_deg * 1e7))
        assert gps.alt == -12.5
        np.testing.assert_allclose((gps.vn, gps.ve, gps.vd), V_NED, atol=1e-6)
        assert gps.horiz_accuracy == pytest.approx(earth.horizontal_m, rel=1e-5)
        assert gps.vert_accuracy == pytest.approx(earth.sigma_down_m, rel=1e-5)
        assert (gps.fix_type, gps.ignore_flags) == (3, 0)
        assert gps.yaw == round(100 * math.degrees(placed.yaw_rad))
        gps_time_s = gps.time_week * 604_800 + gps.time_week_ms / 1e3
        epoch = datetime(1980, 1, 6, tzinfo=UTC).timestamp()
        assert gps_time_s == pytest.approx(at(5) / S_NS - epoch + 18, abs=1e-3)


class TestHttp:
    @pytest.fixture
    def served(self) -> Iterator[tuple[Answers, str]]:
        self.now_ns = at(5)
        state = Answers(lambda: self.now_ns)
        api = HttpApi("127.0.0.1", 0, state)
        yield state, f"http://127.0.0.1:{api.port}"
        api.close()

    @staticmethod
    def get(address: str, **headers: str) -> Any:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=30) as response:
            return json.loads(response.read())

    def test_the_position_is_as_the_ugps_documents_it_and_goes_invalid(self, served: tuple[Answers, str]) -> None:
        state, address = served
        path = f"{address}/api/v1/position"
        assert self.get(f"{path}/acoustic/filtered")["position_valid"] is False
        assert self.get(f"{path}/global")["fix_quality"] == 0
        placed = placed_of(declination_rad=0.0)
        state.place(placed, on_earth(placed, PLACE), PLACE)
        acoustic = self.get(f"{path}/acoustic/filtered")
        assert (acoustic["x"], acoustic["y"], acoustic["z"]) == pytest.approx((*P_NED[:2], 12.5))
        assert acoustic["position_valid"] is True
        assert acoustic["std"] == pytest.approx(placed.sigma_m)
        where = self.get(f"{path}/global")
        assert where["lat"] == on_earth(placed, PLACE).latitude_deg
        assert where["fix_quality"] == 1
        assert where["orientation"] == pytest.approx(math.degrees(placed.yaw_rad))
        assert self.get(f"{path}/master")["lat"] == PLACE.latitude_deg
        assert self.get(f"{address}/api/")["version"] == "v1"
        self.now_ns += S_NS
        assert self.get(f"{path}/acoustic/filtered")["position_valid"] is False
        assert self.get(f"{path}/global")["fix_quality"] == 0

    def test_a_place_that_is_behind_the_nodes_is_not_valid(self, served: tuple[Answers, str]) -> None:
        state, address = served
        for newest_k, valid in ((5, True), (30, False)):
            placed = take(Placing("b"), *INFOS.values(), oriented(), attitude("b", at(newest_k)), estimate())
            assert placed is not None
            state.place(placed, None, None)
            answer = self.get(f"{address}/api/v1/position/acoustic/filtered")
            assert answer["position_valid"] is valid

    def test_every_key_s_last_message_is_there_and_unknown_paths_are_not(self, served: tuple[Answers, str]) -> None:
        state, address = served
        state.take(open_envelope("buddyline/node/a/status", encode(status("a", at(1))), at(1)))
        assert self.get(f"{address}/buddyline") == ["buddyline/node/a/status"]
        assert self.get(f"{address}/buddyline/node/a/status")["stamp_ns"] == at(1)
        with pytest.raises(urllib.error.HTTPError, match="404"):
            self.get(f"{address}/etc/passwd")

    def test_the_readme_s_javascript_reads_it(self, served: tuple[Answers, str], tmp_path: Path) -> None:
        node = shutil.which("node")
        if node is None:
            pytest.skip("node is not installed")
        state, address = served
        state.take(open_envelope("buddyline/node/a/status", encode(status("a", at(1))), at(1)))
        placed = placed_of()
        state.place(placed, None, None)
        found = re.search(r"```js\n(.*?)```", (REPOSITORY / "protocol" / "README.md").read_text(), re.DOTALL)
        assert found is not None
        program = tmp_path / "program.mjs"
        program.write_text(found[1].replace("http://127.0.0.1:8082", address))
        done = subprocess.run([node, program], capture_output=True, text=True, timeout=120, check=True)
        x, y, _ = placed.p_ned_m.tolist()
        first, second = done.stdout.splitlines()
        assert first == f"buddyline/node/a/status {at(1)}"
        valid, *numbers = second.split()
        assert valid == "true"
        assert [float(n) for n in numbers] == pytest.approx([x, y, 12.5, placed.sigma_m])

    def test_a_page_of_another_site_does_not_read_it(self, served: tuple[Answers, str]) -> None:
        with pytest.raises(urllib.error.HTTPError, match="403"):
            self.get(f"{served[1]}/buddyline", Host="evil.example:80")


def test_a_vehicle_on_a_real_hub_reaches_autopilot_plotter_and_program() -> None:
    mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega", reason="pymavlink is not installed")
    endpoint = free_endpoint()
    receivers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for receiver in receivers:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(120.0)
    autopilot, plotter = (f"127.0.0.1:{receiver.getsockname()[1]}" for receiver in receivers)
    http_port = int(free_endpoint().rpartition(":")[2])
    words = ["--messages", "odometry,gps", "--place", "47.5,9.5", "--declination", "2.5"]
    words += ["--mavlink", autopilot, "--nmea", plotter, "--http", f"127.0.0.1:{http_port}"]
    stop = threading.Event()
    with open_hub(endpoint), Process("bridge", "--vehicle", "b", "--connect", endpoint, *words) as bridge:
        bus = connect(endpoint, stop=stop, on_wait=lambda _: None)
        assert bus is not None
        bridge.wait_for("no estimate of b")

        def say() -> None:
            k = 0
            while not stop.wait(0.05):
                k += 1
                for message in (*INFOS.values(), oriented(k), depth("b", at(k)), estimate(k), solver_status(at(k))):
                    from buddyline.protocol.topics import topic_of

                    topic = topic_of(message)
                    ids = tuple(str(getattr(message, field)) for field in topic.id_fields)
                    publishers.setdefault(key_of(message), bus.publisher(topic, *ids)).put(message)

        publishers: dict[str, Any] = {}
        speaker = threading.Thread(target=say)
        speaker.start()
        try:
            parser, kinds = mavlink.MAVLink(None), set()
            while not {"HEARTBEAT", "ODOMETRY", "GPS_INPUT"} <= kinds:
                kinds |= {m.get_type() for m in parser.parse_buffer(receivers[0].recv(65535)) or []}
            assert receivers[1].recv(65535).startswith(b"$GPGGA,")
            bridge.wait_for("b has a place")
            address = f"http://127.0.0.1:{http_port}"
            turned = rotation_of(0, 0, math.radians(2.5)) @ P_NED
            acoustic = TestHttp.get(f"{address}/api/v1/position/acoustic/filtered")
            assert (acoustic["x"], acoustic["y"], acoustic["z"]) == pytest.approx((*turned[:2], 12.5), abs=1e-6)
            assert "buddyline/pair/a/b/track" in TestHttp.get(f"{address}/buddyline")
        finally:
            stop.set()
            speaker.join()
            bus.close()
            for receiver in receivers:
                receiver.close()


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        ((), "give --mavlink, --nmea or --http"),
        (("--nmea", "nowhere"), "--nmea nowhere: give HOST:PORT"),
        (("--http", "127.0.0.1:8", "--messages", "all"), "--messages all"),
        (("--http", "127.0.0.1:8", "--messages", "gps"), "needs --place or --boat"),
        (("--http", "127.0.0.1:8", "--place", "95,1"), "--place 95,1"),
        (("--http", "127.0.0.1:8", "--reference", "b"), "is the vehicle itself"),
        (("--http", "127.0.0.1:8", "--rate", "nan"), "--rate nan"),
    ],
)
def test_what_cannot_be_meant_is_refused(
    words: tuple[str, ...], fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from buddyline.tools.cli import main

    assert main(["bridge", "--vehicle", "b", *words]) == 2
    assert fault in capsys.readouterr().err
