"""The magnetic field at a node, as a witness for or against its compass."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from buddyline.tools.survey.readings import Node


@dataclass(frozen=True)
class Field:
    """Mean field while a node rested: norm_t, and dip_rad below the horizon as its accelerometer has it."""

    norm_t: float
    dip_rad: float


def field_of(node: Node, start_ns: int, end_ns: int) -> Field | None:
    """Return the field from start_ns to end_ns; None without a magnetometer."""
    part = node.between(node.imu_ns, start_ns, end_ns)
    mag_t, accel = node.mag_t[part], node.accel_mps2[part]
    known = ~np.isnan(mag_t).any(axis=1)
    if not known.any():
        return None
    mag_t, accel = mag_t[known], accel[known]
    # The accelerometer of a node at rest feels up.
    up = accel / np.maximum(np.linalg.norm(accel, axis=1), 1e-9)[:, None]
    norm_t = np.linalg.norm(mag_t, axis=1)
    sine = np.clip(-(mag_t * up).sum(1) / np.maximum(norm_t, 1e-12), -1.0, 1.0)
    return Field(float(np.median(norm_t)), math.asin(float(np.median(sine))))
