"""Simulated triggers with truth, for the benchmarks: two equal nodes face to face, and false candidates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.node.sim.rotation import from_euler
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import CameraModel, NodeInfo
from buddyline.solver_service.geometry.rotation import matrix_to_quat
from buddyline.solver_service.geometry.trigger import Fix, NoFix, Observation, Sensed, Settings, View, solve_triggers
from buddyline.solver_service.results import rig_of
from buddyline.tools.bound import light_images
from numpy.typing import NDArray

Floats = NDArray[np.float64]

INFO: Final = NodeInfo(
    node="x",
    stamp_ns=0,
    width_px=1640,
    height_px=1232,
    camera=CameraModel(model="pinhole", fx_px=1800.0, fy_px=1800.0, cx_px=819.5, cy_px=615.5, distortion=[0.0] * 5),
    light_left_m=(-0.44, 0.0, 0.0),
    light_right_m=(0.44, 0.0, 0.0),
    sigma_px=1.0,
    trigger_period_ns=S_NS,
)
RIG: Final = rig_of(INFO)
CAMERA: Final = RIG.camera
# Between the two nodes, 1 sd: 1.4 degrees in roll and pitch, 5 in yaw, and 3 cm in depth.
TILT_SIGMA_RAD: Final = math.radians(1.0)
HEADING_SIGMA_RAD: Final = math.radians(3.5)
DEPTH_SIGMA_M: Final = 0.02


@dataclass(frozen=True, eq=False)
class Trigger:
    """One trigger: candidates and sensor readings, and the truth: T_a_b and the indices of the true (left, right)."""

    views: tuple[View, View]
    sensed: tuple[Sensed, Sensed]
    t_a_b_m: Floats
    R_a_b: Floats
    pair_a: tuple[int, int]
    pair_b: tuple[int, int]

    def observed(self, *, sensors: bool) -> Observation:
        """Return the candidates, with the sensor readings or without."""
        return Observation(*self.views, *(self.sensed if sensors else (Sensed(), Sensed())))

    def solve(self, settings: Settings, *, sensors: bool) -> Fix | NoFix:
        """Solve this trigger alone."""
        return solve_triggers([self.observed(sensors=sensors)], RIG, RIG, settings)[0]

    def right(self, fix: Fix) -> bool:
        """Whether all four lights are the true ones."""
        return (fix.pair_a, fix.pair_b) == (self.pair_a, self.pair_b)


def simulate(rng: np.random.Generator, range_m: tuple[float, float], false: int = 0, sigma_px: float = 1.0) -> Trigger:
    """Return a trigger with all four lights in view and `false` false candidates in each picture."""
    mount = RIG.R_body_camera
    while True:
        r = rng.uniform(*range_m)
        edge_px = min(0.4 * RIG.length_m / r * CAMERA.fx_px, 0.45 * CAMERA.width_px)
        pixel = rng.uniform((edge_px, 0), (CAMERA.width_px - edge_px, CAMERA.height_px), (1, 2))
        R_ned_a, R_ned_b = _upright(rng, 0.0) @ mount, _upright(rng, math.pi) @ mount
        t, R = r * CAMERA.bearings(pixel)[0], R_ned_a.T @ R_ned_b
        clear = images(t, R)
        if (clear > 0.0).all() and (clear < (CAMERA.width_px - 1, CAMERA.height_px - 1)).all():
            break
    views, pairs = [], []
    for lights in clear.reshape(2, 2, 2):
        pixels = np.concatenate(
            (
                lights + sigma_px * rng.standard_normal((2, 2)),
                rng.uniform((0, 0), (CAMERA.width_px, CAMERA.height_px), (false, 2)),
            )
        )
        order = rng.permutation(len(pixels))
        places = np.argsort(order)
        pairs.append((int(places[0]), int(places[1])))
        one = np.ones(len(pixels))
        views.append(View.of(pixels[order], sigma_px * one, np.nan * one, 100.0 * one, 0.0 * one, 0))
    sigma_rad = np.array((TILT_SIGMA_RAD, TILT_SIGMA_RAD, HEADING_SIGMA_RAD))
    depths_m = 10.0, 10.0 + float((R_ned_a @ t)[2])
    sensed = [
        Sensed(
            matrix_to_quat(R_ned @ mount.T @ _turn(rng.normal(0.0, sigma_rad[::-1]))),
            sigma_rad,
            depth_m + rng.normal(0.0, DEPTH_SIGMA_M),
            DEPTH_SIGMA_M,
        )
        for R_ned, depth_m in zip((R_ned_a, R_ned_b), depths_m, strict=True)
    ]
    return Trigger((views[0], views[1]), (sensed[0], sensed[1]), t, R, pairs[0], pairs[1])


def images(t_a_b_m: Floats, R_a_b: Floats) -> Floats:
    """Project B's left and right light into A's picture, and A's into B's (4, 2); NaN behind a camera."""
    return light_images(t_a_b_m[None], matrix_to_quat(R_a_b)[None], INFO, INFO).reshape(4, 2)


def _upright(rng: np.random.Generator, heading_rad: float) -> Floats:
    """Return R_ned_body of a random attitude near upright and near this heading."""
    return _turn(rng.normal((heading_rad, 0.0, 0.0), (0.3, 0.2, 0.2)))


def _turn(yaw_pitch_roll_rad: Floats) -> Floats:
    yaw_rad, pitch_rad, roll_rad = yaw_pitch_roll_rad.tolist()
    return from_euler(roll_rad, pitch_rad, yaw_rad)
