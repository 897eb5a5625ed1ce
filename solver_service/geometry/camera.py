"""The inverse camera model: pixels to bearings, and pixel noise to bearing noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats

_MAX_STEPS = 30
_TOLERANCE = 1e-13
# Bearing and tangents at the optical axis, at a focal length of one.
_AHEAD = np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera, pixel centres at integers.

    distortion: OpenCV's k1 k2 p1 p2 k3 (pinhole) or k1..k4 (fisheye: equidistant).
    """

    model: Literal["pinhole", "fisheye"]
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] | Floats = ()

    def rays(self, pixels: Floats) -> tuple[Floats, Floats]:
        """Give the bearings (N, 3) of distorted pixels (N, 2) and their tangents (N, 2, 3), px per rad.

        For a direction q near the bearing b, tangent @ q / (b @ q) is how far q's image stands off the
        pixel, in px, to first order. Both are NaN where the model does not reach the pixel.
        """
        frames, _ = self.frames(pixels)
        return frames[:, 0], frames[:, 1:]

    def frames(self, pixels: Floats) -> tuple[Floats, Floats]:
        """Give each distorted pixel's (N, 2) bearing and two tangents, as `rays` has them, (N, 3, 3), and px^2 per sr.

        The second (N,) is the area in the picture over the solid angle there, NaN where the model does not reach.
        """
        distorted = (pixels - self._centre_px) / self._focal_px
        if self.model == "fisheye":
            return self._fisheye_frames(distorted[:, 0], distorted[:, 1])
        return self._pinhole_frames(distorted)

    def same_as(self, other: Camera) -> bool:
        """Whether both have the same lens; their pictures' sizes may differ."""
        mine, others = (
            (c.model, c.fx_px, c.fy_px, c.cx_px, c.cy_px, *(float(k) for k in c.distortion)) for c in (self, other)
        )
        return mine == others

    def bearings(self, pixels: Floats) -> Floats:
        """Give the unit bearings (N, 3) of distorted pixels (N, 2)."""
        return self.rays(pixels)[0]

    @property
    def area_px2(self) -> float:
        """The picture's area."""
        return float(self.width_px * self.height_px)

    @cached_property
    def _centre_px(self) -> Floats:
        return np.array((self.cx_px, self.cy_px))

    @cached_property
    def _focal_px(self) -> Floats:
        return np.array((self.fx_px, self.fy_px))

    @cached_property
    def _coefficients(self) -> list[float]:
        """The distortion, empty where there is none."""
        return [float(k) for k in self.distortion] if any(self.distortion) else []

    @cached_property
    def solid_angle_sr(self) -> float:
        """The solid angle that the picture covers."""
        columns, rows = 32, 24
        u = (np.arange(columns) + 0.5) * self.width_px / columns - 0.5
        v = (np.arange(rows) + 0.5) * self.height_px / rows - 0.5
        grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        with np.errstate(all="ignore"):
            _, px2_per_sr = self.frames(grid)
            angle = float(np.nansum(self.area_px2 / (columns * rows) / px2_per_sr))
        return angle if 0.0 < angle < 13.0 else 1.0

    @cached_property
    def half_view_rad(self) -> float:
        """The widest angle of the picture from the optical axis; pi where the model does not reach its corners."""
        right, below = self.width_px - 0.5, self.height_px - 0.5
        corners = np.array([(u, v) for u in (-0.5, right) for v in (-0.5, below)])
        with np.errstate(all="ignore"):
            ahead = float(self.frames(corners)[0][:, 0, 2].min())
        return math.acos(min(max(ahead, -1.0), 1.0)) if math.isfinite(ahead) else math.pi

    def _pinhole_frames(self, distorted: Floats) -> tuple[Floats, Floats]:
        frames = np.empty((len(distorted), 3, 3))
        frames[:] = _AHEAD
        bearings, tangents = frames[:, 0], frames[:, 1:]
        if self._coefficients:
            x, y = xd, yd = distorted[:, 0], distorted[:, 1]
            k1, k2, p1, p2, k3 = self._coefficients
            for _ in range(_MAX_STEPS):
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
                a00 = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
                a01 = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
                a11 = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
                ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - xd
                ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - yd
                det = a00 * a11 - a01 * a01
                dx = (a11 * ex - a01 * ey) / det
                dy = (a00 * ey - a01 * ex) / det
                x, y = x - dx, y - dy
                step = np.abs(dx) + np.abs(dy)
                if not (step > _TOLERANCE).any():
                    break
            # Past the fold of the distortion a solution is none: no scene point images there.
            x = np.where((step < 1e-9) & (det > 0.0) & (a00 + a11 > 0.0), x, np.nan)
            bearings[:, 0], bearings[:, 1] = x, y
            tangents[:, 0, 0], tangents[:, 0, 1] = a00, a01
            tangents[:, 1, 0], tangents[:, 1, 1] = a01, a11
            tangents[:, 0, 2], tangents[:, 1, 2] = -(a00 * x + a01 * y), -(a01 * x + a11 * y)
            area: Floats | float = det * (self.fx_px * self.fy_px)
        else:
            bearings[:, :2] = distorted
            np.negative(distorted, out=tangents[:, :, 2])
            area = self.fx_px * self.fy_px
        norm2 = np.add.reduce(bearings * bearings, 1)
        norm = np.sqrt(norm2)
        bearings /= norm[:, None]
        tangents *= (norm[:, None] * self._focal_px)[:, :, None]
        return frames, norm2 * norm * area

    def _fisheye_frames(self, xd: Floats, yd: Floats) -> tuple[Floats, Floats]:
        k1, k2, k3, k4 = self._coefficients or (0.0, 0.0, 0.0, 0.0)
        rd = np.sqrt(xd * xd + yd * yd)
        theta, slope, step = rd, np.ones_like(rd), np.zeros_like(rd)
        if self._coefficients:
            for _ in range(_MAX_STEPS):
                t2 = theta * theta
                value = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
                slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
                step = (value - rd) / slope
                theta = theta - step
                if not (np.abs(step) > _TOLERANCE).any():
                    break
        bad = ~((np.abs(step) < 1e-9) & (slope > 0.0) & (theta >= 0.0) & (theta < np.pi))
        theta = np.where(bad, np.nan, theta)
        centre = rd < 1e-12
        safe = np.where(centre, 1.0, rd)
        cos_phi, sin_phi = np.where(centre, 1.0, xd / safe), yd / safe
        sin_theta, cos_theta = np.sin(theta), np.cos(theta)
        across = np.where(centre, 1.0, rd / np.where(centre, 1.0, sin_theta))
        outward = np.stack((cos_theta * cos_phi, cos_theta * sin_phi, -sin_theta), axis=-1)
        around = np.stack((-sin_phi, cos_phi, np.zeros_like(rd)), axis=-1)
        frames = np.empty((len(rd), 3, 3))
        frames[:, 0] = np.stack((sin_theta * cos_phi, sin_theta * sin_phi, cos_theta), axis=-1)
        along, sideways = slope[:, None] * outward, across[:, None] * around
        frames[:, 1] = self.fx_px * (cos_phi[:, None] * along - sin_phi[:, None] * sideways)
        frames[:, 2] = self.fy_px * (sin_phi[:, None] * along + cos_phi[:, None] * sideways)
        return frames, (self.fx_px * self.fy_px) * slope * across
