"""Uncertainties of an estimate of T_a_b: of one trigger's pose or of the track."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from buddyline.protocol.messages import RelativePose, Track
from msgspec import UNSET
from numpy.typing import NDArray

# The pose of one trigger, or the fused estimate at any time. Fields with the same name have the same meaning.
Estimate: TypeAlias = RelativePose | Track


def sigma_m(estimate: Estimate) -> float:
    """Return a position's uncertainty: the root of the sum of its three variances."""
    return math.sqrt(sum(max(estimate.covariance[i], 0.0) for i in (0, 7, 14)))


def range_sigma_m(estimate: Estimate) -> float:
    """Return a range's uncertainty (1 sd): the position's, along the line of sight."""
    sight, _ = _scaled(np.array(estimate.t_a_b_m))
    covariance, largest = _scaled(np.array(estimate.covariance).reshape(6, 6)[:3, :3])
    along = float(sight @ covariance @ sight) / max(float(sight @ sight), 1e-9)
    return math.sqrt(largest) * math.sqrt(max(along, 0.0))


def range_gap_m(estimate: Estimate) -> float:
    """Return the range by A's picture minus that by B's; NaN where both do not tell one by themselves."""
    if isinstance(estimate, Track) or estimate.method == "three_lights":
        return math.nan
    return estimate.range_gap_m


def _scaled(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return values as shares of the largest, and that: squares of a stranger's numbers may be too large."""
    largest = float(np.abs(values).max())
    return (values / largest if largest else values), largest


def known(estimate: Estimate, field: str) -> float | None:
    """Return an optional field of an estimate, such as sigma_azimuth_rad; None if it is absent."""
    value = getattr(estimate, field)
    return None if value is UNSET else float(value)
