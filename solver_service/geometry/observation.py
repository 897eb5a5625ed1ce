"""What goes into one trigger: what two nodes saw and sensed, what earlier fixes say, and how to decide."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal, TypeAlias

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.geometry.se3 import SE3

Method: TypeAlias = Literal["refined", "exact", "paper", "paper_midpoint", "paper_literal"]
Reason: TypeAlias = Literal[
    "unmatched",
    "too_few_candidates",
    "range_gap",
    "twist_gap",
    "attitude",
    "depth",
    "heading",
    "other_lights",
    "out_of_range",
    "ambiguous",
    "degenerate",
]
CHECKS: Final = frozenset({"range", "twist", "attitude", "depth"})


@dataclass(frozen=True, eq=False)
class Blinking:
    """What a code says of the candidates (N) of one picture.

    log_ratio: (N, 2) that each is the other node's left or right lamp, over chance. dark: whether the left and the
    right lamp are switched off in this picture.
    """

    log_ratio: Floats
    dark: tuple[bool, bool]


@dataclass(frozen=True, eq=False)
class View:
    """What one node saw at one trigger: N candidates.

    table: (N, 7), one row a candidate, with the columns that the properties name. stamp_ns: of the frame. elsewhere:
    how many more the whole picture held, where only parts were searched. blinking: what a code by which the other
    node's lamps blink says; None where they do not.
    """

    table: Floats
    stamp_ns: int
    elsewhere: int = 0
    blinking: Blinking | None = None

    @staticmethod
    def of(pixels: Floats, sigma_px: Floats, score: Floats, area_px: Floats, dt_s: Floats, stamp_ns: int) -> View:
        """Put the columns together: pixels (N, 2), all others (N,); errors are each picture's own."""
        return View(np.column_stack((pixels, sigma_px, score, area_px, dt_s, np.zeros(len(pixels)))), stamp_ns)

    @property
    def pixels(self) -> Floats:
        """Distorted picture coordinates u and v (N, 2), px."""
        return self.table[:, :2]

    @property
    def sigma_px(self) -> Floats:
        """Noise of each coordinate (N,), 1 sd."""
        return self.table[:, 2]

    @property
    def score(self) -> Floats:
        """Probability that each is a lamp (N,); NaN: unknown."""
        return self.table[:, 3]

    @property
    def area_px(self) -> Floats:
        """Area of each in the picture (N,), px^2."""
        return self.table[:, 4]

    @property
    def dt_s(self) -> Floats:
        """Exposure of each one's row after stamp_ns (N,), s."""
        return self.table[:, 5]

    @property
    def lasting_s(self) -> Floats:
        """For how long each one's error lasts (N,), s."""
        return self.table[:, 6]


@dataclass(frozen=True, eq=False)
class Sensed:
    """Attitude (body to NED; sigma: roll, pitch, yaw) and depth of the port at a trigger, None where unknown."""

    q_ned_body_xyzw: Floats | None = None
    sigma_rad: Floats | None = None
    depth_m: float | None = None
    depth_sigma_m: float | None = None


@dataclass(frozen=True, eq=False)
class Observation:
    """What nodes A and B saw and sensed at one trigger."""

    view_a: View
    view_b: View
    sensed_a: Sensed = Sensed()
    sensed_b: Sensed = Sensed()


@dataclass(frozen=True, eq=False)
class Prior:
    """A prediction from earlier fixes for this instant, its covariance (6, 6) widened for the time since.

    rates: (6,) velocity (m/s) and turn (rad/s) of B in A's camera frame, with covariance (6, 6); None: unknown.
    agreed: how many fixes in a row have agreed with those before. since_s: time since the last of them.
    """

    T_a_b: SE3
    covariance: Floats
    rates: Floats | None = None
    rates_covariance: Floats | None = None
    agreed: int = 0
    since_s: float = 0.0


@dataclass(frozen=True)
class Heading:
    """What to add to B's heading so that both headings agree with the earlier poses.

    variance: of the present headings' difference about it, their own noise included, rad^2.
    """

    offset_rad: float
    variance: float


# How far a picture's stamp may be off its exposure, 1 sd. Dives that others simulated show 1.1 ms.
STAMP_SIGMA_S: Final = 1e-3


@dataclass(frozen=True)
class Settings:
    """How triggers are solved.

    checks: what may speak for or against a hypothesis. min_probability: of the published pose, against chance and
    every other; min_oriented_probability: the same where both attitudes speak, because a right pose is then nearly
    certain; more is asked of one that no earlier pose supports. range_min_m: nearer, no picture of 60 degrees holds a
    bar of 0.57 m. gate_sigma: both gaps, in standard deviations. speed_mps, turn_radps: relative motion where the prior
    knows none (1 sd); skew_sigma_s: how well the clocks agree (1 sd); stamp_sigma_s: how well a picture's stamp tells
    its exposure (1 sd).
    """

    method: Method = "refined"
    checks: frozenset[str] = CHECKS
    range_min_m: float = 0.5
    range_max_m: float = 30.0
    min_probability: float = 0.9
    min_oriented_probability: float = 0.95
    gate_sigma: float = 4.5
    speed_mps: float = 0.2
    turn_radps: float = 0.2
    skew_sigma_s: float = 0.0
    stamp_sigma_s: float = STAMP_SIGMA_S

    @property
    def still(self) -> bool:
        """Whether clocks and stamps are taken for exact."""
        return self.skew_sigma_s == 0.0 and self.stamp_sigma_s == 0.0

    @cached_property
    def gaps(self) -> int:
        """How many of both gaps may speak."""
        return len(self.checks & {"range", "twist"})

    def __post_init__(self) -> None:
        """Refuse what cannot work."""
        if not self.checks <= CHECKS:
            raise ValueError(f"checks: {sorted(self.checks - CHECKS)} unknown, there are {sorted(CHECKS)}")
        if not 0.0 < self.range_min_m < self.range_max_m < math.inf:
            raise ValueError(f"range_min_m: {self.range_min_m:g}, range_max_m: {self.range_max_m:g}: not 0 < min < max")
        for name in ("min_probability", "min_oriented_probability"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"{name}: {getattr(self, name):g} is not in [0, 1)")
        if not 0.0 < self.gate_sigma < math.inf:
            raise ValueError(f"gate_sigma: {self.gate_sigma:g} is not positive")
