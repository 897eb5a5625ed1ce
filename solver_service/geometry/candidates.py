"""Both nodes' candidates of one trigger as bearings, in one table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from solver_service.geometry.observation import View
from solver_service.geometry.rig import RigPair
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


def find_candidates(views: tuple[View, View], rigs: RigPair) -> Candidates:
    """Turn both views into bearings; the instant of the pose is the mean of both stamps.

    Left out are candidates whose position or noise is not finite, and pixels that the camera model does not reach.
    """
    pixels_a, pixels_b = (np.reshape(view.pixels, (-1, 2))[:_MAX_CANDIDATES] for view in views)
    in_a, in_b = len(pixels_a), len(pixels_b)
    pixels = np.concatenate((pixels_a, pixels_b))
    a, b = slice(0, in_a), slice(in_a, None)
    rig_a, rig_b = rigs.rigs
    if rigs.one_camera:
        bearings, in_camera = rig_a.camera.rays(pixels)
    else:
        rays = rig_a.camera.rays(pixels_a), rig_b.camera.rays(pixels_b)
        bearings, in_camera = (np.concatenate(parts) for parts in zip(*rays, strict=True))
    offset_s = 0.5e-9 * (views[0].stamp_ns - views[1].stamp_ns)
    table, tangents = np.empty((9, in_a + in_b)), np.empty((in_a + in_b, 2, 3))
    index = np.arange(in_a + in_b)
    index[b] -= in_a
    for view, rig, part, n, shift_s in (
        (views[0], rig_a, a, in_a, offset_s),
        (views[1], rig_b, b, in_b, -offset_s),
    ):
        columns, turn = table[:, part], rig.R_level_camera
        np.matmul(turn, bearings[part].T, out=columns[:3])
        np.matmul(in_camera[part], turn.T, out=tangents[part])
        np.divide(pixels[part].T, rig.camera.size_px, out=columns[3:5])
        np.add(view.dt_s[:n], shift_s, out=columns[5])
        columns[6], columns[7], columns[8] = view.sigma_px[:n], view.score[:n], view.area_px[:n]
    usable = np.isfinite(table[:7].sum(0))
    if not usable.all():
        in_a = int(usable[:in_a].sum())
        table, tangents, index = table[:, usable], tangents[usable], index[usable]
    sigma_px = np.maximum(table[6], _MIN_SIGMA_PX)
    tangents /= sigma_px[:, None, None]
    gram = tangents @ tangents.swapaxes(1, 2)
    return Candidates(
        counts=(in_a, table.shape[1] - in_a),
        bearings=table[:3],
        tangents=tangents,
        variance=1.0 / np.sqrt(gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2),
        index=index,
        shares=table[3:5],
        sigma_px=sigma_px,
        dt_s=table[5],
        log_score=_log_score(table[7], in_a),
        log_area=np.log(np.fmax(table[8], 1.0)),
    )


def _log_score(score: Floats, in_a: int) -> Floats | None:
    """Give half the log odds of scores, within limits; on each picture's average, and where unknown, no evidence.

    None where none is known.
    """
    known = np.isfinite(score)
    if not known.any():
        return None
    odds = np.minimum(np.maximum(np.where(known, score, 0.5), 1e-3), 1.0 - 1e-3)
    weight = 0.5 * np.log(odds / (1.0 - odds))
    weight = np.minimum(np.maximum(weight, -_MAX_LOG_SCORE), _MAX_LOG_SCORE)
    ratio = np.exp(weight)
    for part in (slice(0, in_a), slice(in_a, None)):
        if len(ratio[part]):
            weight[part] -= math.log(float(ratio[part].sum()) / len(ratio[part]))
    return weight
