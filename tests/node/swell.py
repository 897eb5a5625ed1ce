"""The samples of an inertial unit on a diver's rig in swell, with the true attitude at each sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from buddyline.node.drivers.samples import ImuSample
from buddyline.protocol.messages import Imu
from numpy.typing import NDArray

RATE_HZ = 100
START_NS = 1_764_000_000_000_000_000
FIELD_T = 48e-6
DIP_RAD = np.radians(62.0)
GRAVITY_MPS2 = 9.81
COOLING_TAU_S = 120.0  # of a closed housing in water; 0.04 to 0.05 deg/s per K, 5 to 25 K

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SwellDive:
    """times_s (n,), R_ned_body (n, 3, 3), samples (n); disturbed (n,): whether foreign iron is near."""

    times_s: Array
    R_ned_body: Array
    samples: list[ImuSample]
    disturbed: NDArray[np.bool_]


def log_of(dive: SwellDive) -> list[Imu]:
    """Give the samples as a node's log has them."""
    found = []
    for s in dive.samples:
        accel_mps2, gyro_radps, mag_t = (tuple(each.tolist()) for each in (s.accel_mps2, s.gyro_radps, s.mag_t))
        found.append(Imu(node="a", stamp_ns=s.stamp_ns, accel_mps2=accel_mps2, gyro_radps=gyro_radps, mag_t=mag_t))
    return found


def field_ned_t() -> Array:
    return FIELD_T * np.array([np.cos(DIP_RAD), 0.0, np.sin(DIP_RAD)])


def euler_to_matrix(roll: Array, pitch: Array, yaw: Array) -> Array:
    """R_ned_body (n, 3, 3) of yaw, then pitch, then roll."""
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    return np.stack(
        [
            np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], -1),
            np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], -1),
            np.stack([-sp, cp * sr, cp * cr], -1),
        ],
        -2,
    )


def matrix_to_vector(R: Array) -> Array:
    """Rotation vectors (n, 3) of small rotations (n, 3, 3)."""
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], -1) / 2
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, (np.trace(R, axis1=1, axis2=2)[:, None] - 1) / 2)
    return axis * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)


def simulate(
    seconds: float = 120.0,
    seed: int = 1,
    rest_s: float = 6.0,
    swell_m: float = 0.5,
    tilt_rad: float = np.radians(12.0),
    disturbances: tuple[tuple[float, float, float], ...] = (),
    gyro_bias_radps: float = np.radians(0.8),
    accel_bias_mps2: float = 0.0,
    calibrated: bool = True,
    cooling_radps: Array | None = None,
) -> SwellDive:
    """A node that lies still for rest_s, then sways.

    disturbances: (begin s, end s, T) of a foreign field that comes and goes smoothly, fixed in the body's frame.
    cooling_radps: (3,), by how much the gyroscope's bias moves as the housing cools from the deck to the water.
    """
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    on = np.clip((t - rest_s) / 3.0, 0.0, 1.0)
    on = on * on * (3 - 2 * on)

    def sway(periods: tuple[float, ...]) -> Array:
        phases = rng.uniform(0, 2 * np.pi, len(periods))
        return sum(np.sin(2 * np.pi * t / p + a) for p, a in zip(periods, phases, strict=True)) / len(periods)

    roll = 0.03 + on * tilt_rad * sway((3.1, 7.3))
    pitch = -0.05 + on * tilt_rad * sway((4.3, 8.1))
    yaw = 0.7 + on * (1.2 * sway((31.0, 17.0)) + 0.3 * sway((6.1, 9.7)))
    R = euler_to_matrix(roll, pitch, yaw)
    position = on[:, None] * np.stack(
        [swell_m * sway((7.9, 5.3)), swell_m * sway((7.1, 6.3)), swell_m * sway((7.9, 6.7)) + 0.01 * sway((0.9,))], -1
    )
    accel_ned = np.gradient(np.gradient(position, 1 / RATE_HZ, axis=0), 1 / RATE_HZ, axis=0)
    force_ned = accel_ned - np.array([0.0, 0.0, GRAVITY_MPS2])
    turned = matrix_to_vector(np.einsum("nji,njk->nik", R[:-1], R[1:])) * RATE_HZ
    gyro = np.vstack([turned[:1], turned]) + rng.normal(0, gyro_bias_radps, 3)
    gyro += np.cumsum(rng.normal(0, np.radians(0.002), (n, 3)) / np.sqrt(RATE_HZ), axis=0)
    gyro += rng.normal(0, np.radians(0.06), (n, 3))
    if cooling_radps is not None:
        gyro += (1 - np.exp(-np.clip(t - rest_s, 0.0, None) / COOLING_TAU_S))[:, None] * cooling_radps
    accel = np.einsum("nji,nj->ni", R, force_ned) + rng.normal(0, 0.015, (n, 3))
    accel += rng.normal(0, 1.0, 3) * accel_bias_mps2
    mag = np.einsum("nji,j->ni", R, field_ned_t()) + rng.normal(0, 0.4e-6, (n, 3))
    disturbed = np.zeros(n, dtype=bool)
    for begin, end, size in disturbances:
        near = np.clip(np.minimum(t - begin, end - t) / 2.0, 0.0, 1.0)
        direction = rng.normal(size=3)
        mag += near[:, None] * size * direction / np.linalg.norm(direction)
        disturbed |= near > 0
    if not calibrated:
        mag = mag @ np.array([[1.1, 0.03, 0.0], [0.03, 0.95, -0.02], [0.0, -0.02, 1.04]]) + [8e-6, -12e-6, 5e-6]
    samples = [ImuSample(START_NS + round(t[i] * 1e9), accel[i], gyro[i], mag[i]) for i in range(n)]
    return SwellDive(t, R, samples, disturbed)
