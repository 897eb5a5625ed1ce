"""The exact closed form, and the paper's, for many hypotheses at once.

Damron, Quattrini Li, Rekleitis 2018, Eq. 1, with beta taken in the plane of the bar and the other camera, and
the bar's middle where it really is between its two light images: the median of the triangle stands off the
apex's bisector by phi / 2 with phi = beta - asin(sin beta cos alpha), alpha the apex angle and beta the
bearing of the apex at the middle of the base.

Arrays hold both nodes' views on their first axis, 0: A sees B's lights, 1: B sees A's; hypotheses on the last.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np

from solver_service.geometry.rig import Rig
from solver_service.geometry.rotation import Floats

Variant: TypeAlias = Literal["exact", "paper", "paper_midpoint", "paper_literal"]

# Each round shrinks the error by about alpha^2 / 4, and where a bar does not pass through its camera by the ratio
# of that offset to the range.
_ROUNDS: Final = 9


@dataclass(frozen=True, eq=False)
class Bars:
    """The two light bars, each in its own camera's frame: axis and middle (2, 3, 1), length (2, 1)."""

    axis: Floats
    middle_m: Floats
    length_m: Floats
    centred: bool

    @staticmethod
    def of(rig_a: Rig, rig_b: Rig) -> Bars:
        """Take the bars of two rigs."""
        middle_m = np.array((rig_a.middle_m, rig_b.middle_m))[:, :, None]
        return Bars(
            axis=np.array((rig_a.axis, rig_b.axis))[:, :, None],
            middle_m=middle_m,
            length_m=np.array(((rig_a.length_m,), (rig_b.length_m,))),
            centred=not middle_m.any(),
        )


@dataclass(frozen=True, eq=False)
class ClosedForm:
    """What the closed form says of K hypotheses.

    u: (2, 3, K) bearings of the other bar's middle from one's own. range_m: (2, K) l_A and l_B.
    twist_rad: (2, K) tau_A and tau_B. R_a_b: (3, 3, K), t_a_b_m: (3, K).
    """

    u: Floats
    range_m: Floats
    twist_rad: Floats
    R_a_b: Floats
    t_a_b_m: Floats

    @property
    def twist_gap_rad(self) -> Floats:
        """tau_A - tau_B (K,), within +-pi."""
        return wrap(self.twist_rad[0] - self.twist_rad[1])


def wrap(angle_rad: Floats) -> Floats:
    """Bring angles into [-pi, pi]."""
    wrapped: Floats = angle_rad - 2.0 * np.pi * np.rint(angle_rad / (2.0 * np.pi))
    return wrapped


def dot(a: Floats, b: Floats) -> Floats:
    """Scalar product over the axis before the last."""
    product: Floats = (a * b).sum(-2)
    return product


def cross(a: Floats, b: Floats) -> Floats:
    """Cross product over the axis before the last."""
    ax, ay, az = a[..., 0, :], a[..., 1, :], a[..., 2, :]
    bx, by, bz = b[..., 0, :], b[..., 1, :], b[..., 2, :]
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), axis=-2)


def eq1_range_m(cos_alpha: Floats, sin_alpha: Floats, sin_beta: Floats, length_m: Floats) -> Floats:
    """Eq. 1: the distance of the bar's middle from the camera that sees the bar of length_m under alpha."""
    sine2 = sin_beta * sin_beta
    root = np.sqrt(1.0 - cos_alpha * cos_alpha * sine2)
    range_m: Floats = length_m / (2.0 * sin_alpha) * (cos_alpha * np.sqrt(1.0 - sine2) + root)
    return range_m


def closed_form(
    left: Floats, right: Floats, bars: Bars, variant: Variant = "exact", rounds: int = _ROUNDS
) -> ClosedForm:
    """Solve K hypotheses.

    left, right: (2, 3, K) unit bearings of the other node's lights, [0] in A's frame, [1] in B's. variant:
    "paper" splits alpha in half, "paper_midpoint" takes the middle of the two images on the plane z = 1,
    "paper_literal" the latter and the angle to the optical axis for beta, as the paper's text has them.
    """
    c, w, cos_alpha, sin_alpha = _bisect(left, right)
    u, span = c, w
    if variant == "exact":
        for i in range(rounds):
            if i and not bars.centred:
                c, w, cos_alpha, sin_alpha = _bisect(*_from_middles(left, right, u, span, cos_alpha, sin_alpha, bars))
            sin_beta = np.clip(dot(u, bars.axis)[::-1], -1.0, 1.0)
            half = 0.5 * (np.arcsin(sin_beta) - np.arcsin(sin_beta * cos_alpha))
            cosine, sine = np.cos(half)[:, None], np.sin(half)[:, None]
            u, span = c * cosine - w * sine, w * cosine + c * sine
    elif variant in {"paper_midpoint", "paper_literal"}:
        middle = left / left[:, 2:3] + right / right[:, 2:3]
        u = middle / np.sqrt(dot(middle, middle))[:, None]
        span = w - u * dot(u, w)[:, None]
        span = span / np.sqrt(dot(span, span))[:, None]
    sin_beta = np.clip(dot(u, bars.axis), -1.0, 1.0)
    slant = np.sqrt(np.clip(1.0 - u[:, 2] ** 2, 0.0, 1.0)) if variant == "paper_literal" else sin_beta
    range_m = eq1_range_m(cos_alpha[::-1], sin_alpha[::-1], slant, bars.length_m)

    own = bars.axis - u * sin_beta[:, None]
    own = own / np.sqrt(dot(own, own))[:, None]
    side = cross(u, own)
    twist = np.arctan2(dot(side, span), dot(own, span))
    # The paper uses one of the two twists only.
    mean = twist[0] if variant != "exact" else twist[0] - 0.5 * wrap(twist[0] - twist[1])
    y = own[0] * np.cos(mean) + side[0] * np.sin(mean)
    z = cross(u[0], y)
    # B's frame about the same line of sight: -u_B, its bar across it, and their cross product.
    R = y[:, None] * own[1][None] - u[0][:, None] * u[1][None] - z[:, None] * side[1][None]
    t = bars.middle_m[0] + u[0] * (0.5 * (range_m[0] + range_m[1]))
    if not bars.centred:
        t = t - (R * bars.middle_m[1][None]).sum(1)
    return ClosedForm(u, range_m, twist, R, t)


def _bisect(left: Floats, right: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Give the bisector, the unit vector from left to right across it, and cos and sin of the angle."""
    total, difference = left + right, right - left
    chord2 = dot(difference, difference)
    chord = np.sqrt(chord2)
    c = total / np.sqrt(dot(total, total))[:, None]
    return c, difference / chord[:, None], 1.0 - 0.5 * chord2, chord * np.sqrt(1.0 - 0.25 * chord2)


def _from_middles(
    left: Floats, right: Floats, u: Floats, span: Floats, cos_alpha: Floats, sin_alpha: Floats, bars: Bars
) -> tuple[Floats, Floats]:
    """Move the bearings from the cameras to the middles of their own bars, by the distances known so far."""
    sin_beta = np.clip(dot(u, bars.axis), -1.0, 1.0)
    range_m = eq1_range_m(cos_alpha[::-1], sin_alpha[::-1], sin_beta, bars.length_m).mean(0)
    sin_beta, cos_beta = sin_beta[::-1, None], np.sqrt(1.0 - sin_beta * sin_beta)[::-1, None]
    middle = bars.middle_m + range_m * u
    arm = 0.5 * bars.length_m[::-1, None] * (span * cos_beta - u * sin_beta)
    moved = []
    for bearing, light in ((left, middle - arm), (right, middle + arm)):
        ray = bearing * np.sqrt(dot(light, light))[:, None] - bars.middle_m
        moved.append(ray / np.sqrt(dot(ray, ray))[:, None])
    return moved[0], moved[1]
