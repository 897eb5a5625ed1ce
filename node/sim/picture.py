"""Pictures of a simulated camera: scenery, glow, lamps, passing obstacles, snow, noise."""

from __future__ import annotations

import cv2
import numpy as np
from buddyline.node.capture.exposure import Exposure
from buddyline.node.sim import tags
from buddyline.node.sim.decoys import Decoys
from buddyline.node.sim.flicker import Flicker
from buddyline.node.sim.glow import GlowRenderer
from buddyline.node.sim.randomness import generator
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.scene import Lamp, Passer, Scene, SceneView
from buddyline.node.sim.scenery import Scenery
from buddyline.node.sim.sensor import scene_exposure, shot_noise
from buddyline.node.sim.snow import Snow
from numpy.typing import NDArray

Image = NDArray[np.float32]
NOISE_MARGIN_PX = 64


class Painter:
    """Renders the pictures of one node, in linear light, with the scene's exposure or the one asked for.

    The camera's tone curve is a square root. After a square root, shot noise has the same size at every brightness.
    So all frames use one tile of noise, shifted at random. Not safe for several threads: the buffers are reused.
    """

    def __init__(self, scenario: Scenario, scene: Scene, index: int) -> None:
        water, camera = scenario.water, scene.rigs[index].camera
        self._seed, self._index = scenario.seed, index
        self._size_px = scenario.width_px, scenario.height_px
        self._glow = GlowRenderer(water, scenario.width_px, scenario.height_px, camera.fx_px)
        self._scenery = Scenery(scenario, camera)
        self._snow = Snow(scenario, camera, index)
        self._decoys = Decoys(scenario, index, camera.fx_px)
        self._noise = _noise_tile(scenario, index)
        self._noise_sd = water.noise
        self._scene_exposure = scene_exposure(water)
        self._flicker = Flicker(scenario) if scenario.pwm_hz > 0 else None
        self._full: Image = np.empty((scenario.height_px, scenario.width_px, 3), np.float32)

    def paint(self, view: SceneView, t_s: float, frame: int, exposure: Exposure | None = None) -> NDArray[np.uint8]:
        """Return the picture, (H, W, 3) uint8, blue green red.

        frame: seeds the frame's noise. exposure: None for the scene's own.
        """
        rng = generator(self._seed, "frame", self._index, frame)
        lamps = [lamp for lamp in (*view.lights, *view.others) if self._matters(lamp)]
        tables = [self._glow.table(lamp) for lamp in lamps]
        full = self._full
        rows = [self._rows(lamp, view, t_s, exposure) for lamp in lamps]
        coarse = np.zeros((*self._glow.coarse_shape, 3), np.float32)
        for lamp, table, lit in zip(lamps, tables, rows, strict=True):
            self._glow.add_wide(coarse, lamp, table, lit)
        self._scenery.paint(view, t_s, coarse, full)
        self._decoys.add_behind(full, frame)
        for tag in view.tags:
            tags.paint(full, tag)
        for lamp, table, lit in zip(lamps, tables, rows, strict=True):
            self._glow.add_near(full, lamp, table, lit)
        for passer in view.passers:
            _darken(full, passer, self._scenery.passer_radiance)
        self._snow.add(full, view, t_s)
        self._decoys.add_before(full, frame)
        noisier = 1.0
        if exposure is not None:
            full *= np.float32(exposure.amount / self._scene_exposure.amount)
            noisier = shot_noise(exposure.gain) / self._noise_sd
        cv2.sqrt(full, dst=full)
        left, top = rng.integers(0, NOISE_MARGIN_PX, 2)
        width_px, height_px = self._size_px
        noise = self._noise[top : top + height_px, left : left + width_px]
        picture = np.asarray(cv2.addWeighted(full, 255.0, noise, noisier, 0.0, dtype=cv2.CV_8U), np.uint8)
        self._decoys.burn_in(picture, frame)
        return picture

    def _rows(self, lamp: Lamp, view: SceneView, t_s: float, exposure: Exposure | None) -> Image | None:
        """Return the share of a lamp's light that each row gets, (H,); None for a steady lamp."""
        side = next((i for i, light in enumerate(view.lights) if light is lamp), None)
        if self._flicker is None or side is None:
            return None
        return self._flicker.rows(side % 2, t_s, exposure or self._scene_exposure)

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
