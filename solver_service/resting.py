"""Which triggers of a pair are not solved: of nodes out of each other's view, or for which there is no time.

In a team many pairs are out of each other's view: nearly half of all, where two groups face each other. A pair that had
no pose for REST_NS rests where its cameras look apart by both attitudes, and in a CROWD anyway: only one in LOOKS of
its triggers is solved. A pose, or one that only a compass contradicts, wakes it. So a compass that is off costs the
first poses only, and the cost of many nodes grows with the pairs that are in view. In a crowd whose solver cannot keep
up, one in LOOKS triggers of each pair is solved, or one in LOOKS^2 (pace.py); one in LOOKS^2 of a pair that rests.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.fix import Fix, NoFix
from buddyline.solver_service.geometry.observation import Sensed
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import quat_to_matrix

REST_NS: Final = 5 * S_NS
LOOKS: Final = 5
# From so many nodes on, a pair rests wherever its cameras look: it is one of ten or more.
CROWD: Final = 5
# The details of the triggers that are not solved; their reason is `too_few_candidates`.
LOOK_APART: Final = "by both attitudes the cameras look apart"
NOT_IN_VIEW: Final = "one of many pairs, which had no pose for 5 s"
# Of those that are left out for want of time; their reason is `unmatched`.
NO_TIME: Final = "this solver cannot keep up: until it does, it solves one in five triggers, or one in 25"
# What iron may add to both compasses together, and how many of their own sigmas count.
IRON_RAD: Final = math.radians(30.0)
SIGMAS: Final = 4.0


class Resting:
    """Remembers when a pair's nodes last had, or may have had, each other in view."""

    def __init__(self) -> None:
        self._seen_ns: int | None = None

    def forget(self) -> None:
        """Forget it: the pair does not rest for REST_NS."""
        self._seen_ns = None

    def rests(self, stamp_ns: int) -> bool:
        """Whether the pair rests at a trigger, should its nodes not look at each other."""
        if self._seen_ns is None:
            self._seen_ns = stamp_ns
        return stamp_ns - self._seen_ns > REST_NS

    def take(self, stamp_ns: int, found: Fix | NoFix) -> None:
        """Take what became of a trigger."""
        if isinstance(found, Fix) or found.reason in ("heading", "other_lights"):
            self._seen_ns = stamp_ns


def look_apart(sensed: tuple[Sensed, Sensed], rigs: tuple[Rig, Rig]) -> bool:
    """Whether two nodes cannot both have the other in view, whatever lies between them; False where it is not known.

    Of two cameras that see each other, the one's axis and the other's, turned round, are apart by no more than half of
    both fields of view.
    """
    axes, variance = [], 0.0
    for one, rig in zip(sensed, rigs, strict=True):
        if one.q_ned_body_xyzw is None or one.sigma_rad is None:
            return False
        axes.append(quat_to_matrix(one.q_ned_body_xyzw) @ rig.R_body_camera[:, 2])
        variance += float(np.square(one.sigma_rad).sum())
    apart = math.acos(min(max(-float(axes[0] @ axes[1]), -1.0), 1.0))
    return apart > sum(rig.camera.half_view_rad for rig in rigs) + IRON_RAD + SIGMAS * math.sqrt(variance)
