"""Where a vehicle is, in north-east-down from its reference, out of the messages on the bus.

The vehicle is one of the nodes. Its reference is the other node of a pair, which stands still (a fixed node, or a node
under a boat), or the origin of a net. Camera frames become body frames here, and their errors those of north-east-down.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.health import stale_after_s
from buddyline.protocol.messages import Attitude, Depth, NodeInfo, NodePose, RelativePose, Track
from buddyline.protocol.topics import TRACK
from buddyline.solver_service.geometry.rotation import Floats, quat_to_matrix, skew
from buddyline.solver_service.sensors import HORIZON_NS, BackwardJump, SampleStream, attitude_at
from buddyline.solver_service.track.anchors import attitude_covariance
from buddyline.tools.estimate import Estimate

# An estimate whose position has this share of the range for its sigma is worth nothing: no track is published there.
WORTHLESS_SHARE: Final = 0.2
MIN_RANGE_M: Final = 0.1
# Of a position and a depth (m), and a velocity (m/s). Numbers of MAVLink are of single precision, and an autopilot
# squares them.
MOST: Final = 1e5
# Of which infos and attitudes are kept, as far as it is not known which is the reference; a solver takes 16.
MAX_NODES: Final = 64


@dataclass(frozen=True)
class Placed:
    """The vehicle's camera at stamp_ns: p_ned_m (3,) from the reference, turned by R_ned_body.

    covariance (6, 6): of p_ned_m (m) and of the small rotation w (rad) with R_true = exp(w) R_ned_body, both in
    north-east-down, the compass's error counted. v_ned_mps, v_covariance: None where they are not known. depth_m: by
    the vehicle's own gauge. restarts: how often the estimate has begun anew. reference_yaw_rad: heading of the
    reference's body, None for the origin of a net. is_north_true: whether north is true north, not magnetic.
    behind_s: how far stamp_ns is behind the newest attitude that has come.
    """

    vehicle: str
    reference: str
    stamp_ns: int
    p_ned_m: Floats
    R_ned_body: Floats
    covariance: Floats
    is_north_true: bool
    v_ned_mps: Floats | None = None
    v_covariance: Floats | None = None
    reference_yaw_rad: float | None = None
    depth_m: float | None = None
    restarts: int = 0
    behind_s: float = 0.0

    @property
    def range_m(self) -> float:
        """Distance from the reference."""
        return float(np.linalg.norm(self.p_ned_m))

    @property
    def sigma_m(self) -> float:
        """Uncertainty of the position: the root of the sum of its three variances."""
        return math.sqrt(max(float(np.trace(self.covariance[:3, :3])), 0.0))

    @property
    def yaw_rad(self) -> float:
        """Heading of the vehicle, 0 to 2 pi."""
        return math.atan2(self.R_ned_body[1, 0], self.R_ned_body[0, 0]) % (2 * math.pi)

    @property
    def confidence(self) -> float:
        """1 for a position without error, 0 for one that is worth nothing."""
        return max(0.0, 1.0 - self.sigma_m / (WORTHLESS_SHARE * max(self.range_m, MIN_RANGE_M)))

    def with_true_north(self, declination_rad: float) -> Placed:
        """Return the same place from true north, for a place from magnetic north."""
        turn = _about_down(declination_rad)
        both = np.kron(np.eye(2), turn)
        return replace(
            self,
            p_ned_m=turn @ self.p_ned_m,
            R_ned_body=turn @ self.R_ned_body,
            covariance=both @ self.covariance @ both.T,
            is_north_true=True,
            v_ned_mps=None if self.v_ned_mps is None else turn @ self.v_ned_mps,
            v_covariance=None if self.v_covariance is None else turn @ self.v_covariance @ turn.T,
            reference_yaw_rad=None if self.reference_yaw_rad is None else self.reference_yaw_rad + declination_rad,
        )


class Placing:
    """Keeps what is needed of earlier messages. `take` returns a Placed for each estimate that has a place.

    vehicle, reference: node ids; reference None: the other node of the first pair that has the vehicle. net: take the
    node's poses in this net instead. declination_rad: added where a node's headings are magnetic; None: they stay so.
    why: what is missing for a place, in words; "" when there was one.
    """

    def __init__(
        self,
        vehicle: str,
        reference: str | None = None,
        net: str | None = None,
        declination_rad: float | None = None,
    ) -> None:
        self.vehicle = vehicle
        self.why = f"no estimate of {vehicle} has come yet"
        self._reference = reference
        self._net = net
        self._declination_rad = declination_rad
        self._infos: dict[str, NodeInfo] = {}
        self._attitudes: dict[str, SampleStream[Attitude]] = {}
        self._depth_m: float | None = None
        self._tracked_ns: int | None = None
        self._last_ns: int | None = None
        self._jump = BackwardJump()
        self._restarts = 0

    def take(self, envelope: Envelope) -> Placed | None:
        """Take one message of any topic."""
        message = envelope.message
        if isinstance(message, NodeInfo):
            if self._follows(message.node, self._infos):
                self._infos[message.node] = message
        elif isinstance(message, Attitude):
            if self._follows(message.node, self._attitudes):
                self._attitudes.setdefault(message.node, SampleStream(0)).add(message)
        elif isinstance(message, Depth):
            if message.node == self.vehicle and abs(message.depth_m) <= MOST:
                self._depth_m = message.depth_m
        elif isinstance(message, NodePose):
            if (message.net, message.node) == (self._net, self.vehicle):
                return self._in_net(message)
        elif isinstance(message, Track | RelativePose) and self._net is None and self._is_ours(message):
            return self._in_pair(message)
        return None

    def _follows(self, node: str, known: Collection[str]) -> bool:
        """Return whether what a node says is kept: a client that invents nodes must not fill the memory."""
        return node in known or len(known) < MAX_NODES or node in (self.vehicle, self._reference)

    def _is_ours(self, estimate: Estimate) -> bool:
        """Return whether an estimate is of our pair, and the best there is: a pose only where no track is fresh."""
        pair = {estimate.node_a, estimate.node_b}
        if self.vehicle not in pair:
            return False
        (other,) = pair - {self.vehicle}
        self._reference = self._reference or other
        if other != self._reference:
            return False
        if isinstance(estimate, Track):
            if estimate.mode == "lag":
                return False
            self._tracked_ns = estimate.stamp_ns
            return True
        if self._tracked_ns is None:
            return True
        # Much older: the clock was set back after the track had ended.
        return not -HORIZON_NS <= estimate.stamp_ns - self._tracked_ns <= stale_after_s(TRACK) * S_NS

    def _in_pair(self, estimate: Estimate) -> Placed | None:
        """Return T_ned_body of the vehicle from T_a_b and A's attitude.

        p = R_na t, and R_nb = R_na R_ab, with errors dp = R_na dt + phi x p and w_b = R_na w + phi, where phi is the
        error of A's attitude. Seen from B, A is at -p, and its rotation is its attitude alone: w_a = phi.
        """
        info_a, info_b = self._infos.get(estimate.node_a), self._infos.get(estimate.node_b)
        if info_a is None or info_b is None:
            missing = estimate.node_a if info_a is None else estimate.node_b
            self.why = f"the calibration of node {missing} is not known"
            return None
        stream = self._attitudes.get(estimate.node_a)
        oriented = None if stream is None else attitude_at(stream, estimate.stamp_ns)
        if oriented is None:
            self.why = f"the attitude of node {estimate.node_a} is not known at that instant: no north-east-down"
            return None
        R_ned_body_a = quat_to_matrix(oriented[0])
        R_ned_a = R_ned_body_a @ quat_to_matrix(np.array(info_a.q_body_camera_xyzw))
        of_attitude = attitude_covariance(R_ned_body_a, oriented[1], 1.0, 1.0)
        p_m = R_ned_a @ np.array(estimate.t_a_b_m)
        R_ned_body_b = (
            R_ned_a
            @ quat_to_matrix(np.array(estimate.q_a_b_xyzw))
            @ quat_to_matrix(np.array(info_b.q_body_camera_xyzw)).T
        )
        is_b = self.vehicle == estimate.node_b
        sign = 1.0 if is_b else -1.0
        of_pose, of_phi = np.zeros((6, 6)), np.zeros((6, 3))
        of_pose[:3, :3] = sign * R_ned_a
        of_phi[:3] = -sign * skew(p_m)
        of_phi[3:] = np.eye(3)
        if is_b:
            of_pose[3:, 3:] = R_ned_a
        covariance = of_pose @ np.array(estimate.covariance).reshape(6, 6) @ of_pose.T + of_phi @ of_attitude @ of_phi.T
        v_mps = v_covariance = None
        if isinstance(estimate, Track):
            v_mps = sign * (R_ned_a @ np.array(estimate.v_a_b_mps))
            v_covariance = R_ned_a @ np.array(estimate.v_covariance).reshape(3, 3) @ R_ned_a.T
        at_reference = R_ned_body_a if is_b else R_ned_body_b
        return self._finished(
            Placed(
                vehicle=self.vehicle,
                reference=estimate.node_a if is_b else estimate.node_b,
                stamp_ns=estimate.stamp_ns,
                p_ned_m=sign * p_m,
                R_ned_body=R_ned_body_b if is_b else R_ned_body_a,
                covariance=covariance,
                is_north_true=info_a.declination_rad != 0.0,
                v_ned_mps=v_mps,
                v_covariance=v_covariance,
                reference_yaw_rad=math.atan2(at_reference[1, 0], at_reference[0, 0]),
            )
        )

    def _in_net(self, pose: NodePose) -> Placed | None:
        info = self._infos.get(self.vehicle)
        if info is None:
            self.why = f"the calibration of node {self.vehicle} is not known"
            return None
        R_ned_body = quat_to_matrix(np.array(pose.q_xyzw)) @ quat_to_matrix(np.array(info.q_body_camera_xyzw)).T
        return self._finished(
            Placed(
                vehicle=self.vehicle,
                reference=pose.net,
                stamp_ns=pose.stamp_ns,
                p_ned_m=np.array(pose.p_m),
                R_ned_body=R_ned_body,
                covariance=np.array(pose.covariance).reshape(6, 6),
                is_north_true=info.declination_rad != 0.0,
                v_ned_mps=np.array(pose.v_mps),
            )
        )

    def _finished(self, placed: Placed) -> Placed | None:
        """Return a place by true north if that is known, with depth, restarts and age; None if it cannot be used."""
        stamp_ns = placed.stamp_ns
        verdict = self._jump.judge(stamp_ns, self._last_ns)
        if self._last_ns is not None and verdict != "restart":
            if verdict == "drop" or stamp_ns <= self._last_ns:
                return None
            self._restarts += stamp_ns - self._last_ns > stale_after_s(TRACK) * S_NS
        elif verdict == "restart":
            self._restarts += 1
        self._last_ns = stamp_ns
        if not placed.is_north_true and self._declination_rad is not None:
            placed = placed.with_true_north(self._declination_rad)
        if not _is_sound(placed):
            self.why = "the estimate is out of numeric range"
            return None
        self.why = ""
        # A third node's clock may be any.
        streams = [self._attitudes[node] for node in (placed.vehicle, placed.reference) if node in self._attitudes]
        newest_ns = max((stream.newest_ns for stream in streams if stream.newest_ns is not None), default=stamp_ns)
        depth_m, info = self._depth_m, self._infos[self.vehicle]
        if depth_m is not None:
            # The gauge's port is not the camera.
            R_body_camera = quat_to_matrix(np.array(info.q_body_camera_xyzw))
            depth_m -= float((placed.R_ned_body @ (R_body_camera @ np.array(info.depth_port_m)))[2])
        return replace(placed, depth_m=depth_m, restarts=self._restarts, behind_s=(newest_ns - stamp_ns) / S_NS)


def _is_sound(placed: Placed) -> bool:
    """Return whether all numbers are finite, and such that every receiver's format can say them."""
    limited = (
        (placed.p_ned_m, MOST),
        (placed.v_ned_mps, MOST),
        (placed.R_ned_body, MOST),
        (placed.covariance, MOST**2),
        (placed.v_covariance, MOST**2),
    )
    return all(values is None or bool((np.abs(values) <= most).all()) for values, most in limited)


def _about_down(angle_rad: float) -> Floats:
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def euler_rad(R_ned_body: Floats) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll = math.atan2(R_ned_body[2, 1], R_ned_body[2, 2])
    pitch = math.asin(min(max(-float(R_ned_body[2, 0]), -1.0), 1.0))
    return roll, pitch, math.atan2(R_ned_body[1, 0], R_ned_body[0, 0])


def euler_covariance(placed: Placed) -> Floats:
    """Return the covariance (6, 6) of north, east, down (m) and roll, pitch, yaw (rad).

    A small rotation w in north-east-down is E (droll, dpitch, dyaw), E's columns being the axes of the three turns.
    Straight up or down roll and yaw are one: their variances are then large, as they should be.
    """
    _, pitch, yaw = euler_rad(placed.R_ned_body)
    E = np.array(
        [
            [math.cos(yaw) * math.cos(pitch), -math.sin(yaw), 0.0],
            [math.sin(yaw) * math.cos(pitch), math.cos(yaw), 0.0],
            [-math.sin(pitch), 0.0, 1.0],
        ]
    )
    to_euler = np.eye(6)
    to_euler[3:, 3:] = np.linalg.pinv(E, rcond=1e-6)
    covariance: Floats = to_euler @ placed.covariance @ to_euler.T
    return covariance
