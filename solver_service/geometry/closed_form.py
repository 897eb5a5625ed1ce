"""The exact closed form, and the paper's, for many hypotheses at once.

Damron, Quattrini Li, Rekleitis 2018, Eq. 1, with beta taken in the plane of the bar and the other camera, and
the bar's middle where it really is between its two light images: the median of the triangle stands off the
apex's bisector by phi / 2 with phi = beta - asin(sin beta cos alpha), alpha the apex angle and beta the
bearing of the apex at the middle of the base.

Arrays hold both nodes' views on their first axis, 0: A sees B's lights, 1: B sees A's; hypotheses on the last.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal, TypeAlias

import numpy as np
from buddyline.solver_service.geometry.rig import Rig, RigPair, pair_of
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.geometry.se3 import SE3

Variant: TypeAlias = Literal["exact", "paper", "paper_midpoint", "paper_literal"]

# A round of the split shrinks its error by about alpha^2 / 4, a round of the offset by its ratio to the range.
_ROUNDS: Final = 9
# The axes after each axis, and those after them.
_YZX: Final = np.array((1, 2, 0))
_ZXY: Final = np.array((2, 0, 1))
# Left and right of a middle.
_ENDS: Final[Floats] = np.array((-1.0, 1.0)).reshape(2, 1, 1, 1)


@dataclass(frozen=True, eq=False)
class Bars:
    """The two light bars along the x axes of their bar frames: middle (2, 3, 1), length (2, 1)."""

    middle_m: Floats
    length_m: Floats
    centred: bool

    @staticmethod
    @lru_cache(maxsize=16)
    def of(pair: RigPair) -> Bars:
        """Take the bars of two rigs."""
        return Bars(pair.middle_m[:, :, None], pair.length_m[:, None], pair.offset_m == 0.0)


@dataclass(eq=False, slots=True)
class Spans:
    """The other node's bar as each view sees it: unit bisector c and chord w (2, 3, K) left to right, chord (2, K).

    The chord's length is 2 sin(alpha / 2). ends: (2, 2, 3, K) unit bearings of left and right, those on the first axis.
    """

    ends: Floats
    c: Floats
    w: Floats
    chord: Floats

    @staticmethod
    def of(ends: Floats) -> Spans:
        """Take the ends."""
        left, right = ends
        total, difference = left + right, right - left
        chord2 = dot(difference, difference)
        chord = np.sqrt(chord2)
        return Spans(ends, total / np.sqrt(4.0 - chord2)[:, None], difference / chord[:, None], chord)


@dataclass(eq=False, slots=True)
class ClosedForm:
    """What the closed form says of K hypotheses.

    range_m: (2, K) l_A and l_B. twist_gap_rad: (K,) tau_A - tau_B, within +-pi. T_a_b: K poses.
    """

    range_m: Floats
    twist_gap_rad: Floats
    T_a_b: SE3


def wrap(angle_rad: Floats) -> Floats:
    """Bring angles into [-pi, pi]."""
    wrapped: Floats = angle_rad - (2.0 * math.pi) * np.rint(angle_rad / (2.0 * math.pi))
    return wrapped


def dot(a: Floats, b: Floats) -> Floats:
    """Scalar product over the axis before the last."""
    total: Floats = np.add.reduce(a * b, -2)
    return total


def cross(a: Floats, b: Floats) -> Floats:
    """Cross product over the axis before the last."""
    product: Floats = a[..., _YZX, :] * b[..., _ZXY, :] - a[..., _ZXY, :] * b[..., _YZX, :]
    return product


def eq1_range_m(cos_alpha: Floats, sin_alpha: Floats, sin_beta: Floats, length_m: Floats) -> Floats:
    """Eq. 1: the distance of the bar's middle from the camera that sees the bar of length_m under alpha."""
    return _eq1_range_m(cos_alpha, sin_alpha, sin_beta, np.sqrt(1.0 - sin_beta * sin_beta), length_m)


def _eq1_range_m(cos_alpha: Floats, sin_alpha: Floats, sin_beta: Floats, cos_beta: Floats, length_m: Floats) -> Floats:
    shortened = cos_alpha * sin_beta
    range_m: Floats = length_m / (2.0 * sin_alpha) * (cos_alpha * cos_beta + np.sqrt(1.0 - shortened * shortened))
    return range_m


def closed_form(left: Floats, right: Floats, rig_a: Rig, rig_b: Rig, variant: Variant = "exact") -> ClosedForm:
    """Solve K hypotheses for T_a_b between the cameras' frames.

    left, right: (2, 3, K) unit bearings of the other node's lights, [0] in A's camera frame, [1] in B's. variant:
    "paper" splits alpha in half, "paper_midpoint" takes the middle of the two images on the plane z = 1,
    "paper_literal" the latter and the angle to the optical axis for beta, as the paper's text has them.
    """
    pair = pair_of(rig_a, rig_b)
    turns = pair.R_bar_camera
    spans = Spans.of(turns @ np.array((left, right)))
    bars = Bars.of(pair)
    if variant == "exact":
        solved = solve_exact(spans, bars)
    else:
        u = spans.c
        if variant != "paper":
            u = left / left[:, 2:3] + right / right[:, 2:3]
            u = turns @ (u / np.sqrt(dot(u, u))[:, None])
        slant = None
        if variant == "paper_literal":
            slant = np.sqrt(np.clip(1.0 - (turns.swapaxes(1, 2) @ u)[:, 2] ** 2, 0.0, 1.0))
        span = spans.w - u * dot(u, spans.w)[:, None]
        span /= np.sqrt(dot(span, span))[:, None]
        solved = _pose(u, span, slant, _angles(spans.chord), bars, mean_twist=False)
    return ClosedForm(solved.range_m, solved.twist_gap_rad, pair.between_cameras(solved.T_a_b))


def solve_exact(spans: Spans, bars: Bars, *, split_rounds: int = _ROUNDS, offset_rounds: int = _ROUNDS) -> ClosedForm:
    """Solve K hypotheses between the bar frames."""
    # Where the bars are not centred, the first split only tells how to move the bearings: one round is enough.
    angles = _angles(spans.chord)
    u, span = _split(spans, angles[0], split_rounds if bars.centred else 1)
    if not bars.centred:
        for _ in range(offset_rounds):
            moved = Spans.of(_from_middles(spans.ends, u, span, angles, bars))
            angles = _angles(moved.chord)
            u, span = _split(moved, angles[0], split_rounds)
    return _pose(u, span, None, angles, bars, mean_twist=True)


def _angles(chord: Floats) -> tuple[Floats, Floats]:
    """Give cos and sin of alpha."""
    chord2 = chord * chord
    return 1.0 - 0.5 * chord2, chord * np.sqrt(1.0 - 0.25 * chord2)


def _split(spans: Spans, cos_alpha: Floats, rounds: int) -> tuple[Floats, Floats]:
    """Turn the bisector and the chord to the bar's middle, in their plane."""
    c, w = spans.c, spans.w
    cosine, sine = _off_bisector(c[:, 0], cos_alpha)
    for _ in range(rounds - 1):
        cosine, sine = _off_bisector(c[:, 0] * cosine - w[:, 0] * sine, cos_alpha)
    cosine, sine = cosine[:, None], sine[:, None]
    return c * cosine - w * sine, w * cosine + c * sine


def _off_bisector(sin_beta: Floats, cos_alpha: Floats) -> tuple[Floats, Floats]:
    """Give cos and sin of how far the bars' middles stand off the bisectors; sin_beta: as either node sees them."""
    other = sin_beta[::-1]
    half = 0.5 * (np.arcsin(other) - np.arcsin(other * cos_alpha))
    return np.cos(half), np.sin(half)


def _pose(
    u: Floats, span: Floats, slant: Floats | None, angles: tuple[Floats, Floats], bars: Bars, *, mean_twist: bool
) -> ClosedForm:
    """Put a pose together from lines of sight u and the bars across them; slant: what Eq. 1 takes for sin beta."""
    ux, uy, uz = u.swapaxes(0, 1)
    cos_beta = np.sqrt(1.0 - ux * ux)
    cos_alpha, sin_alpha = angles[0][::-1], angles[1][::-1]
    if slant is None:
        range_m = _eq1_range_m(cos_alpha, sin_alpha, ux, cos_beta, bars.length_m)
    else:
        range_m = eq1_range_m(cos_alpha, sin_alpha, slant, bars.length_m)
    twist = np.arctan2(uz * span[:, 1] - uy * span[:, 2], span[:, 0])
    twist_gap = wrap(twist[0] - twist[1])
    # The paper uses one of the two twists only.
    mean = twist[0] - 0.5 * twist_gap if mean_twist else twist[0]
    # One's own bar across the line of sight is (1 - ux^2, -ux uy, -ux uz) / cos beta; its perpendicular:
    slope = u / cos_beta[:, None]
    side = np.zeros(u.shape)
    side[:, 1], side[:, 2] = slope[:, 2], -slope[:, 1]
    own = -ux[:, None] * slope
    own[:, 0] = cos_beta
    cosine, sine = np.cos(mean), np.sin(mean)
    # What B's frame about the same line of sight is in A's: B's bar across it, u_B, and their cross product.
    in_a = np.array((own[0] * cosine + side[0] * sine, -u[0], own[0] * sine - side[0] * cosine))
    in_b = np.array((own[1], u[1], side[1]))
    R = in_a.transpose(2, 1, 0) @ in_b.transpose(2, 0, 1)
    t = (u[0] * (0.5 * (range_m[0] + range_m[1]))).T
    if not bars.centred:
        middle_a_m, middle_b_m = bars.middle_m[:, :, 0]
        t = t + middle_a_m - R @ middle_b_m
    return ClosedForm(range_m, twist_gap, SE3(R, t))


def _from_middles(ends: Floats, u: Floats, span: Floats, angles: tuple[Floats, Floats], bars: Bars) -> Floats:
    """Move the bearings (2, 2, 3, K) from the cameras to the middles of their own bars, by the distances so far."""
    cos_alpha, sin_alpha = angles
    sin_beta = u[:, 0]
    cos_beta = np.sqrt(1.0 - sin_beta * sin_beta)
    of_a_m, of_b_m = _eq1_range_m(cos_alpha[::-1], sin_alpha[::-1], sin_beta, cos_beta, bars.length_m)
    range_m = 0.5 * (of_a_m + of_b_m)
    sin_beta, cos_beta = sin_beta[::-1, None], cos_beta[::-1, None]
    middle = bars.middle_m + range_m * u
    arm = 0.5 * bars.length_m[::-1, None] * (span * cos_beta - u * sin_beta)
    light = middle + _ENDS * arm
    ray = ends * np.sqrt(dot(light, light))[:, :, None] - bars.middle_m
    moved: Floats = ray / np.sqrt(dot(ray, ray))[:, :, None]
    return moved
