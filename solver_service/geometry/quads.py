"""Which four candidates may be the four lights: a search that grows with the pairs that agree, not with all.

Eq. 1 of both nodes agrees where ln(alpha cos(beta) d) is the same in both pictures, up to terms of alpha^2, and so
does the twist: a join of two sorted lists finds the quads that pass both gaps, and only these are solved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.candidates import CandidateBearings
from buddyline.solver_service.geometry.closed_form import Spans
from buddyline.solver_service.geometry.evidence import GROSS_SCALE
from buddyline.solver_service.geometry.observation import Settings
from buddyline.solver_service.geometry.pairs import Pairs
from buddyline.solver_service.geometry.ragged import largest, places
from buddyline.solver_service.geometry.rig import RigPair
from buddyline.solver_service.geometry.rotation import Floats, Indices
from numpy.typing import NDArray

# The join's own error, in units of alpha^2: at the optical axis, and per tan^2 of the widest bearing. Found from
# random poses over fields of view up to 90 degrees; the twist's is smaller.
_KEY_TERM: Final = 0.03
_KEY_SLOPE: Final = 0.15
_TWIST_TERM: Final = 0.03
# The join takes the cameras to stand in the middle of their bars: what that leaves, per offset over range.
_OFFSET_SLOPE: Final = 1.5
# How the log ratio of two areas scatters (1 sd): of two lamps of a kind, and of any two candidates; and the most
# that areas may speak against two lamps.
_LIKE_LOG_AREA: Final = 0.8
_ANY_LOG_AREA: Final = 1.2
_LEAST_ALIKE: Final = -1.0
# Of so many combinations of pairs the gates are widened for gross errors; beyond, chance hides the right one.
_MAX_WIDE: Final = 60_000
# Gravity across the line of sight (product of both) below which both readings of left and right are weighed.
_UNDECIDED: Final = 0.3
# Twists reach no further than this, so that none is met twice.
_NEARLY_HALF_PI: Final = 1.57
# All keys of a trigger lie within this of each other: angles, cosines and lengths differ by less than e^40.
_SPREAD: Final = 40.0


@dataclass(eq=False, slots=True)
class Quads:
    """K quads by trigger: candidates (4, K) as B's left and right in A's picture, A's left and right in B's.

    spans: both bars as seen. variance: (K,) of the gap of ln range, and of twist. log_weight: (K,) what does not
    depend on the pose.
    """

    trigger: Indices
    lights: Indices
    spans: Spans
    variance: Floats
    log_weight: Floats


def find_quads(
    candidates: CandidateBearings, pairs: Pairs, rigs: RigPair, motion_variance: Floats, settings: Settings
) -> tuple[Quads, NDArray[np.bool_]]:
    """Give the quads whose gaps pass, read as gravity has them; and (T,) whether any combination has like ranges.

    motion_variance: (P,) what relative motion between the exposures adds to both gaps of a pair of A's, rad^2.
    """
    by_range, by_twist = "range" in settings.checks, "twist" in settings.checks
    wide = pairs.counts.prod(1) <= _MAX_WIDE
    gate_sigma = settings.gate_sigma * np.where(wide, GROSS_SCALE, 1.0)
    of_a = pairs.of_node(0)
    ia, ib, swap = join(pairs, of_a, rigs, gate_sigma, motion_variance, by_range=by_range, by_twist=by_twist)
    found = np.bincount(pairs.trigger[ia], minlength=candidates.triggers) > 0
    if by_range and by_twist and not found.all():
        missed = of_a[~found[pairs.trigger[of_a]]]
        near, _, _ = join(pairs, missed, rigs, gate_sigma, motion_variance, by_range=True, by_twist=False)
        found[pairs.trigger[near]] = True
    # With first -> second as left -> right in A, and B read to agree with it, B's gravity turned into A's frame;
    # across the line of sight the two count the other way round.
    apart = pairs.twist_rad[ia] - pairs.gravity_rad[ia] - pairs.gravity_rad[ib]
    upright = pairs.gravity_across_sight[ia] * pairs.gravity_across_sight[ib] * np.cos(apart)
    flip = upright < 0.0
    undecided = np.flatnonzero(np.abs(upright) < _UNDECIDED)
    both = np.concatenate((np.arange(len(ia)), undecided))
    flip = np.concatenate((flip, ~flip[undecided]))
    by_trigger = pairs.trigger[ia[both]].argsort(kind="stable")
    both, flip = both[by_trigger], flip[by_trigger]
    ia, ib, flip_b = ia[both], ib[both], swap[both] != flip
    lights = np.concatenate((_read(pairs.ends, ia, flip), _read(pairs.ends, ib, flip_b)))
    read = np.array((ia, ib))
    spans = Spans(
        ends=candidates.bearing[:, lights].reshape(3, 2, 2, -1).transpose(2, 1, 0, 3),
        c=pairs.c[:, read].swapaxes(0, 1),
        w=(pairs.w[:, read] * np.where((flip, flip_b), -1.0, 1.0)).swapaxes(0, 1),
        chord=pairs.chord[read],
    )
    quads = Quads(
        trigger=pairs.trigger[ia],
        lights=lights,
        spans=spans,
        variance=pairs.variance[ia] + pairs.variance[ib] + motion_variance[ia],
        log_weight=pairs.log_weight[read].sum(0)
        + _alike(candidates.log_area[lights])
        + candidates.log_score[lights].sum(0),
    )
    return quads, found


def _read(ends: Indices, pair: Indices, flip: NDArray[np.bool_]) -> Indices:
    """Give left and right light (2, K) of pairs, the second being the left one where flip is set."""
    return np.where(flip, ends[::-1, pair], ends[:, pair])


def _alike(log_area: Floats) -> Floats:
    """Give the log likelihood ratio (K,) of the areas (4, K) for lamps of a kind, against any candidates."""
    square = (log_area[::2] - log_area[1::2]) ** 2
    gain = math.log(_ANY_LOG_AREA / _LIKE_LOG_AREA) - 0.5 * (_LIKE_LOG_AREA**-2 - _ANY_LOG_AREA**-2) * square
    total: Floats = np.maximum(gain, _LEAST_ALIKE).sum(0)
    return total


def join(
    pairs: Pairs,
    of_a: Indices,
    rigs: RigPair,
    gate_sigma: Floats,
    motion_variance: Floats,
    *,
    by_range: bool,
    by_twist: bool,
) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """Give the combinations of A's pairs `of_a` and B's pairs that pass the gates, and whether one order swaps.

    gate_sigma: (T,). motion_variance: (P,). swap: the twists agree where one of the two pairs is read
    second -> first.
    """
    of_b = pairs.of_node(1)
    trigger_a, trigger_b, triggers = pairs.trigger[of_a], pairs.trigger[of_b], len(gate_sigma)
    variance = pairs.variance + motion_variance
    length_a_m, length_b_m = rigs.length_m
    slack = (_OFFSET_SLOPE * rigs.offset_m / length_b_m) * pairs.chord
    alpha2 = (max(1.0, length_a_m / length_b_m) * pairs.chord) ** 2
    slack_range = (_KEY_TERM + _KEY_SLOPE * pairs.tan2_beta[pairs.trigger]) * alpha2 + slack
    slack_twist = _TWIST_TERM * alpha2 + slack
    if by_range:
        # B's pair looks no shorter than this where it matches A's: cos(beta_B) is at most one.
        least2 = np.exp(2.0 * pairs.key[of_a]) / length_b_m**2
        worst = largest(trigger_b, pairs.variance[of_b] * pairs.chord[of_b] ** 2, triggers, 0.0)[trigger_a] / least2
    else:
        worst = largest(trigger_b, pairs.variance[of_b], triggers, 0.0)[trigger_a]
    reach = gate_sigma[trigger_a] * np.sqrt(variance[of_a] + worst)
    if by_twist:
        # Both orders swapped leave the difference of the twists as it is, one swapped adds pi.
        reach = np.minimum(reach + slack_twist[of_a], _NEARLY_HALF_PI)
        twist_rad = pairs.twist_rad % math.pi
        a, b = _near(twist_rad[of_a], reach, twist_rad[of_b], trigger_a, trigger_b, period=math.pi)
    else:
        reach = np.minimum(reach + slack_range[of_a], _SPREAD) if by_range else np.full(len(of_a), _SPREAD)
        a, b = _near(pairs.key[of_a], reach, pairs.key[of_b], trigger_a, trigger_b)
    ia, ib = of_a[a], of_b[b]
    gate = gate_sigma[pairs.trigger[ia]] * np.sqrt(variance[ia] + pairs.variance[ib])
    keep = np.ones(len(ia), dtype=bool)
    if by_range:
        keep &= np.abs(pairs.key[ia] - pairs.key[ib]) < gate + slack_range[ia]
    off_half_turn = np.abs(np.abs(pairs.twist_rad[ia] - pairs.twist_rad[ib]) - math.pi)
    swap = off_half_turn < 0.5 * math.pi
    if by_twist:
        off = np.minimum(off_half_turn, math.pi - off_half_turn)
        keep &= off < np.minimum(gate + slack_twist[ia], _NEARLY_HALF_PI)
    return ia[keep], ib[keep], swap[keep]


def _near(
    of_a: Floats, reach: Floats, of_b: Floats, trigger_a: Indices, trigger_b: Indices, *, period: float | None = None
) -> tuple[Indices, Indices]:
    """Join two lists by trigger: give the places in both of all no further apart than reach, which belongs to of_a.

    The triggers are laid side by side on one axis, too far apart to meet.
    """
    copies = 1
    stride = 4.0 * _SPREAD
    if period is not None:
        copies, stride = 3, 4.0 * period
        of_b = np.concatenate((of_b - period, of_b, of_b + period))
    values = of_b + stride * np.tile(trigger_b, copies)
    order = values.argsort(kind="stable")
    values, centre = values[order], of_a + stride * trigger_a
    low = values.searchsorted(centre - reach)
    a, place = places(values.searchsorted(centre + reach, side="right") - low)
    b = order[low[a] + place] % max(len(trigger_b), 1)
    same = trigger_a[a] == trigger_b[b]
    return a[same], b[same]
