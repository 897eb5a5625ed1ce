"""T_a_b from the tags that both nodes see of each other: least squares over all corners of both pictures.

False readings, and tags that are not on a node, do not fit the layouts together with the others. So the largest set
of readings that one pose explains is used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from buddyline.protocol.messages import CameraModel
from buddyline.solver_service.geometry.rotation import skew
from buddyline.tools.evaluation.rotation import (
    Floats,
    conjugate,
    from_rotation_vector,
    multiply,
    normalized,
    rotate,
    rotation_vector,
)
from buddyline.tools.tags.layout import Layout

# Noise of a refined corner, per axis, and its weight against a picture's own residuals, as a number of residuals.
CORNER_SIGMA_PX: Final = 0.5
_PRIOR_COUNT: Final = 16
# Largest residual of readings that one pose explains, RMS per axis.
_FIT_PX: Final = 1.5
# A second pose that is this much less likely (chi-square) does not count; poses nearer than this are the same.
_RIVAL_CHI2: Final = 9.0
_SAME_RAD: Final = 0.1
# A single tag cannot be checked: it may be false, and glow at a corner can turn it unnoticed.
_READINGS: Final = 2
_STEPS: Final = 25
# Nodes do not come nearer to each other than this.
_NEAR_M: Final = 0.05


@dataclass(frozen=True, eq=False)
class TagReading:
    """One tag read in one picture. points_m: (4, 3), where the layout has its corners, in the other node's frame.

    rays: (4, 2), corners as x/z, y/z; focal_px: (2,); by_a: whether A's camera saw it.
    """

    points_m: Floats
    rays: Floats
    focal_px: Floats
    by_a: bool


@dataclass(frozen=True, eq=False)
class TagPose:
    """T_a_b from tags. covariance: (6, 6), as RelativePose has it. chi2: of the residuals over CORNER_SIGMA_PX.

    range_a_m, range_b_m: from A's and B's picture alone (the joint one where that shows no tag). twist_gap_rad:
    difference of the rotations about the line of sight that each picture gives alone, 0 if one shows no tag.
    readings: how many were used; left_out: how many did not fit. residual_px: RMS per axis.
    """

    t_a_b_m: Floats
    q_a_b_xyzw: Floats
    covariance: Floats
    chi2: float
    range_a_m: float
    range_b_m: float
    twist_gap_rad: float
    readings: int
    left_out: int
    residual_px: float


@dataclass(frozen=True, eq=False)
class _TagFit:
    t_m: Floats
    q_xyzw: Floats
    squares_px2: float
    information: Floats


def readings_of(
    found: Mapping[int, Sequence[Floats]], layout: Layout, camera: CameraModel, *, by_a: bool
) -> list[TagReading]:
    """Return a picture's readings of the other node's tags; found: by id, corners (4, 2) px."""
    matrix = np.array([[camera.fx_px, 0.0, camera.cx_px], [0.0, camera.fy_px, camera.cy_px], [0.0, 0.0, 1.0]])
    undistort = cv2.fisheye.undistortPoints if camera.model == "fisheye" else cv2.undistortPoints
    focal_px = np.array([camera.fx_px, camera.fy_px])
    distortion = np.array(camera.distortion)
    return [
        TagReading(
            layout.corners_m[tag_id],
            np.asarray(undistort(corners.reshape(-1, 1, 2), matrix, distortion), dtype=np.float64).reshape(4, 2),
            focal_px,
            by_a,
        )
        for tag_id, seen in sorted(found.items())
        for corners in seen
    ]


def tag_pose(readings: Sequence[TagReading]) -> TagPose | None:
    """Return T_a_b from all readings that fit together; None if too few do, or two poses explain them."""
    best: list[TagReading] = []
    best_fit: _TagFit | None = None
    everything = len({(reading.by_a, id(reading.points_m)) for reading in readings})
    for seed in readings:
        if len(best) == everything:
            break
        for start in _starts(seed):
            chosen, fit = _gather(seed, start, readings)
            if fit is not None and (len(chosen), -_mean(fit, chosen)) > (
                len(best),
                -_mean(best_fit, best) if best_fit else 0.0,
            ):
                best, best_fit = chosen, fit
    if best_fit is None or len(best) < _READINGS:
        return None
    degrees = 8 * len(best) - 6
    variance_px2 = (_PRIOR_COUNT * CORNER_SIGMA_PX**2 + best_fit.squares_px2) / (_PRIOR_COUNT + degrees)
    # A square fits two poses. The second pose of one square in each picture is the rival to compare with.
    for seed in {reading.by_a: reading for reading in best}.values():
        for start in _starts(seed):
            rival = _fit(start, best)
            if (
                rival is not None
                and _angle(rival.q_xyzw, best_fit.q_xyzw) > _SAME_RAD
                and (rival.squares_px2 - best_fit.squares_px2) / variance_px2 < _RIVAL_CHI2
            ):
                return None
    alone = [_alone(best, best_fit, by_a=by_a) for by_a in (True, False)]
    direction = best_fit.t_m / np.linalg.norm(best_fit.t_m)
    between = rotation_vector(multiply(alone[0].q_xyzw, conjugate(alone[1].q_xyzw)))
    return TagPose(
        t_a_b_m=best_fit.t_m,
        q_a_b_xyzw=best_fit.q_xyzw,
        covariance=np.asarray(np.linalg.inv(best_fit.information) * variance_px2, dtype=np.float64),
        chi2=best_fit.squares_px2 / CORNER_SIGMA_PX**2,
        range_a_m=float(np.linalg.norm(alone[0].t_m)),
        range_b_m=float(np.linalg.norm(alone[1].t_m)),
        twist_gap_rad=float(between @ direction) if all(any(r.by_a is a for r in best) for a in (True, False)) else 0.0,
        readings=len(best),
        left_out=len(readings) - len(best),
        residual_px=float(np.sqrt(best_fit.squares_px2 / (8 * len(best)))),
    )


def _mean(fit: _TagFit, chosen: Sequence[TagReading]) -> float:
    return fit.squares_px2 / (8 * len(chosen))


def _angle(p_xyzw: Floats, q_xyzw: Floats) -> float:
    return float(np.linalg.norm(rotation_vector(multiply(p_xyzw, conjugate(q_xyzw)))))


def _alone(chosen: Sequence[TagReading], joint: _TagFit, *, by_a: bool) -> _TagFit:
    """Return the pose from one picture's tags, refined from the joint one; the joint one if it has no tags."""
    own = [reading for reading in chosen if reading.by_a is by_a]
    return (_fit((joint.t_m, joint.q_xyzw), own) or joint) if own else joint


def _gather(
    seed: TagReading, start: tuple[Floats, Floats], readings: Sequence[TagReading]
) -> tuple[list[TagReading], _TagFit | None]:
    """Return the readings that fit together with this one, and their pose."""
    fit = _fit(start, [seed])
    if fit is None or _mean(fit, [seed]) > _FIT_PX**2:
        return [], None
    chosen = [seed]
    for reading in readings:
        # A tag is in one place only: of two readings of it at most one is true.
        if any(reading.by_a is one.by_a and reading.points_m is one.points_m for one in chosen):
            continue
        wider = _fit((fit.t_m, fit.q_xyzw), [*chosen, reading])
        if wider is not None and _mean(wider, [*chosen, reading]) <= _FIT_PX**2:
            chosen.append(reading)
            fit = wider
    return chosen, fit


def _starts(reading: TagReading) -> list[tuple[Floats, Floats]]:
    """Return the two poses of a square that a picture leaves about equally likely, as T_a_b."""
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        reading.points_m, reading.rays.reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    starts = []
    for turn, shift in zip(turns[:count], shifts[:count], strict=True):
        w = np.asarray(turn, dtype=np.float64).ravel()
        t = np.asarray(shift, dtype=np.float64).ravel()
        q = from_rotation_vector(w)
        if not np.isfinite(t).all() or t[2] < -10.0:
            continue
        starts.append((t, q) if reading.by_a else (-rotate(conjugate(q), t), conjugate(q)))
    return starts


def _residuals(t_m: Floats, q_xyzw: Floats, stack: tuple[Floats, ...]) -> tuple[Floats, Floats] | None:
    """Return residuals (n,) in px and their derivatives (n, 6); None if a corner is not before its camera."""
    points, rays, focal_px, by_a = stack
    R = rotate(q_xyzw, np.eye(3)).T
    turned = np.where(by_a, points @ R.T, points - t_m)
    seen = np.where(by_a, turned + t_m, turned @ R)
    depth = seen[:, 2:]
    if (depth < _NEAR_M).any():
        return None
    image = seen[:, :2] / depth
    toward = np.zeros((len(points), 2, 3))
    toward[:, 0, 0] = toward[:, 1, 1] = 1.0
    toward[:, :, 2] = -image
    toward *= focal_px[:, :, None] / depth[:, :, None]
    by_shift = np.where(by_a[:, :, None], np.eye(3), -R.T)
    by_turn = np.where(by_a[:, :, None], -skew(turned), R.T @ skew(turned))
    J = toward @ np.concatenate([by_shift, by_turn], axis=2)
    return ((image - rays) * focal_px).ravel(), J.reshape(-1, 6)


def _fit(start: tuple[Floats, Floats], readings: Sequence[TagReading]) -> _TagFit | None:
    """Return the pose of least squares (Levenberg-Marquardt); None if it is not determined."""
    stack = (
        np.concatenate([reading.points_m for reading in readings]),
        np.concatenate([reading.rays for reading in readings]),
        np.concatenate([np.tile(reading.focal_px, (4, 1)) for reading in readings]),
        np.repeat([reading.by_a for reading in readings], 4)[:, None],
    )
    t_m, q_xyzw = start
    now = _residuals(t_m, q_xyzw, stack)
    if now is None:
        return None
    damping = 1e-3
    for _ in range(_STEPS):
        r, J = now
        H = J.T @ J
        damped = H + damping * np.diag(np.diag(H)) + 1e-9 * np.eye(6)
        step: Floats = np.asarray(np.linalg.solve(damped, -J.T @ r), dtype=np.float64)
        moved = t_m + step[:3], normalized(multiply(from_rotation_vector(step[3:]), q_xyzw))
        then = _residuals(*moved, stack)
        if then is None or float(then[0] @ then[0]) > float(r @ r):
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        (t_m, q_xyzw), now, damping = moved, then, damping * 0.1
        if float(np.abs(step).max()) < 1e-6:
            break
    r, J = now
    H = J.T @ J
    unit = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-12))
    if np.linalg.eigvalsh(H * np.outer(unit, unit))[0] < 1e-10:
        return None
    return _TagFit(t_m, q_xyzw, float(r @ r), H)
