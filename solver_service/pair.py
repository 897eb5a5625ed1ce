"""One pair of nodes: matched frames in, a fix or the reason against one out.

The pair's memory (motion prior, heading bias, clock alignment) lives here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, NodeInfo
from buddyline.solver_service.alignment import ClockAlignment
from buddyline.solver_service.geometry.evidence import heading_offset
from buddyline.solver_service.geometry.observation import Heading
from buddyline.solver_service.geometry.rotation import matrix_of
from buddyline.solver_service.geometry.trigger import Fix, NoFix, Rig, Sensed, Settings, solve_trigger
from buddyline.solver_service.headings import HeadingOffset
from buddyline.solver_service.prior import PosePrior
from buddyline.solver_service.results import view_of


@dataclass(frozen=True, eq=False)
class Matched:
    """The frames of nodes a and b for one trigger, with the calibration and the sensor readings for each frame.

    stamp_ns: mean of both frames' stamps. Each frame has its calibration's picture size.
    """

    trigger: int
    stamp_ns: int
    frame_a: Candidates
    frame_b: Candidates
    info_a: NodeInfo
    info_b: NodeInfo
    rig_a: Rig
    rig_b: Rig
    sensed_a: Sensed
    sensed_b: Sensed


class PairSolver:
    """Solves the triggers of one pair; alignment: collects what the fixes tell about the clocks' offset."""

    def __init__(self, settings: Settings, alignment: ClockAlignment | None = None) -> None:
        self.settings = settings
        self.alignment = alignment
        self._prior = PosePrior()
        self._headings = HeadingOffset()

    def solve(self, matched: Sequence[Matched]) -> list[Fix | NoFix]:
        """Return one result for each trigger.

        The triggers come in increasing order, also from call to call. How they are split into calls changes nothing.
        """
        return [self._solve_one(one) for one in matched]

    def forget(self) -> None:
        """Forget what earlier fixes told: a clock was set, or the values make no sense."""
        self._prior.reset()
        self._headings.reset()

    def heading(self, stamp_ns: int) -> Heading | None:
        """Return how far the two headings disagree at stamp_ns, None where too few fixes have told it."""
        return self._headings.predict(stamp_ns)

    def _solve_one(self, matched: Matched) -> Fix | NoFix:
        try:
            found = solve_trigger(
                view_of(matched.frame_a),
                view_of(matched.frame_b),
                matched.rig_a,
                matched.rig_b,
                matched.sensed_a,
                matched.sensed_b,
                self.settings,
                self._prior.predict(matched.stamp_ns),
                self._headings.predict(matched.stamp_ns),
            )
            if isinstance(found, Fix):
                self._remember(matched, found)
        except (ArithmeticError, ValueError) as error:
            # Absurd but finite values, such as 1e300, overflow or leave a singular matrix.
            self.forget()
            nodes = f"{matched.frame_a.node} or {matched.frame_b.node}"
            return NoFix("degenerate", f"values from {nodes} are out of numeric range ({error})")
        return found

    def _remember(self, matched: Matched, fix: Fix) -> None:
        if not (np.isfinite(fix.t_a_b_m).all() and np.isfinite(fix.covariance).all()):
            raise ValueError("the pose is not finite")
        self._prior.update(matched.stamp_ns, fix)
        q_a, q_b = matched.sensed_a.q_ned_body_xyzw, matched.sensed_b.q_ned_body_xyzw
        rigs = matched.rig_a, matched.rig_b
        if q_a is not None and q_b is not None and fix.method != "three_lights":
            R_a_b, covariance = matrix_of(fix.q_a_b_xyzw), fix.covariance[3:, 3:]
            self._headings.update(matched.stamp_ns, *heading_offset(R_a_b, covariance, rigs, (q_a, q_b)))
        if self.alignment is not None:
            stamp_a_ns, stamp_b_ns = matched.frame_a.stamp_ns, matched.frame_b.stamp_ns
            infos = matched.info_a, matched.info_b
            sigma_a_rad, sigma_b_rad = (info.sigma_px / info.camera.fx_px for info in infos)
            known_s = (stamp_b_ns - stamp_a_ns) / S_NS
            self.alignment.add(stamp_a_ns, fix, rigs, known_s, (sigma_a_rad, sigma_b_rad))
