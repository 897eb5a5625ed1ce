"""Two nodes that both look at a third party's bar: what they publish, and where they truly are."""

from __future__ import annotations

import math

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Blob, Candidates, Depth, NodeInfo
from buddyline.protocol.messages import CameraModel as Model
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rig import NOMINAL_R_BODY_CAMERA
from buddyline.solver_service.geometry.rotation import matrix_to_quat

from tests.solver_service.scenes import project, upright

START_NS = 1_764_000_000_000_000_000
PERIOD_NS = 200_000_000
WIDTH, HEIGHT, F_PX, SIGMA_PX = 820, 616, 900.0, 0.7
CAMERA = Camera("pinhole", WIDTH, HEIGHT, F_PX, F_PX, 409.5, 307.5)
BAR_M = np.array([[-0.44, 0.0, 0.0], [0.44, 0.0, 0.0]])
NAMES = ("b", "c")


def third_bar_dive(seed, range_m, apart_deg, compass_deg, dead_lamp=None, triggers=12, false=2):
    """Return all messages of b and c, and the true t_b_c of each trigger.

    Both stand range_m from the bar's middle, apart_deg from each other as seen from there, about level. compass_deg: 1
    sd of each compass, most of it for the whole dive. dead_lamp: of c, 0 left, 1 right.
    """
    rng = np.random.default_rng((seed, round(100 * range_m), round(apart_deg), round(compass_deg)))
    sigma_rad = math.radians(compass_deg)
    bias_rad = 0.9 * sigma_rad * rng.standard_normal(2)
    turned_rad = rng.uniform(-math.pi, math.pi)
    # The bar is about square to the middle of both, so that each sees its lights apart.
    half_rad = math.radians(apart_deg) / 2
    across = upright(turned_rad + rng.normal(0, 0.1), 0, rng.normal(0, 0.02))
    aims_rad = rng.normal(0, 0.08, 2)
    messages = [info(name) for name in NAMES]
    truths = {}
    for k in range(triggers):
        stamp_ns = START_NS + k * PERIOD_NS
        sway_rad = 0.02 * math.sin(0.5 * k)
        poses = []
        for node, side in enumerate((-1, 1)):
            toward_rad = turned_rad + side * half_rad
            R = upright(toward_rad + aims_rad[node] + sway_rad, rng.normal(0, 0.02), rng.normal(0, 0.02))
            at = -range_m * np.array([math.cos(toward_rad), math.sin(toward_rad), 0.0])
            poses.append((R, at + rng.normal(0, 0.002 * range_m, 3)))
        truths[stamp_ns // PERIOD_NS] = poses[0][0].T @ (poses[1][1] - poses[0][1])
        for node, name in enumerate(NAMES):
            R, at = poses[node]
            R_other, at_other = poses[1 - node]
            own = BAR_M @ R_other.T + at_other
            if dead_lamp is not None and node == 0:
                own = np.delete(own, dead_lamp, axis=0)
            lamps = np.concatenate((BAR_M @ across.T, own))
            pixels = project(CAMERA, (lamps - at) @ R)
            pixels = pixels[np.isfinite(pixels).all(1)] + 0.0
            pixels = pixels + SIGMA_PX * rng.standard_normal(pixels.shape)
            pixels = np.concatenate((pixels, rng.uniform((0, 0), (WIDTH, HEIGHT), (false, 2))))
            inside = ((pixels > 0) & (pixels < (WIDTH - 1, HEIGHT - 1))).all(1)
            messages += sensors(
                name, stamp_ns, R, at, bias_rad[node] + 0.4 * sigma_rad * rng.standard_normal(), rng, sigma_rad
            )
            messages.append(frame(name, stamp_ns, k, rng.permutation(pixels[inside])))
    return messages, truths


def info(name):
    return NodeInfo(
        node=name, stamp_ns=START_NS - S_NS, width_px=WIDTH, height_px=HEIGHT,
        camera=Model(model="pinhole", fx_px=F_PX, fy_px=F_PX, cx_px=409.5, cy_px=307.5, distortion=[0.0] * 5),
        light_left_m=tuple(BAR_M[0]), light_right_m=tuple(BAR_M[1]), sigma_px=SIGMA_PX, trigger_period_ns=PERIOD_NS,
        row_time_ns=0, q_body_camera_xyzw=tuple(matrix_to_quat(NOMINAL_R_BODY_CAMERA).tolist()),
        depth_port_m=(0.0, 0.0, 0.0), software="test",
    )  # fmt: skip


def sensors(name, stamp_ns, R_ned_camera, at, heading_error_rad, rng, sigma_rad):
    c, s = math.cos(heading_error_rad), math.sin(heading_error_rad)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ R_ned_camera @ NOMINAL_R_BODY_CAMERA.T
    sigmas = math.radians(1.0), math.radians(1.0), sigma_rad
    return [
        Attitude(node=name, stamp_ns=stamp_ns, q_ned_body_xyzw=tuple(matrix_to_quat(R).tolist()), sigma_rad=sigmas),
        Depth(node=name, stamp_ns=stamp_ns, depth_m=10.0 + at[2] + 0.02 * rng.standard_normal(), sigma_m=0.02,
              pressure_pa=2e5, temperature_degc=20.0),
    ]  # fmt: skip


def frame(name, stamp_ns, seq, pixels):
    blobs = [
        Blob(u_px=float(u), v_px=float(v), sigma_px=SIGMA_PX, area_px=60.0, peak=255.0, elongation=1.0, dt_ns=0)
        for u, v in pixels
    ]
    return Candidates(
        node=name, stamp_ns=stamp_ns, trigger=stamp_ns // PERIOD_NS, seq=seq, boot="test", width_px=WIDTH,
        height_px=HEIGHT, blobs=blobs, truncated=0,
    )  # fmt: skip


def is_wrong(pose, t_true):
    """Whether a pose is off by more than a tenth of the range and three of its sigmas."""
    off = np.subtract(pose.t_a_b_m, t_true)
    covariance = np.array(pose.covariance).reshape(6, 6)[:3, :3]
    far = np.linalg.norm(off) > 0.1 * np.linalg.norm(t_true)
    return bool(far and off @ np.linalg.solve(covariance, off) > 9.0)
