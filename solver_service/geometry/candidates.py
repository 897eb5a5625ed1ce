"""The candidates of many triggers as bearings, in one table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.observation import Observation
from buddyline.solver_service.geometry.ragged import places, starts_of
from buddyline.solver_service.geometry.rig import RigPair
from buddyline.solver_service.geometry.rotation import Floats, Indices

# As many as a Candidates message holds.
_MAX_CANDIDATES: Final = 64
# No detector finds a light's centre better than this.
_MIN_SIGMA_PX: Final = 0.05
# A score is a detector's opinion: its log odds count half, and at most 3 either way.
_SCORE_WEIGHT: Final = 0.5
_LEAST_SCORE: Final = 1.0 / (1.0 + math.exp(3.0))


@dataclass(eq=False, slots=True)
class CandidateBearings:
    """The usable candidates of T triggers, N in all: by trigger, A's picture before B's.

    triggers: T. counts: (T, 2) how many in A's and in B's picture.
    image: (N,) the picture that each is in: 2 * trigger, plus one for B's. starts: (2 T + 1,) where each
    picture's candidates begin. index: (N,) into the view. bearing: (3, N), bar frame. frames: (N, 3, 3) bearing and
    both tangents, px per rad over sigma_px, bar frame. place: (2, N) over the picture's width and height. variance:
    (N,) of the bearing, rad^2 per axis. disc2: (N,) square of the radius of a disc of its area, rad^2. sigma_px (N,).
    dt_s: (N,) after the instant that the pose is for, the mean of both stamps. log_score, log_area: (N,).
    """

    triggers: int
    counts: Indices
    image: Indices
    starts: Indices
    index: Indices
    bearing: Floats
    frames: Floats
    place: Floats
    variance: Floats
    disc2: Floats
    sigma_px: Floats
    dt_s: Floats
    log_score: Floats
    log_area: Floats


def find_candidates(observations: Sequence[Observation], rigs: RigPair) -> CandidateBearings:
    """Turn all views into bearings.

    Left out are candidates whose position or noise is not finite, and pixels that the camera model does not reach.
    """
    views = [view for seen in observations for view in (seen.view_a, seen.view_b)]
    counts = np.array([min(len(view.pixels), _MAX_CANDIDATES) for view in views])
    image, index = places(counts)
    node = image & 1

    def joined(name: str) -> Floats:
        return np.concatenate([getattr(view, name)[:_MAX_CANDIDATES] for view in views], dtype=np.float64)

    pixels = joined("pixels")
    sigma_px = np.maximum(joined("sigma_px"), _MIN_SIGMA_PX)
    area_px = np.fmax(joined("area_px"), 1.0)
    apart_s = [0.5e-9 * (seen.view_a.stamp_ns - seen.view_b.stamp_ns) for seen in observations]
    dt_s = joined("dt_s") + np.outer(apart_s, (1.0, -1.0)).ravel()[image]
    in_camera, px2_per_sr = _frames(pixels, node, rigs)
    frames = in_camera @ rigs.R_bar_camera.swapaxes(1, 2)[node]
    frames[:, 1:] /= sigma_px[:, None, None]
    variance = sigma_px * sigma_px / px2_per_sr
    usable = np.isfinite(frames[:, 0].sum(1) + pixels.sum(1) + variance + area_px + dt_s)
    image = image[usable]
    frames, pixels, area_px = frames[usable], pixels[usable], area_px[usable]
    counts = np.bincount(image, minlength=len(views))
    return CandidateBearings(
        triggers=len(observations),
        counts=counts.reshape(-1, 2),
        image=image,
        starts=starts_of(counts),
        index=index[usable],
        bearing=np.ascontiguousarray(frames[:, 0].T),
        frames=frames,
        place=(pixels / rigs.size_px[node[usable]]).T,
        variance=variance[usable],
        disc2=area_px / (math.pi * px2_per_sr[usable]),
        sigma_px=sigma_px[usable],
        dt_s=dt_s[usable],
        log_score=_log_score(joined("score")[usable], image, counts),
        log_area=np.log(area_px),
    )


def _frames(pixels: Floats, node: Indices, rigs: RigPair) -> tuple[Floats, Floats]:
    """Give bearing and tangents (N, 3, 3), camera frames, and px^2 per sr (N,)."""
    camera_a, camera_b = (rig.camera for rig in rigs.rigs)
    if camera_a.same_as(camera_b):
        return camera_a.frames(pixels)
    frames, px2_per_sr = np.empty((len(pixels), 3, 3)), np.empty(len(pixels))
    for camera, own in ((camera_a, node == 0), (camera_b, node == 1)):
        frames[own], px2_per_sr[own] = camera.frames(pixels[own])
    return frames, px2_per_sr


def _log_score(score: Floats, image: Indices, counts: Indices) -> Floats:
    """Turn scores into log likelihood ratios, one on each picture's average; an unknown score is no evidence."""
    odds = np.clip(np.where(np.isfinite(score), score, 0.5), _LEAST_SCORE, 1.0 - _LEAST_SCORE)
    weight = _SCORE_WEIGHT * np.log(odds / (1.0 - odds))
    total = np.bincount(image, np.exp(weight), minlength=len(counts))
    balanced: Floats = weight - np.log(total / np.maximum(counts, 1))[image]
    return balanced
