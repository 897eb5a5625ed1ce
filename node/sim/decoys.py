"""Things that a detector may take for lamps: pale walls between shadows, shells and slabs on a lit floor, and so on.

They stand for what real pictures without lamps show. Each frame has others; lasers and clock stay where they are.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from buddyline.node.sim.randomness import generator
from buddyline.node.sim.scenario import Scenario
from numpy.typing import NDArray

Image = NDArray[np.float32]

SHIFT: Final = 4
"""Places are drawn to 1/16 px."""
SCALE_PX: Final = 904.0
"""Focal length, px, for which this module's lengths are given; they scale with it."""
SEDIMENT: Final = np.array([0.5, 0.8, 0.75], np.float32)
PALE: Final = np.array([0.9, 1.0, 0.95], np.float32)
LASERS: Final = np.array([[0.05, 0.05, 1.0], [0.2, 1.0, 0.1]], np.float32)


class Decoys:
    """Draws a scenario's decoys into one camera's pictures, in linear light. Not safe for several threads."""

    def __init__(self, scenario: Scenario, index: int, f_px: float) -> None:
        rng = generator(scenario.seed, "decoys", index)
        self._kinds = scenario.decoys
        self._seed, self._index = scenario.seed, index
        self._size_px = scenario.width_px, scenario.height_px
        self._scale = f_px / SCALE_PX
        self._laser = LASERS[rng.integers(2)]
        self._lasers_at = rng.uniform(0.35, 0.65, 2) + np.array([[-0.08, 0.0], [0.08, 0.0]])
        self._clock_at = rng.choice([0.03, 0.55]), rng.choice([0.05, 0.97])

    def add_behind(self, full: Image, frame: int) -> None:
        """Add what lies behind the lamps: walls, the floor with its shells, slabs and bars."""
        rng = generator(self._seed, "decoys behind", self._index, frame)
        if "walls" in self._kinds:
            self._add_walls(full, rng)
        if "shells" in self._kinds:
            full += self._floor(rng)
        if "slabs" in self._kinds:
            self._add_slabs(full, rng)

    def add_before(self, full: Image, frame: int) -> None:
        """Add what floats before the lamps, and laser dots."""
        rng = generator(self._seed, "decoys before", self._index, frame)
        if "bubbles" in self._kinds:
            self._add_bubbles(full, rng)
        if "lasers" in self._kinds:
            self._add_lasers(full, rng)

    def burn_in(self, picture: NDArray[np.uint8], frame: int) -> None:
        """Write a clock into the finished picture."""
        if "clock" not in self._kinds:
            return
        width_px, height_px = self._size_px
        at = round(self._clock_at[0] * width_px), round(self._clock_at[1] * height_px)
        text = f"{frame // 10**9 % 10**5:05d}.{frame // 10**8 % 10} 21.4C 18.2m"
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45 * self._scale, (255, 255, 255), 1, cv2.LINE_AA)

    def _floor(self, rng: np.random.Generator) -> Image:
        """Return a floor in the light of the camera's own lamps, (H, W, 3): sediment and pale, sharp-edged shells."""
        width_px, height_px = self._size_px
        albedo: Image = np.ones((height_px, width_px), np.float32)
        for cell_px, depth in ((90.0, 0.2), (25.0, 0.2), (7.0, 0.2), (2.5, 0.15)):
            step = max(cell_px * self._scale, 1.0)
            coarse = rng.standard_normal((int(height_px / step) + 2, int(width_px / step) + 2), np.float32)
            albedo += depth * cv2.resize(coarse, self._size_px, interpolation=cv2.INTER_CUBIC)
        shells = np.zeros_like(albedo)
        for _ in range(int(rng.integers(0, 70))):
            self._add_patch(
                shells, rng, size_px=float(np.exp(rng.uniform(0.0, 2.2))), light=float(rng.uniform(1.0, 7.0))
            )
        albedo = np.maximum(albedo, np.float32(0.1))
        albedo += cv2.GaussianBlur(shells, (0, 0), 0.7 * self._scale)
        v, u = np.ogrid[:height_px, :width_px]
        at = rng.uniform(0.3, 0.7, 2) * self._size_px
        reach_px = width_px * rng.uniform(0.25, 0.7)
        pool = np.exp(-(((u - at[0]) ** 2 + (v - at[1]) ** 2) / reach_px**2)).astype(np.float32)
        light = float(np.exp(rng.uniform(np.log(0.03), np.log(0.35)))) * (pool + 0.05)
        # Shells are white: they take the colour of the light that the water lets through, as the sediment does.
        water = np.array([rng.uniform(0.4, 1.0), 1.0, rng.uniform(0.5, 1.0)], np.float32)
        white = np.minimum(shells, 1.0)[:, :, None]
        colour = (SEDIMENT + white * (PALE - SEDIMENT)) * water
        return np.asarray((albedo * light)[:, :, None] * colour, np.float32)

    def _add_patch(self, layer: Image, rng: np.random.Generator, size_px: float, light: float) -> None:
        """Add an irregular convex patch, sometimes long, to a layer (H, W)."""
        angles = np.sort(rng.uniform(0, 2 * np.pi, 8))
        radii = size_px * self._scale * rng.uniform(0.7, 1.0, 8)
        points = np.stack([radii * np.cos(angles), radii * np.sin(angles) * rng.uniform(0.35, 1.0)], axis=1)
        turn = rng.uniform(0, np.pi)
        c, s = np.cos(turn), np.sin(turn)
        points = points @ np.array([[c, s], [-s, c]]) + rng.uniform(0, 1, 2) * self._size_px
        corners = np.round(points * 2**SHIFT).astype(np.int32)
        cv2.fillConvexPoly(layer, corners, light, cv2.LINE_8, SHIFT)

    def _add_walls(self, full: Image, rng: np.random.Generator) -> None:
        """Add a pale wall, lit unevenly, in the shadow of poles, edges and swimmers: its lit rest has any shape."""
        width_px, height_px = self._size_px
        shade: Image = np.ones((height_px, width_px), np.float32)
        for _ in range(int(rng.integers(2, 12))):
            dark = float(rng.uniform(0.05, 0.7))
            if rng.random() < 0.5:
                self._add_patch(shade, rng, size_px=float(rng.uniform(20, 250)), light=dark)
                continue
            ends = rng.uniform(-0.2, 1.2, (2, 2)) * self._size_px
            thick = round(float(np.exp(rng.uniform(1.5, 5.0))) * self._scale) + 1
            cv2.line(shade, _point(ends[0]), _point(ends[1]), dark, thick, cv2.LINE_8, SHIFT)
        cv2.GaussianBlur(shade, (0, 0), float(np.exp(rng.uniform(-0.2, 1.5))) * self._scale, dst=shade)
        for cell_px, depth in ((150.0, 0.25), (40.0, 0.1), (12.0, 0.1)):
            cells = (int(height_px / cell_px / self._scale) + 2, int(width_px / cell_px / self._scale) + 2)
            shade *= 1.0 + depth * cv2.resize(
                rng.standard_normal(cells, np.float32), self._size_px, interpolation=cv2.INTER_CUBIC
            )
        water = np.array([rng.uniform(0.5, 1.0), 1.0, rng.uniform(0.05, 0.9)], np.float32)
        full += float(np.exp(rng.uniform(np.log(0.05), np.log(0.9)))) * np.maximum(shade, 0.0)[:, :, None] * water

    def _add_slabs(self, full: Image, rng: np.random.Generator) -> None:
        """Add white bars and pale slabs, as of frames, boxes, stones and sponges in the light of the own lamps."""
        width_px, height_px = self._size_px
        layer = np.zeros((height_px, width_px), np.float32)
        for _ in range(int(rng.integers(1, 5))):
            ends = rng.uniform(0, 1, (2, 2)) * self._size_px
            thick = max(round(float(rng.uniform(2, 14)) * self._scale), 1)
            cv2.line(layer, _point(ends[0]), _point(ends[1]), float(rng.uniform(0.2, 1.5)), thick, cv2.LINE_8, SHIFT)
        for _ in range(int(rng.integers(2, 14))):
            light = float(np.exp(rng.uniform(np.log(0.05), np.log(1.5))))
            self._add_patch(layer, rng, size_px=float(np.exp(rng.uniform(1.5, 4.3))), light=light)
        cells = (int(height_px / 12 / self._scale) + 2, int(width_px / 12 / self._scale) + 2)
        grain = cv2.resize(rng.standard_normal(cells, np.float32), self._size_px, interpolation=cv2.INTER_CUBIC)
        layer *= np.maximum(1.0 + float(rng.uniform(0.0, 0.25)) * grain, 0.1)
        full += cv2.GaussianBlur(layer, (0, 0), 0.8 * self._scale)[:, :, None] * PALE

    def _add_bubbles(self, full: Image, rng: np.random.Generator) -> None:
        """Add bubbles: bright rims with a glint near the top; near ones are discs out of focus."""
        height_px, width_px = full.shape[:2]
        layer = np.zeros((height_px, width_px), np.float32)
        middle = rng.uniform(0, 1, 2) * self._size_px
        for _ in range(int(rng.integers(3, 30))):
            at = middle + rng.normal(0, 0.1, 2) * self._size_px
            radius_px = float(np.exp(rng.uniform(0.4, 2.5))) * self._scale
            light = float(np.exp(rng.uniform(np.log(0.03), np.log(1.5))))
            if rng.random() < 0.5:
                cv2.circle(layer, _point(at), round(radius_px * 2**SHIFT), light, -1, cv2.LINE_8, SHIFT)
                continue
            cv2.circle(layer, _point(at), round(radius_px * 2**SHIFT), 0.3 * light, 1, cv2.LINE_8, SHIFT)
            glint = at + radius_px * np.array([rng.uniform(-0.4, 0.4), -0.6])
            cv2.circle(layer, _point(glint), round(0.25 * radius_px * 2**SHIFT), 2 * light, -1, cv2.LINE_8, SHIFT)
        full += cv2.GaussianBlur(layer, (0, 0), float(rng.uniform(0.6, 1.4)) * self._scale)[:, :, None] * PALE

    def _add_lasers(self, full: Image, rng: np.random.Generator) -> None:
        """Add two dots of one colour, a fixed distance apart, on whatever is there."""
        height_px, width_px = full.shape[:2]
        layer = np.zeros((height_px, width_px), np.float32)
        down = float(rng.uniform(-0.1, 0.1))
        for at in self._lasers_at:
            cv2.circle(
                layer,
                _point((at + np.array([0.0, down])) * self._size_px),
                round(1.5 * self._scale * 2**SHIFT),
                4.0,
                -1,
                cv2.LINE_8,
                SHIFT,
            )
        sharp, wide = (cv2.GaussianBlur(layer, (0, 0), sd * self._scale) for sd in (0.8, 5.0))
        full += float(np.exp(rng.uniform(-2.0, 0.7))) * (sharp + wide)[:, :, None] * self._laser


def _point(at_px: NDArray[np.float64]) -> tuple[int, int]:
    u, v = np.round(np.asarray(at_px) * 2**SHIFT).astype(int).tolist()
    return u, v
