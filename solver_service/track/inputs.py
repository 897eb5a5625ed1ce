"""What a track is made from: two nodes' calibration, inertial samples, frames, anchors, fixes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats
from numpy.typing import NDArray

Stamps = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TrackNode:
    """One node's constants. name: its id, for problems in words.

    imu_m: the inertial unit's place (3,) in the camera frame, None where not told. imu_delay_ns: its stamps minus
    the true time, None where not told.
    """

    name: str
    rig: Rig
    imu_m: Floats | None = None
    imu_delay_ns: int | None = None


@dataclass(frozen=True, eq=False, slots=True)
class FrameSeen:
    """The light candidates of one picture.

    pixels (K, 2) and sigma_px (K,); dt_ns (K,): each row's exposure minus stamp_ns. elsewhere: how many more the whole
    picture held, where only parts were searched.
    """

    stamp_ns: int
    pixels: Floats
    sigma_px: Floats
    dt_ns: Stamps = field(default_factory=lambda: np.zeros(0, np.int64))
    elsewhere: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class FixSeen:
    """A pose that one trigger's lights gave by themselves: T_a_b and its covariance (6, 6), as RelativePose has it."""

    stamp_ns: int
    t_a_b_m: Floats
    R_a_b: Floats
    covariance: Floats


@dataclass(frozen=True, eq=False, slots=True)
class AttitudeSeen:
    """One attitude message: R_ned_body (3, 3) and the sigmas (3,) of roll, pitch and yaw in rad."""

    stamp_ns: int
    R_ned_body: Floats
    sigma_rad: Floats


@dataclass(frozen=True, eq=False, slots=True)
class DepthSeen:
    """One depth message."""

    stamp_ns: int
    depth_m: float
    sigma_m: float
