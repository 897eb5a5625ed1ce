"""Alarms: which of a leg's sights, magnetic fields, depths and ranges contradict the others."""

from __future__ import annotations

import math
from typing import Final, TypeAlias

from buddyline.tools.survey.averages import wrap
from buddyline.tools.survey.magnetism import Field, field_alarm, off_usual
from buddyline.tools.survey.project import Leg
from buddyline.tools.survey.settings import AlarmSettings
from buddyline.tools.survey.shots import Shot
from msgspec import UNSET
from msgspec.structs import replace

# Sights further apart than this many sigmas, with a field this share of its limit off, are suspect together.
SUSPECT_SIGMAS: Final = 2.0
SUSPECT_SHARE: Final = 0.25
# British Cave Research Association's grades as 1 sd: compass (deg), distance (m).
GRADES: Final = ((5, 0.5, 0.05), (4, 0.85, 0.1), (3, 1.25, 0.25))

# Each node's median field in the dive; None without a magnetometer.
UsualFields: TypeAlias = dict[str, Field | None]


def off_fields(shot: Shot, usual: UsualFields, limits: AlarmSettings) -> dict[str, float]:
    """Return the deviation of each node's field from its usual one, as a share of the tolerance."""
    return {end.node: off_usual(end.field, usual.get(end.node), limits) for end in shot.ends}


def disturbed(shot: Shot, usual: UsualFields, limits: AlarmSettings) -> list[str]:
    """Return the nodes whose compasses are disturbed.

    A field beyond its limits is enough. If the sights contradict each other, so is a smaller difference from the
    usual field, if it is clearly larger than the other node's.
    """
    off = off_fields(shot, usual, limits)
    found = [node for node, share in off.items() if share > 1]
    fore, back = (end.azimuth for end in shot.ends)
    if found or fore is None or back is None:
        return found
    gap = wrap(fore.value - back.value - math.pi)
    if abs(gap) <= SUSPECT_SIGMAS * math.hypot(fore.sigma, back.sigma):
        return []
    better, worse = sorted(off, key=lambda node: off[node])
    return [worse] if off[worse] > max(SUSPECT_SHARE, 2 * off[better]) else []


def disturbed_alike(legs: list[Leg], off: list[dict[str, float]]) -> list[Leg]:
    """Return the legs, with a node marked as disturbed if the leg before or after disturbs it at the same station.

    off: each leg's off_fields. A node that turns round at its station stays beside the iron that disturbs it.
    """

    def at(leg: Leg, node: str) -> str:
        return leg.from_ if leg.from_node == node else leg.to

    result = list(legs)
    for k, leg in enumerate(legs):
        for other in legs[max(k - 1, 0) : k + 2]:
            for node in other.disturbed:
                same = at(leg, node) == at(other, node)
                if same and node not in result[k].disturbed and off[k][node] > SUSPECT_SHARE:
                    result[k] = replace(result[k], disturbed=sorted([*result[k].disturbed, node]))
    return result


def of_leg(leg: Leg, shot: Shot, usual: UsualFields, limits: AlarmSettings) -> list[str]:
    """Return a leg's alarms, each as `check: what is wrong`."""
    found = []
    if leg.azimuth_deg is not UNSET and leg.back_azimuth_deg is not UNSET:
        gap_deg = math.degrees(wrap(math.radians(leg.azimuth_deg - leg.back_azimuth_deg - 180)))
        if abs(gap_deg) > limits.sights_deg:
            found.append(f"sights: foresight and backsight differ by {abs(gap_deg):.1f} deg")
    elif leg.azimuth_deg is UNSET and leg.back_azimuth_deg is UNSET:
        found.append("compass: no attitude of either node; the leg has no direction")
    for end in shot.ends:
        if text := field_alarm(end.field, usual.get(end.node), limits):
            found.append(f"field: at node {end.node} {text}")
    if leg.heading_gap_deg is not UNSET and abs(leg.heading_gap_deg) > limits.heading_deg:
        found.append(
            f"heading: compasses and what the nodes see of each other differ by {abs(leg.heading_gap_deg):.1f} deg"
        )
    found += _depth_alarms(leg, limits)
    if shot.range_spread > limits.range_sigmas:
        found.append(f"range: fixes scatter {shot.range_spread:.1f} times their stated sigma")
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
    """Return the leg's grade after the BCRA's, 5 best; 2: it meets none, or has an alarm; 1: no compass."""
    sigmas = [s for s in (leg.azimuth_sigma_deg, leg.back_azimuth_sigma_deg) if s is not UNSET]
    if not sigmas:
        return 1
    compass_deg = math.hypot(*sigmas) / len(sigmas)
    good = (n for n, deg, m in GRADES if compass_deg <= deg and leg.distance_sigma_m <= m and not leg.alarms)
    return next(good, 2)
