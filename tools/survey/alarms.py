"""What does not fit: sights, field, depths and ranges of a leg, each named where it contradicts the others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.tools.survey.averages import wrap
from buddyline.tools.survey.magnetism import Field
from buddyline.tools.survey.project import Leg
from buddyline.tools.survey.settings import AlarmSettings
from buddyline.tools.survey.shots import Shot
from msgspec import UNSET
from msgspec.structs import replace

# Sights further apart than this many of their sigmas, and a field this share of its limit off, are suspect together.
SUSPECT_SIGMAS: Final = 2.0
SUSPECT_SHARE: Final = 0.25
# British Cave Research Association's grades as 1 sd: compass (deg), distance (m).
GRADES: Final = ((5, 0.5, 0.05), (4, 0.85, 0.1), (3, 1.25, 0.25))


@dataclass(frozen=True)
class UsualFields:
    """Each node's field as it mostly was in the dive; None without a magnetometer."""

    a: Field | None
    b: Field | None


def usual_fields(shots: list[Shot]) -> UsualFields:
    """Return the medians over a dive's rests: what is disturbed must be the exception."""
    return UsualFields(median_field([s.field_a for s in shots]), median_field([s.field_b for s in shots]))


def median_field(fields: Sequence[Field | None]) -> Field | None:
    """Return the median of what is known; None where nothing is."""
    known = [one for one in fields if one is not None]
    if not known:
        return None
    return Field(float(np.median([one.norm_t for one in known])), float(np.median([one.dip_rad for one in known])))


def field_alarm(field: Field | None, usual: Field | None, limits: AlarmSettings) -> str:
    """Say how a field differs from the usual one; empty where it does not, or is not known."""
    if field is None or usual is None:
        return ""
    share = field.norm_t / usual.norm_t - 1
    turn_deg = math.degrees(field.dip_rad - usual.dip_rad)
    parts = []
    if abs(share) > limits.field_share:
        parts.append(f"strength {share:+.0%}")
    if abs(turn_deg) > limits.dip_deg:
        parts.append(f"dip {turn_deg:+.1f} deg")
    return ", ".join(parts)


def disturbed(shot: Shot, usual: UsualFields, limits: AlarmSettings, nodes: tuple[str, str]) -> list[str]:
    """Return the nodes whose compasses are not to be believed.

    A field beyond its limits condemns. Where the sights contradict each other, so does less: what is clearly
    further off its usual field than the other node's.
    """
    off = off_fields(shot, usual, limits)
    found = [node for node, far in zip(nodes, off, strict=True) if far > 1]
    if found or shot.sight_a is None or shot.sight_b is None:
        return found
    gap = wrap(shot.sight_a.azimuth.value - shot.sight_b.azimuth.value - math.pi)
    if abs(gap) <= SUSPECT_SIGMAS * math.hypot(shot.sight_a.azimuth.sigma, shot.sight_b.azimuth.sigma):
        return []
    worse = 0 if off[0] > off[1] else 1
    return [nodes[worse]] if off[worse] > max(SUSPECT_SHARE, 2 * off[1 - worse]) else []


def off_fields(shot: Shot, usual: UsualFields, limits: AlarmSettings) -> tuple[float, float]:
    """Return how far each node's field is from its usual one, as a share of what is tolerated."""
    return _off(shot.field_a, usual.a, limits), _off(shot.field_b, usual.b, limits)


def disturbed_alike(legs: list[Leg], off: list[dict[str, float]]) -> list[Leg]:
    """Return legs in which a node that was disturbed at a station is so in the leg before and after as well.

    off: each leg's off_fields by node. A node that turns about at its station stays beside what disturbs it.
    """

    def at(leg: Leg, node: str) -> str:
        return leg.from_ if leg.from_node == node else leg.to

    result = list(legs)
    for k, leg in enumerate(legs):
        for other in (k - 1, k + 1):
            if not 0 <= other < len(legs):
                continue
            for node in legs[other].disturbed:
                same = at(leg, node) == at(legs[other], node)
                if same and node not in result[k].disturbed and off[k][node] > SUSPECT_SHARE:
                    result[k] = replace(result[k], disturbed=sorted([*result[k].disturbed, node]))
    return result


def _off(field: Field | None, usual: Field | None, limits: AlarmSettings) -> float:
    """Return how far a field is from the usual one, as a share of what is tolerated; 0 where it is not known."""
    if field is None or usual is None:
        return 0.0
    share = abs(field.norm_t / usual.norm_t - 1) / limits.field_share
    return max(share, abs(math.degrees(field.dip_rad - usual.dip_rad)) / limits.dip_deg)


def of_leg(leg: Leg, shot: Shot, usual: UsualFields, limits: AlarmSettings, nodes: tuple[str, str]) -> list[str]:
    """Return what is wrong with a leg, each as `check: what`. nodes: ids of a and b."""
    found = []
    if leg.azimuth_deg is not UNSET and leg.back_azimuth_deg is not UNSET:
        gap_deg = math.degrees(wrap(math.radians(leg.azimuth_deg - leg.back_azimuth_deg - 180)))
        if abs(gap_deg) > limits.sights_deg:
            found.append(f"sights: foresight and backsight differ by {abs(gap_deg):.1f} deg")
    elif leg.azimuth_deg is UNSET and leg.back_azimuth_deg is UNSET:
        found.append("compass: no attitude of either node; the leg has no direction")
    for node, field, of_node in zip(nodes, (shot.field_a, shot.field_b), (usual.a, usual.b), strict=True):
        text = field_alarm(field, of_node, limits)
        if text:
            found.append(f"field: at node {node} the magnetic field is not the usual one ({text})")
    if leg.heading_gap_deg is not UNSET and abs(leg.heading_gap_deg) > limits.heading_deg:
        found.append(
            f"heading: compasses and what the nodes see of each other differ by {abs(leg.heading_gap_deg):.1f} deg"
        )
    found += _depth_alarms(leg, limits)
    if shot.range_spread > limits.range_sigmas:
        found.append(f"range: fixes scatter {shot.range_spread:.1f} times what they state")
    return found


def _depth_alarms(leg: Leg, limits: AlarmSettings) -> list[str]:
    depths = leg.depth_from_m, leg.depth_to_m, leg.depth_from_sigma_m, leg.depth_to_sigma_m
    if UNSET in depths:
        return ["depth: a gauge is missing; the rise is the clinometers'"]
    from_m, to_m, from_sigma_m, to_sigma_m = (float(value) for value in depths if value is not UNSET)
    rise_m = from_m - to_m
    if abs(rise_m) > leg.distance_m + 3 * (math.hypot(from_sigma_m, to_sigma_m) + leg.distance_sigma_m):
        return [f"depth: rise of {rise_m:.2f} m on a leg of {leg.distance_m:.2f} m"]
    found = []
    for sight, sign, inclination_deg, sigma_deg in (
        ("foresight", 1.0, leg.inclination_deg, leg.inclination_sigma_deg),
        ("backsight", -1.0, leg.back_inclination_deg, leg.back_inclination_sigma_deg),
    ):
        if inclination_deg is UNSET or sigma_deg is UNSET:
            continue
        by_tilt_m = sign * leg.distance_m * math.sin(math.radians(inclination_deg))
        sigma_m = math.hypot(leg.distance_m * math.radians(sigma_deg), from_sigma_m, to_sigma_m)
        off_m = abs(by_tilt_m - rise_m)
        if off_m > limits.depth_m and off_m > limits.depth_sigmas * sigma_m:
            found.append(f"depth: depths and {sight}'s inclination differ by {off_m:.2f} m")
    return found


def grade(leg: Leg) -> int:
    """Return the leg's grade after the BCRA's, 5 best; 2: it meets none, or an alarm is on it; 1: no compass."""
    sigmas = [s for s in (leg.azimuth_sigma_deg, leg.back_azimuth_sigma_deg) if s is not UNSET]
    if not sigmas:
        return 1
    compass_deg = math.hypot(*sigmas) / len(sigmas)
    for number, deg, metres in GRADES:
        if compass_deg <= deg and leg.distance_sigma_m <= metres and not leg.alarms:
            return number
    return 2
