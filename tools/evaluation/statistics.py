"""Statistics of a sample of errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from buddyline.tools.evaluation.rotation import Floats
from numpy.typing import NDArray


@dataclass(frozen=True)
class Stats:
    """Statistics of errors. count: of finite values. median, p95: of absolute values. rmse. mean: signed, the bias."""

    count: int
    median: float | None = None
    p95: float | None = None
    rmse: float | None = None
    mean: float | None = None

    @classmethod
    def of(cls, errors: Floats) -> Stats:
        """Return the statistics of errors (N,); NaN for an unknown one."""
        known = errors[np.isfinite(errors)]
        if not len(known):
            return cls(0)
        size = np.abs(known)
        return cls(
            count=len(known),
            median=float(np.median(size)),
            p95=float(np.percentile(size, 95)),
            rmse=float(np.sqrt(np.mean(known**2))),
            mean=float(np.mean(known)),
        )


def share(part: int | float, whole: int | float) -> float | None:
    """Return part / whole; None if whole is 0."""
    return part / whole if whole else None


def in_bins(edges: Sequence[float], values: Floats) -> Iterator[tuple[float, float, NDArray[np.bool_]]]:
    """Yield each bin's edges, and a mask (N,) of the values in it: start <= value < end."""
    for start, end in pairwise(edges):
        yield start, end, (values >= start) & (values < end)
