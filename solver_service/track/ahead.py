"""Increments of many steps at once, as each node's own axes see them, before the attitudes are known.

What samples say of a step hardly depends on the track: in the axes that a node has at the step's start it depends on
the unit's constants alone, and on those nearly linearly (Forster et al. 2017, preintegration). So the samples of many
steps are integrated together about the constants of the moment. When a step's turn comes, its increments are corrected
by their own Jacobian for what the constants have changed since, and turned to level.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, skew
from buddyline.solver_service.track.moving import HOLD_S
from buddyline.solver_service.track.samples import Samples
from buddyline.solver_service.track.strapdown import OWN, Carried, Increments, NodesCarried, SampleGrid, integrate
from numpy.typing import NDArray

# Constants may change by so much before steps are integrated anew: the gyro's bias, the accelerometer's, mount, lever
# arm, delay. What is neglected is the square of that, and how shaking changes the force within the delay's change.
TOLERANCES: Final = np.repeat((5e-3, 5e-2, 5e-3, 2e-2, 1e-3), (3, 3, 3, 3, 1))
_IDENTITY: Final[Floats] = np.eye(3)


@dataclass(frozen=True, eq=False)
class StepsAhead:
    """Increments of steps (M) of both nodes in the axes that each has at the step's start.

    at: a step's place by its two times. constants (2, 13): that they were integrated about, in the order of TOLERANCES.
    R (M, 2, 3, 3). gained (M, 2, 2, 3): dv, dp. jacobian (M, 2, 3, 3, OWN + 2): of attitude, dv and dp, with the
    shares' two columns last. by_change (M, 2, 3, 3, 13): of the same by the constants, to correct them. rates_radps (M,
    2, 3): uncorrected, at the end. sudden_rad (M, 2): as in Increments. by_shares: whether the shares were asked for.
    """

    at: dict[tuple[float, float], int]
    constants: Floats
    R: Floats
    gained: Floats
    jacobian: Floats
    by_change: Floats
    rates_radps: Floats
    sudden_rad: Floats
    by_shares: bool

    def fits(self, state: Carried) -> bool:
        """Whether the constants are still near enough to those that the steps were integrated about."""
        return bool((np.abs(_constants(state) - self.constants) <= TOLERANCES).all())

    def increments(self, state: Carried, k: int) -> Increments:
        """Give a step's increments for the state at its start."""
        changed = _constants(state) - self.constants
        moved = (self.by_change[k] @ changed[:, None, :, None])[..., 0]
        R0 = state.R[:, None]
        gained = (R0 @ (self.gained[k] + moved[:, 1:])[..., None])[..., 0]
        jacobian = R0 @ self.jacobian[k]
        # An error of attitude at the start turns all that the samples say.
        jacobian[:, 0, :, :3] = _IDENTITY
        jacobian[:, 1:, :, :3] = skew(-gained)
        rates = rotation_exp(state.mount_rad) @ (self.rates_radps[k] - state.gyro_bias_radps)[..., None]
        return Increments(
            R=state.R @ rotation_exp(moved[:, 0]) @ self.R[k],
            dv_mps=gained[:, 0],
            dp_m=gained[:, 1],
            jacobian=jacobian[..., :OWN].reshape(2, 9, OWN),
            gap_s=np.zeros(2),
            rate_radps=rates[..., 0],
            by_fast=jacobian[..., OWN:].reshape(2, 9, 2) if self.by_shares else None,
            without=np.zeros(2, dtype=bool),
            sudden_rad=self.sudden_rad[k],
        )


@dataclass(frozen=True, eq=False)
class ToldSteps:
    """The samples of those steps (M) of both nodes that samples tell throughout.

    told (M,): which they are. values (M, 2, P, 13): as in SampleSteps. grid: the same of nodes (2 M), with fast parts.
    """

    told: NDArray[np.intp]
    values: Floats
    grid: SampleGrid


def told_steps(of_nodes: Sequence[Samples], delays_s: Floats, times_s: Floats) -> ToldSteps:
    """Give the samples between times (M + 1,), which each unit's stamps exceed by its delay (2,)."""
    seen = [
        samples.steps(times_s + delay_s, HOLD_S - delay_s)
        for samples, delay_s in zip(of_nodes, delays_s.tolist(), strict=True)
    ]
    told = np.flatnonzero(np.logical_and.reduce([of_node.told for of_node in seen]))
    most, count = max(of_node.times_s.shape[1] for of_node in seen), len(of_nodes) * len(told)
    grid_s, values, slow_radps = np.empty((len(told), 2, most)), np.empty((len(told), 2, most, 13)), []
    for node, of_node in enumerate(seen):
        # Intervals of no length at the end, where the other node has more samples.
        at = np.minimum(np.arange(most), of_node.times_s.shape[1] - 1)
        grid_s[:, node], values[:, node] = of_node.times_s[told][:, at], of_node.values[told][:, at]
        slow_radps.append(of_node.slow_radps[told])
    each = values.reshape(count, most, 13)
    grid = SampleGrid(
        times_s=grid_s.reshape(count, most),
        values=each[..., :6],
        told=np.ones((count, most - 1), dtype=bool),
        onward_radps=each[:, -1, 3:6],
        slow_radps=np.stack(slow_radps, axis=1).reshape(count, 2, 3),
        fast=each[..., 6:12],
    )
    return ToldSteps(told, values, grid)


def steps_ahead(
    of_nodes: Sequence[Samples], state: Carried, times_s: Sequence[float], *, by_shares: bool
) -> StepsAhead:
    """Integrate both nodes' samples between times (M + 1,), but for steps that samples do not tell throughout.

    by_shares: whether to tell what shares of the samples' fast parts do.
    """
    steps = told_steps(of_nodes, state.delay_s, np.array(times_s))
    told, values, grid = steps.told, steps.values, steps.grid if by_shares else replace(steps.grid, fast=None)
    count, most = grid.times_s.shape
    each = values.reshape(count, most, 13)
    rates_radps = each[:, :, 3:6]
    constants = _constants(state)
    gyro, accel, mount, lever, delay = np.split(np.tile(constants, (len(told), 1)), (3, 6, 9, 12), axis=1)
    # Level is here what a node's own axes are at the step's start.
    start = NodesCarried(np.broadcast_to(_IDENTITY, (count, 3, 3)), gyro, accel, mount, lever, delay[:, 0])
    parts = integrate(start, grid)
    # To correct for lever arm and delay, unlike to estimate them, what the unit itself shakes counts.
    by_change = integrate(start, replace(grid, slow_radps=rates_radps[:, [0, -1]], fast=None)).jacobian[..., 3:]
    # Samples that are d later: the end comes d later, and the start's axes are those of d later.
    mount, span_s = rotation_exp(mount), (grid.times_s[:, -1] - grid.times_s[:, 0])[:, None]
    f0, f1 = (mount @ (each[:, end, :3] - accel)[..., None] for end in (0, -1))
    w0 = skew((mount @ (rates_radps[:, 0] - gyro)[..., None])[..., 0])
    by_change[:, 3:6, -1] = (parts.R @ f1 - f0 - w0 @ parts.dv_mps[..., None])[..., 0]
    by_change[:, 6:9, -1] = parts.dv_mps - span_s * f0[..., 0] - (w0 @ parts.dp_m[..., None])[..., 0]
    jacobian = np.zeros((count, 9, OWN + 2))
    jacobian[..., :OWN] = parts.jacobian
    if parts.by_fast is not None:
        jacobian[..., OWN:] = parts.by_fast
    return StepsAhead(
        at={(times_s[k], times_s[k + 1]): n for n, k in enumerate(told.tolist())},
        constants=constants,
        R=parts.R.reshape(-1, 2, 3, 3),
        gained=np.stack((parts.dv_mps, parts.dp_m), axis=1).reshape(-1, 2, 2, 3),
        jacobian=jacobian.reshape(-1, 2, 3, 3, OWN + 2),
        by_change=by_change.reshape(-1, 2, 3, 3, OWN - 3),
        rates_radps=values[:, :, -1, 3:6],
        sudden_rad=values[..., 12].max(axis=2),
        by_shares=by_shares,
    )


def _constants(state: Carried) -> Floats:
    """Give the constants (2, 13) in the order of TOLERANCES, which is that of an increment's Jacobian."""
    return np.concatenate(
        (state.gyro_bias_radps, state.accel_bias_mps2, state.mount_rad, state.lever_m, state.delay_s[:, None]), axis=1
    )
