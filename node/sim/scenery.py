"""The background of a picture: open water, a floor with caustics, the surface from below, the other node's body."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from buddyline.node.sim.randomness import generator
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.scene import Lamp, SceneView
from buddyline.protocol.messages import CameraModel
from numpy.typing import NDArray

Image = NDArray[np.float32]
Texture = NDArray[np.uint8]

GRID_PX: Final = 8
TEXTURED_PX: Final = 2
"""Textures are computed for every second pixel; they have no finer detail."""
TEXTURE_PX: Final = 256
TILES: Final = 8
FLOOR_TILE_M: Final = 6.0
SURFACE_TILE_M: Final = 6.0
FADING_M: Final = 12.0
"""Range at which textures blur into their mean."""
FARTHEST_M: Final = 40.0
DARK_WATER: Final = 0.0006
"""Radiance of unlit water, from the lamps' light that is scattered many times."""


class Scenery:
    """The background of one camera, projected as by a pinhole: a background needs no lens distortion.

    What changes slowly over the picture (directions, distances, veiling light) is computed on a coarse grid. Only
    textures are computed at a finer resolution.
    """

    def __init__(self, scenario: Scenario, camera: CameraModel) -> None:
        self._water = water = scenario.water
        self._size_px = scenario.width_px, scenario.height_px
        self._f_px = camera.fx_px
        self._grid = -(-scenario.height_px // GRID_PX), -(-scenario.width_px // GRID_PX)
        middle = -(-scenario.height_px // TEXTURED_PX), -(-scenario.width_px // TEXTURED_PX), 3
        self._middle: Image = np.empty(middle, np.float32)
        self._rays = _rays(camera, self._size_px, self._grid)
        self._ambient: Image = np.array(water.ambient, np.float32)
        self._sunlit = float(self._ambient.max()) > 0
        self._k = np.array(water.absorption_per_m) + 0.4 * np.array(water.scattering_per_m)
        rng = generator(scenario.seed, "scenery")
        self._caustics = [_caustics(rng) for _ in range(2)] if water.caustics else []
        self._surface = [_ripples(rng) for _ in range(2)] if water.surface else []
        self._drifts = rng.uniform(-40, 40, (4, 2))
        self._speck: Image = np.array((0.8, 1.0, 0.9), np.float32)
        self.passer_radiance: Image = 0.5 * self._ambient

    def paint(self, view: SceneView, t_s: float, coarse: Image, full: Image) -> None:
        """Write the background plus the glow in `coarse`, (h, w, 3), into `full`, (H, W, 3)."""
        if not self._sunlit:
            coarse += DARK_WATER
            cv2.resize(coarse, self._size_px, dst=full, interpolation=cv2.INTER_LINEAR)
            return
        rays_ned = self._rays @ view.R_ned_camera.T
        down = rays_ned[..., 2]
        veil = np.exp(-1.1 * down)[..., None] * self._ambient
        depth_m = float(view.placement.position_ned_m[2])
        textured = []
        if self._caustics:
            floor = _Plane(rays_ned, self._water.floor_depth_m - depth_m, self._k)
            lit = self._ambient.max() * self._speck * self._water.caustics
            veil += floor.through * (0.6 * lit - veil)
            tile = self._drifting(self._caustics, t_s, self._drifts[:2])
            textured.append((floor, tile, FLOOR_TILE_M, 30.0 * lit))
        if self._surface:
            above = _Plane(-rays_ned, depth_m, self._k)
            veil += above.through * (0.45 * self._ambient - veil)
            tile = self._drifting(self._surface, t_s, self._drifts[2:])
            textured.append((above, tile, SURFACE_TILE_M, 9.0 * self._ambient * self._water.surface))
        height, width = coarse.shape[:2]
        coarse += cv2.resize(veil.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        middle = self._middle
        cv2.resize(coarse, middle.shape[1::-1], dst=middle, interpolation=cv2.INTER_LINEAR)
        position_m = view.placement.position_ned_m[:2]
        for plane, tile, tile_m, colour in textured:
            self._add_texture(plane, position_m, tile, tile_m, colour)
        for left, right in view.bars:
            self._add_body(left, right)
        cv2.resize(middle, self._size_px, dst=full, interpolation=cv2.INTER_LINEAR)

    def _add_body(self, left: Lamp, right: Lamp) -> None:
        """Add another node's bar and housing to the half-size picture; they show against sunlit water."""
        if min(left.position_m[2], right.position_m[2]) < 0.3 or np.isnan([left.pixel, right.pixel]).any():
            return
        range_m = (left.range_m + right.range_m) / 2
        scale = self._f_px / TEXTURED_PX / range_m
        ends = np.array([left.pixel, right.pixel]) / TEXTURED_PX
        height_px, width_px = self._middle.shape[:2]
        u0, v0 = np.clip((ends.min(axis=0) - 0.16 * scale).astype(int), 0, (width_px, height_px))
        u1, v1 = np.clip((ends.max(axis=0) + 0.16 * scale).astype(int) + 1, 0, (width_px, height_px))
        if u0 >= u1 or v0 >= v1 or np.abs(ends).max() > 4 * width_px:
            return
        through = np.exp(-self._k * range_m) / 255.0
        for radiance, draw in ((1.7, self._bar), (0.12, self._housing)):
            mask = np.zeros((v1 - v0, u1 - u0), np.uint8)
            draw(mask, ends - (u0, v0), scale)
            rows, columns = np.nonzero(mask)
            patch = self._middle[v0:v1, u0:u1]
            behind = patch[rows, columns]
            cover = mask[rows, columns, None] * through
            patch[rows, columns] = behind + cover * (radiance * self._ambient - behind)

    @staticmethod
    def _bar(mask: Texture, ends_px: NDArray[np.float64], scale: float) -> None:
        below = ends_px + np.array([0.0, 0.05 * scale])
        points = [(round(16 * u), round(16 * v)) for u, v in below]
        cv2.line(mask, points[0], points[1], 255, max(round(0.04 * scale), 1), cv2.LINE_AA, 4)

    @staticmethod
    def _housing(mask: Texture, ends_px: NDArray[np.float64], scale: float) -> None:
        u, v = ends_px.mean(axis=0)
        cv2.circle(mask, (round(16 * u), round(16 * v)), round(16 * 0.1 * scale), 255, -1, cv2.LINE_AA, 4)

    def _drifting(self, tiles: list[Texture], t_s: float, drifts: NDArray[np.float64]) -> Texture:
        """Return the darker of two tiles that drift apart: moving light that does not repeat soon."""
        shifted = [
            np.roll(tile, (round(dy * t_s) % TEXTURE_PX, round(dx * t_s) % TEXTURE_PX), (0, 1))
            for tile, (dx, dy) in zip(tiles, drifts, strict=True)
        ]
        return np.asarray(cv2.min(shifted[0], shifted[1]), np.uint8)

    def _add_texture(
        self, plane: _Plane, position_m: NDArray[np.float64], tile: Texture, tile_m: float, colour: Image
    ) -> None:
        """Add a plane's texture to the half-size picture, in the rows that see the plane."""
        rows = np.flatnonzero(plane.seen.any(axis=1))
        if rows.size == 0:
            return
        first, last = max(int(rows[0]) - 1, 0), min(int(rows[-1]) + 2, self._grid[0])
        cell = GRID_PX // TEXTURED_PX
        top, bottom = first * cell, min(last * cell, self._middle.shape[0])
        size = self._middle.shape[1], (last - first) * cell
        # The texture repeats, so any whole number of tiles may be added: this one keeps the look-up inside the sheet.
        corner_m = position_m % tile_m + tile_m * (TILES // 2)
        where = ((plane.hits_m[first:last] + corner_m) * (TEXTURE_PX / tile_m)).astype(np.float32)
        columns, lines = (
            cv2.resize(np.ascontiguousarray(where[..., i]), size, interpolation=cv2.INTER_LINEAR) for i in range(2)
        )
        light = cv2.remap(cv2.repeat(tile, TILES, TILES), columns, lines, cv2.INTER_LINEAR)
        fading = np.exp(-((plane.range_m[first:last] / FADING_M) ** 2))[..., None]
        weight = cv2.resize((plane.through[first:last] * fading * colour * (1 / 255)).astype(np.float32), size)
        grey = cv2.cvtColor(light.astype(np.float32), cv2.COLOR_GRAY2BGR)
        self._middle[top:bottom] += cv2.multiply(weight, grey)[: bottom - top]


class _Plane:
    """A horizontal plane below the camera (above it, with negated rays), on a grid of rays.

    hits_m: (h, w, 2), where the rays meet it, relative to the camera. range_m: (h, w). seen: (h, w), whether a ray
    meets it within FARTHEST_M. through: (h, w, 3), the share of its light that reaches the camera.
    """

    def __init__(self, rays: NDArray[np.float64], distance_m: float, k: NDArray[np.float64]) -> None:
        towards = rays[..., 2]
        self.seen = towards > distance_m / FARTHEST_M
        self.range_m = distance_m / np.maximum(towards, distance_m / FARTHEST_M)
        self.hits_m = rays[..., :2] * self.range_m[..., None]
        self.through = np.exp(-self.range_m[..., None] * k) * self.seen[..., None]


def _rays(camera: CameraModel, size_px: tuple[int, int], grid: tuple[int, int]) -> NDArray[np.float64]:
    """Return unit rays in the camera frame through the centres of the grid's cells, (h, w, 3)."""
    height, width = grid
    rays = np.empty((height, width, 3))
    rays[..., 0] = ((np.arange(width) + 0.5) * GRID_PX - 0.5 - camera.cx_px) / camera.fx_px
    rays[..., 1] = (((np.arange(height) + 0.5) * GRID_PX - 0.5 - camera.cy_px) / camera.fy_px)[:, None]
    rays[..., 2] = 1.0
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _field(rng: np.random.Generator, waves: float, spread: float) -> NDArray[np.float64]:
    """Return a random smooth field that wraps around, with sd 1 and about `waves` waves across the tile."""
    frequency = np.fft.fftfreq(TEXTURE_PX, 1 / TEXTURE_PX)
    radius = np.hypot(frequency[:, None], frequency[None])
    band = np.exp(-(((radius - waves) / spread) ** 2))
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((TEXTURE_PX, TEXTURE_PX))) * band).real
    return np.asarray(field / field.std())


def _caustics(rng: np.random.Generator) -> Texture:
    """Return a tile of caustics: bright curves of uneven strength, where a random field is 0."""
    ridge = np.exp(-np.abs(_field(rng, 9.0, 4.5)) * 2.4) * np.clip(0.8 + 0.35 * _field(rng, 3.0, 2.0), 0.2, 1.3)
    return np.asarray(np.clip(250 * ridge, 0, 255), np.uint8)


def _ripples(rng: np.random.Generator) -> Texture:
    """Return a tile of the surface from below: soft waves with a few sharp glints."""
    field = _field(rng, 7.0, 6.0)
    return np.asarray(np.clip(70 * np.exp(0.75 * field), 0, 255), np.uint8)
