"""Simulated inertial units: their place on the rig, their mounting, and their errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.node.sim import rotation
from buddyline.node.sim.randomness import Sway, generator
from buddyline.node.sim.rig import R_BODY_CAMERA
from buddyline.node.sim.rotation import Vector
from buddyline.node.sim.scenario import InertialGrade
from buddyline.node.sim.trajectory import NodesMotion
from buddyline.protocol.clock import MS_NS, S_NS

GRAVITY_MPS2: Final = 9.80665
STEP_S: Final = 0.005
FIELD_NED_T: Final = np.array([48e-6 * math.cos(math.radians(60)), 0.0, 48e-6 * math.sin(math.radians(60))])
ACCEL_SIGMA_MPS2: Final = 0.03
GYRO_SIGMA_RADPS: Final = 0.004
MAG_SIGMA_T: Final = 0.3e-6
WALK_S: Final = (20.0, 200.0)
"""Shortest and longest period of a bias's wandering part, s."""


@dataclass(frozen=True)
class Grade:
    """The errors of a unit, 1 sd if not said otherwise.

    lever_sigma_m: of each coordinate of the stated lever arm. misalignment_rad: the angle between the true and the
    stated mounting. delay_ns: least and greatest delay of the stamps, which NodeInfo does not state.
    gyro_bias_radps, accel_bias_mps2: constant biases. gyro_walk_radps, accel_walk_mps2: their wandering parts.
    shake_mps2, shake_radps: shaking by fin kicks, which turns and pushes the unit in its mount; shake_s: its shortest
    and longest period.
    """

    lever_sigma_m: float
    misalignment_rad: float
    delay_ns: tuple[int, int]
    gyro_bias_radps: float
    accel_bias_mps2: float
    gyro_walk_radps: float
    accel_walk_mps2: float
    shake_mps2: float
    shake_radps: float
    shake_s: tuple[float, float] = (0.1, 0.6)


# The fair one's shaking is that of an independent simulated dive, found by comparing its samples with its dense truth:
# nothing below 7 Hz, nothing above 18 Hz.
GRADES: Final[dict[InertialGrade, Grade]] = {
    "good": Grade(0.001, math.radians(0.1), (0, 0), 0.003, 0.02, 0.0003, 0.005, 0.0, 0.0),
    "fair": Grade(
        0.005, math.radians(1.0), (2 * MS_NS, 6 * MS_NS), 0.003, 0.05, 0.0003, 0.004, 0.09, 0.005, (0.055, 0.14)
    ),
    "poor": Grade(0.005, math.radians(1.0), (2 * MS_NS, 6 * MS_NS), 0.003, 0.05, 0.002, 0.03, 0.2, 0.02),
}


class InertialUnit:
    """The inertial unit of one node. Times in seconds since the start, on the node's own clock.

    lever_m, stated_lever_m: (3,), its true place and the one in NodeInfo, in the camera frame.
    """

    def __init__(
        self, seed: int, index: int, motion: NodesMotion, grade: InertialGrade, heading_off_rad: float
    ) -> None:
        rng = generator(seed, "inertial", index)
        self._grade = GRADES[grade]
        self._motion, self._seed, self._index = motion, seed, index
        self.stated_lever_m = np.array([0.02, 0.05, -0.06]) + rng.uniform(-0.02, 0.02, 3)
        self.lever_m = self.stated_lever_m + rng.normal(0.0, self._grade.lever_sigma_m, 3)
        axis = rng.normal(size=3)
        self._R_unit_body = rotation.from_euler(*(self._grade.misalignment_rad * axis / np.linalg.norm(axis)))
        self._delay_s = rng.uniform(*self._grade.delay_ns) / S_NS
        self._gyro_bias_radps = rng.normal(0.0, self._grade.gyro_bias_radps, 3)
        self._accel_bias_mps2 = rng.normal(0.0, self._grade.accel_bias_mps2, 3)
        self._walks = [Sway(rng, *WALK_S, 6) for _ in range(6)]
        self._shakes = [Sway(rng, *self._grade.shake_s, 6) for _ in range(6)]
        self._R_ned_field = rotation.from_euler(0.0, 0.0, heading_off_rad)

    def sample(self, stamp_ns: int, t_s: float) -> tuple[Vector, Vector, Vector]:
        """Return specific force (m/s^2), turn rate (rad/s) and field (T), (3,) each, in the stated body frame.

        t_s: the sample's time by its stamp. stamp_ns: the same stamp, which seeds the sample's noise.
        """
        rng = generator(self._seed, "imu", self._index, stamp_ns)
        true_s = t_s - self._delay_s
        lever_body_m = R_BODY_CAMERA @ self.lever_m
        around = [self._motion.placement(self._index, true_s + step) for step in (-STEP_S, 0.0, STEP_S)]
        before, now, after = (each.position_ned_m + each.R_ned_body @ lever_body_m for each in around)
        R_unit_ned = self._R_unit_body @ around[1].R_ned_body.T
        force = R_unit_ned @ ((after - 2 * now + before) / STEP_S**2 - np.array([0.0, 0.0, GRAVITY_MPS2]))
        turned = rotation.to_vector(around[0].R_ned_body.T @ around[2].R_ned_body)
        rate = self._R_unit_body @ turned / (2 * STEP_S)
        field_t = R_unit_ned @ self._R_ned_field.T @ FIELD_NED_T
        grade = self._grade
        gyro_walk, accel_walk, gyro_shake, accel_shake = (
            np.array([sway(true_s) / sway.sd for sway in sways])
            for sways in (self._walks[:3], self._walks[3:], self._shakes[:3], self._shakes[3:])
        )
        rate += self._gyro_bias_radps + grade.gyro_walk_radps * gyro_walk + grade.shake_radps * gyro_shake
        force += self._accel_bias_mps2 + grade.accel_walk_mps2 * accel_walk + grade.shake_mps2 * accel_shake
        noise = rng.standard_normal((3, 3))
        return (
            force + ACCEL_SIGMA_MPS2 * noise[0],
            rate + GYRO_SIGMA_RADPS * noise[1],
            field_t + MAG_SIGMA_T * noise[2],
        )
