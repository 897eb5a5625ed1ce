"""What the sun and the nodes' own lamps light: open water, a floor with caustics, the surface from below."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from node.sim.randomness import generator
from node.sim.scenario import Scenario
from node.sim.scene import View
from protocol.messages import CameraModel

Image = NDArray[np.float32]

TEXTURE_PX: Final = 512
TEXTURE_M: Final = 3.0
BACKSCATTER: Final = 0.004


class Scenery:
    """The background of one camera. Directions are a pinhole's: distortion does not matter to a background."""

    def __init__(self, scenario: Scenario, camera: CameraModel) -> None:
        self._water = water = scenario.water
        self._camera = camera
        self._size_px = scenario.width_px, scenario.height_px
        self._ambient = np.array(water.ambient, np.float32)
        self._sunlit = float(self._ambient.max()) > 0
        self._k = np.array(water.absorption_per_m) + 0.5 * np.array(water.scattering_per_m)
        rng = generator(scenario.seed, "scenery")
        self._ripples = [_ripple_texture(rng) for _ in range(2)] if water.floor_depth_m else []
        self._floor_colour = np.array([0.55, 0.75, 0.75], np.float32)
        self.passer_radiance: Image = 0.6 * self._ambient

    def coarse(self, view: View, shape: tuple[int, int]) -> Image:
        """Return the radiance of open water, (h, w, 3) on the coarse grid."""
        if not self._sunlit:
            return np.full((*shape, 3), 0.0006, np.float32)
        up = -self._rays_ned(view, shape)[..., 2]
        brightness = np.exp(1.1 * up).astype(np.float32)
        return np.asarray(brightness[..., None] * self._ambient, np.float32)

    def add(self, full: Image, view: View, t_s: float) -> None:
        """Add floor and surface to the full picture."""
        return

    def _rays_ned(self, view: View, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Return unit rays in NED of a grid over the picture, (h, w, 3)."""
        height, width = shape
        u = (np.arange(width) + 0.5) * self._size_px[0] / width - 0.5
        v = (np.arange(height) + 0.5) * self._size_px[1] / height - 0.5
        rays = np.empty((height, width, 3))
        rays[..., 0] = (u - self._camera.cx_px) / self._camera.fx_px
        rays[..., 1] = ((v - self._camera.cy_px) / self._camera.fy_px)[:, None]
        rays[..., 2] = 1.0
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return np.asarray(rays @ view.R_ned_camera.T)


def _ripple_texture(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a tile of caustics that wraps around: bright curves where a random smooth field passes 0."""
    frequency = np.fft.fftfreq(TEXTURE_PX, 1 / TEXTURE_PX)
    radius = np.hypot(frequency[:, None], frequency[None])
    band = np.exp(-(((radius - 7.0) / 3.0) ** 2))
    spectrum = np.fft.fft2(rng.standard_normal((TEXTURE_PX, TEXTURE_PX))) * band
    field = np.fft.ifft2(spectrum).real
    field /= field.std()
    ridge = np.exp(-np.abs(field) * 3.0)
    return np.asarray(np.clip(255 * ridge, 0, 255), np.uint8)
