"""Which four candidates may be the four lights: a search that grows with the pairs that agree, not with all.

An image alone gives each of its pairs an apex angle, a bearing across the bar and a twist. Eq. 1 of both nodes
agrees where ln(alpha cos(beta) d) is the same in both images, up to terms of alpha^2, and so does the twist: a
join of two sorted lists finds the hypotheses that pass both gaps, and only these are solved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from buddyline.solver_service.geometry.candidates import Candidates
from buddyline.solver_service.geometry.closed_form import Spans, dot
from buddyline.solver_service.geometry.evidence import GROSS_SCALE
from buddyline.solver_service.geometry.observation import Settings
from buddyline.solver_service.geometry.rig import RigPair
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.geometry.scalars import EIGHTH, FOUR, HALF, MINUS_TWO, ONE, PI, ZERO, scalar
from numpy.typing import NDArray

# The join's own error, in units of alpha^2: at the optical axis, and per tan^2 of the widest bearing. Found from
# random poses over fields of view up to 90 degrees; the twist's is smaller.
_KEY_TERM: Final = 0.03
_KEY_SLOPE: Final = 0.15
_TWIST_TERM: Final = scalar(0.03)
# The join takes the cameras to stand in the middle of their bars: what that leaves, per offset over range.
_OFFSET_SLOPE: Final = 1.5
# A bar seen at a grazing angle looks this much shorter at most.
_FORESHORTENING: Final = 0.3
# A pair whose angle is known worse than this (relative variance) says nothing.
_MAX_RELATIVE_VARIANCE: Final = scalar(0.06)
# The largest angle a bar is seen under, over length / range; and the square of the largest chord of all.
_NEAREST: Final = 1.5
_MAX_CHORD2: Final = 3.9
# The least share of a picture over which a pair may be shifted and stay in view.
_LEAST_IN_VIEW: Final = scalar(0.02)
# How the log ratio of two areas scatters (1 sd): of two lamps of a kind, and of any two candidates; and the most
# that areas may speak against two lamps.
_LIKE_LOG_AREA, _ANY_LOG_AREA = 0.8, 1.2
_LIKE_GAIN: Final = scalar(math.log(_ANY_LOG_AREA / _LIKE_LOG_AREA))
_LIKE_SLOPE: Final = scalar(0.5 / _LIKE_LOG_AREA**2 - 0.5 / _ANY_LOG_AREA**2)
_LEAST_ALIKE: Final = scalar(-1.0)
# Of so few combinations of pairs all are looked at: sorting costs more.
_FEW: Final = 2000
# Of so many combinations of pairs the gates are widened for gross errors; beyond, chance hides the right one.
_MAX_WIDE: Final = 60_000
# Gravity across the line of sight (product of both) below which both readings of left and right are weighed.
_UNDECIDED: Final = scalar(0.3)
# Twists reach no further than this, so that none is met twice.
_NEARLY_HALF_PI: Final = scalar(1.57)
_HALF_PI: Final = scalar(0.5 * math.pi)
_LEAST_COS2: Final = scalar(1e-6)


@dataclass(eq=False, slots=True)
class Pairs:
    """The pairs of candidates of either image that may be the other node's bar; P in all, `split` of them A's.

    ends: (2, P) candidates, first and second. c, w: (3, P) unit bisector and unit chord, first to second, level frame.
    key: ln(alpha cos(beta) d) with its alpha^2 term. twist_rad: from one's own bar to the direction first -> second.
    variance: of ln alpha and of the twist. chord: 2 sin(alpha / 2). log_weight: how rarely chance puts two candidates
    so near each other. tan2_beta: of the widest. fall_rad, level: gravity across the line of sight, its direction from
    one's own bar and its length.
    """

    split: int
    ends: NDArray[np.intp]
    c: Floats
    w: Floats
    key: Floats
    twist_rad: Floats
    variance: Floats
    chord: Floats
    log_weight: Floats
    tan2_beta: float
    fall_rad: Floats
    level: Floats

    @property
    def counts(self) -> tuple[int, int]:
        """Count A's and B's pairs."""
        return self.split, len(self.key) - self.split


@dataclass(eq=False, slots=True)
class Hypotheses:
    """K hypotheses: candidates (4, K) as B's left and right in A's image, A's left and right in B's.

    spans: both bars as seen. variance: (K,) of the gap of ln range, and of twist. log_weight: (K,) what does not
    depend on the pose.
    """

    lights: NDArray[np.intp]
    spans: Spans
    variance: Floats
    log_weight: Floats


@lru_cache(maxsize=64)
def _combinations(count_a: int, count_b: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Give all pairs (2, P) of A's candidates, then of B's, and whose they are (P,)."""
    of_a, of_b = np.triu_indices(count_a, 1), np.triu_indices(count_b, 1)
    ends = np.concatenate((of_a, np.add(of_b, count_a)), axis=1)
    node = np.repeat((0, 1), (len(of_a[0]), len(of_b[0])))
    ends.flags.writeable = node.flags.writeable = False
    return ends, node


@lru_cache(maxsize=64)
def _bounds(rigs: RigPair, counts: tuple[int, int], range_min_m: float, range_max_m: float) -> Floats:
    """Give the least and the largest chord^2 of all pairs, and the length^2 of the bar they are seen from (3, P)."""
    _, node = _combinations(*counts)
    own_m2, other_m2 = rigs.length_m**2, rigs.length_m[::-1] ** 2
    shortest = (_FORESHORTENING / range_max_m) ** 2 * other_m2
    longest = np.minimum((_NEAREST / range_min_m) ** 2 * other_m2, _MAX_CHORD2)
    bounds = np.array((shortest, longest, own_m2)).take(node, axis=1)
    bounds.flags.writeable = False
    return bounds


def find_pairs(candidates: Candidates, rigs: RigPair, down: tuple[Floats, Floats], settings: Settings) -> Pairs:
    """Give the pairs whose angle fits the other node's bar within the range limits; down: in each level frame."""
    ends, node = _combinations(*candidates.counts)
    shortest2, longest2, own_m2 = _bounds(rigs, candidates.counts, settings.range_min_m, settings.range_max_m)
    one, two = candidates.table.take(ends, 1).swapaxes(0, 1)
    w, total = two - one, two + one
    # Of the cross product of the two, what turns about the bar.
    about = one[1] * two[2] - one[2] * two[1]
    chord2 = dot(w[:3], w[:3])
    variance = total[5] / chord2
    keep = (chord2 >= shortest2) & (chord2 <= longest2) & (variance < _MAX_RELATIVE_VARIANCE)
    if np.count_nonzero(keep) < len(keep):
        kept = keep.nonzero()[0]
        ends, node, own_m2 = ends.take(kept, 1), node[kept], own_m2[kept]
        w, total, about = w.take(kept, 1), total.take(kept, 1), about[kept]
        chord2, variance = chord2[kept], variance[kept]
    # One glow may give several candidates: within it, that two are near each other is no rarity.
    crowded2 = np.maximum(chord2, total[6])
    chord = np.sqrt(chord2)
    norm = np.sqrt(FOUR - chord2)
    total /= norm
    sin_beta = total[0]
    cos_beta2 = np.maximum(ONE - sin_beta * sin_beta, _LEAST_COS2)
    room = ONE - np.abs(w[3:5])
    falls = np.array(down).T.take(node, 1)
    # Gravity along the bar and along its perpendicular, both as seen across the line of sight.
    along = falls[0] - sin_beta * dot(falls, total[:3])
    across = falls[1] * total[2] - falls[2] * total[1]
    return Pairs(
        split=int(node.searchsorted(1)),
        ends=ends,
        c=total[:3],
        w=w[:3] / chord,
        key=HALF * np.log(chord2 * cos_beta2 * own_m2) + EIGHTH * chord2,
        twist_rad=np.arctan2(MINUS_TWO * about / norm, w[0]),
        variance=variance,
        chord=chord,
        log_weight=-np.log(crowded2 * np.maximum(room[0] * room[1], _LEAST_IN_VIEW)),
        tan2_beta=1.0 / float(np.minimum.reduce(cos_beta2, initial=1.0)) - 1.0,
        fall_rad=np.arctan2(across, along),
        level=np.sqrt((along * along + across * across) / cos_beta2),
    )


def _alike(log_area: Floats) -> Floats:
    """Give the log likelihood ratio (K,) of the areas (4, K) for lamps of a kind, against any candidates."""
    square = (log_area[::2] - log_area[1::2]) ** 2
    weight = np.maximum(_LIKE_GAIN - _LIKE_SLOPE * square, _LEAST_ALIKE)
    total: Floats = weight[0] + weight[1]
    return total


def join(
    pairs: Pairs, rigs: RigPair, gate_sigma: float, motion_variance: Floats, *, by_range: bool, by_twist: bool
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Give the combinations of A's and B's pairs that pass the gates, and whether one order swaps.

    motion_variance: of A's pairs, what relative motion between the exposures adds to both gaps, rad^2.
    swap: the twists agree where one of the two pairs is read second -> first.
    """
    split, in_b = pairs.counts
    chord, variance, variance_b = pairs.chord[:split], pairs.variance[:split] + motion_variance, pairs.variance[split:]
    key_a, key_b = pairs.key[:split], pairs.key[split:]
    length_a_m, length_b_m = rigs.length_m.tolist()
    slack = (_OFFSET_SLOPE * rigs.offset_m / length_b_m) * chord
    chord2 = (max(1.0, length_a_m / length_b_m) * chord) ** 2
    slack_range = (_KEY_TERM + _KEY_SLOPE * pairs.tan2_beta) * chord2 + slack
    slack_twist = _TWIST_TERM * chord2 + slack
    if by_range and by_twist and split * in_b <= _FEW:
        off = np.abs(key_a[:, None] - key_b)
        near = off < gate_sigma * np.sqrt(variance[:, None] + variance_b) + slack_range[:, None]
        ia, ib = np.divmod(near.ravel().nonzero()[0], in_b)
        ib += split
    else:
        if by_range:
            # B's pair looks no shorter than this where it matches A's: cos(beta_B) is at most one.
            least2 = np.exp(2.0 * key_a) / length_b_m**2
            worst = variance + np.maximum.reduce(variance_b * pairs.chord[split:] ** 2) / least2
        else:
            worst = variance + np.maximum.reduce(variance_b)
        reach = gate_sigma * np.sqrt(worst)
        if by_twist:
            # Both orders swapped leave the difference of the twists as it is, one swapped adds pi.
            twist_rad = pairs.twist_rad % PI
            reach = np.minimum(reach + slack_twist, _NEARLY_HALF_PI)
            ia, ib = _near(twist_rad[:split], reach, twist_rad[split:], period=np.pi)
        else:
            ia, ib = _near(key_a, reach + slack_range if by_range else np.full(split, np.inf), key_b)
        ib += split
        if by_range and by_twist:
            off = np.abs(pairs.key[ia] - pairs.key[ib])
            keep = off < gate_sigma * np.sqrt(variance[ia] + pairs.variance[ib]) + slack_range[ia]
            ia, ib = ia[keep], ib[keep]
    off_half_turn = np.abs(np.abs(pairs.twist_rad[ia] - pairs.twist_rad[ib]) - PI)
    swap = off_half_turn < _HALF_PI
    if by_twist:
        off = np.minimum(off_half_turn, PI - off_half_turn)
        gate = gate_sigma * np.sqrt(variance[ia] + pairs.variance[ib]) + slack_twist[ia]
        keep = off < np.minimum(gate, _NEARLY_HALF_PI)
        ia, ib, swap = ia[keep], ib[keep], swap[keep]
    return ia, ib, swap


def _near(
    of_a: Floats, reach: Floats, of_b: Floats, *, period: float | None = None
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Join two lists: give the places in both of all that are no further apart than reach, which belongs to of_a."""
    order = of_b.argsort(kind="stable")
    values = of_b[order]
    if period is not None:
        values, order = np.concatenate((values - period, values, values + period)), np.tile(order, 3)
    low = values.searchsorted(of_a - reach)
    count = values.searchsorted(of_a + reach, side="right") - low
    ia = np.arange(len(of_a)).repeat(count)
    return ia, order[np.arange(len(ia)) - (count.cumsum() - count - low).repeat(count)]


def search(
    candidates: Candidates, pairs: Pairs, rigs: RigPair, motion_variance: Floats, settings: Settings
) -> Hypotheses | Literal["range_gap", "twist_gap"]:
    """Give the hypotheses whose gaps pass, read as gravity has them, or the name of the gap that none passes."""
    by_range, by_twist = "range" in settings.checks, "twist" in settings.checks
    gate = settings.gate_sigma
    if math.prod(pairs.counts) <= _MAX_WIDE:
        gate *= GROSS_SCALE
    ia, ib, swap = join(pairs, rigs, gate, motion_variance, by_range=by_range, by_twist=by_twist)
    if not len(ia):
        if not (by_range and by_twist):
            return "range_gap" if by_range else "twist_gap"
        ia, ib, swap = join(pairs, rigs, gate, motion_variance, by_range=True, by_twist=False)
        return "twist_gap" if len(ia) else "range_gap"
    # With first -> second as left -> right in A, and B read to agree with it, B's gravity turned into A's frame;
    # across the line of sight the two count the other way round.
    apart = pairs.twist_rad[ia] - pairs.fall_rad[ia] - pairs.fall_rad[ib]
    upright = pairs.level[ia] * pairs.level[ib] * np.cos(apart)
    flip = upright < ZERO
    undecided = (np.abs(upright) < _UNDECIDED).nonzero()[0]
    if len(undecided):
        both = np.concatenate((np.arange(len(ia)), undecided))
        ia, ib, swap = ia[both], ib[both], swap[both]
        flip = np.concatenate((flip, ~flip[undecided]))
    both = np.array((ia, ib))
    # A's pair, then B's, behind all others where its second is the left light.
    as_read = both + np.array((flip, swap != flip)) * len(pairs.key)
    lights = np.concatenate((pairs.ends, pairs.ends[::-1]), 1).take(as_read, 1).swapaxes(0, 1).reshape(4, -1)
    w = np.concatenate((pairs.w, -pairs.w), 1).take(as_read, 1)
    ends = candidates.bearings.take(lights, 1).reshape(3, 2, 2, -1).transpose(2, 1, 0, 3)
    log_weight = pairs.log_weight[ia] + pairs.log_weight[ib]
    log_weight += _alike(candidates.log_area[lights])
    if candidates.log_score is not None:
        log_weight += np.add.reduce(candidates.log_score[lights])
    return Hypotheses(
        lights=lights,
        spans=Spans(ends, pairs.c.take(both, 1).swapaxes(0, 1), w.swapaxes(0, 1), pairs.chord[both]),
        variance=pairs.variance[ia] + pairs.variance[ib] + motion_variance[ia],
        log_weight=log_weight,
    )
