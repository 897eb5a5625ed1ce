"""Between messages and geometry: what the solver computes with, and the pose it publishes."""

from __future__ import annotations

import math

import numpy as np
from buddyline.protocol.messages import Attitude, Candidates, Depth, NodeInfo, RelativePose
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.solver_service.geometry.trigger import Fix, Rig, Sensed, View
from buddyline.solver_service.sensors import SampleStream, attitude_at, depth_at
from msgspec import UNSET


def rig_of(info: NodeInfo) -> Rig:
    """Return a node's calibration as the geometry takes it."""
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
    """Return a frame's candidates as arrays; an unknown score is NaN."""
    rows = [
        (
            blob.u_px,
            blob.v_px,
            blob.sigma_px,
            math.nan if blob.score is UNSET else blob.score,
            blob.area_px,
            blob.peak,
            1e-9 * blob.dt_ns,
        )
        for blob in frame.blobs
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    _, _, sigma_px, score, area_px, peak, dt_s = table.T
    return View(table[:, :2], sigma_px, score, area_px, peak, dt_s, frame.stamp_ns)


def sensed_of(attitude: SampleStream[Attitude], depth: SampleStream[Depth], stamp_ns: int) -> Sensed:
    """Return a node's attitude and depth at stamp_ns, each None where unknown."""
    oriented = attitude_at(attitude, stamp_ns)
    immersed = depth_at(depth, stamp_ns)
    return Sensed(
        q_ned_body_xyzw=oriented[0] if oriented else None,
        sigma_rad=oriented[1] if oriented else None,
        depth_m=immersed[0] if immersed else None,
        depth_sigma_m=immersed[1] if immersed else None,
    )


def relative_pose(frame_a: Candidates, frame_b: Candidates, rig_a: Rig, sensed_a: Sensed, fix: Fix) -> RelativePose:
    """Return the message for a fix; azimuth and inclination follow A's attitude."""
    t_ned_m = None
    if sensed_a.q_ned_body_xyzw is not None:
        t_ned_m = quat_to_matrix(sensed_a.q_ned_body_xyzw) @ rig_a.R_body_camera @ fix.t_a_b_m
    return RelativePose(
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
        t_ned_m=UNSET if t_ned_m is None else tuple(t_ned_m.tolist()),
        azimuth_rad=UNSET if t_ned_m is None else math.atan2(t_ned_m[1], t_ned_m[0]) % (2 * math.pi),
        inclination_rad=UNSET if t_ned_m is None else -math.atan2(t_ned_m[2], math.hypot(t_ned_m[0], t_ned_m[1])),
    )
