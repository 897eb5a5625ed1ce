"""Backward over a track's steps: what came later corrects what came before (Rauch, Tung and Striebel)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log
from buddyline.solver_service.track.estimate import Step
from buddyline.solver_service.track.output import TrackRow, row_of
from buddyline.solver_service.track.state import NAV, State
from buddyline.solver_service.track.strapdown import predicted


def smoothed(steps: Sequence[Step]) -> list[tuple[State, Floats]]:
    """Give the state and covariance of each step by all steps' measurements.

    Backward, C = P F^T (P-)^-1 with P- = F P F^T + Q; the state is off its filtered one by C (x+1 - x-), its covariance
    P + C (P+1 - P-) C^T.
    """
    state, P = steps[-1].after, steps[-1].covariance
    out = [(state, P)]
    for k in range(len(steps) - 2, -1, -1):
        step, later = steps[k], steps[k + 1]
        P_before = predicted(step.covariance, later.F, later.Q, later.walk)
        across = step.covariance.copy()
        across[:, :NAV] = step.covariance @ later.F.T
        gain = np.linalg.solve(P_before, across.T).T
        error = gain @ state.minus(later.before)
        P = step.covariance + gain @ (P - P_before) @ gain.T
        P = 0.5 * (P + P.T)
        state = step.after.plus(error)
        out.append((state, P))
    out.reverse()
    return out


def rows_between(
    steps: Sequence[Step], results: Sequence[tuple[State, Floats]], times_s: Floats, stamps_ns: Sequence[int]
) -> list[TrackRow]:
    """Give the smoothed steps' rows at times (N,) within them, by Hermite interpolation."""
    at = np.array([step.t_s for step in steps])
    rows: list[TrackRow] = []
    if len(at) < 2:
        return rows
    for i in np.flatnonzero((times_s >= at[0] - 1e-3) & (times_s <= at[-1] + 1e-3)).tolist():
        k = min(max(int(np.searchsorted(at, times_s[i], side="right")) - 1, 0), len(at) - 2)
        row = _row_between(steps, results, k, float(times_s[i]), stamps_ns[i])
        if row is not None:
            rows.append(row)
    return rows


def _row_between(
    steps: Sequence[Step], results: Sequence[tuple[State, Floats]], k: int, t_s: float, stamp_ns: int
) -> TrackRow | None:
    one, two = steps[k], steps[k + 1]
    (state, P), (after, P_after) = results[k], results[k + 1]
    span = max(two.t_s - one.t_s, 1e-6)
    a = (t_s - one.t_s) / span
    # Cubic Hermite polynomials: of the end point, and of the slopes at both ends.
    end, slope0, slope1 = a * a * (3.0 - 2.0 * a), a * (1.0 - a) ** 2, a * a * (a - 1.0)
    r = state.r_m + end * (after.r_m - state.r_m) + span * (slope0 * state.v_mps + slope1 * after.v_mps)
    v = state.v_mps + a * (after.v_mps - state.v_mps)
    R = []
    for node in (0, 1):
        turn = rotation_log(state.R[node].T @ after.R[node])
        rates = one.rates_radps[node], two.rates_radps[node]
        if k == 0:
            rates = turn / span, turn / span
        R.append(state.R[node] @ rotation_exp(end * turn + span * (slope0 * rates[0] + slope1 * rates[1])))
    b = min(max(a, 0.0), 1.0)
    near = one if b < 1.0 else two
    return row_of(
        stamp_ns,
        state.moved(r, v, np.stack(R)),
        (1.0 - b) * P + b * P_after,
        (1.0 - b) * one.rates_radps + b * two.rates_radps,
        near.lights,
        max(t_s - near.light_s, 0.0),
    )
