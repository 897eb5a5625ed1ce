"""Pictures of a simulated camera: scenery, glow, lamps, passing obstacles, snow, noise."""

from __future__ import annotations

import cv2
import numpy as np
from buddyline.node.sim import tags
from buddyline.node.sim.glow import GlowRenderer
from buddyline.node.sim.randomness import generator
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.scene import Lamp, Passer, Scene, SceneView
from buddyline.node.sim.scenery import Scenery
from buddyline.node.sim.snow import Snow
from numpy.typing import NDArray

Image = NDArray[np.float32]
NOISE_MARGIN_PX = 64


class Painter:
    """Renders the pictures of one node, in linear light. The camera's tone curve is a square root.

    After a square root, shot noise has the same size at every brightness. So all frames use one tile of noise,
    shifted at random. Not safe for several threads: the buffers are reused.
    """

    def __init__(self, scenario: Scenario, scene: Scene, index: int) -> None:
        water, camera = scenario.water, scene.rigs[index].camera
        self._seed, self._index = scenario.seed, index
        self._size_px = scenario.width_px, scenario.height_px
        self._glow = GlowRenderer(water, scenario.width_px, scenario.height_px, camera.fx_px)
        self._scenery = Scenery(scenario, camera)
        self._snow = Snow(scenario, camera, index)
        self._noise = _noise_tile(scenario, index)
        self._full: Image = np.empty((scenario.height_px, scenario.width_px, 3), np.float32)

    def paint(self, view: SceneView, t_s: float, frame: int) -> NDArray[np.uint8]:
        """Return the picture, (H, W, 3) uint8, blue green red. frame: seeds the frame's noise."""
        rng = generator(self._seed, "frame", self._index, frame)
        lamps = [lamp for lamp in (*view.lights, *view.others) if self._matters(lamp)]
        tables = [self._glow.table(lamp) for lamp in lamps]
        full = self._full
        coarse = np.zeros((*self._glow.coarse_shape, 3), np.float32)
        for lamp, table in zip(lamps, tables, strict=True):
            self._glow.add_wide(coarse, lamp, table)
        self._scenery.paint(view, t_s, coarse, full)
        for tag in view.tags:
            tags.paint(full, tag)
        for lamp, table in zip(lamps, tables, strict=True):
            self._glow.add_near(full, lamp, table)
        for passer in view.passers:
            _darken(full, passer, self._scenery.passer_radiance)
        self._snow.add(full, view, t_s)
        cv2.sqrt(full, dst=full)
        left, top = rng.integers(0, NOISE_MARGIN_PX, 2)
        width_px, height_px = self._size_px
        noise = self._noise[top : top + height_px, left : left + width_px]
        return np.asarray(cv2.addWeighted(full, 255.0, noise, 1.0, 0.0, dtype=cv2.CV_8U), np.uint8)

    def _matters(self, lamp: Lamp) -> bool:
        """Return whether a lamp is in the picture, or near enough to light the water in it."""
        if np.isnan(lamp.pixel).any() or lamp.position_m[2] < 0.1:
            return False
        beyond = np.abs(lamp.pixel / self._size_px - 0.5) - 0.5
        return bool(beyond.max() < 0.4)


def _noise_tile(scenario: Scenario, index: int) -> Image:
    """Return a tile of sensor noise in grey levels, slightly blurred as by demosaicing."""
    rng = generator(scenario.seed, "noise", index)
    shape = scenario.height_px + NOISE_MARGIN_PX, scenario.width_px + NOISE_MARGIN_PX, 3
    tile = cv2.GaussianBlur(rng.standard_normal(shape, np.float32), (3, 3), 0.6)
    tile *= scenario.water.noise / tile.std()
    return np.asarray(tile, np.float32)


def _darken(full: Image, passer: Passer, radiance: Image) -> None:
    """Paint a dark body with a soft edge over the picture. radiance: (3,)."""
    reach = int(passer.radii_px.max()) + 3
    u, v = passer.centre_px
    height_px, width_px = full.shape[:2]
    u0, u1 = max(int(u) - reach, 0), min(int(u) + reach + 1, width_px)
    v0, v1 = max(int(v) - reach, 0), min(int(v) + reach + 1, height_px)
    if u0 >= u1 or v0 >= v1:
        return
    du, dv = np.meshgrid(np.arange(u0, u1) - u, np.arange(v0, v1) - v)
    c, s = np.cos(passer.angle_rad), np.sin(passer.angle_rad)
    along = (c * du + s * dv) / passer.radii_px[0]
    across = (c * dv - s * du) / passer.radii_px[1]
    edge_px = float(passer.radii_px.min())
    cover = np.clip((1.0 - np.hypot(along, across)) * edge_px / 1.5 + 0.5, 0, 1).astype(np.float32)[..., None]
    patch = full[v0:v1, u0:u1]
    patch += cover * (radiance - patch)
