"""Inertial samples for a link that does not carry them all: a few means, which turn and push as much as the samples."""

from __future__ import annotations

from typing import Final

import numpy as np
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.messages import Imu, ImuMeans
from numpy.typing import ArrayLike, NDArray

SPAN_NS: Final = 50 * MS_NS
# In a message: its headers would take more than a mean.
MEANS: Final = 8
# Then a sample is tried again.
PACKING_NS: Final = 10 * S_NS


def mean_motion(
    accel_mps2: ArrayLike, gyro_radps: ArrayLike, dt_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the constant force and turn rate (3,) that do over n dt_s what samples (n, 3) do, dt_s each.

    To second order in the turn: coning is the part of the turn that the rates' changing axes make, sculling that of the
    velocity (Savage, "Strapdown inertial navigation integration algorithm design", 1998).
    """
    force, turns = np.asarray(accel_mps2), np.asarray(gyro_radps) * dt_s
    before = np.cumsum(turns, axis=0) - turns
    turn = (turns + 0.5 * np.cross(before, turns)).sum(0)
    pushed = (force + np.cross(before + 0.5 * turns, force)).mean(0)
    return pushed - 0.5 * np.cross(turn, pushed), turn / (len(turns) * dt_s)


class ImuPacker:
    """Makes means of the samples from the first that a link has left out, for PACKING_NS at a time."""

    def __init__(self) -> None:
        self._until_ns = -1
        self._span: list[Imu] = []
        self._means: list[tuple[int, NDArray[np.float64], NDArray[np.float64]]] = []

    @property
    def is_packing(self) -> bool:
        """Whether samples are to come here, and not to be sent."""
        return self._until_ns >= 0

    def add(self, sample: Imu) -> ImuMeans | None:
        """Take a sample that is not sent; return the means that are due."""
        if not self.is_packing:
            self._until_ns = sample.stamp_ns + PACKING_NS
        if self._span and sample.stamp_ns < self._span[-1].stamp_ns:
            # The clock was set back.
            self._span.clear()
            self._means.clear()
        if self._span and self._span[0].stamp_ns // SPAN_NS != sample.stamp_ns // SPAN_NS:
            self._end_span()
        self._span.append(sample)
        if len(self._means) < MEANS:
            return None
        stamps_ns, forces, rates = zip(*self._means, strict=True)
        self._means.clear()
        if not 0 <= self._until_ns - sample.stamp_ns <= PACKING_NS:
            self._until_ns = -1
            self._span.clear()
        return ImuMeans(
            node=sample.node,
            stamp_ns=stamps_ns[-1],
            ages_ns=[stamps_ns[-1] - one for one in stamps_ns],
            accel_mps2=[_rounded(one, 3) for one in forces],
            gyro_radps=[_rounded(one, 5) for one in rates],
        )

    def _end_span(self) -> None:
        span, self._span = self._span, []
        force, rate = mean_motion(
            [one.accel_mps2 for one in span], [one.gyro_radps for one in span], SPAN_NS / S_NS / len(span)
        )
        stamp_ns = span[0].stamp_ns + round(sum(one.stamp_ns - span[0].stamp_ns for one in span) / len(span))
        self._means.append((stamp_ns, force, rate))


def _rounded(values: NDArray[np.float64], digits: int) -> tuple[float, float, float]:
    x, y, z = (round(value, digits) for value in values.tolist())
    return x, y, z
