"""How far a node's clock is from the common clock, over a dive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from buddyline.protocol.clock import S_NS
from numpy.typing import NDArray


def trigger_moved(trigger: int, offset_ns: int, period_ns: int) -> int:
    """Return the number that a trigger of a clock that is offset_ns ahead has on the common clock.

    All of a clock's triggers move by as many: where the offset is half a period, the stamps' scatter would else move
    some by one more than others, so that two have one number, and others none.
    """
    return max(trigger - round(offset_ns / period_ns), 0)


@dataclass(frozen=True, eq=False)
class ClockCurve:
    """A clock minus the common clock: straight lines between its points, and level beyond the first and the last.

    stamps_ns: (N,) int64, rising, by the clock itself. offsets_ns: (N,) int64.
    """

    stamps_ns: NDArray[np.int64]
    offsets_ns: NDArray[np.int64]

    def __post_init__(self) -> None:
        """Check the points."""
        if not len(self.stamps_ns) or len(self.stamps_ns) != len(self.offsets_ns):
            raise ValueError("a clock's curve needs as many offsets as stamps, and at least one")
        if np.any(np.diff(self.stamps_ns) <= 0):
            raise ValueError("the stamps of a clock's curve must rise")

    @classmethod
    def of(cls, stamps_ns: Sequence[int], offsets_ns: Sequence[int]) -> Self:
        """Return the curve through these points."""
        return cls(np.array(stamps_ns, np.int64), np.array(offsets_ns, np.int64))

    @classmethod
    def constant(cls, offset_s: float) -> Self:
        """Return the curve of a clock that is always so far ahead."""
        return cls.of([0], [round(offset_s * S_NS)])

    @classmethod
    def line(cls, offset_s: float, at_ns: int, drift: float, start_ns: int, end_ns: int) -> Self:
        """Return the curve of a clock that is offset_s ahead at at_ns, and gains drift s a second."""
        ends_ns = [start_ns, max(end_ns, start_ns + 1)]
        return cls.of(ends_ns, [round(offset_s * S_NS + drift * (end_ns - at_ns)) for end_ns in ends_ns])

    def offset_ns(self, stamp_ns: int) -> int:
        """Return the clock minus the common clock at a stamp of the clock."""
        first_ns = int(self.stamps_ns[0])
        # Differences from the first stamp: a float cannot hold today's epoch nanoseconds exactly.
        found = np.interp(float(stamp_ns - first_ns), self.stamps_ns - first_ns, self.offsets_ns)
        return round(float(found))

    @property
    def largest_s(self) -> float:
        """The greatest distance from the common clock."""
        return float(np.abs(self.offsets_ns).max()) / S_NS

    @property
    def words(self) -> str:
        """What it is at its first and last point."""
        first_ms, last_ms = (1e3 * float(self.offsets_ns[end]) / S_NS for end in (0, -1))
        return (
            f"{first_ms:+.2f} ms"
            if len(self.stamps_ns) == 1
            else f"{first_ms:+.2f} ms at first, {last_ms:+.2f} at last"
        )
