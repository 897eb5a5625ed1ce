"""Where B is as A sees it, by one trigger or by the track, and how sure that is."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from buddyline.protocol.messages import RelativePose, Track
from msgspec import UNSET

# A measurement of one trigger, or the fused estimate at any time: fields of one name mean the same.
Estimate: TypeAlias = RelativePose | Track


def sigma_m(estimate: Estimate) -> float:
    """Return a position's uncertainty: the root of the sum of its three variances."""
    return math.sqrt(sum(max(estimate.covariance[i], 0.0) for i in (0, 7, 14)))


def range_sigma_m(estimate: Estimate) -> float:
    """Return a range's uncertainty (1 sd): the position's, along the line of sight."""
    sight = np.array(estimate.t_a_b_m)
    covariance = np.array(estimate.covariance).reshape(6, 6)[:3, :3]
    return math.sqrt(max(float(sight @ covariance @ sight), 0.0)) / max(float(np.linalg.norm(sight)), 1e-9)


def known(estimate: Estimate, field: str) -> float | None:
    """Return a number that an estimate may lack, such as sigma_azimuth_rad, None where it does."""
    value = getattr(estimate, field)
    return None if value is UNSET else float(value)
