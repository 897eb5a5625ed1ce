"""What becomes of a trigger: a pose, or the reason why there is none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from buddyline.solver_service.geometry.compasses import Contradiction, HeadingGap
from buddyline.solver_service.geometry.observation import Reason
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.geometry.se3 import SE3

# No picture tells ranges beyond this from each other. Rounded to three digits it is the last one below 1000 m.
MOST_TOLD_M: Final = 999.5


@dataclass(frozen=True, eq=False)
class Fix:
    """A pose. T_a_b maps B's camera frame into A's.

    covariance: (6, 6), position in A's camera frame, then the small rotation w with R_true = exp(w) R_a_b, in
    A's camera frame. pair_a: indices into view A of B's (left, right) light, -1 where it was not seen; pair_b
    likewise. chi2: of the picture coordinates, two degrees of freedom. probability: against chance and others.
    heading: how the pose compares with both headings, None without attitudes. all_four: the probability that the
    candidates are all four lights, by this trigger alone.
    """

    T_a_b: SE3
    covariance: Floats
    range_a_m: float
    range_b_m: float
    range_gap_m: float
    twist_gap_rad: float
    chi2: float
    hypotheses: int
    pair_a: tuple[int, int]
    pair_b: tuple[int, int]
    method: str
    checks: tuple[str, ...]
    probability: float
    heading: HeadingGap | None = None
    all_four: float = 0.0

    @property
    def t_a_b_m(self) -> Floats:
        """Where B's camera is (3,), in A's camera frame."""
        return self.T_a_b.t_m

    @property
    def q_a_b_xyzw(self) -> Floats:
        """How B's camera is turned (4,), from its frame to A's."""
        return self.T_a_b.q_xyzw


def in_metres(range_m: float) -> str:
    """Return a range in words. The words give no digits of a range beyond MOST_TOLD_M."""
    return f"{range_m:.3g} m" if range_m < MOST_TOLD_M else "1000 m or more"


@dataclass(frozen=True)
class NoFix:
    """Why there is no pose: detail is for a person. all_four: as in Fix.

    contradiction: the pose that would be there but for both headings, where a compass may be off.
    """

    reason: Reason
    detail: str
    all_four: float = 0.0
    contradiction: Contradiction | None = None

    @property
    def silent(self) -> bool:
        """Whether the trigger says nothing of the lamps."""
        return self.reason in ("too_few_candidates", "degenerate", "out_of_range")
