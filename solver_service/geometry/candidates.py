"""Both nodes' candidates of one trigger as bearings, in one table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from solver_service.geometry.observation import View
from solver_service.geometry.rig import Rig
from solver_service.geometry.rotation import Floats

# A message holds no more.
_MAX_CANDIDATES: Final = 64
_MIN_SIGMA_PX: Final = 0.05
_MAX_LOG_SCORE: Final = 1.5


@dataclass(frozen=True, eq=False)
class Candidates:
    """The usable candidates, A's first. counts: (A's, B's), their sum N.

    bearings: (3, N), each in its own rig's level frame. tangents: (N, 2, 3), px per rad over sigma_px, likewise.
    variance: (N,) of the bearing, rad^2 per axis. index: (N,) into the view. shares: (2, N) position over the
    picture's width and height. sigma_px: (N,). dt_s: (N,) after the instant that the pose is for. log_score: (N,)
    weak evidence for a light, None where no candidate has a score. log_area: (N,).
    """

    counts: tuple[int, int]
    bearings: Floats
    tangents: Floats
    variance: Floats
    index: NDArray[np.intp]
    shares: Floats
    sigma_px: Floats
    dt_s: Floats
    log_score: Floats | None
    log_area: Floats


def find_candidates(views: tuple[View, View], rigs: tuple[Rig, Rig]) -> Candidates:
    """Turn both views into bearings; the instant of the pose is the mean of both stamps.

    Left out are candidates whose position or noise is not finite, and pixels that the camera model does not reach.
    """
    offset_s = 0.5e-9 * (views[0].stamp_ns - views[1].stamp_ns)
    a = _see(views[0], rigs[0], offset_s)
    b = _see(views[1], rigs[1], -offset_s)
    table = np.concatenate((a[0], b[0]), axis=1)
    tangents = np.concatenate((a[1], b[1]))
    index = np.concatenate((a[2], b[2]))
    in_a = a[0].shape[1]
    usable = np.isfinite(table[:7].sum(0))
    if not usable.all():
        in_a = int(usable[:in_a].sum())
        table, tangents, index = table[:, usable], tangents[usable], index[usable]
    gram = tangents @ tangents.swapaxes(1, 2)
    sigma_px = table[6]
    log_score = None
    if np.isfinite(table[7]).any():
        log_score = np.concatenate([_log_score(part) for part in (table[7, :in_a], table[7, in_a:])])
    return Candidates(
        counts=(in_a, table.shape[1] - in_a),
        bearings=table[:3],
        tangents=tangents / sigma_px[:, None, None],
        variance=sigma_px**2 / np.sqrt(gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2),
        index=index,
        shares=table[3:5],
        sigma_px=sigma_px,
        dt_s=table[5],
        log_score=log_score,
        log_area=np.log(np.fmax(table[8], 1.0)),
    )


def _see(view: View, rig: Rig, offset_s: float) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Give a table (9, N) of one view, its tangents (N, 2, 3) and its indices (N,)."""
    pixels = np.reshape(view.pixels, (-1, 2))[:_MAX_CANDIDATES]
    bearings, tangents = rig.camera.rays(pixels)
    n = len(pixels)
    table = np.empty((9, n))
    np.matmul(rig.R_level_camera, bearings.T, out=table[:3])
    table[3], table[4] = pixels[:, 0] / rig.camera.width_px, pixels[:, 1] / rig.camera.height_px
    table[5] = view.dt_s[:n] + offset_s
    table[6] = np.maximum(view.sigma_px[:n], _MIN_SIGMA_PX)
    table[7], table[8] = view.score[:n], view.area_px[:n]
    return table, tangents @ rig.R_level_camera.T, np.arange(n)


def _log_score(score: Floats) -> Floats:
    """Give half the log odds of scores, within limits; on average they are no evidence, nor is one not known."""
    odds = np.clip(np.where(np.isfinite(score), score, 0.5), 1e-3, 1.0 - 1e-3)
    weight = np.clip(0.5 * np.log(odds / (1.0 - odds)), -_MAX_LOG_SCORE, _MAX_LOG_SCORE)
    return weight - math.log(np.exp(weight).mean()) if len(weight) else weight
