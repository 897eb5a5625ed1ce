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
from buddyline.solver_service.geometry.ragged import largest, places, starts_of
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
# The log ratio of both densities where two areas are equal, and what it loses per square of their log ratio.
_LOG_ALIKE: Final = math.log(_ANY_LOG_AREA / _LIKE_LOG_AREA)
_LOG_ALIKE_SLOPE: Final = 0.5 * (_LIKE_LOG_AREA**-2 - _ANY_LOG_AREA**-2)
# Up to this many combinations of pairs, the gates are widened for gross errors; beyond, chance hides the right one.
_MAX_WIDE: Final = 60_000
# Up to this many combinations of pairs in a trigger, each is looked at: that costs less than sorting.
_FEW: Final = 2000
# Gravity across the line of sight (product of both) below which both readings of left and right are weighed.
_UNDECIDED: Final = 0.3
# Twists reach no further than this, so that none is met twice.
_NEARLY_HALF_PI: Final = 1.57
# All keys of a trigger lie within this of each other: angles, cosines and lengths differ by less than e^40.
_SPREAD: Final = 40.0
# Between the places of two triggers on one axis: more than twists (rad) and keys reach.
_STRIDE: Final = 4.0 * _SPREAD
# What may be added to a twist (rad), and to a key.
_HALF_TURNS: Final[Floats] = math.pi * np.array([[-1.0], [0.0], [1.0]])
_AS_IT_IS: Final[Floats] = np.zeros((1, 1))


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
    wide = pairs.counts[:, 0] * pairs.counts[:, 1] <= _MAX_WIDE
    gate_sigma = np.where(wide, settings.gate_sigma * GROSS_SCALE, settings.gate_sigma)
    of_a = pairs.of_node(0)
    ia, ib, swap = join(pairs, of_a, rigs, gate_sigma, motion_variance, by_range=by_range, by_twist=by_twist)
    found = np.bincount(pairs.trigger[ia], minlength=candidates.triggers) > 0
    if by_range and by_twist and not found.all():
        missed = of_a[~found[pairs.trigger[of_a]]]
        near, _, _ = join(pairs, missed, rigs, gate_sigma, motion_variance, by_range=True, by_twist=False)
        found[pairs.trigger[near]] = True
    # With first -> second as left -> right in A, and B read to agree with it, B's gravity turned into A's frame;
    # across the line of sight the two count the other way round.
    upright = (np.exp(-1j * pairs.twist_rad[ia]) * pairs.gravity[ia] * pairs.gravity[ib]).real
    flip = upright < 0.0
    (undecided,) = (np.abs(upright) < _UNDECIDED).nonzero()
    if len(undecided):
        both = np.concatenate((np.arange(len(ia)), undecided))
        flip = np.concatenate((flip, ~flip[undecided]))
        by_trigger = pairs.trigger[ia[both]].argsort(kind="stable")
        both, flip = both[by_trigger], flip[by_trigger]
        ia, ib, swap = ia[both], ib[both], swap[both]
    # The pairs (2, K) in A's and in B's picture, and whether their second end is the left light.
    read, turned = np.array((ia, ib)), np.array((flip, swap != flip))
    ends = pairs.ends[:, read]
    # (2, 2, K): left and right, then in A's picture and in B's.
    lights = np.where(turned, ends[::-1], ends)
    log_score = candidates.log_score[lights]
    if candidates.log_side is not None:
        log_score += candidates.log_side[lights, np.array((0, 1))[:, None, None]]
    quads = Quads(
        trigger=pairs.trigger[ia],
        lights=lights.swapaxes(0, 1).reshape(4, -1),
        spans=Spans(
            ends=candidates.bearing[:, lights].transpose(1, 2, 0, 3),
            c=pairs.c[:, read].swapaxes(0, 1),
            w=(pairs.w[:, read] * np.where(turned, -1.0, 1.0)).swapaxes(0, 1),
            chord=pairs.chord[read],
        ),
        variance=np.add.reduce(pairs.variance[read], 0) + motion_variance[ia],
        log_weight=np.add.reduce(
            pairs.log_weight[read] + _alike(candidates.log_area[lights]) + log_score[0] + log_score[1], 0
        ),
    )
    return quads, found


def _alike(log_area: Floats) -> Floats:
    """Give the log likelihood ratio (2, K) of the areas (2, 2, K) for two lamps of a kind, against any candidates."""
    off = log_area[0] - log_area[1]
    ratio: Floats = np.maximum(_LOG_ALIKE - _LOG_ALIKE_SLOPE * (off * off), _LEAST_ALIKE)
    return ratio


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
    trigger_a, in_b = pairs.trigger[of_a], pairs.counts[:, 1]
    variance_a, variance_b = pairs.variance[of_a] + motion_variance[of_a], pairs.variance[of_b]
    chord_a, gate_a = pairs.chord[of_a], gate_sigma[trigger_a]
    length_a_m, length_b_m = rigs.length_m.tolist()
    slack = (_OFFSET_SLOPE * rigs.offset_m / length_b_m) * chord_a
    alpha2 = max(1.0, length_a_m / length_b_m) ** 2 * (chord_a * chord_a)
    slack_range = (_KEY_TERM + _KEY_SLOPE * pairs.tan2_beta[trigger_a]) * alpha2 + slack
    slack_twist = _TWIST_TERM * alpha2 + slack
    crowded = pairs.counts[:, 0] * in_b > _FEW
    a, place = places(np.where(crowded, 0, in_b)[trigger_a])
    b = starts_of(in_b)[trigger_a[a]] + place
    if crowded.any():
        (among,) = crowded[trigger_a].nonzero()
        reach = gate_a * np.sqrt(variance_a + _worst_variance(pairs, of_a, of_b, length_b_m, by_range=by_range))
        if by_twist:
            # Both orders swapped leave the difference of the twists as it is, one swapped adds pi.
            reach = np.minimum(reach + slack_twist, _NEARLY_HALF_PI)
            more_a, more_b = _near(
                pairs.twist_rad % math.pi, of_a[among], of_b, reach[among], pairs.trigger, _HALF_TURNS
            )
        else:
            reach = np.minimum(reach + slack_range, _SPREAD) if by_range else np.full(len(of_a), _SPREAD)
            more_a, more_b = _near(pairs.key, of_a[among], of_b, reach[among], pairs.trigger, _AS_IT_IS)
        a, b = np.concatenate((a, among[more_a])), np.concatenate((b, more_b))
        in_order = a.argsort(kind="stable")
        a, b = a[in_order], b[in_order]
    ia, ib = of_a[a], of_b[b]
    gate = gate_a[a] * np.sqrt(variance_a[a] + variance_b[b])
    keep = np.ones(len(ia), dtype=bool)
    if by_range:
        keep = np.abs(pairs.key[ia] - pairs.key[ib]) < gate + slack_range[a]
    off_half_turn = np.abs(np.abs(pairs.twist_rad[ia] - pairs.twist_rad[ib]) - math.pi)
    swap = off_half_turn < 0.5 * math.pi
    if by_twist:
        off = np.minimum(off_half_turn, math.pi - off_half_turn)
        keep &= off < np.minimum(gate + slack_twist[a], _NEARLY_HALF_PI)
    return ia[keep], ib[keep], swap[keep]


def _worst_variance(pairs: Pairs, of_a: Indices, of_b: Indices, length_b_m: float, *, by_range: bool) -> Floats:
    """Give the largest variance of any pair of B's that may match each of A's, of_a."""
    trigger_a, trigger_b = pairs.trigger[of_a], pairs.trigger[of_b]
    variance_b, triggers = pairs.variance[of_b], len(pairs.counts)
    if not by_range:
        return largest(trigger_b, variance_b, triggers, 0.0)[trigger_a]
    # B's pair looks no shorter than this where it matches A's: cos(beta_B) is at most one.
    least2 = np.exp(2.0 * pairs.key[of_a]) / length_b_m**2
    worst: Floats = largest(trigger_b, variance_b * pairs.chord[of_b] ** 2, triggers, 0.0)[trigger_a] / least2
    return worst


def _near(
    values: Floats, of_a: Indices, of_b: Indices, reach: Floats, trigger: Indices, turns: Floats
) -> tuple[Indices, Indices]:
    """Join the pairs of_a and of_b by trigger: give the places in both of all whose values are within reach (of A's).

    turns: (n, 1) what may be added to B's values. The triggers are laid side by side on one axis, too far apart to
    meet.
    """
    values = values + _STRIDE * trigger
    of_each = (values[of_b] + turns).ravel()
    order = of_each.argsort(kind="stable")
    of_each, centre = of_each[order], values[of_a]
    low = of_each.searchsorted(centre - reach)
    a, place = places(of_each.searchsorted(centre + reach, side="right") - low)
    return a, order[low[a] + place] % max(len(of_b), 1)
