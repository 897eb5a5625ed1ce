"""The track's state: what is estimated, and how an error moves it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import (
    Floats,
    applied,
    inner,
    left_jacobian,
    rotation_exp,
    rotation_log,
    skew,
)

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
DEPTH_SCALE: Final = 49
SIZE: Final = 50
NAV: Final = 12
"""The first errors: of position, velocity and attitudes."""
MOVING: Final = 21
"""The first errors, which a step moves; the others are constants or walk slowly."""

# Where each quantity stands in a state's row. R has nine numbers a node where the errors have three; from there on rows
# and errors have the same order.
_R: Final = slice(6, 24)
_AFTER_R: Final = slice(_R.stop, None)
_SHOVE: Final = slice(30, 33)
_CONSTANTS: Final = _SHOVE.stop
_PER_NODE: Final = [slice(k, k + 6) for k in (24, *range(_CONSTANTS, _CONSTANTS + 24, 6))]
_SHAKE, _GYRO_BIAS, _ACCEL_BIAS, _MOUNT, _LEVER = _PER_NODE
_DELAY: Final = slice(57, 59)
CLOCK_COLUMN: Final = 59
_DEPTH_OFFSET: Final = 60
_DEPTH_SCALE: Final = 61
ROW: Final = 62
_BOTH: Final = slice(PHI[0].start, PHI[1].stop)
_IDENTITY: Final[Floats] = np.eye(3)
_STILL: Final[Floats] = np.eye(MOVING)
_OF_PLACE: Final = np.r_[R_, PHI[0], PHI[1]]
_PLACE: Final = np.ix_(_OF_PLACE, _OF_PLACE)


@dataclass(frozen=True, eq=False, slots=True)
class State:
    """Where both nodes are, in a level frame (z down; north-east-down where a compass says so), and their constants.

    row (ROW,): all its numbers, which the quantities below are views of. Several rows (..., ROW) are a batch of states,
    whose quantities have the same leading axes.
    """

    row: Floats

    @classmethod
    def at_rest(cls, r_m: Floats, R: Floats) -> State:
        """Return a state of which all else is 0."""
        return cls(np.zeros((*r_m.shape[:-1], ROW))).moved(r_m, np.zeros(3), R)

    @property
    def r_m(self) -> Floats:
        """Of B's camera from A's (3,)."""
        return self.row[..., R_]

    @property
    def v_mps(self) -> Floats:
        """Its change (3,)."""
        return self.row[..., V_]

    @property
    def R(self) -> Floats:
        """Each camera to level (2, 3, 3)."""
        return self.row[..., _R].reshape(*self.row.shape[:-1], 2, 3, 3)

    @property
    def shake_rad(self) -> Floats:
        """How far each unit is shaken out of its mount at this time (2, 3), camera axes."""
        return self._of_nodes(_SHAKE)

    @property
    def shove_mps(self) -> Floats:
        """What the shaking adds to the velocity that the units tell (3,), level axes."""
        return self.row[..., _SHOVE]

    @property
    def gyro_bias_radps(self) -> Floats:
        """What the gyros show too much (2, 3), camera axes."""
        return self._of_nodes(_GYRO_BIAS)

    @property
    def accel_bias_mps2(self) -> Floats:
        """What the accelerometers show too much (2, 3), camera axes."""
        return self._of_nodes(_ACCEL_BIAS)

    @property
    def mount_rad(self) -> Floats:
        """The small turns that bring the units' axes, as stated, to the true ones (2, 3), camera axes."""
        return self._of_nodes(_MOUNT)

    @property
    def range_m(self) -> Floats:
        """How far B is from A (...)."""
        ranges_m: Floats = np.sqrt(inner(self.r_m, self.r_m))
        return ranges_m

    @property
    def lever_m(self) -> Floats:
        """The units' places (2, 3), camera axes."""
        return self._of_nodes(_LEVER)

    @property
    def delay_s(self) -> Floats:
        """The units' stamps minus true time (2,)."""
        return self.row[..., _DELAY]

    @property
    def clock_s(self) -> float:
        """B's clock minus A's; of a batch an array."""
        return self.row[..., CLOCK_COLUMN][()]  # type: ignore[return-value]

    @property
    def depth_offset_m(self) -> float:
        """What B's gauge shows too much against A's; of a batch an array."""
        return self.row[..., _DEPTH_OFFSET][()]  # type: ignore[return-value]

    @property
    def depth_scale(self) -> float:
        """By which share both gauges show depths too large; of a batch an array."""
        return self.row[..., _DEPTH_SCALE][()]  # type: ignore[return-value]

    def _of_nodes(self, part: slice) -> Floats:
        return self.row[..., part].reshape(*self.row.shape[:-1], 2, 3)

    def plus(self, error: Floats) -> State:
        """Return the state that is off this one by an error (SIZE,); of a batch, with leading axes.

        R_A = exp(phi_A) R_A, R_B = exp(phi_A) exp(psi) R_B with psi = phi_B - phi_A, v = exp(phi_A) (v + dv), shove
        likewise, r = exp(phi_A) (exp(psi) r + J(psi) dr): A turns all, and B goes by the screw (psi, dr) against it.
        Turning all about the vertical changes nothing that pictures show, and where one node alone is seen, what they
        leave open stays on its circle, however large it is (docs/track.md, consistency). What rounding does to R is
        mended by the next step (strapdown.integrate).
        """
        lead = error.shape[:-1]
        screws = error[..., _BOTH].reshape(*lead, 2, 3).copy()
        psi = screws[..., 1, :]
        psi -= screws[..., 0, :]
        turns = rotation_exp(screws)
        turn_a, turn_b = turns[..., 0, :, :], turns[..., 1, :, :]
        off = State(np.empty((*lead, ROW)))
        off.row[..., _AFTER_R] = self.row[..., _AFTER_R] + error[..., NAV:]
        off.r_m[...] = applied(turn_a, applied(turn_b, self.r_m) + applied(left_jacobian(psi), error[..., R_]))
        off.v_mps[...] = applied(turn_a, self.v_mps + error[..., V_])
        off.shove_mps[...] = applied(turn_a, off.shove_mps)
        R, was = off.R, self.R
        R[..., 0, :, :], R[..., 1, :, :] = turn_a @ was[..., 0, :, :], turn_a @ turn_b @ was[..., 1, :, :]
        return off

    def minus(self, other: State) -> Floats:
        """Return the error (SIZE,) by which this state is off another: other.plus(error) is this one.

        Of batches, with leading axes.
        """
        error = np.empty((*self.row.shape[:-1], SIZE))
        R, other_R = self.R, other.R
        phi = rotation_log(R[..., 0, :, :] @ other_R[..., 0, :, :].swapaxes(-1, -2))
        back = rotation_exp(-phi)
        turn = back @ R[..., 1, :, :] @ other_R[..., 1, :, :].swapaxes(-1, -2)
        psi = rotation_log(turn)
        along = applied(back, self.r_m) - applied(turn, other.r_m)
        error[..., R_] = np.linalg.solve(left_jacobian(psi), along[..., None])[..., 0]
        error[..., V_] = applied(back, self.v_mps) - other.v_mps
        error[..., PHI[0]], error[..., PHI[1]] = phi, phi + psi
        error[..., NAV:] = self.row[..., _AFTER_R] - other.row[..., _AFTER_R]
        error[..., SHOVE] = applied(back, self.shove_mps) - other.shove_mps
        return error

    def moved(self, r_m: Floats, v_mps: Floats, R: Floats) -> State:
        """Return the same constants elsewhere."""
        there = State(self.row.copy())
        there.r_m[...], there.v_mps[...], there.R[...] = r_m, v_mps, R
        return there

    def with_parts(self, **parts: Floats | float) -> State:
        """Return a state whose named quantities are others."""
        changed = State(self.row.copy())
        at = {"clock_s": CLOCK_COLUMN, "depth_offset_m": _DEPTH_OFFSET, "depth_scale": _DEPTH_SCALE}
        for name, value in parts.items():
            if name in at:
                changed.row[..., at[name]] = value
            else:
                getattr(changed, name)[...] = value
        return changed


def orthonormal(R: Floats) -> Floats:
    """Return near rotations (..., 3, 3) made exact to second order."""
    cured: Floats = 0.5 * R @ (3.0 * _IDENTITY - R.swapaxes(-1, -2) @ R)
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
    T = np.empty((*state.row.shape[:-1], MOVING, MOVING))
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
    J = np.concatenate((_IDENTITY, across, -across), axis=1)
    block: Floats = J @ P[_PLACE] @ J.T
    return block
