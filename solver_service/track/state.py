"""The track's state: what is estimated, and how an error moves it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, applied, left_jacobian, rotation_exp, rotation_log, skew

# Where each error stands in the error state: R_ is the position r's, not a rotation R's, which is PHI. A's part comes
# first where a quantity belongs to a node.
R_: Final = slice(0, 3)
V_: Final = slice(3, 6)
PHI: Final = (slice(6, 9), slice(9, 12))
SHAKE: Final = (slice(12, 15), slice(15, 18))
SHOVE: Final = slice(18, 21)
GYRO_BIAS: Final = (slice(21, 24), slice(24, 27))
ACCEL_BIAS: Final = (slice(27, 30), slice(30, 33))
MOUNT: Final = (slice(33, 36), slice(36, 39))
LEVER: Final = (slice(39, 42), slice(42, 45))
DELAY: Final = (45, 46)
CLOCK: Final = 47
DEPTH_OFFSET: Final = 48
SIZE: Final = 49
NAV: Final = 12
"""The first errors: of position, velocity and attitudes."""
MOVING: Final = 21
"""The first errors, which a step moves; the others are constants or walk slowly."""

# The shapes of a state's fields, where each ends in a row, all of that for each field, and how long a row is.
_SHAPES: Final = ((3,), (3,), (2, 3, 3), (2, 3), (3,), (2, 3), (2, 3), (2, 3), (2, 3), (2,), (), ())
_ENDS: Final = np.cumsum([math.prod(shape) for shape in _SHAPES]).tolist()
_PARTS: Final = list(zip([0, *_ENDS], _ENDS, _SHAPES, strict=False))
ROW: Final = _ENDS[-1]
CLOCK_COLUMN: Final = ROW - 2
_THREE: Final = 3.0 * np.eye(3)
_STILL: Final[Floats] = np.eye(MOVING)
_OF_PLACE: Final = np.r_[R_, PHI[0], PHI[1]]
_PLACE: Final = np.ix_(_OF_PLACE, _OF_PLACE)


@dataclass(frozen=True, eq=False)
class State:
    """Where both nodes are, in a level frame (z down; north-east-down where a compass says so), and their constants.

    r_m, v_mps (3,): of B's camera from A's. R (2, 3, 3): each camera to level. shake_rad (2, 3): how far each unit is
    shaken out of its mount at this time, camera axes; shove_mps (3,): what the shaking adds to the velocity that the
    units tell, level axes. gyro_bias_radps, accel_bias_mps2, mount_rad, lever_m (2, 3): in camera axes; mount: the
    small turn that brings the unit's axes, as stated, to the true ones. delay_s (2,): the unit's stamps minus true
    time. clock_s: B's clock minus A's. depth_offset_m: what B's gauge shows too much against A's. As rows of numbers
    states are kept; several rows make a batch of states, each array with leading axes.
    """

    r_m: Floats
    v_mps: Floats
    R: Floats
    shake_rad: Floats
    shove_mps: Floats
    gyro_bias_radps: Floats
    accel_bias_mps2: Floats
    mount_rad: Floats
    lever_m: Floats
    delay_s: Floats
    clock_s: float
    depth_offset_m: float

    def plus(self, error: Floats) -> State:
        """Return the state that is off this one by an error (SIZE,); of a batch, with leading axes.

        R_A = exp(phi_A) R_A, R_B = exp(phi_A) exp(psi) R_B with psi = phi_B - phi_A, v = exp(phi_A) (v + dv), shove
        likewise, r = exp(phi_A) (exp(psi) r + J(psi) dr): A turns all, and B goes by the screw (psi, dr) against it.
        Turning all about the vertical changes nothing that pictures show, and where one node alone is seen, what they
        leave open stays on its circle, however large it is (docs/track.md, consistency). What rounding does to R is
        mended by the next step (strapdown.integrate).
        """
        phi = error[..., PHI[0]]
        psi = error[..., PHI[1]] - phi
        turn_a, turn_b = rotation_exp(phi), rotation_exp(psi)
        lead = error.shape[:-1]
        R = np.empty((*lead, 2, 3, 3))
        R[..., 0, :, :], R[..., 1, :, :] = turn_a @ self.R[..., 0, :, :], turn_a @ turn_b @ self.R[..., 1, :, :]
        shake, gyro, accel, mount, lever = (
            error[..., k : k + 6].reshape(*lead, 2, 3) for k in (SHAKE[0].start, *range(MOVING, DELAY[0], 6))
        )
        return State(
            r_m=applied(turn_a, applied(turn_b, self.r_m) + applied(left_jacobian(psi), error[..., R_])),
            v_mps=applied(turn_a, self.v_mps + error[..., V_]),
            R=R,
            shake_rad=self.shake_rad + shake,
            shove_mps=applied(turn_a, self.shove_mps + error[..., SHOVE]),
            gyro_bias_radps=self.gyro_bias_radps + gyro,
            accel_bias_mps2=self.accel_bias_mps2 + accel,
            mount_rad=self.mount_rad + mount,
            lever_m=self.lever_m + lever,
            delay_s=self.delay_s + error[..., DELAY[0] : DELAY[1] + 1],
            clock_s=self.clock_s + error[..., CLOCK],  # type: ignore[arg-type]
            depth_offset_m=self.depth_offset_m + error[..., DEPTH_OFFSET],  # type: ignore[arg-type]
        )

    def minus(self, other: State) -> Floats:
        """Return the error (SIZE,) by which this state is off another: other.plus(error) is this one.

        Of batches, with leading axes.
        """
        error = np.empty((*self.r_m.shape[:-1], SIZE))
        flat = (*error.shape[:-1], 6)
        phi = rotation_log(self.R[..., 0, :, :] @ np.swapaxes(other.R[..., 0, :, :], -1, -2))
        back = rotation_exp(-phi)
        turn = back @ self.R[..., 1, :, :] @ np.swapaxes(other.R[..., 1, :, :], -1, -2)
        psi = rotation_log(turn)
        error[..., PHI[0]], error[..., PHI[1]] = phi, phi + psi
        along = applied(back, self.r_m) - applied(turn, other.r_m)
        error[..., R_] = np.linalg.solve(left_jacobian(psi), along[..., None])[..., 0]
        error[..., V_] = applied(back, self.v_mps) - other.v_mps
        error[..., 12:18] = (self.shake_rad - other.shake_rad).reshape(flat)
        error[..., SHOVE] = applied(back, self.shove_mps) - other.shove_mps
        error[..., 21:27] = (self.gyro_bias_radps - other.gyro_bias_radps).reshape(flat)
        error[..., 27:33] = (self.accel_bias_mps2 - other.accel_bias_mps2).reshape(flat)
        error[..., 33:39] = (self.mount_rad - other.mount_rad).reshape(flat)
        error[..., 39:45] = (self.lever_m - other.lever_m).reshape(flat)
        error[..., 45:47] = self.delay_s - other.delay_s
        error[..., CLOCK] = self.clock_s - other.clock_s
        error[..., DEPTH_OFFSET] = self.depth_offset_m - other.depth_offset_m
        return error

    def to_row(self) -> Floats:
        """Return all numbers as one row (ROW,), of a batch as rows (..., ROW)."""
        if self.r_m.ndim == 1:
            return np.concatenate([np.ravel(part) for part in vars(self).values()])
        lead = self.r_m.shape[:-1]
        return np.concatenate([np.reshape(part, (*lead, -1)) for part in vars(self).values()], axis=-1)

    @classmethod
    def of_row(cls, rows: Floats) -> State:
        """Return the state of a row, or the batch of rows (..., ROW)."""
        lead = rows.shape[:-1]
        shaped = [rows[..., start:end].reshape((*lead, *shape)) for start, end, shape in _PARTS]
        return cls(*(part if part.ndim else float(part) for part in shaped))  # type: ignore[arg-type]

    def moved(self, r_m: Floats, v_mps: Floats, R: Floats) -> State:
        """Return the same constants elsewhere."""
        return replace(self, r_m=r_m, v_mps=v_mps, R=R)


def orthonormal(R: Floats) -> Floats:
    """Return near rotations (..., 3, 3) made exact to second order."""
    cured: Floats = 0.5 * R @ (_THREE - np.swapaxes(R, -1, -2) @ R)
    return cured


def plain_of_invariant(state: State) -> Floats:
    """Give T (MOVING, MOVING): errors with plain r_true - r, v_true - v and shove likewise, from the state's own."""
    return _turned_with(state, -1.0)


def invariant_of_plain(state: State) -> Floats:
    """Give the inverse of `plain_of_invariant`."""
    return _turned_with(state, 1.0)


def _turned_with(state: State, sign: float) -> Floats:
    """Give both, of a batch of states with its leading axes."""
    across = skew(sign * np.array((state.r_m, state.v_mps, state.shove_mps)))
    T = np.empty((*state.r_m.shape[:-1], MOVING, MOVING))
    T[...] = _STILL
    T[..., R_, PHI[1]], T[..., V_, PHI[0]], T[..., SHOVE, PHI[0]] = across
    return T


def of_place(state: State, P: Floats) -> Floats:
    """Give the covariance (SIZE, SIZE) whose first errors are of where A sees B, exp(-phi_A) r, in the state's own."""
    across = skew(state.r_m)
    out = P.copy()
    out[R_] += across @ (P[PHI[1]] - P[PHI[0]])
    out[:, R_] += (out[:, PHI[1]] - out[:, PHI[0]]) @ across.T
    return out


def place_covariance(state: State, P: Floats) -> Floats:
    """Give the covariance (3, 3) of where A sees B, in level axes."""
    across = skew(state.r_m)
    J = np.concatenate((np.eye(3), across, -across), axis=1)
    block: Floats = J @ P[_PLACE] @ J.T
    return block
