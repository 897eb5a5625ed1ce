"""`bridge --mavlink`: what autopilots read."""

from __future__ import annotations

import math
import socket
from dataclasses import replace
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
from buddyline.tools.bridge.placed import Placed, Placing, euler_covariance, euler_rad

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

    def test_before_the_first_day_of_gps_there_is_no_gps_input(self, mavlink: Any) -> None:
        """A Pi without a clock of its own begins in 1970."""
        first_s = datetime(1980, 1, 6, tzinfo=UTC).timestamp()
        placed = [replace(placed_of(), stamp_ns=round(seconds * S_NS)) for seconds in (0.0, first_s - 1.0, first_s)]
        weeks = [m.time_week for m in self.received(mavlink, placed, ("gps",)) if m.get_type() == "GPS_INPUT"]
        assert weeks == [0]

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

    def test_every_number_is_in_the_unit_that_the_definitions_state(self, mavlink: Any) -> None:
        """Turned into SI by the units of MAVLink's own definitions, each field is the place that was sent."""
        si = {"us": 1e-6, "ms": 1e-3, "m": 1.0, "m/s": 1.0, "rad": 1.0, "degE7": 1e-7, "cdeg": 0.01, "%": 0.01}
        placing = Placing("b", declination_rad=0.0)
        take(placing, *INFOS.values())
        first, placed = (
            take(placing, oriented(k), estimate(k, P_NED + np.array((0.0, 0.1 * k, 0.0)))) for k in range(2)
        )
        assert first is not None
        assert placed is not None
        read = self.received(mavlink, [first, placed], ("odometry", "estimate", "delta", "gps"))
        told = {
            f"{message.get_type()}.{name}": np.array(getattr(message, name)) * si[unit]
            for message in read
            if message.get_type() not in ("HEARTBEAT", "SET_GPS_GLOBAL_ORIGIN")
            for name, unit in message.fieldunits_by_name.items()
            if unit in si
        }
        roll, pitch, yaw = euler_rad(placed.R_ned_body)
        earth, (north, east, down) = on_earth(placed, PLACE), placed.p_ned_m
        moved = placed.R_ned_body.T @ (placed.p_ned_m - first.p_ned_m)
        assert placed.v_covariance is not None
        expected = {
            **{f"{kind}.{name}": value for kind in ("ODOMETRY", "VISION_POSITION_ESTIMATE")
               for name, value in zip("xyz", (north, east, down), strict=True)},
            **dict(zip(("ODOMETRY.vx", "ODOMETRY.vy", "ODOMETRY.vz"), placed.R_ned_body.T @ V_NED, strict=True)),
            "ODOMETRY.quality": placed.confidence,
            "VISION_POSITION_ESTIMATE.roll": roll,
            "VISION_POSITION_ESTIMATE.pitch": pitch,
            "VISION_POSITION_ESTIMATE.yaw": yaw,
            "VISION_POSITION_DELTA.time_delta_usec": 0.1,
            "VISION_POSITION_DELTA.position_delta": moved,
            "VISION_POSITION_DELTA.angle_delta": np.zeros(3),
            "VISION_POSITION_DELTA.confidence": placed.confidence,
            "GPS_INPUT.lat": earth.latitude_deg,
            "GPS_INPUT.lon": earth.longitude_deg,
            "GPS_INPUT.alt": earth.altitude_m,
            **dict(zip(("GPS_INPUT.vn", "GPS_INPUT.ve", "GPS_INPUT.vd"), V_NED, strict=True)),
            "GPS_INPUT.speed_accuracy": math.sqrt(np.trace(placed.v_covariance)),
            "GPS_INPUT.horiz_accuracy": earth.horizontal_m,
            "GPS_INPUT.vert_accuracy": earth.sigma_down_m,
            "GPS_INPUT.yaw": math.degrees(placed.yaw_rad),
        }  # fmt: skip
        # Whole percents, and hundredths of a degree.
        rounded = {"ODOMETRY.quality": 0.006, "GPS_INPUT.yaw": 0.006}
        for name, value in expected.items():
            np.testing.assert_allclose(told.pop(name), value, rtol=1e-5, atol=rounded.get(name, 2e-6))
        stamps = {name: told.pop(name) for name in list(told) if name.endswith((".time_usec", ".usec"))}
        assert (len(stamps), set(stamps.values())) == (4, {at(1) // 1000 * 1e-6})
        # What is left: GPS time, which is tested above.
        assert set(told) == {"GPS_INPUT.time_week_ms"}

    def test_covariances_are_upper_triangles_row_by_row(self, mavlink: Any) -> None:
        placed = placed_of()
        assert placed.v_covariance is not None
        odometry, estimated, *_ = self.received(mavlink, [placed], ("odometry", "estimate"))
        whole = euler_covariance(placed)
        rows = [whole[i, k] for i in range(6) for k in range(i, 6)]
        assert np.abs(whole - np.diag(np.diag(whole))).max() > 0
        np.testing.assert_allclose(odometry.pose_covariance, rows, rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(estimated.covariance, rows, rtol=1e-5, atol=1e-12)
        of_velocity = R_NED_B.T @ placed.v_covariance @ R_NED_B
        told = np.array(odometry.velocity_covariance)
        for i in range(3):
            for k in range(i, 3):
                # Row i of the triangle begins after those of 6, 5, ... numbers.
                assert told[6 * i - i * (i - 1) // 2 + k - i] == pytest.approx(of_velocity[i, k], rel=1e-5, abs=1e-12)
