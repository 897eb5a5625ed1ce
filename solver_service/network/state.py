"""The network's state: where all member nodes are in one frame, and their constants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log, skew
from buddyline.solver_service.track.inputs import TrackNode
from buddyline.solver_service.track.shaking import SHAKE_RAD, SHOVE_MPS
from buddyline.solver_service.track.start import (
    ACCEL_BIAS_MPS2,
    DELAY_TOLD_S,
    DELAY_UNTOLD_S,
    DEPTH_SCALE_SIGMA,
    GYRO_BIAS_RADPS,
    LEVER_TOLD_M,
    LEVER_UNTOLD_M,
    MOUNT_RAD,
    SPEED_MPS,
)
from buddyline.solver_service.track.state import orthonormal

# The errors of all, before the nodes' own: of the frame's depth, and of the water's density.
DATUM: Final = 0
DEPTH_SCALE: Final = 1
COMMON: Final = 2

# The errors of one node, in the order of its block.
P_: Final = slice(0, 3)
V_: Final = slice(3, 6)
PHI: Final = slice(6, 9)
SHAKE: Final = slice(9, 12)
SHOVE: Final = slice(12, 15)
GYRO_BIAS: Final = slice(15, 18)
ACCEL_BIAS: Final = slice(18, 21)
MOUNT: Final = slice(21, 24)
LEVER: Final = slice(24, 27)
DELAY: Final = 27
CLOCK: Final = 28
GAUGE: Final = 29
BLOCK: Final = 30
MOVING: Final = 15
"""The first errors of a block, which a step moves; the others are constants or walk slowly."""

POSED: Final = PHI.stop
"""The first errors of a block, of what a pose is made of: place, velocity and attitude."""

# How far a node's clock may be off, 1 sd, and by how much this changes in a root second: quartz clocks drift. Attitudes
# alone, without an inertial unit, tell it worse than they seem to.
CLOCK_S: Final = 0.1
CLOCK_WALK_S: Final = 1e-4
CLOCK_WALK_WITHOUT_S: Final = 3e-3
# Each depth gauge's own offset, and the distance of the frame's zero from the surface, 1 sd.
GAUGE_M: Final = 0.1
DATUM_M: Final = 1000.0


@dataclass(frozen=True, eq=False)
class NetState:
    """Members (n) in the net's frame, z down. The errors of node i are `block(i)`.

    p_m, v_mps (n, 3): cameras. R (n, 3, 3): camera to net. shake_rad, shove_mps (n, 3): shaking, as in the track's
    State, each node's own. gyro_bias_radps, accel_bias_mps2, mount_rad, lever_m (n, 3), delay_s (n,): of the inertial
    units, camera axes. clock_s (n,): each clock minus the net's. gauge_m (n,): by how much each gauge reads too deep.
    datum_m: depth of the frame's zero. depth_scale: by which share of what they show all gauges show too much: they are
    told one density of the water.
    """

    p_m: Floats
    v_mps: Floats
    R: Floats
    shake_rad: Floats
    shove_mps: Floats
    gyro_bias_radps: Floats
    accel_bias_mps2: Floats
    mount_rad: Floats
    lever_m: Floats
    delay_s: Floats
    clock_s: Floats
    gauge_m: Floats
    datum_m: float
    depth_scale: float

    def __len__(self) -> int:
        """Return the number of members."""
        return len(self.p_m)

    def plus(self, error: Floats) -> NetState:
        """Return the state that is off this one by an error (2 + 30 n,).

        R = exp(phi) R^, p = exp(phi) p^ + dp, v and shove likewise, each with its node's own phi: turning all about
        the vertical is then an error in the phi alone, wherever the nodes are (docs/track.md, consistency).
        """
        e = error[COMMON:].reshape(len(self), BLOCK)
        turn = rotation_exp(e[:, PHI])
        return NetState(
            p_m=_turned(turn, self.p_m) + e[:, P_],
            v_mps=_turned(turn, self.v_mps) + e[:, V_],
            R=orthonormal(turn @ self.R),
            shake_rad=self.shake_rad + e[:, SHAKE],
            shove_mps=_turned(turn, self.shove_mps) + e[:, SHOVE],
            gyro_bias_radps=self.gyro_bias_radps + e[:, GYRO_BIAS],
            accel_bias_mps2=self.accel_bias_mps2 + e[:, ACCEL_BIAS],
            mount_rad=self.mount_rad + e[:, MOUNT],
            lever_m=self.lever_m + e[:, LEVER],
            delay_s=self.delay_s + e[:, DELAY],
            clock_s=self.clock_s + e[:, CLOCK],
            gauge_m=self.gauge_m + e[:, GAUGE],
            datum_m=self.datum_m + float(error[DATUM]),
            depth_scale=self.depth_scale + float(error[DEPTH_SCALE]),
        )

    def minus(self, other: NetState) -> Floats:
        """Return the error (2 + 30 n,) by which this state is off another: other.plus(error) is this one."""
        e = np.empty((len(self), BLOCK))
        e[:, PHI] = phi = rotation_log(self.R @ other.R.swapaxes(1, 2))
        turn = rotation_exp(phi)
        e[:, P_] = self.p_m - _turned(turn, other.p_m)
        e[:, V_] = self.v_mps - _turned(turn, other.v_mps)
        e[:, SHAKE] = self.shake_rad - other.shake_rad
        e[:, SHOVE] = self.shove_mps - _turned(turn, other.shove_mps)
        e[:, GYRO_BIAS] = self.gyro_bias_radps - other.gyro_bias_radps
        e[:, ACCEL_BIAS] = self.accel_bias_mps2 - other.accel_bias_mps2
        e[:, MOUNT] = self.mount_rad - other.mount_rad
        e[:, LEVER] = self.lever_m - other.lever_m
        e[:, DELAY] = self.delay_s - other.delay_s
        e[:, CLOCK] = self.clock_s - other.clock_s
        e[:, GAUGE] = self.gauge_m - other.gauge_m
        return np.concatenate(((self.datum_m - other.datum_m, self.depth_scale - other.depth_scale), e.ravel()))

    def chosen(self, members: list[int]) -> NetState:
        """Return the state of some members, in the order given."""
        return replace(self, **{name: getattr(self, name)[members] for name in _OF_NODES})

    def replaced(self, members: list[int], after: NetState) -> NetState:
        """Return the state with what moves of some members as it is in another state of these alone."""
        moved = {name: getattr(self, name).copy() for name in _MOVED}
        for name, values in moved.items():
            values[members] = getattr(after, name)
        return replace(self, **moved)

    def joined(self, other: NetState) -> NetState:
        """Return the members of both states, those of the other behind."""
        return NetState.behind((self, other))

    @classmethod
    def behind(cls, states: Sequence[NetState]) -> NetState:
        """Return the members of several states, one behind another, with what is common as it is in the first."""
        every = {name: np.concatenate([getattr(state, name) for state in states]) for name in _OF_NODES}
        return replace(states[0], **every)  # type: ignore[arg-type]


_OF_NODES: Final = tuple(field.name for field in fields(NetState) if field.name not in ("datum_m", "depth_scale"))


_MOVED: Final = ("p_m", "v_mps", "R", "shake_rad", "shove_mps")


def _turned(turn: Floats, vectors: Floats) -> Floats:
    turned: Floats = (turn @ vectors[:, :, None])[:, :, 0]
    return turned


def common_variances() -> Floats:
    """Give the variances (COMMON,) of what is common to all, before anything is known."""
    return np.square((DATUM_M, DEPTH_SCALE_SIGMA))


def block(member: int) -> slice:
    """Give where a member's errors are."""
    return slice(COMMON + BLOCK * member, COMMON + BLOCK * (member + 1))


def blocks(members: list[int]) -> list[int]:
    """Give the indices of what is common and of some members' errors."""
    of_members = np.arange(BLOCK) + COMMON + BLOCK * np.array(members, dtype=int)[:, None]
    return [*range(COMMON), *of_members.ravel().tolist()]


def own_of_plain(p_m: Floats, v_mps: Floats, shove_mps: Floats) -> Floats:
    """Give (..., MOVING, MOVING): nodes' errors from those with plain p_true - p, v_true - v and shove likewise."""
    return _turning(skew(np.array((p_m, v_mps, shove_mps))))


def plain_of_own(p_m: Floats, v_mps: Floats, shove_mps: Floats) -> Floats:
    """Give the inverse of `own_of_plain`."""
    return _turning(-skew(np.array((p_m, v_mps, shove_mps))))


def _turning(crosses: Floats) -> Floats:
    """Give (..., MOVING, MOVING) errors with the part (3, ..., 3, 3) of phi in those of p, v and shove."""
    T = np.zeros((*crosses.shape[1:-2], MOVING, MOVING))
    T[...] = np.eye(MOVING)
    T[..., P_, PHI], T[..., V_, PHI], T[..., SHOVE, PHI] = crosses
    return T


def lone(node: TrackNode, p_m: Floats, R: Floats) -> tuple[NetState, Floats]:
    """Give the state of one node at rest at p_m (3,), R (3, 3), with its constants as told, and the variances
    (BLOCK,) of all but place and attitude."""
    zero = np.zeros((1, 3))
    state = NetState(
        p_m=p_m[None],
        v_mps=zero,
        R=R[None],
        shake_rad=zero,
        shove_mps=zero,
        gyro_bias_radps=zero,
        accel_bias_mps2=zero,
        mount_rad=zero,
        lever_m=zero if node.imu_m is None else node.imu_m[None],
        delay_s=np.array(((node.imu_delay_ns or 0) * 1e-9,)),
        clock_s=np.zeros(1),
        gauge_m=np.zeros(1),
        datum_m=0.0,
        depth_scale=0.0,
    )
    sigma = np.zeros(BLOCK)
    sigma[V_] = SPEED_MPS
    sigma[SHAKE] = SHAKE_RAD
    sigma[SHOVE] = SHOVE_MPS
    sigma[GYRO_BIAS] = GYRO_BIAS_RADPS
    sigma[ACCEL_BIAS] = ACCEL_BIAS_MPS2
    sigma[MOUNT] = MOUNT_RAD
    sigma[LEVER] = LEVER_UNTOLD_M if node.imu_m is None else LEVER_TOLD_M
    sigma[DELAY] = DELAY_UNTOLD_S if node.imu_delay_ns is None else DELAY_TOLD_S
    sigma[CLOCK] = CLOCK_S
    sigma[GAUGE] = GAUGE_M
    return state, sigma**2
