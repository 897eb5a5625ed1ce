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
from numpy.typing import NDArray

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

    image: (P,) as in CandidateBearings, trigger: (P,). usable: (P,) whether the angle fits, and is known well enough;
    all else holds for usable pairs alone. counts: (T, 2) of them, in A's and in B's picture.
    ends: (2, P) candidates, first and second. c, w: (3, P) unit bisector and
    unit chord, first to second, bar frame. key: ln(alpha cos(beta) d) with its alpha^2 term. twist_rad: from one's
    own bar to the direction first -> second. variance: of ln alpha and of the twist. chord: 2 sin(alpha / 2).
    log_weight: how rarely chance puts two candidates so near each other. tan2_beta: (T,) of each trigger's widest.
    gravity: (P,) complex, gravity across the line of sight: along one's own bar, and along its perpendicular.
    """

    image: Indices
    trigger: Indices
    usable: NDArray[np.bool_]
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
    gravity: NDArray[np.complex128]

    def of_node(self, node: int) -> Indices:
        """Give the usable pairs in A's pictures (0) or in B's (1)."""
        places: Indices = (self.usable & ((self.image & 1) == node)).nonzero()[0]
        return places


def _chord2_limits(rigs: RigPair, settings: Settings) -> Floats:
    """Give the least and the largest square (2, 2) of the other bar's chord in A's picture, and in B's."""
    length_a_m, length_b_m = rigs.length_m.tolist()
    shortest, longest = _FORESHORTENING / settings.range_max_m, _NEAREST / settings.range_min_m
    limits = [
        ((shortest * other_m) ** 2, min((longest * other_m) ** 2, _MAX_CHORD2)) for other_m in (length_b_m, length_a_m)
    ]
    return np.array(limits).T


def find_pairs(candidates: CandidateBearings, rigs: RigPair, down: Floats, settings: Settings) -> Pairs:
    """Give the pairs whose angle fits the other node's bar within the range limits; down: (T, 2, 3), bar frames."""
    seen = candidates
    # Each candidate with all that come after it in its picture.
    first, after = places(seen.starts[1:][seen.image] - np.arange(1, len(seen.image) + 1))
    ends = np.array((first, first + 1 + after))
    image = seen.image[first]
    node, trigger = image & 1, image >> 1
    one, two = seen.table[:, ends].swapaxes(0, 1)
    total, apart = two + one, two - one
    chord2 = dot(apart[:3], apart[:3])
    # Of the angle between the two, relative to it.
    variance = total[5] / chord2
    shortest2, longest2 = _chord2_limits(rigs, settings)[:, node]
    usable = (chord2 >= shortest2) & (chord2 <= longest2) & (variance < _MAX_RELATIVE_VARIANCE)
    # One glow may give several candidates: within it, that two are near each other is no rarity.
    crowded2 = np.maximum(chord2, total[6])
    chord = np.sqrt(chord2)
    c, w = total[:3] / np.sqrt(4.0 - chord2), apart[:3] / chord
    sin_beta = c[0]
    cos_beta2 = np.maximum(1.0 - sin_beta * sin_beta, _LEAST_COS2)
    room = 1.0 - np.abs(apart[3:5])
    # Gravity along the bar and along its perpendicular, both as seen across the line of sight.
    falls = down.reshape(-1, 3).T[:, image]
    along = falls[0] - sin_beta * dot(falls, c)
    across = falls[1] * c[2] - falls[2] * c[1]
    return Pairs(
        image=image,
        trigger=trigger,
        usable=usable,
        counts=np.bincount(image[usable], minlength=2 * seen.triggers).reshape(-1, 2),
        ends=ends,
        c=c,
        w=w,
        key=0.5 * np.log(chord2 * cos_beta2 * rigs.length_m[node] ** 2) + 0.125 * chord2,
        # Of the cross product of bisector and chord, what turns about the bar.
        twist_rad=np.arctan2(c[2] * w[1] - c[1] * w[2], w[0]),
        variance=variance,
        chord=chord,
        log_weight=-np.log(crowded2 * np.maximum(room[0] * room[1], _LEAST_IN_VIEW)),
        tan2_beta=largest(trigger[usable], 1.0 / cos_beta2[usable], seen.triggers, 1.0) - 1.0,
        gravity=(along + 1j * across) / np.sqrt(cos_beta2),
    )
