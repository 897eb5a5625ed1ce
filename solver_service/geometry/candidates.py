"""Both nodes' candidates of one trigger as bearings, in one table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.observation import View
from buddyline.solver_service.geometry.rig import RigPair
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.geometry.scalars import ONE, PI, scalar
from numpy.typing import NDArray

# A message holds no more.
_MAX_CANDIDATES: Final = 64
_MIN_SIGMA_PX: Final = scalar(0.05)
# Scores beyond say no more; half the log odds are then at most 1.5.
_LEAST_SCORE: Final = 1.0 / (1.0 + math.exp(3.0))


@dataclass(eq=False, slots=True)
class Candidates:
    """The usable candidates, A's first. counts: (A's, B's), their sum N.

    frames: (N, 3, 3) bearing and both tangents, px per rad over sigma_px, in its own rig's level frame. table: (7, N)
    bearing, position over the picture's width and height, variance of the bearing, rad^2 per axis, and square of the
    radius that a disc of its area would have, rad^2. index: (N,) into the view. sigma_px: (N,). dt_s: (N,) after the
    instant that the pose is for. log_score: (N,) weak evidence for a light, None where no candidate has a score.
    log_area: (N,).
    """

    counts: tuple[int, int]
    frames: Floats
    table: Floats
    index: NDArray[np.intp]
    sigma_px: Floats
    dt_s: Floats
    log_score: Floats | None
    log_area: Floats

    @property
    def bearings(self) -> Floats:
        """(3, N), each in its own rig's level frame."""
        return self.table[:3]

    @property
    def variance(self) -> Floats:
        """(N,) of the bearing, rad^2 per axis."""
        variance: Floats = self.table[5]
        return variance


def find_candidates(views: tuple[View, View], rigs: RigPair) -> Candidates:
    """Turn both views into bearings; the instant of the pose is the mean of both stamps.

    Left out are candidates whose position or noise is not finite, and pixels that the camera model does not reach.
    """
    view_a, view_b = views
    rig_a, rig_b = rigs.rigs
    pixels_a, pixels_b = view_a.pixels.reshape(-1, 2)[:_MAX_CANDIDATES], view_b.pixels.reshape(-1, 2)[:_MAX_CANDIDATES]
    in_a, in_b = len(pixels_a), len(pixels_b)
    pixels = np.concatenate((pixels_a, pixels_b))
    index, turns, size_px = _places(rigs, in_a, in_b)
    if rigs.one_camera:
        in_camera, px2_per_sr = rig_a.camera.frames(pixels)
    else:
        of_each = zip(rig_a.camera.frames(pixels_a), rig_b.camera.frames(pixels_b), strict=True)
        in_camera, px2_per_sr = map(np.concatenate, of_each)
    frames = in_camera @ turns
    table = np.empty((11, in_a + in_b))
    offset_s = 0.5e-9 * (view_a.stamp_ns - view_b.stamp_ns)
    for view, columns, shift_s in ((view_a, table[7:, :in_a], offset_s), (view_b, table[7:, in_a:], -offset_s)):
        n = columns.shape[1]
        np.add(view.dt_s[:n], shift_s, out=columns[0])
        columns[1], columns[2], columns[3] = view.sigma_px[:n], view.score[:n], view.area_px[:n]
    sigma_px = np.maximum(table[8], _MIN_SIGMA_PX)
    frames[:, 1:] /= sigma_px[:, None, None]
    table[:3] = frames[:, 0].T
    np.divide(pixels.T, size_px, out=table[3:5])
    np.divide(sigma_px * sigma_px, px2_per_sr, out=table[5])
    np.fmax(table[10], ONE, out=table[10])
    np.divide(table[10], PI * px2_per_sr, out=table[6])
    if not math.isfinite(np.add.reduce(table[:9], None)):
        usable = np.isfinite(table[:9].sum(0))
        in_a = int(usable[:in_a].sum())
        table, frames, index, sigma_px = table[:, usable], frames[usable], index[usable], sigma_px[usable]
    return Candidates(
        counts=(in_a, table.shape[1] - in_a),
        frames=frames,
        table=table[:7],
        index=index,
        sigma_px=sigma_px,
        dt_s=table[7],
        log_score=_log_score(table[9], in_a),
        log_area=np.log(table[10]),
    )


@lru_cache(maxsize=64)
def _places(rigs: RigPair, in_a: int, in_b: int) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Give the place in its view of each of A's candidates and then of B's, with its rig's turn and picture size."""
    index, node = np.concatenate((np.arange(in_a), np.arange(in_b))), np.repeat((0, 1), (in_a, in_b))
    turns, size_px = rigs.turns[node], rigs.size_px[:, node]
    index.flags.writeable = turns.flags.writeable = size_px.flags.writeable = False
    return index, turns, size_px


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
