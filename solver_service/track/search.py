"""Starts without a fix: one picture's two lights, and both attitudes.

A dead or hidden lamp leaves no trigger with all four lights. Two lights of a bar whose attitude is known roughly
tell where it is.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.anchors import attitude_covariance
from buddyline.solver_service.track.inputs import AttitudeSeen, TrackNode
from buddyline.solver_service.track.lights import Sight
from buddyline.solver_service.track.start import constants_of
from buddyline.solver_service.track.state import PHI, R_, State, of_place

NEAREST_M: Final = 0.5
FURTHEST_M: Final = 20.0
# By how much of its length a bar may stand off the plane of its two bearings: three tilts of 1 to 2 degrees.
OFF_PLANE: Final = 0.10
# How far off the range may be before the lights themselves are counted.
RANGE_SHARE: Final = 0.3


def starts(
    nodes: tuple[TrackNode, TrackNode],
    sight: Sight,
    attitudes: tuple[AttitudeSeen, AttitudeSeen],
    clock_sigma_s: float,
) -> list[tuple[State, Floats, tuple[int, int]]]:
    """Give each start that two candidates of a picture allow: state, covariance, and which candidate is which light.

    With level bearings b, s_0 b_0 - s_1 b_1 = R (l_0 - l_1) has two unknowns in three equations. Heading bears on the
    distances s alone, tilt on what is left over.
    """
    R = np.stack([seen.R_ned_body @ node.rig.R_body_camera for node, seen in zip(nodes, attitudes, strict=True)])
    observer, other = sight.node, 1 - sight.node
    lights = nodes[other].rig.lights_m @ R[other].T
    bar = lights[0] - lights[1]
    length = float(np.linalg.norm(bar))
    bearings = sight.bearings @ R[observer].T
    found = []
    for p in range(len(bearings)):
        for q in range(len(bearings)):
            if p == q:
                continue
            A = np.stack((bearings[p], -bearings[q]), axis=1)
            s, _, rank, _ = np.linalg.lstsq(A, bar, rcond=None)
            off = float(np.linalg.norm(A @ s - bar))
            if rank < 2 or min(s) < NEAREST_M or max(s) > FURTHEST_M or off > OFF_PLANE * length:
                continue
            d = 0.5 * (s[0] * bearings[p] - lights[0] + s[1] * bearings[q] - lights[1])
            r = d if observer == 0 else -d
            state, variances = constants_of(nodes, R, r, clock_sigma_s)
            P = np.diag(variances)
            P[R_, R_] = (RANGE_SHARE * float(np.linalg.norm(r))) ** 2 * np.eye(3)
            for node in (0, 1):
                P[PHI[node], PHI[node]] = attitude_covariance(
                    attitudes[node].R_ned_body, attitudes[node].sigma_rad, 1.5, 1.5
                )
            found.append((state, of_place(state, P), (p, q)))
    return found
