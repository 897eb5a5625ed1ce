"""Whether both nodes' pictures tell one distance: a bar that is not as long as stated, or a focal length that is off.

If B's bar is 1 + s / 2 times as long as stated and A's 1 - s / 2 times, every residual of a light is y = (h + H U) s +
noise: h is what that does to the light at once, U how it has moved the state so far, carried along by the same
transition and the same gains (Friedland 1969, as in `vibration`). Least squares give s. What both have in common no
picture tells.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.state import NAV, PHI, R_, State, invariant_of_plain

# Before anything is told, 1 sd.
FIRST_SCALE: Final = 0.05
# Beyond so many sigmas and this share there is a gap. On 16 sample dives without one it was 2.5 sigmas at most.
GAP_SIGMAS: Final = 5.0
LEAST_GAP: Final = 0.002
# Beyond this share a live track is not told: lights are then left out, and more is wrong than the distance.
MOST_GAP: Final = 0.03


@dataclass(frozen=True, slots=True)
class ScaleGap:
    """What the lights tell of s, as normal equations."""

    information: float = FIRST_SCALE**-2
    told: float = 0.0

    @property
    def share(self) -> float:
        """How much longer B's bar is beside A's than both are stated to be."""
        return self.told / self.information

    @property
    def sigmas(self) -> float:
        """How many sigmas that is, without its sign."""
        return abs(self.told) / math.sqrt(self.information)

    @property
    def found(self) -> bool:
        """Whether there is a gap."""
        return abs(self.share) > LEAST_GAP and self.sigmas > GAP_SIGMAS

    def taught(self, y: Floats, S_inverse: Floats, moved: Floats) -> ScaleGap:
        """Go on by one picture's residuals y (m,), of which moved (m,) is how much a gap of 1 makes."""
        weighed = S_inverse @ moved
        return ScaleGap(self.information + float(weighed @ moved), self.told + float(weighed @ y))

    def plus(self, other: ScaleGap) -> ScaleGap:
        """Join what two tracks tell."""
        return ScaleGap(self.information + other.information - FIRST_SCALE**-2, self.told + other.told)


def gap_words(share: float, names: Sequence[str]) -> str:
    """Say that there is a gap between two nodes."""
    a, b = names
    than = "longer" if share > 0.0 else "shorter"
    return (
        f"nodes {a} and {b}: beside that of {a} the bar of {b} is {100.0 * abs(share):.1f} % {than} than stated, or a "
        "focal length is off; sigmas count it: measure both bars, calibrate both cameras"
    )


def scaled(rig: Rig, share: float) -> Rig:
    """Give a rig whose lights are further from its camera by a share."""
    return replace(rig, lights_m=(1.0 + share) * rig.lights_m)


def by_scale(H: Floats, state: State, other: int, lights_m: Floats) -> Floats:
    """Give h (2 N,) of lights: H (2 N, SIZE), lights_m (N, 3) of the node other than the observer."""
    # What moves a light by a share of its arm is what would move the node by that.
    arms = 0.5 * lights_m @ state.R[other].T
    return np.asarray((H[:, R_].reshape(-1, 2, 3) @ arms[:, :, None]).ravel())


def with_gap(P: Floats, share: float, U: Floats, state: State) -> Floats:
    """Give covariances (..., N, N) of states with what a gap may make of them: its share of U (N,), and what follows.

    It is not known which bar or focal length is wrong. So half of the gap is counted as an error of the distance. A
    focal length that is off turns its camera by the gap's share of the angle at which it sees the other node.
    """
    r_m = state.r_m
    toward = np.stack((r_m, -r_m), axis=-2)
    sight = state.R.swapaxes(-1, -2) @ toward[..., None]
    ahead = np.array((0.0, 0.0, 1.0))
    axis = np.cross(ahead, sight[..., 0])
    sine = np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-9)
    turns = (state.R @ (axis * np.arctan2(sine, sight[..., 2, :]) / sine)[..., None])[..., 0]
    plain = np.zeros((*r_m.shape[:-1], 3, NAV))
    plain[..., 0, R_] = 0.5 * share * r_m
    for node in (0, 1):
        plain[..., 1 + node, PHI[node]] = math.sqrt(0.5) * share * turns[..., node, :]
    moved = plain @ np.swapaxes(invariant_of_plain(state)[..., :NAV, :NAV], -1, -2)
    more = P + share**2 * np.outer(U, U)
    more[..., :NAV, :NAV] += moved.swapaxes(-1, -2) @ moved
    return more
