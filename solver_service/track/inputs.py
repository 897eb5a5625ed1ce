"""What a track is made from: two nodes' calibration, inertial samples, frames, anchors, fixes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import overload

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
    picture held, where only parts were searched. lasting_s (K,): for how long each one's error lasts.
    """

    stamp_ns: int
    pixels: Floats
    sigma_px: Floats
    dt_ns: Stamps = field(default_factory=lambda: np.zeros(0, np.int64))
    elsewhere: int = 0
    lasting_s: Floats = field(default_factory=lambda: np.zeros(0))


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
class Attitudes(Sequence[AttitudeSeen]):
    """Attitude messages as columns: stamps (N,), R_ned_body (N, 3, 3), sigma_rad (N, 3).

    An hour may have 360,000 of a node. As a list of AttitudeSeen they would take four times the memory.
    """

    stamps_ns: Stamps
    R_ned_body: Floats
    sigma_rad: Floats

    @classmethod
    def joined(cls, pieces: Sequence[Sequence[AttitudeSeen]]) -> Attitudes:
        """Give those of pieces, at least one, in order of stamps."""
        every = [piece if isinstance(piece, Attitudes) else cls._of(piece) for piece in pieces]
        if len(every) == 1 and bool((np.diff(every[0].stamps_ns) >= 0).all()):
            return every[0]
        together = cls(
            *(
                np.concatenate([getattr(one, name) for one in every])
                for name in ("stamps_ns", "R_ned_body", "sigma_rad")
            )
        )
        return together._chosen(np.argsort(together.stamps_ns, kind="stable"))

    @classmethod
    def _of(cls, seen: Sequence[AttitudeSeen]) -> Attitudes:
        stamps_ns = np.array([one.stamp_ns for one in seen], dtype=np.int64)
        R = np.array([one.R_ned_body for one in seen]).reshape(-1, 3, 3)
        return cls(stamps_ns, R, np.array([one.sigma_rad for one in seen]).reshape(-1, 3))

    def _chosen(self, rows: slice | NDArray[np.intp]) -> Attitudes:
        return Attitudes(self.stamps_ns[rows], self.R_ned_body[rows], self.sigma_rad[rows])

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.stamps_ns)

    @overload
    def __getitem__(self, at: int) -> AttitudeSeen: ...

    @overload
    def __getitem__(self, at: slice) -> Attitudes: ...

    def __getitem__(self, at: int | slice) -> AttitudeSeen | Attitudes:
        """Give one message, or those of a slice."""
        if isinstance(at, slice):
            return self._chosen(at)
        return AttitudeSeen(int(self.stamps_ns[at]), self.R_ned_body[at], self.sigma_rad[at])

    def __iter__(self) -> Iterator[AttitudeSeen]:
        """Yield each message."""
        return map(AttitudeSeen, self.stamps_ns.tolist(), self.R_ned_body, self.sigma_rad)


@dataclass(frozen=True, eq=False, slots=True)
class DepthSeen:
    """One depth message."""

    stamp_ns: int
    depth_m: float
    sigma_m: float
