"""Fixes as sights: each one's line from station to station, by A's attitude and by B's.

All directions are magnetic; NED is x magnetic north, y magnetic east, z down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.readings import Readings, Stamps
from buddyline.tools.survey.rotations import matrices_of
from buddyline.tools.survey.settings import SurveySettings


@dataclass(frozen=True, eq=False)
class Sights:
    """All fixes of a dive, (n,) and (n, 3). NaN where a node's attitude is not known.

    line_a_m: A's station to B's, oriented by A's attitude; line_b_m: the same line by B's. along_sigma_m,
    across_sigma_m: 1 sd of the fix. sigma_a_rad: A's stated roll, pitch, yaw. port_a_m: A's station below its
    pressure port. heading_gap_rad: B's compass minus A's, by what the two see of each other.
    """

    stamps_ns: Stamps
    triggers: Stamps
    range_m: Floats
    line_a_m: Floats
    line_b_m: Floats
    along_sigma_m: Floats
    across_sigma_m: Floats
    sigma_a_rad: Floats
    sigma_b_rad: Floats
    port_a_m: Floats
    port_b_m: Floats
    heading_gap_rad: Floats

    @property
    def line_m(self) -> Floats:
        """The line by A's attitude, or by B's where A's is not known."""
        return np.where(np.isnan(self.line_a_m), self.line_b_m, self.line_a_m)


def sights(readings: Readings, settings: SurveySettings) -> Sights:
    """Return the lines of all fixes, from reference point to reference point."""
    node_a, node_b = readings.nodes
    reference_a = np.array(settings.reference_m.get(node_a, (0.0, 0.0, 0.0)))
    reference_b = np.array(settings.reference_m.get(node_b, (0.0, 0.0, 0.0)))
    R_a_b = matrices_of(readings.q_a_b)
    between_m = readings.t_a_b_m + R_a_b @ reference_b - reference_a
    R_ned_a, sigma_a_rad = readings.a.attitude(readings.stamps_ns)
    R_ned_b, sigma_b_rad = readings.b.attitude(readings.stamps_ns)
    R_ned_a_by_b = R_ned_b @ R_a_b.transpose(0, 2, 1)
    turn = R_ned_a_by_b @ R_ned_a.transpose(0, 2, 1)
    range_m = np.sqrt((between_m**2).sum(-1))
    unit = between_m / np.maximum(range_m, 1e-9)[:, None]
    position = readings.covariance[:, :3, :3]
    along = np.einsum("ni,nij,nj->n", unit, position, unit)
    across = (np.trace(position, axis1=1, axis2=2) - along) / 2
    return Sights(
        stamps_ns=readings.stamps_ns,
        triggers=readings.triggers,
        range_m=range_m,
        line_a_m=(R_ned_a @ between_m[:, :, None])[:, :, 0],
        line_b_m=(R_ned_a_by_b @ between_m[:, :, None])[:, :, 0],
        along_sigma_m=np.sqrt(np.maximum(along, 0.0)),
        across_sigma_m=np.sqrt(np.maximum(across, 0.0)),
        sigma_a_rad=sigma_a_rad,
        sigma_b_rad=sigma_b_rad,
        port_a_m=(R_ned_a @ (reference_a - np.array(readings.a.info.depth_port_m)))[:, 2],
        port_b_m=(R_ned_b @ (reference_b - np.array(readings.b.info.depth_port_m)))[:, 2],
        heading_gap_rad=np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1]),
    )
