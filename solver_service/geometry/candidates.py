"""Both nodes' candidates of one trigger as bearings, in one table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from solver_service.geometry.observation import View
from solver_service.geometry.rig import RigPair
from solver_service.geometry.rotation import Floats

# A message holds no more.
_MAX_CANDIDATES: Final = 64
_MIN_SIGMA_PX: Final = 0.05
# Scores beyond say no more; half the log odds are then at most 1.5.
_LEAST_SCORE: Final = 1.0 / (1.0 + math.exp(3.0))


@dataclass(eq=False, slots=True)
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
    view_a, view_b = views
    rig_a, rig_b = rigs.rigs
    pixels_a, pixels_b = view_a.pixels.reshape(-1, 2)[:_MAX_CANDIDATES], view_b.pixels.reshape(-1, 2)[:_MAX_CANDIDATES]
    in_a, in_b = len(pixels_a), len(pixels_b)
    pixels = np.concatenate((pixels_a, pixels_b))
    index, node = _places(in_a, in_b)
    if rigs.one_camera:
        bearings, in_camera = rig_a.camera.rays(pixels)
    else:
        rays = rig_a.camera.rays(pixels_a), rig_b.camera.rays(pixels_b)
        bearings, in_camera = (np.concatenate(parts) for parts in zip(*rays, strict=True))
    turns = rigs.turns.take(node, 0)
    tangents = in_camera @ turns
    table = np.empty((9, in_a + in_b))
    table[:3] = (bearings[:, None] @ turns)[:, 0].T
    np.divide(pixels.T, rigs.size_px.take(node, 1), out=table[3:5])
    offset_s = 0.5e-9 * (view_a.stamp_ns - view_b.stamp_ns)
    for view, columns, shift_s in ((view_a, table[5:, :in_a], offset_s), (view_b, table[5:, in_a:], -offset_s)):
        n = columns.shape[1]
        np.add(view.dt_s[:n], shift_s, out=columns[0])
        columns[1], columns[2], columns[3] = view.sigma_px[:n], view.score[:n], view.area_px[:n]
    if not math.isfinite(np.add.reduce(table[:7], None)):
        usable = np.isfinite(table[:7].sum(0))
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


@lru_cache(maxsize=64)
def _places(in_a: int, in_b: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Give the place in its view, and the node, of each of A's candidates and then of B's."""
    index, node = np.concatenate((np.arange(in_a), np.arange(in_b))), np.repeat((0, 1), (in_a, in_b))
    index.flags.writeable = node.flags.writeable = False
    return index, node


def _log_score(score: Floats, in_a: int) -> Floats | None:
    """Give half the log odds of scores, within limits; on each picture's average, and where unknown, no evidence.

    None where none is known.
    """
    known = np.isfinite(score)
    count = np.count_nonzero(known)
    if not count:
        return None
    odds = score if count == len(score) else np.where(known, score, 0.5)
    odds = np.minimum(np.maximum(odds, _LEAST_SCORE), 1.0 - _LEAST_SCORE)
    weight: Floats = 0.5 * np.log(odds / (1.0 - odds))
    ratio = np.exp(weight)
    for part in (slice(0, in_a), slice(in_a, None)):
        if len(ratio[part]):
            weight[part] -= math.log(float(np.add.reduce(ratio[part])) / len(ratio[part]))
    return weight
