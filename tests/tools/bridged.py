"""A vehicle b at a known place from node a, for the tests of the bridge."""

from __future__ import annotations

import json
import urllib.request
from typing import Any

import numpy as np
from buddyline.protocol.codec import encode
from buddyline.protocol.envelope import open_envelope
from buddyline.protocol.messages import Attitude, Message, Track
from buddyline.protocol.topics import key_of
from buddyline.solver_service.geometry.rotation import (
    Floats,
    matrix_to_quat,
    quat_to_matrix,
    rotation_exp,
)
from buddyline.tools.bridge.place import GeoPoint
from buddyline.tools.bridge.placed import Placed, Placing

from tests.tools.evaluated import INFOS, track
from tests.tools.watched import at, depth

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
    """Give the messages to placing; return what it makes of the last."""
    placed = None
    for message in messages:
        placed = placing.take(open_envelope(key_of(message), encode(message), at(0)))
    return placed


def placed_of(vehicle: str = "b", **how: Any) -> Placed:
    placed = take(Placing(vehicle, **how), *INFOS.values(), oriented(), depth(vehicle, at(5), 12.5), estimate())
    assert placed is not None
    return placed


def rotation_of(roll: float, pitch: float, yaw: float) -> Floats:
    R: Floats = (
        rotation_exp(np.array([0.0, 0.0, yaw]))
        @ rotation_exp(np.array([0.0, pitch, 0.0]))
        @ rotation_exp(np.array([roll, 0.0, 0.0]))
    )
    return R


def get(address: str, **headers: str) -> Any:
    """Return the JSON that an address answers."""
    with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=30) as response:
        return json.loads(response.read())
