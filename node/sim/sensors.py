"""Simulated inertial, attitude and depth sensors, consistent with the motion."""

from __future__ import annotations

import math
from typing import Final

from buddyline.node.sim import rotation
from buddyline.node.sim.inertial import GRAVITY_MPS2, InertialUnit
from buddyline.node.sim.randomness import Sway, generator
from buddyline.node.sim.rig import R_BODY_CAMERA
from buddyline.node.sim.rotation import Vector
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.scene import Scene
from buddyline.protocol.messages import Attitude, Depth, Imu

SURFACE_PA: Final = 101325.0

TILT_SIGMA_RAD: Final = math.radians(1.0)
DEPTH_SIGMA_M: Final = 0.02
DEPTH_STEP_M: Final = 0.005

SLOW_SHARE: Final = 0.8
"""Share of an attitude error's variance that wanders slowly; the rest is new in every sample."""


class SensorModel:
    """The sensors of one node. t_s: seconds since the start. stamp_ns: the sample's stamp, which seeds its noise."""

    def __init__(self, scenario: Scenario, scene: Scene, index: int) -> None:
        rng = generator(scenario.seed, "sensors", index)
        self._scenario, self._scene, self._index = scenario, scene, index
        self._node = scenario.nodes[index]
        yaw_sigma_rad = math.radians(rng.uniform(3, 5))
        self._sigma_rad = (TILT_SIGMA_RAD, TILT_SIGMA_RAD, yaw_sigma_rad)
        self._wander = [Sway(rng, 8.0, 40.0, 6), Sway(rng, 8.0, 40.0, 6), Sway(rng, 40.0, 400.0, 6)]
        self._off_rad = scenario.magnetometer_off_rad if index == 1 else 0.0
        self.unit = InertialUnit(scenario.seed, index, scene.motion, scenario.inertial, self._off_rad)

    def attitude(self, stamp_ns: int, t_s: float) -> Attitude:
        """Return an attitude filter's output. Its sigmas are true except for the error magnetometer_off_rad."""
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
        """Return the depth of the pressure port, with the noise and resolution of a cheap gauge."""
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
        """Return specific force, turn rate and magnetic field in the stated body frame."""
        accel_mps2, gyro_radps, mag_t = map(_triple, self.unit.sample(stamp_ns, t_s))
        return Imu(node=self._node, stamp_ns=stamp_ns, accel_mps2=accel_mps2, gyro_radps=gyro_radps, mag_t=mag_t)


def _triple(vector: Vector) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
