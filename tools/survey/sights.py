"""Fixes as sights: each one's line from station to station, by each node's own attitude.

All directions are magnetic; NED is x magnetic north, y magnetic east, z down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from buddyline.tools.evaluation.rotation import conjugate, multiply, rotate
from buddyline.tools.survey.averages import Floats, Ints
from buddyline.tools.survey.readings import PairReadings
from buddyline.tools.survey.settings import SurveySettings


@dataclass(frozen=True, eq=False)
class Sights:
    """All fixes of a pair's dive, (n,) and (n, 3); what each node says, (2, n) and (2, n, 3), a first. NaN: not known.

    line_by_m: a's station to b's, oriented by a's attitude and by b's. along_sigma_m, across_sigma_m: 1 sd of the
    fix. sigma_rad: each node's stated roll, pitch, yaw. below_port_m: each station below its node's pressure port.
    heading_gap_rad: b's compass minus a's, by what the two see of each other.
    """

    stamps_ns: Ints
    triggers: Ints
    range_m: Floats
    line_by_m: Floats
    along_sigma_m: Floats
    across_sigma_m: Floats
    sigma_rad: Floats
    below_port_m: Floats
    heading_gap_rad: Floats

    @property
    def line_m(self) -> Floats:
        """The line by a's attitude, or by b's where a's is not known."""
        by_a, by_b = self.line_by_m
        return np.asarray(np.where(np.isnan(by_a), by_b, by_a))


def sights(readings: PairReadings, settings: SurveySettings) -> Sights:
    """Return the lines of all fixes, from reference point to reference point."""
    references = [np.array(settings.reference_m.get(node, (0.0, 0.0, 0.0))) for node in readings.nodes]
    between_m = readings.t_a_b_m + rotate(readings.q_a_b, references[1]) - references[0]
    attitudes = [node.q_ned_camera(readings.stamps_ns) for node in readings.pair]
    # Camera a to NED: by a's own attitude, and by b's.
    q_ned_a = attitudes[0][0], multiply(attitudes[1][0], conjugate(readings.q_a_b))
    turn = multiply(q_ned_a[1], conjugate(q_ned_a[0]))
    heading_gap_rad = 2 * np.arctan2(turn[:, 2], turn[:, 3])
    range_m = np.linalg.norm(between_m, axis=1)
    unit = between_m / np.maximum(range_m, 1e-9)[:, None]
    position = readings.covariance[:, :3, :3]
    along = np.einsum("ni,nij,nj->n", unit, position, unit)
    across = (np.trace(position, axis1=1, axis2=2) - along) / 2
    below_port_m = [
        rotate(q_ned_camera, reference - np.array(node.info.depth_port_m))[:, 2]
        for node, reference, (q_ned_camera, _) in zip(readings.pair, references, attitudes, strict=True)
    ]
    return Sights(
        stamps_ns=readings.stamps_ns,
        triggers=readings.triggers,
        range_m=range_m,
        line_by_m=np.stack([rotate(q, between_m) for q in q_ned_a]),
        along_sigma_m=np.sqrt(np.maximum(along, 0.0)),
        across_sigma_m=np.sqrt(np.maximum(across, 0.0)),
        sigma_rad=np.stack([sigma_rad for _, sigma_rad in attitudes]),
        below_port_m=np.stack(below_port_m),
        heading_gap_rad=(heading_gap_rad + np.pi) % (2 * np.pi) - np.pi,
    )
