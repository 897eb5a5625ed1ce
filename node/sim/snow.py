"""Marine snow: drifting particles that reflect the lamps' light."""

from __future__ import annotations

import numpy as np
from buddyline.node.sim.randomness import generator
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.scene import SceneView
from buddyline.protocol.messages import CameraModel
from numpy.typing import NDArray

Image = NDArray[np.float32]
BOX_M = 2.4
NEAREST_M = 0.15
SHINE = 0.05
FAINTEST = 0.002
"""A particle of lower radiance is hidden in noise, and is not drawn."""


class Snow:
    """Slowly drifting particles that fill the water: one box of them, repeated in all directions."""

    def __init__(self, scenario: Scenario, camera: CameraModel, index: int) -> None:
        rng = generator(scenario.seed, "snow")
        count = scenario.water.snow * 5
        self._home_m = rng.uniform(0, BOX_M, (count, 3))
        self._drift_mps = rng.normal(0, 0.03, (count, 3)) + rng.normal(0, 0.06, 3)
        self._shine = rng.lognormal(-1.0, 0.8, count)
        self._camera = camera

    def add(self, full: Image, view: SceneView, t_s: float) -> None:
        """Add the particles in view to the full picture."""
        camera = self._camera
        position_m = view.placement.position_ned_m
        centre_m = position_m + view.R_ned_camera[:, 2] * BOX_M / 2
        relative_m = self._home_m + self._drift_mps * t_s - centre_m
        relative_m -= BOX_M * np.floor(relative_m / BOX_M + 0.5)
        points = (relative_m + centre_m - position_m) @ view.R_ned_camera
        z = np.maximum(points[:, 2], NEAREST_M)
        pixels = points[:, :2] / z[:, None] * (camera.fx_px, camera.fy_px) + (camera.cx_px, camera.cy_px)
        sharp_px = camera.fx_px / 900.0 * (0.7 + 1.2 * np.maximum(0.6 / z - 1.0, 0.0))
        light = SHINE * self._shine * np.minimum(1.0, (z / 0.5) ** 2) / (z * sharp_px) ** 2
        inside = ((pixels > 2) & (pixels < np.array([full.shape[1], full.shape[0]]) - 3)).all(axis=1)
        shown = inside & (points[:, 2] > NEAREST_M) & (light > FAINTEST)
        for (u, v), sd_px, shine in zip(pixels[shown], sharp_px[shown], light[shown], strict=True):
            _add_spot(full, float(u), float(v), float(sd_px), float(shine))


def _add_spot(full: Image, u_px: float, v_px: float, sd_px: float, light: float) -> None:
    reach = int(3 * sd_px) + 1
    u0, v0 = round(u_px), round(v_px)
    height_px, width_px = full.shape[:2]
    left, right = max(u0 - reach, 0), min(u0 + reach + 1, width_px)
    top, bottom = max(v0 - reach, 0), min(v0 + reach + 1, height_px)
    across = np.exp(-0.5 * ((np.arange(left, right) - u_px) / sd_px) ** 2)
    down = np.exp(-0.5 * ((np.arange(top, bottom) - v_px) / sd_px) ** 2)
    full[top:bottom, left:right] += (light * down[:, None] * across).astype(np.float32)[..., None]
