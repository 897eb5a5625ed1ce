"""A dive's attitudes once more, from its inertial samples: with a later calibration, and in both directions of time.

Forward, the filter learns bias and heading as the dive goes on. Backward, it comes with what the end of the dive has
taught it. Each sample gets the mean of both, weighted by their sigmas.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, TypeAlias

import numpy as np
from buddyline.node.attitude import GIVE_UP_REST_S, VqfAttitude, attitudes
from buddyline.node.config import NodeConfig
from buddyline.node.drivers.samples import Vector
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Imu
from msgspec.structs import replace

Quaternion: TypeAlias = tuple[float, float, float, float]
# The error that both directions have in common, as a share of the dive's least sigma.
COMMON: Final = 0.95


def attitude_estimator(config: NodeConfig, at_ns: int) -> VqfAttitude:
    """Return a node's estimator: its magnetometer's calibration, and the Earth's field at its place on that day."""
    calibration = config.sensors.magnetometer_calibration
    # What an uncalibrated magnetometer reads would never be the field of the place.
    here = None if calibration.is_none else config.earth_field(at_ns)
    slope = np.array(config.sensors.gyro_bias_radps_per_k)
    return VqfAttitude(calibration, here, config.declination_rad(at_ns), slope)


def attitudes_again(samples: Sequence[Imu], estimator: VqfAttitude) -> list[Attitude]:
    """Return an attitude for each sample but the last few; samples in order of time, of one node.

    The backward pass starts with all that the forward pass has learned. Where the forward pass found no rest at its
    start, it is done again after the backward one. sigma_rad is the smaller one of both passes, not less: both have the
    same magnetometer, accelerometer and mount.
    """
    if not samples:
        return []
    ends_ns = samples[0].stamp_ns + samples[-1].stamp_ns
    forward = {one.stamp_ns: one for one in attitudes(samples, estimator)}
    if not forward:
        return []
    rested = min(forward) - samples[0].stamp_ns < GIVE_UP_REST_S * S_NS
    estimator.turn_back(ends_ns)
    backward = {ends_ns - one.stamp_ns: one for one in attitudes(_reversed(samples, ends_ns), estimator)}
    if not rested:
        estimator.turn_back(ends_ns)
        forward = {one.stamp_ns: one for one in attitudes(samples, estimator)}
    both = sorted(forward.keys() | backward.keys())
    least = np.min([one.sigma_rad for one in (*forward.values(), *backward.values())], axis=0)
    found = []
    for stamp_ns in both:
        one, other = forward.get(stamp_ns), backward.get(stamp_ns)
        if one is not None and other is not None:
            found.append(_mean(one, other, COMMON * least))
        elif (single := one or other) is not None:
            found.append(replace(single, stamp_ns=stamp_ns))
    return found


def _reversed(samples: Sequence[Imu], ends_ns: int) -> list[Imu]:
    """Return the samples as if time ran backward: every turn is the other way, gravity and field stay.

    A sample means the time before it, so that each takes what the one after it has measured.
    """
    later = [*samples[1:], samples[-1]]
    turned = []
    for sample, after in zip(reversed(samples), reversed(later), strict=True):
        x, y, z = after.gyro_radps
        turned.append(replace(after, stamp_ns=ends_ns - sample.stamp_ns, gyro_radps=(-x, -y, -z)))
    return turned


def _mean(one: Attitude, other: Attitude, common_rad: Vector) -> Attitude:
    """Return the mean of two attitudes of one instant, weighted by the part of their errors that is not common.

    common_rad: sigma of the common error, about N, E, D.
    """
    a, b = (np.array(each.sigma_rad) for each in (one, other))
    share = (a**2 - common_rad**2) / (a**2 + b**2 - 2 * common_rad**2)
    turn = _vector_of(_product(other.q_ned_body_xyzw, _inverse(one.q_ned_body_xyzw)))
    q = _product(_quaternion_of(share * turn), one.q_ned_body_xyzw)
    roll, pitch, yaw = np.minimum(a, b).tolist()
    return replace(one, q_ned_body_xyzw=q, sigma_rad=(roll, pitch, yaw))


def _product(p: Quaternion, q: Quaternion) -> Quaternion:
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return (
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    )


def _inverse(q: Quaternion) -> Quaternion:
    x, y, z, w = q
    return -x, -y, -z, w


def _vector_of(q: Quaternion) -> Vector:
    x, y, z, w = q if q[3] >= 0 else (-q[0], -q[1], -q[2], -q[3])
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0
    return scale * np.array([x, y, z])


def _quaternion_of(turn: Vector) -> Quaternion:
    angle = math.sqrt(float(turn @ turn))
    scale = math.sin(angle / 2) / angle if angle > 1e-12 else 0.5
    x, y, z = (scale * turn).tolist()
    return x, y, z, math.cos(angle / 2)
