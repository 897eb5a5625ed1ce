"""MAVLink messages for an autopilot, by pymavlink.

ArduPilot takes ODOMETRY in the frames LOCAL_FRD and BODY_FRD alone, and VISION_POSITION_ESTIMATE in north-east-down;
both have one meaning here, because our LOCAL_FRD has north for forward. Positions are of the node's camera: its place
in the vehicle belongs into the autopilot's own parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.rotation import Floats, matrix_to_quat, rotation_log
from buddyline.tools.bridge.nmea import M_PER_HDOP, SATELLITES
from buddyline.tools.bridge.place import GeoPoint, OnEarth
from buddyline.tools.bridge.placed import Placed, euler_covariance, euler_rad
from buddyline.tools.extras import needed

KINDS: Final = ("odometry", "estimate", "delta", "gps")
# A change of position is told between two estimates at most this far apart.
MAX_DELTA_NS: Final = S_NS // 2
GPS_EPOCH_S: Final = 315_964_800
# GPS time is ahead of UTC; the last leap second was at the end of 2016.
LEAP_S: Final = 18
WEEK_S: Final = 7 * 86_400
_UPPER: Final = np.triu_indices(6)


class MavlinkTranslation:
    """Translates places into packets. kinds: which messages, of KINDS; system: the vehicle's system id."""

    def __init__(self, kinds: Sequence[str], system: int) -> None:
        self._mavlink = needed("pymavlink.dialects.v20.ardupilotmega", "--mavlink", "bridge")
        self._kinds = kinds
        self._link = self._mavlink.MAVLink(
            None, srcSystem=system, srcComponent=self._mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
        )
        self._system = system
        self._before: Placed | None = None

    def heartbeat(self) -> bytes:
        """Return the packet that says that this component is alive; one a second."""
        m = self._mavlink
        return self._packed(
            self._link.heartbeat_encode(
                m.MAV_TYPE_ONBOARD_CONTROLLER, m.MAV_AUTOPILOT_INVALID, 0, 0, m.MAV_STATE_ACTIVE
            )
        )

    def origin(self, place: GeoPoint) -> bytes:
        """Return the packet that gives the autopilot its origin: the reference's place, at the surface."""
        latitude, longitude = round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7)
        return self._packed(self._link.set_gps_global_origin_encode(self._system, latitude, longitude, 0))

    def packets(self, placed: Placed, earth: OnEarth | None) -> list[bytes]:
        """Return the packets of one estimate, in the order of KINDS."""
        said = []
        if "odometry" in self._kinds:
            said.append(self._odometry(placed))
        if "estimate" in self._kinds:
            said.append(self._estimate(placed))
        if "delta" in self._kinds and (delta := self._delta(placed)) is not None:
            said.append(delta)
        # A node whose clock was never set has no time of GPS.
        if "gps" in self._kinds and earth is not None and placed.stamp_ns >= GPS_EPOCH_S * S_NS:
            said.append(self._gps(placed, earth))
        self._before = placed
        return [self._packed(message) for message in said]

    def _packed(self, message: Any) -> bytes:
        packet = bytes(message.pack(self._link))
        self._link.seq = (self._link.seq + 1) % 256
        return packet

    def _odometry(self, placed: Placed) -> Any:
        m, R = self._mavlink, placed.R_ned_body
        x, y, z, w = matrix_to_quat(R).tolist()
        v_body, v_covariance = [math.nan] * 3, [math.nan] + [0.0] * 20
        if placed.v_ned_mps is not None:
            v_body = (R.T @ placed.v_ned_mps).tolist()
        if placed.v_covariance is not None:
            whole = np.zeros((6, 6))
            whole[:3, :3] = R.T @ placed.v_covariance @ R
            v_covariance = _upper(whole)
        return self._link.odometry_encode(
            placed.stamp_ns // 1000,
            m.MAV_FRAME_LOCAL_FRD,
            m.MAV_FRAME_BODY_FRD,
            *placed.p_ned_m.tolist(),
            [w, x, y, z],
            *v_body,
            # Rates of rotation are not estimated.
            *[math.nan] * 3,
            _upper(euler_covariance(placed)),
            v_covariance,
            placed.restarts % 256,
            m.MAV_ESTIMATOR_TYPE_VISION,
            # 0 would mean that the quality is not known.
            max(1, round(100 * placed.confidence)),
        )

    def _estimate(self, placed: Placed) -> Any:
        return self._link.vision_position_estimate_encode(
            placed.stamp_ns // 1000,
            *placed.p_ned_m.tolist(),
            *euler_rad(placed.R_ned_body),
            _upper(euler_covariance(placed)),
            placed.restarts % 256,
        )

    def _delta(self, placed: Placed) -> Any:
        """Return the motion since the last estimate, in the vehicle's present body frame: a compass's bias cancels."""
        before = self._before
        if before is None or before.restarts != placed.restarts or placed.stamp_ns - before.stamp_ns > MAX_DELTA_NS:
            return None
        return self._link.vision_position_delta_encode(
            placed.stamp_ns // 1000,
            (placed.stamp_ns - before.stamp_ns) // 1000,
            rotation_log(before.R_ned_body.T @ placed.R_ned_body).tolist(),
            (placed.R_ned_body.T @ (placed.p_ned_m - before.p_ned_m)).tolist(),
            100.0 * placed.confidence,
        )

    def _gps(self, placed: Placed, earth: OnEarth) -> Any:
        m = self._mavlink
        week = (placed.stamp_ns // S_NS - GPS_EPOCH_S + LEAP_S) // WEEK_S
        of_week_ms = (placed.stamp_ns // 1_000_000 - 1000 * (GPS_EPOCH_S - LEAP_S)) % (1000 * WEEK_S)
        ignored, v_mps, speed_mps = 0, [0.0] * 3, 0.0
        if placed.v_ned_mps is None:
            ignored |= m.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ | m.GPS_INPUT_IGNORE_FLAG_VEL_VERT
        else:
            v_mps = placed.v_ned_mps.tolist()
        if placed.v_covariance is None:
            ignored |= m.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY
        else:
            speed_mps = math.sqrt(max(float(np.trace(placed.v_covariance)), 0.0))
        # 0 would mean that the heading is not given.
        yaw_cdeg = round(100 * math.degrees(placed.yaw_rad)) or 36_000
        return self._link.gps_input_encode(
            placed.stamp_ns // 1000,
            0,
            ignored,
            of_week_ms,
            week,
            3,
            round(earth.latitude_deg * 1e7),
            round(earth.longitude_deg * 1e7),
            earth.altitude_m,
            max(earth.horizontal_m / M_PER_HDOP, 0.1),
            max(earth.sigma_down_m / M_PER_HDOP, 0.1),
            *v_mps,
            speed_mps,
            earth.horizontal_m,
            earth.sigma_down_m,
            SATELLITES,
            yaw_cdeg,
        )


def _upper(covariance: Floats) -> list[float]:
    """Return the upper right triangle, row by row: 21 numbers."""
    return [float(x) for x in covariance[_UPPER]]
