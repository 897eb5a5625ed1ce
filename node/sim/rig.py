"""The rig of a simulated node: two lights on a bar, their aims, the pressure port, the camera's mount."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.node.sim import rotation
from buddyline.node.sim.randomness import generator
from buddyline.node.sim.rotation import Vector
from buddyline.node.sim.scenario import Scenario
from buddyline.protocol.messages import CameraModel

Q_BODY_CAMERA: Final = (0.5, 0.5, 0.5, 0.5)
R_BODY_CAMERA: Final = rotation.from_quaternion(Q_BODY_CAMERA)
LEFT, RIGHT = 0, 1
SPILL: Final = 0.015


@dataclass(frozen=True)
class SimulatedRig:
    """One node as built. lights_m, aims: (2, 3), left and right, in its camera frame; aims are unit vectors.

    beams_rad: (2,), 1 sd of each light's beam. intensities: (2,), on the beam's axis. depth_port_m: (3,), camera frame.
    """

    camera: CameraModel
    lights_m: Vector
    aims: Vector
    beams_rad: Vector
    intensities: Vector
    depth_port_m: Vector


def build(scenario: Scenario, index: int) -> SimulatedRig:
    """Return the rig of a node: lights toed out by 3 to 8 degrees, a few millimetres off the bar."""
    rng = generator(scenario.seed, "rig", index)
    half_m = scenario.baseline_m(index) / 2
    lights_m = np.array([[-half_m, 0.0, 0.0], [half_m, 0.0, 0.0]])
    lights_m += rng.normal(0.0, scenario.rig_sigma_m, (2, 3))
    toe_rad = np.radians(rng.uniform(3, 8, 2)) * (-1, 1)
    tilt_rad = np.radians(rng.uniform(-3, 3, 2))
    aims = np.stack([np.sin(toe_rad) * np.cos(tilt_rad), np.sin(tilt_rad), np.cos(toe_rad) * np.cos(tilt_rad)], axis=1)
    beams_rad = np.radians(rng.uniform(9, 16, 2))
    intensities = rng.uniform(0.7, 1.4, 2)
    port_m = np.array([0.0, 0.06, -0.12]) if scenario.rig_sigma_m > 0 else np.zeros(3)
    return SimulatedRig(scenario.camera(index), lights_m, aims, beams_rad, intensities, port_m)


def beam(cos_off_axis: Vector, beam_rad: float) -> Vector:
    """Return a lamp's intensity relative to its axis: a Gaussian beam, and some light in all directions."""
    off_axis_rad2 = 2.0 * (1.0 - cos_off_axis)
    return np.asarray(SPILL + (1.0 - SPILL) * np.exp(-0.5 * off_axis_rad2 / beam_rad**2))
