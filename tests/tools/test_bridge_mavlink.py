"""`bridge --mavlink`: what autopilots read."""

from __future__ import annotations

import math
import socket
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.rotation import (
    quat_to_matrix,
    rotation_exp,
)
from buddyline.tools.bridge.command import Datagrams
from buddyline.tools.bridge.mavlink import MavlinkTranslation
from buddyline.tools.bridge.place import on_earth
from buddyline.tools.bridge.placed import Placed, Placing, euler_covariance

from tests.tools.bridged import P_NED, PLACE, R_NED_B, V_NED, estimate, oriented, placed_of, rotation_of, take
from tests.tools.evaluated import INFOS
from tests.tools.watched import at


class TestMavlink:
    @pytest.fixture
    def mavlink(self) -> Any:
        return pytest.importorskip("pymavlink.dialects.v20.ardupilotmega", reason="pymavlink is not installed")

    @staticmethod
    def received(mavlink: Any, placed: list[Placed], kinds: tuple[str, ...]) -> list[Any]:
        """Send the packets over UDP on loopback; return what pymavlink's parser reads of them."""
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
