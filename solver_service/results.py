"""Convert messages to the geometry's types, and a fix to the message that is published."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from buddyline.protocol.messages import Attitude, Blob, Candidates, Depth, NodeInfo, RelativePose
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.compasses import north_doubt
from buddyline.solver_service.geometry.direction import direction_of
from buddyline.solver_service.geometry.rotation import Floats, quat_to_matrix, skew
from buddyline.solver_service.geometry.trigger import Fix, Rig, Sensed, View
from buddyline.solver_service.sensors import SampleStream, attitude_at, depth_at
from buddyline.solver_service.track.anchors import attitude_covariance
from msgspec import UNSET
from msgspec.structs import replace

# Where the border cuts a light, the light may be off by up to the depth of the cut, either way: 1 sd over that depth.
_CUT_SHARE: Final = 3.0**-0.5
# What absurd but finite values lead to, such as a depth of 1e308 m. Any other error is a fault of this program.
NUMERIC_ERRORS: Final = (ArithmeticError, np.linalg.LinAlgError)


def rig_of(info: NodeInfo) -> Rig:
    """Return a node's calibration as the geometry's Rig."""
    camera = info.camera
    return Rig(
        camera=Camera(
            camera.model,
            info.width_px,
            info.height_px,
            camera.fx_px,
            camera.fy_px,
            camera.cx_px,
            camera.cy_px,
            np.array(camera.distortion),
        ),
        lights_m=np.array([info.light_left_m, info.light_right_m]),
        R_body_camera=quat_to_matrix(np.array(info.q_body_camera_xyzw)),
        depth_port_m=np.array(info.depth_port_m),
        declination_rad=info.declination_rad,
    )


def view_of(frame: Candidates) -> View:
    """Return a frame's candidates as arrays; a missing score becomes NaN.

    The sigma of a candidate that reaches over the picture's border is widened: its own is of the part inside alone.
    """
    rows = [
        (
            blob.u_px,
            blob.v_px,
            math.hypot(blob.sigma_px, _CUT_SHARE * _cut_px(blob, frame)),
            math.nan if blob.score is UNSET else blob.score,
            blob.area_px,
            1e-9 * blob.dt_ns,
            0.0 if blob.lasting_s is UNSET else blob.lasting_s,
        )
        for blob in frame.blobs
    ]
    elsewhere = 0 if frame.elsewhere is UNSET else frame.elsewhere
    return View(np.array(rows, dtype=np.float64).reshape(-1, 7), frame.stamp_ns, elsewhere)


def _cut_px(blob: Blob, frame: Candidates) -> float:
    """Return how deep the picture's border cuts into a candidate, taken as a disk of its area."""
    right_px, below_px = frame.width_px - 1 - blob.u_px, frame.height_px - 1 - blob.v_px
    return max(math.sqrt(blob.area_px / math.pi) - min(blob.u_px, blob.v_px, right_px, below_px), 0.0)


def wrong_size(frame: Candidates, info: NodeInfo) -> str:
    """Return the sizes of a frame and of its calibration's pictures where they differ, else ""."""
    if (frame.width_px, frame.height_px) == (info.width_px, info.height_px):
        return ""
    return f"{frame.width_px}x{frame.height_px} px, its calibration {info.width_px}x{info.height_px}"


def sensed_of(attitude: SampleStream[Attitude], depth: SampleStream[Depth], stamp_ns: int) -> Sensed:
    """Return a node's attitude and depth at stamp_ns; each is None if unknown."""
    oriented = attitude_at(attitude, stamp_ns)
    immersed = depth_at(depth, stamp_ns)
    return Sensed(
        q_ned_body_xyzw=oriented[0] if oriented else None,
        sigma_rad=oriented[1] if oriented else None,
        depth_m=immersed[0] if immersed else None,
        depth_sigma_m=immersed[1] if immersed else None,
    )


def relative_pose(
    frame_a: Candidates, frame_b: Candidates, rig_a: Rig, sensed: tuple[Sensed, Sensed], fix: Fix
) -> RelativePose:
    """Return the message for a fix. Its values in NED are computed with A's attitude, and absent without.

    Where B's compass contradicts A's, either may be wrong: their sigmas hold it.
    """
    pose = RelativePose(
        node_a=frame_a.node,
        node_b=frame_b.node,
        stamp_ns=(frame_a.stamp_ns + frame_b.stamp_ns) // 2,
        trigger=frame_a.trigger,
        t_a_b_m=tuple(fix.t_a_b_m.tolist()),
        q_a_b_xyzw=tuple(fix.q_a_b_xyzw.tolist()),
        covariance=fix.covariance.ravel().tolist(),
        range_m=math.sqrt(float(fix.t_a_b_m @ fix.t_a_b_m)),
        range_a_m=float(fix.range_a_m),
        range_b_m=float(fix.range_b_m),
        range_gap_m=float(fix.range_gap_m),
        twist_gap_rad=float(fix.twist_gap_rad),
        chi2=float(fix.chi2),
        hypotheses=int(fix.hypotheses),
        blobs_a=fix.pair_a,
        blobs_b=fix.pair_b,
        method=fix.method,
        checks=list(fix.checks),
        skew_ns=frame_a.stamp_ns - frame_b.stamp_ns,
        heading_gap_rad=UNSET if fix.heading is None else fix.heading.gap_rad,
    )
    of_a, of_b = sensed
    if of_a.q_ned_body_xyzw is None or of_a.sigma_rad is None:
        return pose
    sigma_rad = of_a.sigma_rad
    if fix.heading is not None and of_b.sigma_rad is not None:
        stated = np.array((sigma_rad[2], of_b.sigma_rad[2])) ** 2
        doubt = north_doubt(np.array((0.0, -fix.heading.gap_rad)), stated, np.diag((0.0, fix.heading.variance)))
        sigma_rad = np.array((*sigma_rad[:2], math.sqrt(stated[0] + doubt)))
    return in_ned(pose, rig_a.R_body_camera, of_a.q_ned_body_xyzw, sigma_rad)


def in_ned(pose: RelativePose, R_body_camera: Floats, q_ned_body_xyzw: Floats, sigma_rad: Floats) -> RelativePose:
    """Return a pose with its position in north-east-down, its angles and the sigmas of both.

    q_ned_body_xyzw (4,): A's attitude; sigma_rad (3,): of its roll, pitch and yaw. With t_ned = R_ned_camera t and an
    attitude that is off by a small rotation phi, dt_ned = R_ned_camera dt + phi x t_ned. phi counts as independent of
    the fix, whose position comes from the pictures. Where a sigma is out of numeric range, nothing is added.
    """
    R_ned_body = quat_to_matrix(q_ned_body_xyzw)
    R_ned_camera = R_ned_body @ R_body_camera
    t_ned_m = R_ned_camera @ np.array(pose.t_a_b_m)
    of_position = np.array(pose.covariance).reshape(6, 6)[:3, :3]
    arm = skew(t_ned_m)
    with np.errstate(all="ignore"):
        of_attitude = attitude_covariance(R_ned_body, sigma_rad, 1.0, 1.0)
        covariance = R_ned_camera @ of_position @ R_ned_camera.T + arm @ of_attitude @ arm.T
    if not np.isfinite(covariance).all():
        return pose
    north_m, east_m, down_m = t_ned_m.tolist()
    sigma_n_m, sigma_e_m, sigma_d_m = np.sqrt(np.diag(covariance)).tolist()
    return replace(
        pose,
        t_ned_m=(north_m, east_m, down_m),
        sigma_ned_m=(sigma_n_m, sigma_e_m, sigma_d_m),
        **vars(direction_of(t_ned_m, covariance)),
    )
