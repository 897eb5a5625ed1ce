"""Light of a lamp in water: its disc, its halo and beam of scattered light, and the glare of the lens.

The scattered light is single scattering along each sight ray, integrated over the scattering angle phi:

    L = b / D * integral of p(phi) I(beam) exp(-k (d1 + d2)) d(phi)

D: perpendicular distance of the ray from the lamp. b: scattering coefficient. p: phase function. I: the lamp's
intensity towards the scattering point. d1, d2: path lengths before and after it, from the law of sines. L * rho, with
rho the distance from the lamp in the picture, is smooth in (azimuth, log rho), so a small polar table gives all pixels.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from buddyline.node.sim.rig import beam
from buddyline.node.sim.scenario import Water
from buddyline.node.sim.scene import LAMP_RADIUS_M, Lamp
from numpy.typing import NDArray

Image = NDArray[np.float32]

COARSE: Final = 4
NEAR_PX: Final = 32.0
FAR_PX: Final = 64.0
BLUR_PX: Final = 0.8
AZIMUTHS: Final = 24
STEPS: Final = 30
NODES: Final = 8
RHO_MIN_PX: Final = 0.5
FORWARD_SHARE: Final = 0.7
"""Share of scattered light that goes on nearly straight, and counts as not scattered."""
SCALE_PX: Final = 900.0
"""Focal length, px, for which the pixel lengths of this module are given; they scale with it."""
PEAK_FORWARDNESS: Final = 0.97
SEEN_SD: Final = 5.0
GLARE: Final = 0.04
"""Share of a lamp's light that the lens spreads over a wide area."""


def phase(cos_angle: Image, water: Water) -> Image:
    """Return the phase function, 1/sr, at an angle from the forward direction: the sum of two Henyey-Greenstein's."""
    peak, rest = (
        (1 - g * g) / (4 * math.pi) * (1 + g * g - 2 * g * cos_angle) ** -1.5
        for g in (PEAK_FORWARDNESS, water.forwardness)
    )
    return np.asarray(water.peak_share * peak + (1 - water.peak_share) * rest, np.float32)


def through_water(water: Water) -> NDArray[np.float64]:
    """Return the attenuation of direct light, (3,), 1/m. Light that is scattered nearly forward still arrives."""
    return np.array(water.absorption_per_m) + (1 - FORWARD_SHARE) * np.array(water.scattering_per_m)


def flux_px(lamp: Lamp, water: Water, f_px: float) -> NDArray[np.float64]:
    """Return a lamp's direct (unscattered) light in the picture, (3,), in full scales times square pixels."""
    direct = np.exp(-through_water(water) * lamp.range_m) * lamp.towards_camera / lamp.range_m**2
    return np.asarray(water.lamp_gain * direct * f_px**2)


def core_px(lamp: Lamp, water: Water, f_px: float) -> float:
    """Return the approximate radius, px, within which a lamp clips green: that of its disc or of its glare."""
    scale = f_px / SCALE_PX
    flux = float(flux_px(lamp, water, f_px)[1]) / scale**2
    glare_px: float = scale * (GLARE / (2 * math.pi) * flux) ** 0.4
    return max(glare_px, LAMP_RADIUS_M * f_px / lamp.range_m + BLUR_PX)


def stands_out(lamp: Lamp, water: Water, f_px: float) -> bool:
    """Return whether a lamp's disc is brighter than the water by more than SEEN_SD times the pixel noise."""
    size_px, edge_px = _disc_px(lamp, f_px)
    area_px = math.pi * (size_px**2 + (math.pi * edge_px) ** 2 / 3)
    light = float(flux_px(lamp, water, f_px).max()) / area_px
    ambient = max(water.ambient)
    return 255.0 * (math.sqrt(ambient + light) - math.sqrt(ambient)) > SEEN_SD * water.noise


def _disc_px(lamp: Lamp, f_px: float) -> tuple[float, float]:
    """Return a lamp's radius in the picture, and the width of its blurred edge, both in px."""
    return LAMP_RADIUS_M * f_px / lamp.range_m * math.sqrt(lamp.stretch), BLUR_PX / 1.702 * lamp.stretch


class GlowRenderer:
    """Adds lamps to pictures of one size: their wide glow on a coarse grid, disc and near glow on the full one."""

    def __init__(self, water: Water, width_px: int, height_px: int, f_px: float) -> None:
        self._water = water
        self._f_px = f_px
        self._size_px = width_px, height_px
        self._k = through_water(water)
        self._b = np.array(water.scattering_per_m)
        shape = -(-height_px // COARSE), -(-width_px // COARSE)
        self.coarse_shape = shape
        self._coarse_u = ((np.arange(shape[1]) + 0.5) * width_px / shape[1] - 0.5).astype(np.float32)
        self._coarse_v = ((np.arange(shape[0]) + 0.5) * height_px / shape[0] - 0.5).astype(np.float32)
        self._scale = f_px / SCALE_PX
        reach = 1.6 * math.hypot(width_px, height_px)
        self._log_step = math.log(reach / RHO_MIN_PX) / (STEPS - 1)
        self._rho = (RHO_MIN_PX * np.exp(self._log_step * np.arange(STEPS))).astype(np.float32)
        azimuth = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
        self._ring = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
        x, w = np.polynomial.legendre.leggauss(NODES)
        self._node_x, self._node_w = ((x + 1) / 2).astype(np.float32), (w / 2).astype(np.float32)

    def table(self, lamp: Lamp) -> Image:
        """Return L * rho of a lamp's scattered light and glare, (STEPS, AZIMUTHS, 3); rho in px, L in full scales."""
        r = lamp.range_m
        source = lamp.position_m / r
        centre = lamp.position_m[:2] / lamp.position_m[2]
        offsets = self._rho[:, None, None] / self._f_px * self._ring
        rays = np.empty((STEPS, AZIMUTHS, 3), np.float64)
        rays[..., :2] = centre + offsets
        rays[..., 2] = 1.0
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        foot = rays * (rays @ source)[..., None] - source
        sin_psi = np.linalg.norm(foot, axis=-1)
        psi = np.arctan2(sin_psi, rays @ source).astype(np.float32)
        n = foot / sin_psi[..., None]
        span = np.log(np.pi / psi)
        phi = psi[..., None] * np.exp(span[..., None] * self._node_x)
        sin_phi = np.maximum(np.sin(phi), 1e-4)
        cos_phi = np.cos(phi)
        cos_beam = (
            sin_phi * (n @ lamp.aim).astype(np.float32)[..., None]
            - cos_phi * (rays @ lamp.aim).astype(np.float32)[..., None]
        )
        path_m = (r * (sin_psi.astype(np.float32)[..., None] + np.sin(phi - psi[..., None])) / sin_phi).astype(
            np.float32
        )
        weight = self._node_w * phi * span[..., None] * phase(cos_phi, self._water) * beam(cos_beam, lamp.beam_rad)
        table = np.empty((STEPS, AZIMUTHS, 3), np.float32)
        front = (self._rho[:, None] / (r * sin_psi)).astype(np.float32)
        for channel in range(3):
            scattered = np.einsum("ijk,ijk->ij", weight, np.exp(-self._k[channel] * path_m))
            table[..., channel] = scattered * front * self._b[channel]
        table *= self._water.lamp_gain * lamp.intensity
        rho = self._rho / self._scale
        glare = GLARE / (2 * np.pi * self._scale**2) / (rho * rho + 9.0) ** 1.25 * self._rho
        table += (glare[:, None] * flux_px(lamp, self._water, self._f_px)).astype(np.float32)[:, None, :]
        return table

    def add_wide(self, coarse: Image, lamp: Lamp, table: Image, rows: Image | None = None) -> None:
        """Add a lamp's light beyond NEAR_PX to the coarse picture. rows: (H,), the share of it that each row gets."""
        du = np.broadcast_to(self._coarse_u - np.float32(lamp.pixel[0]), self.coarse_shape)
        dv = np.broadcast_to(self._coarse_v[:, None] - np.float32(lamp.pixel[1]), self.coarse_shape)
        radiance, rho = self._look_up(table, du, dv)
        # Only a small box of the picture is near.
        reach = math.ceil(FAR_PX * self._scale / COARSE) + 1
        row, column = round(float(lamp.pixel[1]) / COARSE), round(float(lamp.pixel[0]) / COARSE)
        box = (
            slice(max(row - reach, 0), max(row + reach + 1, 0)),
            slice(max(column - reach, 0), max(column + reach + 1, 0)),
        )
        radiance[box] *= (1.0 - self._window(rho[box]))[..., None]
        if rows is not None:
            radiance *= np.interp(self._coarse_v, np.arange(len(rows)), rows).astype(np.float32)[:, None, None]
        coarse += radiance

    def add_near(self, full: Image, lamp: Lamp, table: Image, rows: Image | None = None) -> None:
        """Add a lamp's disc and its light within FAR_PX to the full picture. rows: as in add_wide."""
        reach = math.ceil(FAR_PX * self._scale) + 1
        u, v = float(lamp.pixel[0]), float(lamp.pixel[1])
        width_px, height_px = self._size_px
        u0, u1 = max(int(u) - reach, 0), min(int(u) + reach + 1, width_px)
        v0, v1 = max(int(v) - reach, 0), min(int(v) + reach + 1, height_px)
        if u0 >= u1 or v0 >= v1:
            return
        du, dv = np.meshgrid(
            np.arange(u0, u1, dtype=np.float32) - np.float32(u),
            (np.arange(v0, v1, dtype=np.float32) - np.float32(v)) / np.float32(lamp.stretch),
        )
        radiance, rho = self._look_up(table, du, dv)
        radiance *= self._window(rho)[..., None]
        size_px, edge_px = _disc_px(lamp, self._f_px)
        area_px = math.pi * (size_px**2 + (math.pi * edge_px) ** 2 / 3)
        near = rho < size_px + 14 * edge_px
        disc = 1.0 / (1.0 + np.exp((rho[near] - size_px) / edge_px))
        radiance[near] += disc[:, None] * (flux_px(lamp, self._water, self._f_px) / area_px).astype(np.float32)
        if rows is not None:
            radiance *= rows[v0:v1, None, None]
        full[v0:v1, u0:u1] += radiance

    def _look_up(self, table: Image, du: Image, dv: Image) -> tuple[Image, Image]:
        distance, azimuth = cv2.cartToPolar(du, dv)
        rho: Image = np.asarray(np.maximum(distance, np.float32(RHO_MIN_PX)), np.float32)
        row = np.log(rho * np.float32(1 / RHO_MIN_PX)) * np.float32(1 / self._log_step)
        column = np.asarray(azimuth, np.float32) * np.float32(AZIMUTHS / (2 * np.pi))
        closed = np.concatenate([table, table[:, :1]], axis=1)
        radiance = cv2.remap(closed, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(radiance, np.float32) / rho[..., None], rho

    def _window(self, rho: Image) -> Image:
        x = np.clip((FAR_PX - rho / np.float32(self._scale)) / np.float32(FAR_PX - NEAR_PX), 0, 1)
        return np.asarray(x * x * (3 - 2 * x), np.float32)
