"""Simulated inertial, attitude and depth sensors, consistent with the motion."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from buddyline.node.sim import rotation
from buddyline.node.sim.randomness import Sway, generator
from buddyline.node.sim.rig import R_BODY_CAMERA
from buddyline.node.sim.rotation import Vector
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.scene import Scene
from buddyline.protocol.messages import Attitude, Depth, Imu

GRAVITY_MPS2: Final = 9.80665
SURFACE_PA: Final = 101325.0
STEP_S: Final = 0.005

TILT_SIGMA_RAD: Final = math.radians(1.0)
DEPTH_SIGMA_M: Final = 0.02
DEPTH_STEP_M: Final = 0.005
ACCEL_SIGMA_MPS2: Final = 0.03
GYRO_SIGMA_RADPS: Final = 0.004
GYRO_BIAS_RADPS: Final = 0.003
MAG_SIGMA_T: Final = 0.3e-6
FIELD_NED_T: Final = np.array([48e-6 * math.cos(math.radians(60)), 0.0, 48e-6 * math.sin(math.radians(60))])

SLOW_SHARE: Final = 0.8
"""Share of an attitude error's variance that wanders slowly; the rest is new in every sample."""


class Sensors:
    """The sensors of one node. Times in seconds since the start; stamps name the samples' own noise."""

    def __init__(self, scenario: Scenario, scene: Scene, index: int) -> None:
        rng = generator(scenario.seed, "sensors", index)
        self._scenario, self._scene, self._index = scenario, scene, index
        self._node = (scenario.node_a, scenario.node_b)[index]
        yaw_sigma_rad = math.radians(rng.uniform(3, 5))
        self._sigma_rad = (TILT_SIGMA_RAD, TILT_SIGMA_RAD, yaw_sigma_rad)
        self._wander = [Sway(rng, 8.0, 40.0, 6), Sway(rng, 8.0, 40.0, 6), Sway(rng, 40.0, 400.0, 6)]
        self._gyro_bias_radps = rng.normal(0, GYRO_BIAS_RADPS, 3)
        self._off_rad = scenario.magnetometer_off_rad if index == 1 else 0.0

    def attitude(self, stamp_ns: int, t_s: float) -> Attitude:
        """Return what an attitude filter would say; its sigmas are true, but for a magnetometer that is off."""
        rng = generator(self._scenario.seed, "attitude", self._index, stamp_ns)
        fresh = rng.standard_normal(3)
        R = self._scene.motion.placement(self._index, t_s).R_ned_body
        angles = [math.atan2(R[2, 1], R[2, 2]), -math.asin(R[2, 0]), math.atan2(R[1, 0], R[0, 0])]
        for i, (wander, sigma_rad) in enumerate(zip(self._wander, self._sigma_rad, strict=True)):
            slow = wander(t_s) / wander.sd * math.sqrt(SLOW_SHARE)
            angles[i] += sigma_rad * (slow + math.sqrt(1 - SLOW_SHARE) * float(fresh[i]))
        q_xyzw = rotation.to_quaternion(rotation.from_euler(angles[0], angles[1], angles[2] + self._off_rad))
        return Attitude(node=self._node, stamp_ns=stamp_ns, q_ned_body_xyzw=q_xyzw, sigma_rad=self._sigma_rad)

    def depth(self, stamp_ns: int, t_s: float) -> Depth:
        """Return the depth of the pressure port, with the noise and the steps of a cheap gauge."""
        rng = generator(self._scenario.seed, "depth", self._index, stamp_ns)
        placement = self._scene.motion.placement(self._index, t_s)
        port_m = R_BODY_CAMERA @ self._scene.rigs[self._index].depth_port_m
        true_m = float(placement.position_ned_m[2] + placement.R_ned_body[2] @ port_m)
        depth_m = round((true_m + DEPTH_SIGMA_M * float(rng.standard_normal())) / DEPTH_STEP_M) * DEPTH_STEP_M
        pressure_pa = SURFACE_PA + self._scenario.water.density_kgpm3 * GRAVITY_MPS2 * depth_m
        return Depth(
            node=self._node,
            stamp_ns=stamp_ns,
            depth_m=depth_m,
            sigma_m=DEPTH_SIGMA_M,
            pressure_pa=pressure_pa,
            temperature_degc=21.5,
        )

    def imu(self, stamp_ns: int, t_s: float) -> Imu:
        """Return specific force, turn rate and magnetic field in the body frame."""
        rng = generator(self._scenario.seed, "imu", self._index, stamp_ns)
        before, now, after = (self._scene.motion.placement(self._index, t_s + step) for step in (-STEP_S, 0.0, STEP_S))
        R_body_ned = now.R_ned_body.T
        accel_ned_mps2 = (after.position_ned_m - 2 * now.position_ned_m + before.position_ned_m) / STEP_S**2 - np.array(
            [0.0, 0.0, GRAVITY_MPS2]
        )
        rate_radps = rotation.to_vector(before.R_ned_body.T @ after.R_ned_body) / (2 * STEP_S)
        field_t = R_body_ned @ rotation.from_euler(0.0, 0.0, self._off_rad).T @ FIELD_NED_T
        noise = rng.standard_normal((3, 3))
        return Imu(
            node=self._node,
            stamp_ns=stamp_ns,
            accel_mps2=_triple(R_body_ned @ accel_ned_mps2 + ACCEL_SIGMA_MPS2 * noise[0]),
            gyro_radps=_triple(rate_radps + self._gyro_bias_radps + GYRO_SIGMA_RADPS * noise[1]),
            mag_t=_triple(field_t + MAG_SIGMA_T * noise[2]),
        )


def _triple(vector: Vector) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
