"""The magnetic field at a node, which shows whether its compass can be trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from buddyline.tools.survey.readings import NodeReadings
from buddyline.tools.survey.settings import AlarmSettings


@dataclass(frozen=True)
class Field:
    """Mean field while a node rested: norm_t, and dip_rad below the horizon by its accelerometer."""

    norm_t: float
    dip_rad: float


def field_of(node: NodeReadings, start_ns: int, end_ns: int) -> Field | None:
    """Return the field from start_ns to end_ns; None without a magnetometer."""
    part = node.imu.between(start_ns, end_ns)
    mag_t, accel = node.imu["mag_t"][part], node.imu["accel_mps2"][part]
    known = ~np.isnan(mag_t).any(axis=1)
    if not known.any():
        return None
    mag_t, accel = mag_t[known], accel[known]
    # At rest the specific force points up.
    up = accel / np.maximum(np.linalg.norm(accel, axis=1), 1e-9)[:, None]
    norm_t = np.linalg.norm(mag_t, axis=1)
    sine = np.clip(-(mag_t * up).sum(1) / np.maximum(norm_t, 1e-12), -1.0, 1.0)
    return Field(float(np.median(norm_t)), math.asin(float(np.median(sine))))


def usual_field(fields: Sequence[Field | None]) -> Field | None:
    """Return the median of the known fields; None if none is known."""
    known = [one for one in fields if one is not None]
    if not known:
        return None
    return Field(float(np.median([one.norm_t for one in known])), float(np.median([one.dip_rad for one in known])))


def _differences(field: Field, usual: Field) -> tuple[float, float]:
    """Return how much stronger the field is than usual, as a share, and how much steeper, degrees."""
    return field.norm_t / usual.norm_t - 1, math.degrees(field.dip_rad - usual.dip_rad)


def off_usual(field: Field | None, usual: Field | None, limits: AlarmSettings) -> float:
    """Return the deviation of a field from the usual one, as a share of the tolerance; 0 if it is not known."""
    if field is None or usual is None:
        return 0.0
    share, turn_deg = _differences(field, usual)
    return max(abs(share) / limits.field_share, abs(turn_deg) / limits.dip_deg)


def iron_rad(field: Field | None, usual: Field | None) -> float:
    """Return by how much iron turns a compass whose field is not the usual one, 1 sd; 0 if a field is not known.

    The iron's field has an unknown direction. Strength and dip show two of its components; the third, level and across
    the usual field, turns the compass, and is as large as those two are (rms).
    """
    if field is None or usual is None:
        return 0.0
    along_t, down_t = field.norm_t - usual.norm_t, usual.norm_t * (field.dip_rad - usual.dip_rad)
    across_t, level_t = math.hypot(along_t, down_t) / math.sqrt(2), usual.norm_t * math.cos(usual.dip_rad)
    return math.atan2(across_t, max(level_t, 0.0))


def field_alarm(field: Field | None, usual: Field | None, limits: AlarmSettings) -> str:
    """Return the difference of a field from the usual one in words; empty if it is small or not known."""
    if field is None or usual is None:
        return ""
    share, turn_deg = _differences(field, usual)
    said = [f"strength {share:+.0%}"] if abs(share) > limits.field_share else []
    said += [f"dip {turn_deg:+.1f} deg"] if abs(turn_deg) > limits.dip_deg else []
    return f"the magnetic field is not the usual one ({', '.join(said)})" if said else ""
