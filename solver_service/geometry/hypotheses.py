"""Which four candidates may be the four lights: a search that grows with the pairs that agree, not with all.

An image alone gives each of its pairs an apex angle, a bearing across the bar and a twist. Eq. 1 of both nodes
agrees where ln(alpha cos(beta) d) is the same in both images, up to terms of alpha^2, and so does the twist: a
join of two sorted lists finds the hypotheses that pass both gaps, and only these are solved.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from solver_service.geometry.camera import Camera
from solver_service.geometry.closed_form import cross
from solver_service.geometry.evidence import GROSS_SCALE
from solver_service.geometry.observation import Settings, View
from solver_service.geometry.rig import Rig
from solver_service.geometry.rotation import Floats

# The join's own error, in units of alpha^2: at the optical axis, and per tan^2 of the widest bearing. Found from
# random poses over fields of view up to 90 degrees; the twist's is smaller.
_KEY_TERM: Final = 0.03
_KEY_SLOPE: Final = 0.15
_TWIST_TERM: Final = 0.03
# The join takes the cameras to stand in the middle of their bars: what that leaves, per offset over range.
_OFFSET_SLOPE: Final = 1.5
# A bar seen at a grazing angle looks this much shorter at most.
_FORESHORTENING: Final = 0.3
# A pair whose angle is known worse than this (relative variance) says nothing.
_MAX_RELATIVE_VARIANCE: Final = 0.06
# The largest angle a bar is seen under, over length / range; and the square of the largest chord of all.
_NEAREST: Final = 1.5
_MAX_CHORD2: Final = 3.9
# The least share of a picture over which a pair may be shifted and stay in view.
_LEAST_IN_VIEW: Final = 0.02
# Square of the log ratio of two areas, from which on they are no less alike.
_MAX_UNLIKE: Final = 4.0
# A message holds no more.
_MAX_CANDIDATES: Final = 64
_MIN_SIGMA_PX: Final = 0.05
# How many hypotheses may pass gates that are widened for gross errors; beyond, chance hides the right one.
_MAX_WIDE: Final = 1000
# Gravity across the line of sight (product of both) below which both readings of left and right are weighed.
_UNDECIDED: Final = 0.3


@dataclass(frozen=True, eq=False)
class Sky:
    """What one node saw, as bearings: the N candidates that can be used.

    bearings: (3, N). tangents: (N, 2, 3), px per rad over sigma_px. variance: (N,) of the bearing, rad^2 per axis.
    index: (N,) into the view. pixels: (2, N), sigma_px: (N,). dt_s: (N,) after the instant that the pose is for.
    log_score, log_area: (N,) weak evidence.
    """

    bearings: Floats
    tangents: Floats
    variance: Floats
    index: NDArray[np.intp]
    pixels: Floats
    sigma_px: Floats
    dt_s: Floats
    log_score: Floats
    log_area: Floats


@dataclass(frozen=True, eq=False)
class Pairs:
    """The P pairs of one image that may be the other node's bar.

    first, second: (P,) indices into the sky. key: ln(alpha cos(beta) d) with its alpha^2 term. twist_rad: from
    one's own bar to the direction first -> second. variance: of ln alpha and of the twist. chord: of alpha, rad.
    log_weight: weak evidence, and how rarely chance puts two candidates so near each other. tan2_beta: of the
    widest. down: (2, P) gravity across the line of sight, along one's own bar and across it.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    key: Floats
    twist_rad: Floats
    variance: Floats
    chord: Floats
    log_weight: Floats
    tan2_beta: float
    down: Floats

    def __len__(self) -> int:
        """Count the pairs."""
        return len(self.key)


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """K hypotheses: indices into the skies (4, K) (B's left and right in A's, A's left and right in B's).

    variance: (K,) of the gap of ln range, and of twist. log_weight: (K,) what does not depend on the pose.
    """

    lights: NDArray[np.intp]
    variance: Floats
    log_weight: Floats


def find_sky(view: View, camera: Camera, offset_s: float) -> Sky:
    """Turn a view into bearings; offset_s: its stamp after the instant that the pose is for.

    Candidates whose position or noise is not finite, and pixels that the camera model does not reach, are left out.
    """
    pixels = np.asarray(view.pixels, dtype=np.float64).reshape(-1, 2)[:_MAX_CANDIDATES]
    bearings, tangents = camera.rays(pixels)
    usable = np.isfinite(tangents).all((1, 2)) & np.isfinite(view.sigma_px[:_MAX_CANDIDATES])
    index = np.flatnonzero(usable)
    if len(index) < len(pixels):
        pixels, bearings, tangents = pixels[index], bearings[index], tangents[index]
    sigma_px = np.maximum(view.sigma_px[index], _MIN_SIGMA_PX)
    tangents = tangents / sigma_px[:, None, None]
    gram = (tangents * tangents).sum(2)
    slant = (tangents[:, 0] * tangents[:, 1]).sum(1)
    score, area_px = view.score[index], view.area_px[index]
    # Half the log odds of a score count, within a factor of e^1.5.
    odds = np.clip(np.where(np.isfinite(score), score, 0.5), 1e-3, 1.0 - 1e-3)
    return Sky(
        bearings=bearings.T.copy(),
        tangents=tangents,
        variance=1.0 / np.sqrt(gram[:, 0] * gram[:, 1] - slant * slant),
        index=index,
        pixels=pixels.T,
        sigma_px=sigma_px,
        dt_s=view.dt_s[index] + offset_s,
        log_score=np.clip(0.5 * np.log(odds / (1.0 - odds)), -1.5, 1.5),
        log_area=np.log(np.maximum(np.where(np.isfinite(area_px), area_px, 1.0), 1.0)),
    )


@lru_cache(maxsize=128)
def _combinations(count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    first, second = np.triu_indices(count, 1)
    first.flags.writeable = second.flags.writeable = False
    return first, second


def find_pairs(sky: Sky, own: Rig, other: Rig, down: Floats, settings: Settings) -> Pairs:
    """Give the pairs whose angle fits the other node's bar within the range limits.

    down: (3,) gravity in the own camera's frame.
    """
    first, second = _combinations(len(sky.index))
    b = sky.bearings
    b_first, b_second = b[:, first], b[:, second]
    difference = b_second - b_first
    chord2 = (difference * difference).sum(0)
    variance = sky.variance[first] + sky.variance[second]
    shortest = (_FORESHORTENING * other.length_m / settings.range_max_m) ** 2
    longest = min((_NEAREST * other.length_m / settings.range_min_m) ** 2, _MAX_CHORD2)
    keep = (chord2 >= shortest) & (chord2 <= longest) & (variance < _MAX_RELATIVE_VARIANCE * chord2)
    if not keep.all():
        first, second = first[keep], second[keep]
        b_first, b_second, difference = b_first[:, keep], b_second[:, keep], difference[:, keep]
        chord2, variance = chord2[keep], variance[keep]
    chord = np.sqrt(chord2)
    norm2 = 4.0 - chord2
    norm = np.sqrt(norm2)
    c = (b_first + b_second) / norm
    sin_beta = own.axis @ c
    cos_beta2 = np.maximum(1.0 - sin_beta * sin_beta, 1e-6)
    # The own bar and its perpendicular, seen along the line of sight c.
    side = cross(np.broadcast_to(own.axis[:, None], c.shape), c)
    sine, cosine = -(side * difference).sum(0), own.axis @ difference
    apart_px = np.abs(sky.pixels[:, second] - sky.pixels[:, first])
    camera = own.camera
    in_view = (1.0 - apart_px[0] / camera.width_px) * (1.0 - apart_px[1] / camera.height_px)
    alike = np.minimum((sky.log_area[second] - sky.log_area[first]) ** 2, _MAX_UNLIKE)
    weak = sky.log_score[first] + sky.log_score[second] - 0.25 * alike
    if len(weak):
        # Its exponential is one on average: what all candidates share is no evidence.
        weak = weak - np.log(np.exp(weak).mean())
    return Pairs(
        first=first,
        second=second,
        key=np.log(chord * np.sqrt(cos_beta2) * own.length_m) + 0.125 * chord2,
        twist_rad=np.arctan2(sine, cosine),
        variance=variance / chord2,
        chord=chord,
        log_weight=weak - np.log(chord2 * np.maximum(in_view, _LEAST_IN_VIEW)),
        tan2_beta=float(1.0 / cos_beta2.min(initial=1.0) - 1.0),
        down=np.stack((down @ own.axis - sin_beta * (down @ c), -(down @ side))) / np.sqrt(cos_beta2),
    )


def join(
    a: Pairs,
    b: Pairs,
    rig_a: Rig,
    rig_b: Rig,
    gate_sigma: float,
    motion_variance: Floats,
    *,
    by_range: bool,
    by_twist: bool,
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Give the combinations of pairs that pass the gates: indices into a, into b, and whether one order swaps.

    motion_variance: (len(a),) what relative motion between the exposures adds to both gaps, rad^2.
    swap: the twists agree where one of the two pairs is read second -> first.
    """
    if not len(a.key) or not len(b.key):
        nothing = np.empty(0, dtype=np.intp)
        return nothing, nothing, np.empty(0, dtype=np.bool_)
    ratio = rig_a.length_m / rig_b.length_m
    chord2 = (a.chord * max(1.0, ratio)) ** 2
    offset_m = float(np.linalg.norm(rig_a.middle_m) + np.linalg.norm(rig_b.middle_m))
    slack = (_OFFSET_SLOPE * offset_m / rig_b.length_m) * a.chord
    if by_range:
        # B's pair looks no shorter than this where it matches A's: cos(beta_B) is at most one.
        least_b = np.exp(a.key) / rig_b.length_m
        worst_b = (b.variance * b.chord * b.chord).max() / (least_b * least_b)
        term = _KEY_TERM + _KEY_SLOPE * max(a.tan2_beta, b.tan2_beta)
        reach = gate_sigma * np.sqrt(a.variance + worst_b + motion_variance) + term * chord2 + slack
        order = np.argsort(b.key, kind="stable")
        keys = b.key[order]
        low = np.searchsorted(keys, a.key - reach)
        count = np.searchsorted(keys, a.key + reach, side="right") - low
        start = np.cumsum(count) - count
        ia = np.repeat(np.arange(len(a.key)), count)
        ib = order[np.arange(len(ia)) + (low - start)[ia]]
    else:
        ia = np.repeat(np.arange(len(a.key)), len(b.key))
        ib = np.tile(np.arange(len(b.key)), len(a.key))
    # Both orders swapped leave the difference of the twists as it is, one swapped adds pi.
    off_half_turn = np.abs(np.abs(a.twist_rad[ia] - b.twist_rad[ib]) - np.pi)
    swap = off_half_turn < 0.5 * np.pi
    if by_twist:
        gap = np.where(swap, off_half_turn, np.pi - off_half_turn)
        spread = np.sqrt(a.variance[ia] + b.variance[ib] + motion_variance[ia])
        keep = gap < gate_sigma * spread + (_TWIST_TERM * chord2 + slack)[ia]
        ia, ib, swap = ia[keep], ib[keep], swap[keep]
    return ia, ib, swap


def search(
    a: Pairs, b: Pairs, rigs: tuple[Rig, Rig], motion_variance: Floats, checks: frozenset[str], gate_sigma: float
) -> Hypotheses | str:
    """Give the hypotheses whose gaps pass, read as gravity has them, or the name of the gap that none passes."""
    by_range, by_twist = "range" in checks, "twist" in checks
    for gate in (gate_sigma * GROSS_SCALE, gate_sigma):
        ia, ib, swap = join(a, b, *rigs, gate, motion_variance, by_range=by_range, by_twist=by_twist)
        if len(ia) <= _MAX_WIDE:
            break
    if not len(ia):
        if not by_range or not by_twist:
            return "range_gap" if by_range else "twist_gap"
        ia, ib, swap = join(a, b, *rigs, gate, motion_variance, by_range=True, by_twist=False)
        return "twist_gap" if len(ia) else "range_gap"
    # With first -> second as left -> right in A, and B read to agree with it, B's gravity turned into A's frame;
    # across the line of sight the two count the other way round.
    cosine, sine = np.cos(a.twist_rad[ia]), np.sin(a.twist_rad[ia])
    da, db = a.down[:, ia], b.down[:, ib]
    upright = da[0] * (cosine * db[0] + sine * db[1]) + da[1] * (sine * db[0] - cosine * db[1])
    flip = upright < 0.0
    undecided = np.flatnonzero(np.abs(upright) < _UNDECIDED)
    if len(undecided):
        both = np.concatenate((np.arange(len(ia)), undecided))
        ia, ib, swap = ia[both], ib[both], swap[both]
        flip = np.concatenate((flip, ~flip[undecided]))
    swap = swap != flip
    first_a, second_a, first_b, second_b = a.first[ia], a.second[ia], b.first[ib], b.second[ib]
    lights = np.stack(
        (
            np.where(flip, second_a, first_a),
            np.where(flip, first_a, second_a),
            np.where(swap, second_b, first_b),
            np.where(swap, first_b, second_b),
        )
    )
    return Hypotheses(
        lights=lights,
        variance=a.variance[ia] + b.variance[ib] + motion_variance[ia],
        log_weight=a.log_weight[ia] + b.log_weight[ib],
    )
