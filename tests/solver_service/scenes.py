"""Simulated triggers with their truth, and the forward camera model, for the geometry's tests."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.observation import Observation, Sensed, View
from buddyline.solver_service.geometry.rig import NOMINAL_R_BODY_CAMERA, Rig
from buddyline.solver_service.geometry.trigger import read_triggers

HD = Camera("pinhole", 1640, 1232, 1800.0, 1800.0, 819.5, 615.5)
IDEAL = Rig(HD, np.array([[-0.44, 0.0, 0.0], [0.44, 0.0, 0.0]]))
ODD_A = Rig(HD, np.array([[-0.44, -0.15, 0.05], [0.5, 0.1, -0.02]]))
ODD_B = Rig(HD, np.array([[-0.3, -0.05, 0.05], [0.33, 0.0, -0.02]]))
# As in geometry.md's table of simulated choices.
TILT_SIGMA_RAD, HEADING_SIGMA_RAD, DEPTH_SIGMA_M = math.radians(1.0), math.radians(3.5), 0.02


def project(camera: Camera, points):
    """Give the pixels (..., 2) of points (..., 3) in the camera's frame; NaN behind it."""
    x, y, z = np.moveaxis(np.asarray(points, dtype=float), -1, 0)
    k = list(camera.distortion) or [0.0] * 5
    if camera.model == "fisheye":
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        t2 = theta**2
        scale = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / np.where(r > 0, r, 1.0)
        xd, yd = x * scale, y * scale
    else:
        x, y = x / np.where(z > 0, z, np.nan), y / np.where(z > 0, z, np.nan)
        r2 = x * x + y * y
        radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
        xd = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
        yd = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y
    return np.stack((camera.fx_px * xd + camera.cx_px, camera.fy_px * yd + camera.cy_px), axis=-1)


def rotation(axis, angle_rad):
    """Rodrigues, one rotation."""
    axis = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + math.sin(angle_rad) * K + (1 - math.cos(angle_rad)) * K @ K


def quaternion(R):
    """Give the quaternion (x, y, z, w) as the null vector of its defining equations."""
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]],
            [R[0, 1] + R[1, 0], R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]],
            [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )
    return np.linalg.eigh(K)[1][:, 3]


@dataclass
class PairScene:
    """One true pose and what it takes to see it."""

    rig_a: Rig
    rig_b: Rig
    t: np.ndarray
    R: np.ndarray
    R_ned_a: np.ndarray
    depth_a_m: float = 10.0
    clear_a: np.ndarray = field(init=False)
    clear_b: np.ndarray = field(init=False)

    def __post_init__(self):
        self.clear_a = project(self.rig_a.camera, self.rig_b.lights_m @ self.R.T + self.t)
        self.clear_b = project(self.rig_b.camera, (self.rig_a.lights_m - self.t) @ self.R)

    @property
    def visible(self):
        return all(
            np.isfinite(p).all()
            and (p > 0).all()
            and (p[:, 0] < r.camera.width_px - 1).all()
            and (p[:, 1] < r.camera.height_px - 1).all()
            for p, r in ((self.clear_a, self.rig_a), (self.clear_b, self.rig_b))
        )

    def views(self, rng=None, sigma_px=0.0, false=0, stated_px=None):
        """Both views, candidates shuffled, and where the true ones stand: (left, right) in each."""
        out = []
        for clear, rig in ((self.clear_a, self.rig_a), (self.clear_b, self.rig_b)):
            size = rig.camera.width_px, rig.camera.height_px
            pixels = np.concatenate(
                (
                    clear + (sigma_px * rng.standard_normal((2, 2)) if sigma_px else 0.0),
                    rng.uniform((0, 0), size, (false, 2)) if false else np.empty((0, 2)),
                )
            )
            order = rng.permutation(len(pixels)) if false else np.arange(2)
            at = np.argsort(order)[:2]
            out.append((view(pixels[order], stated_px or sigma_px or 1.0), (int(at[0]), int(at[1]))))
        return out

    def sensed(self, rng=None, heading_error_rad=0.0, depth_error_m=0.0):
        """Attitude and depth of both nodes, with noise where rng is given."""
        noise = (lambda s: 0.0) if rng is None else (lambda s: s * rng.standard_normal())
        out = []
        R_ned_b = self.R_ned_a @ self.R
        depth_b = self.depth_a_m + (self.R_ned_a @ self.t)[2]
        for R_ned, depth, wrong in (
            (self.R_ned_a, self.depth_a_m, (heading_error_rad, depth_error_m)),
            (R_ned_b, depth_b, (0.0, 0.0)),
        ):
            R = R_ned @ NOMINAL_R_BODY_CAMERA.T
            R = rotation((0, 0, 1), noise(HEADING_SIGMA_RAD) + wrong[0]) @ R
            R = R @ rotation((1, 0, 0), noise(TILT_SIGMA_RAD)) @ rotation((0, 1, 0), noise(TILT_SIGMA_RAD))
            sigma = np.array((TILT_SIGMA_RAD, TILT_SIGMA_RAD, HEADING_SIGMA_RAD))
            out.append(Sensed(quaternion(R), sigma, depth + noise(DEPTH_SIGMA_M) + wrong[1], DEPTH_SIGMA_M))
        return out


def solve_trigger(views, rigs, sensed, settings, prior=None):
    """Solve one trigger alone; views, rigs, sensed: A's and B's."""
    return read_triggers([Observation(*views, *sensed)], *rigs, settings).decide(0, prior, None)


def view(pixels, sigma_px=1.0, dt_s=0.0, stamp_ns=0, score=math.nan):
    """A view of bare pixels."""
    n = len(pixels)
    return View.of(
        pixels=np.asarray(pixels, dtype=float).reshape(-1, 2),
        sigma_px=np.full(n, float(sigma_px)),
        score=np.full(n, score),
        area_px=np.full(n, 100.0),
        dt_s=np.full(n, dt_s),
        stamp_ns=stamp_ns,
    )


def random_scene(rng, range_m, rig_a=IDEAL, rig_b=IDEAL, roll_rad=0.2, lean_rad=0.2):
    """A pose at range_m (or within (low, high)) with all four lights in view, both divers about upright."""
    camera = rig_a.camera
    while True:
        r = rng.uniform(*range_m) if isinstance(range_m, tuple) else range_m
        # Near bars stay in view only about the middle: nothing else need be tried.
        edge = min(0.4 * rig_b.length_m / r * camera.fx_px, 0.45 * camera.width_px)
        pixel = rng.uniform((edge, 0), (camera.width_px - edge, camera.height_px), (1, 2))
        u = camera.bearings(pixel)[0]
        R_ned_a = upright(rng.uniform(-math.pi, math.pi), rng.normal(0, lean_rad), rng.normal(0, roll_rad))
        back = -R_ned_a @ u
        heading = math.atan2(back[1], back[0]) + rng.normal(0, lean_rad)
        R_ned_b = upright(heading, -math.asin(back[2]) + rng.normal(0, lean_rad), rng.normal(0, roll_rad))
        scene = PairScene(rig_a, rig_b, r * u, R_ned_a.T @ R_ned_b, R_ned_a, rng.uniform(2, 40))
        if scene.visible:
            return scene


def upright(heading_rad, pitch_rad, roll_rad):
    """Camera to NED of the nominal mount."""
    R_ned_body = rotation((0, 0, 1), heading_rad) @ rotation((0, 1, 0), pitch_rad) @ rotation((1, 0, 0), roll_rad)
    return R_ned_body @ NOMINAL_R_BODY_CAMERA
