"""Messages as the track and the network take them, and what these tell as messages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, ExpectedLight, NodeInfo, RelativePose, Track, TrackMode
from buddyline.solver_service.geometry.observation import View
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats, quat_to_matrix, rotation_exp
from buddyline.solver_service.track.foresight import ForeseenLight
from buddyline.solver_service.track.inputs import Attitudes, FixSeen, FrameSeen, TrackNode
from buddyline.solver_service.track.output import TrackRow
from msgspec import UNSET, structs


def track_message(row: TrackRow, node_a: str, node_b: str, mode: TrackMode, *, oriented: bool) -> Track:
    """Return the message for a row; oriented: whether an attitude says where north is."""
    return Track(
        node_a=node_a,
        node_b=node_b,
        stamp_ns=row.stamp_ns,
        t_a_b_m=_triple(row.t_a_b_m),
        q_a_b_xyzw=tuple(row.q_a_b_xyzw.tolist()),
        covariance=row.covariance.ravel().tolist(),
        v_a_b_mps=_triple(row.v_a_b_mps),
        v_covariance=row.v_covariance.ravel().tolist(),
        mode=mode,
        lights=row.lights,
        age_s=row.age_s,
        range_m=row.range_m,
        t_ned_m=_triple(row.t_ned_m) if oriented else UNSET,
        sigma_ned_m=_triple(row.sigma_ned_m) if oriented else UNSET,
        azimuth_rad=row.azimuth_rad if oriented else UNSET,
        sigma_azimuth_rad=row.sigma_azimuth_rad if oriented else UNSET,
        inclination_rad=row.inclination_rad if oriented else UNSET,
        sigma_inclination_rad=row.sigma_inclination_rad if oriented else UNSET,
    )


def expected_light(seen: ForeseenLight) -> ExpectedLight:
    """Return where a light should be seen, as `Expect` has it."""
    (uu, uv), (_, vv) = seen.covariance_px2.tolist()
    return ExpectedLight(
        side="left" if seen.light == 0 else "right",
        u_px=float(seen.pixel_px[0]),
        v_px=float(seen.pixel_px[1]),
        covariance_px2=(uu, uv, vv),
        rate_pxps=(float(seen.rate_pxps[0]), float(seen.rate_pxps[1])),
        sigma_rate_pxps=seen.sigma_rate_pxps,
    )


def track_node_of(info: NodeInfo, rig: Rig) -> TrackNode:
    """Return a node's constants as the track and the network take them."""
    return TrackNode(
        name=info.node,
        rig=rig,
        imu_m=None if info.imu_m is UNSET else np.array(info.imu_m),
        imu_delay_ns=None if info.imu_delay_ns is UNSET else info.imu_delay_ns,
    )


def same_rig(info: NodeInfo, other: NodeInfo) -> bool:
    """Whether two calibrations are one, whenever each was stated."""
    return info is other or info == structs.replace(other, stamp_ns=info.stamp_ns)


def frame_of(view: View) -> FrameSeen:
    """Return a frame as the track and the network take it."""
    dt_ns = np.rint(view.dt_s * S_NS).astype(np.int64)
    return FrameSeen(view.stamp_ns, view.pixels, view.sigma_px, dt_ns, view.elsewhere, view.lasting_s)


def attitudes_of(messages: Sequence[Attitude], first: Rig, own: Rig) -> Attitudes:
    """Return a node's attitudes from the north of the first node's, which may have another declination."""
    R = quat_to_matrix(np.array([message.q_ned_body_xyzw for message in messages]).reshape(-1, 4))
    if first.declination_rad != own.declination_rad:
        R = rotation_exp(np.array([0.0, 0.0, first.declination_rad - own.declination_rad])) @ R
    sigmas_rad = np.array([message.sigma_rad for message in messages]).reshape(-1, 3)
    return Attitudes(np.array([message.stamp_ns for message in messages], dtype=np.int64), R, sigmas_rad)


def fix_of(pose: RelativePose) -> FixSeen:
    """Return a pose as the track and the network take it."""
    return FixSeen(
        stamp_ns=pose.stamp_ns,
        t_a_b_m=np.array(pose.t_a_b_m),
        R_a_b=quat_to_matrix(np.array(pose.q_a_b_xyzw)),
        covariance=np.array(pose.covariance).reshape(6, 6),
    )


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
