"""What to do for a fix: how to turn the nodes so that each sees the other's lights, from where they last were."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.rotation import Floats, quat_to_matrix
from buddyline.tools.estimate import sigma_m

if TYPE_CHECKING:
    from buddyline.protocol.messages import NodeInfo
    from buddyline.tools.estimate import Estimate
    from buddyline.tools.monitor.picture import PairPicture

# A light this share of the half field of view off the axis is well in the picture.
WELL_INSIDE: Final = 0.8
# Smaller turns are not worth a word; a diver turns in steps.
STEP_DEG: Final = 5
# An older place, or a place worse than this share of the range, tells no direction.
OLD_S: Final = 20.0
VAGUE_SHARE: Final = 0.2


def turns(picture: PairPicture, now_ns: int) -> list[str]:
    """Return what each node should do to see the other, such as "turn b 20 deg left"; empty where it is not known."""
    newest = max(
        ((at_ns, each) for at_ns, each in ((picture.track_ns, picture.track), (picture.pose_ns, picture.pose)) if each),
        key=lambda one: one[0] or 0,
        default=(None, None),
    )
    at_ns, estimate = newest
    a, b = picture.end_nodes()
    if at_ns is None or estimate is None or a is None or b is None or a.info is None or b.info is None:
        return []
    if now_ns - at_ns > OLD_S * S_NS or sigma_m(estimate) > VAGUE_SHARE * estimate.range_m:
        return []
    said = []
    for name, own, lights_m in (
        (a.node, a.info, lights_in_a(estimate, b.info)),
        (b.node, b.info, lights_in_b(estimate, a.info)),
    ):
        words = _turn(own, lights_m)
        if words:
            said.append(f"turn {name} {words}")
    return said


def lights_in_a(estimate: Estimate, info_b: NodeInfo) -> Floats:
    """Return B's lights (2, 3) in A's camera frame."""
    R_a_b, t_m = quat_to_matrix(np.array(estimate.q_a_b_xyzw)), np.array(estimate.t_a_b_m)
    lights_m: Floats = np.array((info_b.light_left_m, info_b.light_right_m)) @ R_a_b.T + t_m
    return lights_m


def lights_in_b(estimate: Estimate, info_a: NodeInfo) -> Floats:
    """Return A's lights (2, 3) in B's camera frame."""
    R_a_b, t_m = quat_to_matrix(np.array(estimate.q_a_b_xyzw)), np.array(estimate.t_a_b_m)
    lights_m: Floats = (np.array((info_a.light_left_m, info_a.light_right_m)) - t_m) @ R_a_b
    return lights_m


def _turn(info: NodeInfo, lights_m: Floats) -> str:
    """Return the turn that brings both lights well into a node's picture; "" where they are.

    Angles are those of the camera: right is clockwise seen from above, for a camera that is upright.
    """
    camera = info.camera
    half_rad = math.atan(info.width_px / 2 / camera.fx_px), math.atan(info.height_px / 2 / camera.fy_px)
    right_rad = np.arctan2(lights_m[:, 0], lights_m[:, 2])
    down_rad = np.arctan2(lights_m[:, 1], np.hypot(lights_m[:, 0], lights_m[:, 2]))
    words = []
    for angles_rad, limit_rad, (plus, minus) in (
        (right_rad, half_rad[0], ("right", "left")),
        (down_rad, half_rad[1], ("down", "up")),
    ):
        if np.abs(angles_rad).max() <= WELL_INSIDE * limit_rad:
            continue
        middle_deg = math.degrees(float(np.angle(np.exp(1j * angles_rad).sum())))
        rounded = STEP_DEG * round(abs(middle_deg) / STEP_DEG)
        if rounded:
            words.append(f"{rounded} deg {plus if middle_deg > 0 else minus}")
    return " and ".join(words)
