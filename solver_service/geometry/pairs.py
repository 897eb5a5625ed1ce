"""The pairs of candidates in one picture that may be the other node's bar.

A picture alone gives each of its pairs an apex angle, a bearing across the own bar and a twist.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.candidates import CandidateBearings
from buddyline.solver_service.geometry.closed_form import dot
from buddyline.solver_service.geometry.observation import Settings
from buddyline.solver_service.geometry.ragged import largest, places
from buddyline.solver_service.geometry.rig import RigPair
from buddyline.solver_service.geometry.rotation import Floats, Indices

# A bar that is seen along its length looks this much shorter at most: 17 degrees.
_FORESHORTENING: Final = 0.3
# A pair whose angle is known worse than this (relative variance) says nothing.
_MAX_RELATIVE_VARIANCE: Final = 0.06
# The largest angle a bar is seen under, over length / range; and the square of the largest chord of all (2 is 180 deg).
_NEAREST: Final = 1.5
_MAX_CHORD2: Final = 3.9
# The least share of a picture over which a pair may be shifted and stay in view.
_LEAST_IN_VIEW: Final = 0.02
# Keeps a sight along the own bar finite.
_LEAST_COS2: Final = 1e-6


@dataclass(eq=False, slots=True)
class Pairs:
    """P pairs by picture.

    image: (P,) as in CandidateBearings, trigger: (P,). counts: (T, 2) in A's and in B's picture.
    ends: (2, P) candidates, first and second. c, w: (3, P) unit bisector and
    unit chord, first to second, bar frame. key: ln(alpha cos(beta) d) with its alpha^2 term. twist_rad: from one's
    own bar to the direction first -> second. variance: of ln alpha and of the twist. chord: 2 sin(alpha / 2).
    log_weight: how rarely chance puts two candidates so near each other. tan2_beta: (T,) of each trigger's widest.
    gravity_rad, gravity_across_sight: gravity across the line of sight, its direction from one's own bar and its
    length.
    """

    image: Indices
    trigger: Indices
    counts: Indices
    ends: Indices
    c: Floats
    w: Floats
    key: Floats
    twist_rad: Floats
    variance: Floats
    chord: Floats
    log_weight: Floats
    tan2_beta: Floats
    gravity_rad: Floats
    gravity_across_sight: Floats

    def of_node(self, node: int) -> Indices:
        """Give the pairs in A's pictures (0) or in B's (1)."""
        return np.flatnonzero((self.image & 1) == node)


def find_pairs(candidates: CandidateBearings, rigs: RigPair, down: Floats, settings: Settings) -> Pairs:
    """Give the pairs whose angle fits the other node's bar within the range limits; down: (T, 2, 3), bar frames."""
    seen = candidates
    # Each candidate with all that come after it in its picture.
    first, after = places(seen.starts[1:][seen.image] - np.arange(len(seen.image)) - 1)
    ends = np.array((first, first + 1 + after))
    image = seen.image[first]
    other_m = rigs.length_m[::-1]
    shortest2 = (_FORESHORTENING / settings.range_max_m * other_m) ** 2
    longest2 = np.minimum((_NEAREST / settings.range_min_m * other_m) ** 2, _MAX_CHORD2)
    w = seen.bearing[:, ends[1]] - seen.bearing[:, ends[0]]
    chord2 = dot(w, w)
    variance = (seen.variance[ends[0]] + seen.variance[ends[1]]) / chord2
    node = image & 1
    keep = (chord2 >= shortest2[node]) & (chord2 <= longest2[node]) & (variance < _MAX_RELATIVE_VARIANCE)
    ends, image, w, chord2, variance, node = (
        ends[:, keep],
        image[keep],
        w[:, keep],
        chord2[keep],
        variance[keep],
        node[keep],
    )
    trigger = image >> 1
    one, two = seen.bearing[:, ends].swapaxes(0, 1)
    # One glow may give several candidates: within it, that two are near each other is no rarity.
    crowded2 = np.maximum(chord2, seen.disc2[ends].sum(0))
    chord, norm = np.sqrt(chord2), np.sqrt(4.0 - chord2)
    c = (one + two) / norm
    sin_beta = c[0]
    cos_beta2 = np.maximum(1.0 - sin_beta * sin_beta, _LEAST_COS2)
    # Of the cross product of the two, what turns about the bar.
    about = one[1] * two[2] - one[2] * two[1]
    room = 1.0 - np.abs(seen.place[:, ends[1]] - seen.place[:, ends[0]])
    falls = down.reshape(-1, 3).T[:, image]
    # Gravity along the bar and along its perpendicular, both as seen across the line of sight.
    along = falls[0] - sin_beta * dot(falls, c)
    across = falls[1] * c[2] - falls[2] * c[1]
    return Pairs(
        image=image,
        trigger=trigger,
        counts=np.bincount(image, minlength=2 * seen.triggers).reshape(-1, 2),
        ends=ends,
        c=c,
        w=w / chord,
        key=0.5 * np.log(chord2 * cos_beta2 * rigs.length_m[node] ** 2) + 0.125 * chord2,
        twist_rad=np.arctan2(-2.0 * about / norm, w[0]),
        variance=variance,
        chord=chord,
        log_weight=-np.log(crowded2 * np.maximum(room[0] * room[1], _LEAST_IN_VIEW)),
        tan2_beta=largest(trigger, 1.0 / cos_beta2, seen.triggers, 1.0) - 1.0,
        gravity_rad=np.arctan2(across, along),
        gravity_across_sight=np.sqrt((along * along + across * across) / cos_beta2),
    )
