"""What the divers should do for a fix or a better one, in words: from where they last were, and from their lamps.

Where they last were is not known before the first fix; then what they see says it (`first_fix`).

Angles are those of a node's camera: right is clockwise seen from above, for a camera that is upright.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.protocol.health import TRACK_SIGMA_SHARE
from buddyline.protocol.messages import NodeInfo, RelativePose, Track
from buddyline.solver_service.first_fix import STEP_M, WELL_INSIDE, NodeLook, advise_first, turn_words
from buddyline.solver_service.geometry.rotation import Floats, quat_to_matrix

# An older place, or a place worse than this share of the range, tells no direction.
OLD_S: Final = 20.0
VAGUE_SHARE: Final = 0.2
# Why there is no pose where lights are not found: too little is in the picture, or only what is no light.
UNSEEN: Final = ("too_few_candidates", "ambiguous")
# With fewer lights there is no pose.
FEW: Final = 3
# A diver who looks at the other and finds no lights comes closer by this share of the range, but not below NEAR_M.
CLOSER_SHARE: Final = 0.25
NEAR_M: Final = 2.0


@dataclass(frozen=True, eq=False)
class LastPlace:
    """Where B last was as A sees it: t_m (3,), R (3, 3) of T_a_b, sigma_m of the place, and its age.

    why: the rejection reason for which triggers give no pose now; "" where they give poses. told: how many different
    lights the last trigger told the track; a pose tells of itself. turned: the turns (3, 3) of
    A's and B's cameras since then, R_then_now, from their attitude sensors.
    """

    t_m: Floats
    R: Floats
    sigma_m: float
    age_s: float
    why: str = ""
    turned: tuple[Floats, Floats] | None = None
    told: int = 4

    @staticmethod
    def of(
        estimate: RelativePose | Track, age_s: float, why: str, turned: tuple[Floats, Floats] | None = None
    ) -> LastPlace:
        """Return the place that an estimate says."""
        t_m, R = np.array(estimate.t_a_b_m), quat_to_matrix(np.array(estimate.q_a_b_xyzw))
        sigma_m = math.sqrt(sum(max(estimate.covariance[i], 0.0) for i in (0, 7, 14)))
        return LastPlace(t_m, R, sigma_m, age_s, why, turned, estimate.lights if isinstance(estimate, Track) else 4)

    @property
    def range_m(self) -> float:
        """Distance from A to B."""
        return float(np.linalg.norm(self.t_m))

    @property
    def tells(self) -> bool:
        """Whether it is new and certain enough to tell a direction."""
        return self.age_s <= OLD_S and self.sigma_m <= VAGUE_SHARE * self.range_m

    def lights(self, info_a: NodeInfo, info_b: NodeInfo) -> tuple[Floats, Floats]:
        """Return B's lights in A's present camera frame, and A's lights in B's, (2, 3) each."""
        turn_a, turn_b = self.turned or (np.eye(3), np.eye(3))
        of_a, of_b = (np.array((info.light_left_m, info.light_right_m)) for info in (info_a, info_b))
        # B's turn moves only B's lights about its camera, by little beside the range: its direction stays.
        in_a: Floats = (of_b @ (self.R @ turn_b).T + self.t_m) @ turn_a
        in_b: Floats = (of_a @ turn_a.T - self.t_m) @ (self.R @ turn_b)
        return in_a, in_b


def advise(
    infos: Sequence[NodeInfo],
    place: LastPlace | None,
    dark: Iterable[tuple[int, int]] = (),
    looks: Sequence[NodeLook] = (),
    unseen: Iterable[tuple[int, int]] = (),
) -> list[str]:
    """Return what to do, such as "turn b 20 deg left"; empty where all is well, or nothing is known.

    infos: of A and B. dark: lamps that are dark, as node (0: A) and light (0: left). looks: of A and B, for where
    no place tells a direction; empty where they say nothing. unseen: lamps that may be dark, or covered, or too faint.
    """
    named = {lamp: "is not seen" for lamp in unseen} | dict.fromkeys(dark, "is dark")
    said = [f"{('left', 'right')[light]} lamp of {infos[node].node} {what}" for (node, light), what in named.items()]
    if place is None or not place.tells:
        return said + (advise_first(infos, looks) if looks else [])
    seen = place.lights(infos[0], infos[1])
    turns = [f"turn {info.node} {words}" for info, of in zip(infos, seen, strict=True) if (words := _turn(info, of))]
    return said + (turns or _move(infos, place, seen))


def _move(infos: Sequence[NodeInfo], place: LastPlace, seen: tuple[Floats, Floats]) -> list[str]:
    """Return whether the two should come closer or move apart, by which of them who can."""
    range_m = place.range_m
    apart_m = max(_too_near_m(info, lights_m) for info, lights_m in zip(infos, seen, strict=True))
    if apart_m > 0.0:
        return [f"move {math.ceil(apart_m / STEP_M) * STEP_M:.1f} m apart"]
    # Where the lights are lost, what remains is no light: for what reason it is refused says nothing.
    if place.why and place.why not in UNSEEN and place.told >= FEW:
        return []
    # Lights that are not found are too faint; a poor fix gets better in proportion to the range, or faster.
    wanted_m = range_m * ((1.0 - CLOSER_SHARE) if place.why else TRACK_SIGMA_SHARE * range_m / place.sigma_m)
    steps = round((range_m - max(wanted_m, NEAR_M)) / STEP_M)
    return [f"come {steps * STEP_M:.1f} m closer"] if steps > 0 else []


def _too_near_m(info: NodeInfo, lights_m: Floats) -> float:
    """Return how much further the other's bar must be for both lights to be well in the picture."""
    width_m = float(np.linalg.norm(lights_m[1] - lights_m[0]))
    least_m = width_m / 2 / math.tan(WELL_INSIDE * math.atan(info.width_px / 2 / info.camera.fx_px))
    return least_m - float(np.linalg.norm(lights_m.mean(axis=0)))


def _turn(info: NodeInfo, lights_m: Floats) -> str:
    """Return the turn that brings the middle of both lights (2, 3) to the picture's middle; "" if they are inside."""
    camera = info.camera
    half_rad = math.atan(info.width_px / 2 / camera.fx_px), math.atan(info.height_px / 2 / camera.fy_px)
    right_rad = np.arctan2(lights_m[:, 0], lights_m[:, 2])
    down_rad = np.arctan2(lights_m[:, 1], np.hypot(lights_m[:, 0], lights_m[:, 2]))
    turn_rad = [0.0, 0.0]
    for k, (angles_rad, limit_rad) in enumerate(((right_rad, half_rad[0]), (down_rad, half_rad[1]))):
        if np.abs(angles_rad).max() > WELL_INSIDE * limit_rad:
            turn_rad[k] = float(np.angle(np.exp(1j * angles_rad).sum()))
    return turn_words(*turn_rad)
