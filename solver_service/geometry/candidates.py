"""The candidates of many triggers as bearings, in one table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.observation import Blinking, Observation
from buddyline.solver_service.geometry.ragged import places, starts_of
from buddyline.solver_service.geometry.rig import RigPair
from buddyline.solver_service.geometry.rotation import Floats, Indices
from numpy.typing import NDArray

# As many as a Candidates message holds.
_MAX_CANDIDATES: Final = 64
# No smaller sigma is believed. Lamps whose cores are not clipped are found to 0.01 px in rendered pictures.
_MIN_SIGMA_PX: Final = 0.005
# A score is the probability of a lamp, fitted to pictures (node/detect/score.toml): its log odds count, at most this
# much either way, because no fit knows every water.
_MOST_LOG_ODDS: Final = 3.0
_LEAST_SCORE: Final = 1.0 / (1.0 + math.exp(_MOST_LOG_ODDS))
# The pose is for the mean of both stamps: half their difference, A's minus B's, is added for A and taken off for B.
_LATER: Final[Floats] = np.array([[1.0], [-1.0]])


@dataclass(eq=False, slots=True)
class CandidateBearings:
    """The usable candidates of T triggers, N in all: by trigger, A's picture before B's.

    triggers: T. counts: (T, 2) how many in A's and in B's picture. in_whole: (T, 2) the same with those outside the
    searched parts of a picture, because chance picks from all. image: (N,) the picture that each is in: 2 * trigger,
    plus one for B's. starts: (2 T + 1,) where each picture's candidates begin. index: (N,) into the view. table: (7, N)
    the bearing in the bar frame, the place over the picture's width and height, the bearing's variance, rad^2 per axis,
    and the square of the radius of a disc of its area, rad^2. frames: (N, 3, 3) bearing and both tangents, px per rad
    over sigma_px, camera frame. sigma_px (N,). dt_s: (N,) after the instant that the pose is for, the mean of both
    stamps. log_score, log_area: (N,). log_side: (N, 2) what a code says for the other node's left and right lamp. dark:
    (T, 4) which lamps are switched off, in the order of Quads.lights. Both are None where no lamp blinks.
    """

    triggers: int
    counts: Indices
    in_whole: Indices
    image: Indices
    starts: Indices
    index: Indices
    table: Floats
    frames: Floats
    sigma_px: Floats
    dt_s: Floats
    log_score: Floats
    log_area: Floats
    log_side: Floats | None = None
    dark: NDArray[np.bool_] | None = None

    @property
    def bearing(self) -> Floats:
        """Unit vectors (3, N), each in the bar frame of the node that sees it."""
        return self.table[:3]

    @property
    def variance(self) -> Floats:
        """Of each bearing (N,), rad^2 per axis."""
        variance: Floats = self.table[5]
        return variance

    def variance_of(self, trigger: int) -> float:
        """Give the mean variance of the bearings of one trigger, rad^2 per axis; 0 without candidates."""
        first, _, last = self.starts[2 * trigger : 2 * trigger + 3].tolist()
        mean: float = self.variance[first:last].sum() / max(last - first, 1)
        return mean


def find_candidates(observations: Sequence[Observation], rigs: RigPair) -> CandidateBearings:
    """Turn all views into bearings.

    Left out are candidates whose position or noise is not finite, and pixels that the camera model does not reach.
    """
    views = [view for seen in observations for view in (seen.view_a, seen.view_b)]
    seen = np.concatenate([view.table[:_MAX_CANDIDATES] for view in views])
    image, index = places(np.array([min(len(view.table), _MAX_CANDIDATES) for view in views]))
    # A score that is not known is no evidence.
    seen[:, 3] = np.where(np.isfinite(seen[:, 3]), seen[:, 3], 0.5)
    seen[:, 2] = np.maximum(seen[:, 2], _MIN_SIGMA_PX)
    seen[:, 4] = np.fmax(seen[:, 4], 1.0)
    frames, px2_per_sr = _frames(seen[:, :2], image & 1, rigs)
    variance = seen[:, 2] ** 2 / px2_per_sr
    usable = np.isfinite(np.add.reduce(seen, 1) + variance)
    if not usable.all():
        seen, frames, image, index = seen[usable], frames[usable], image[usable], index[usable]
        variance, px2_per_sr = variance[usable], px2_per_sr[usable]
    node, sigma_px, area_px = image & 1, seen[:, 2], seen[:, 4]
    half_apart_s = [0.5e-9 * (each.view_a.stamp_ns - each.view_b.stamp_ns) for each in observations]
    later_s = np.array([half_apart_s, half_apart_s]) * _LATER
    counts = np.bincount(image, minlength=len(views))
    table = np.empty((7, len(image)))
    table[:3] = (rigs.R_bar_camera[node] @ frames[:, 0, :, None])[:, :, 0].T
    table[3:5] = (seen[:, :2] / rigs.size_px[node]).T
    table[5] = variance
    table[6] = area_px / (math.pi * px2_per_sr)
    frames[:, 1:] /= sigma_px[:, None, None]
    elsewhere = np.array([view.elsewhere for view in views])
    log_side, dark = None, None
    if any(view.blinking is not None for view in views):
        said = [view.blinking or Blinking(np.zeros((len(view.table), 2)), (False, False)) for view in views]
        log_side = np.concatenate([each.log_ratio[:_MAX_CANDIDATES] for each in said])[usable]
        dark = np.array([each.dark for each in said]).reshape(-1, 4)
    return CandidateBearings(
        triggers=len(observations),
        counts=counts.reshape(-1, 2),
        in_whole=(counts + elsewhere).reshape(-1, 2),
        image=image,
        starts=starts_of(counts),
        index=index,
        table=table,
        frames=frames,
        sigma_px=sigma_px,
        dt_s=seen[:, 5] + later_s.T.ravel()[image],
        log_score=_log_score(seen[:, 3], image, counts, elsewhere),
        log_area=np.log(area_px),
        log_side=log_side,
        dark=dark,
    )


def _frames(pixels: Floats, node: Indices, rigs: RigPair) -> tuple[Floats, Floats]:
    """Give bearing and tangents (N, 3, 3), camera frames, and px^2 per sr (N,)."""
    camera_a, camera_b = (rig.camera for rig in rigs.rigs)
    if rigs.one_lens:
        return camera_a.frames(pixels)
    frames, px2_per_sr = np.empty((len(pixels), 3, 3)), np.empty(len(pixels))
    for camera, own in ((camera_a, node == 0), (camera_b, node == 1)):
        frames[own], px2_per_sr[own] = camera.frames(pixels[own])
    return frames, px2_per_sr


def _log_score(score: Floats, image: Indices, counts: Indices, elsewhere: Indices) -> Floats:
    """Turn scores into log likelihood ratios; an unknown score, 0.5, is no evidence.

    The ratios of each picture's candidates average one. Those outside the searched parts count as the least likely,
    because likely ones are searched for.
    """
    if (score == 0.5).all():
        return np.zeros(len(score))
    bounded = np.minimum(np.maximum(score, _LEAST_SCORE), 1.0 - _LEAST_SCORE)
    log_odds = np.log(bounded / (1.0 - bounded))
    total = np.bincount(image, np.exp(log_odds), minlength=len(counts)) + elsewhere * math.exp(-_MOST_LOG_ODDS)
    balanced: Floats = log_odds - np.log(total / np.maximum(counts + elsewhere, 1))[image]
    return balanced
