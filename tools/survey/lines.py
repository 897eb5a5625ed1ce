"""Legs as lines: one bearing from both compasses, and the leg's vector with its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.tools.survey.averages import Floats, wrap
from buddyline.tools.survey.project import Leg, Project
from msgspec import UNSET, UnsetType

# If the sigmas of two sights differ by more than this factor, the better sight is better than their mean.
WORTH_BOTH: Final = math.sqrt(3)
# If two sights differ by more than this many sigmas, their sigmas are too small.
CONTRADICT: Final = 2.5
# On steeper legs the clinometers give the horizontal distance better than the depths do.
STEEP_RAD: Final = math.radians(55.0)
# Held depths are nearly exact in a leg, so that a horizontal misclosure moves no depth.
ABSOLUTE_DEPTH_SIGMA_M: Final = 0.002


@dataclass(frozen=True)
class SightPair:
    """Foresight and backsight in use, radians, magnetic for azimuths; sigmas as they are weighed.

    back is as read, from the far station; gap: fore minus back. None: not measured, or not used.
    """

    fore: float | None
    back: float | None
    fore_sigma: float
    back_sigma: float
    gap: float | None

    @property
    def sigma(self) -> float:
        """Standard deviation of the one angle that both give."""
        if self.fore is None:
            return self.back_sigma
        if self.back is None:
            return self.fore_sigma
        return 0.5 * math.hypot(self.fore_sigma, self.back_sigma)


def bearing_of(leg: Leg, project: Project) -> SightPair | None:
    """Return the azimuths of a leg that are used; None if there are none.

    A disturbed compass is not used if the other one is undisturbed; a person's edit takes precedence.
    """
    fore, back, fore_sigma, back_sigma = map(
        _radians, (leg.azimuth_deg, leg.back_azimuth_deg, leg.azimuth_sigma_deg, leg.back_azimuth_sigma_deg)
    )
    gap = None if fore is None or back is None else wrap(fore - back - math.pi)
    bad_fore, bad_back = leg.from_node in leg.disturbed, leg.to_node in leg.disturbed
    disturbed = math.radians(project.settings.disturbed_deg)
    fore_sigma = math.hypot(fore_sigma or 0.0, disturbed * bad_fore)
    back_sigma = math.hypot(back_sigma or 0.0, disturbed * bad_back)
    edit = project.edit_of(leg)
    if edit is not None and edit.compass is not UNSET:
        fore = None if edit.compass == "back" else fore
        back = None if edit.compass == "fore" else back
    elif fore is not None and back is not None and bad_fore != bad_back:
        fore, back = (None, back) if bad_fore else (fore, None)
    return _weighed(fore, back, fore_sigma, back_sigma, gap)


def clino_of(leg: Leg) -> SightPair | None:
    """Return the inclinations of a leg by the nodes' tilt, up positive, as read; None if there are none."""
    fore, back, fore_sigma, back_sigma = map(
        _radians,
        (leg.inclination_deg, leg.back_inclination_deg, leg.inclination_sigma_deg, leg.back_inclination_sigma_deg),
    )
    gap = None if fore is None or back is None else fore + back
    return _weighed(fore, back, fore_sigma or 0.0, back_sigma or 0.0, gap)


def _radians(angle_deg: float | UnsetType) -> float | None:
    return None if angle_deg is UNSET else math.radians(angle_deg)


def _weighed(
    fore: float | None, back: float | None, fore_sigma: float, back_sigma: float, gap: float | None
) -> SightPair | None:
    if fore is None and back is None:
        return None
    if fore is not None and back is not None and gap is not None:
        if max(fore_sigma, back_sigma) > WORTH_BOTH * min(fore_sigma, back_sigma):
            fore, back = (fore, None) if fore_sigma < back_sigma else (None, back)
        else:
            # If the two contradict each other, the truth may be as far from their mean as they are.
            chi = abs(gap) / math.hypot(fore_sigma, back_sigma)
            grown = chi if chi > CONTRADICT else 1.0
            fore_sigma, back_sigma = grown * fore_sigma, grown * back_sigma
    return SightPair(fore, back, fore_sigma, back_sigma, gap)


@dataclass(frozen=True, eq=False)
class Line:
    """A leg to adjust. vector_m: east, north, up of the grid; covariance (3, 3), m^2. turn_m: (3,), per rad of azimuth.

    rise_m: up, and its sigma; by_clino: it is the clinometers'. distance_sigma_m: as weighed. turn_rad: grid
    azimuth minus magnetic. read_rise_m, read_rise_sigma_m: of the leg's own two depths, where others are held.
    """

    leg: Leg
    vector_m: Floats
    covariance: Floats
    turn_m: Floats
    rise_m: float
    rise_sigma_m: float
    distance_sigma_m: float
    by_clino: bool
    turn_rad: float
    read_rise_m: float
    read_rise_sigma_m: float

    @property
    def length_m(self) -> float:
        """Length of the vector."""
        return float(np.linalg.norm(self.vector_m))


def line_of(
    leg: Leg,
    project: Project,
    turn_rad: float,
    depths_m: dict[str, float],
    *,
    alone: bool = False,
    read_m: tuple[float, float] | None = None,
) -> Line | None:
    """Return a leg as a vector; None if its bearing or its rise is unknown.

    turn_rad: grid azimuth minus magnetic. depths_m: stations held at these depths; others by their readings.
    alone: no other legs share the gauges' slow errors, so the rise has all of them. read_m: its
    own two depths, with zeros and levels taken off; by default as read.
    Distance, bearing and rise are independent; the run along follows from distance and rise, except for steep
    legs, where the clinometers give both.
    """
    bearing = bearing_of(leg, project)
    if bearing is None:
        return None
    fore = wrap(bearing.back + math.pi) if bearing.back is not None else bearing.fore
    if fore is None:
        return None
    azimuth = turn_rad + (fore if bearing.fore is None else fore + 0.5 * wrap(bearing.fore - fore))
    distance_m, distance_sigma_m = leg.distance_m, leg.distance_sigma_m
    held = leg.from_ in depths_m and leg.to in depths_m
    own = leg.depth_from_m, leg.depth_to_m
    from_m, to_m = (depths_m[leg.from_], depths_m[leg.to]) if held else own
    clino = clino_of(leg)
    steep = from_m is UNSET or to_m is UNSET or abs(from_m - to_m) > distance_m * math.sin(STEEP_RAD)
    if steep and clino is not None:
        known = [a for a in (clino.fore, None if clino.back is None else -clino.back) if a is not None]
        slope = sum(known) / len(known)
        run_m, rise_m = distance_m * math.cos(slope), distance_m * math.sin(slope)
        by_distance, by_other = (math.cos(slope), math.sin(slope)), (-rise_m, run_m)
        other_sigma, rise_sigma_m = clino.sigma, distance_m * clino.sigma
    elif from_m is not UNSET and to_m is not UNSET and abs(from_m - to_m) < distance_m:
        rise_m = from_m - to_m
        gauges_m = _hypot(leg.depth_from_sigma_m, leg.depth_to_sigma_m)
        noises = leg.depth_from_noise_m, leg.depth_to_noise_m
        if held:
            rise_sigma_m = math.sqrt(2) * ABSOLUTE_DEPTH_SIGMA_M
            # Held depths have errors as well; their effect on the horizontal distance is added to the distance's sigma.
            distance_sigma_m = math.hypot(distance_sigma_m, rise_m / distance_m * gauges_m)
        else:
            # A node keeps its gauge, and mostly its station, from leg to leg, so slow errors cancel along the line.
            rise_sigma_m = gauges_m if alone or UNSET in noises else _hypot(*noises)
        run_m = math.sqrt(distance_m**2 - rise_m**2)
        by_distance, by_other = (distance_m / run_m, 0.0), (-rise_m / run_m, 1.0)
        other_sigma = rise_sigma_m
    else:
        return None
    read_rise_m, read_sigma_m = rise_m, rise_sigma_m
    if read_m is not None and not steep:
        read_rise_m = read_m[0] - read_m[1]
        noises = leg.depth_from_noise_m, leg.depth_to_noise_m
        read_sigma_m = _hypot(*((leg.depth_from_sigma_m, leg.depth_to_sigma_m) if UNSET in noises else noises))
    east, north = math.sin(azimuth), math.cos(azimuth)
    # Columns: by distance, by azimuth, by rise or slope.
    jacobian = np.array(
        [
            [by_distance[0] * east, run_m * north, by_other[0] * east],
            [by_distance[0] * north, -run_m * east, by_other[0] * north],
            [by_distance[1], 0.0, by_other[1]],
        ]
    )
    return Line(
        leg=leg,
        vector_m=np.array([run_m * east, run_m * north, rise_m]),
        covariance=jacobian @ np.diag(np.array([distance_sigma_m, bearing.sigma, other_sigma]) ** 2) @ jacobian.T,
        turn_m=jacobian[:, 1],
        rise_m=rise_m,
        rise_sigma_m=rise_sigma_m,
        distance_sigma_m=distance_sigma_m,
        by_clino=steep,
        turn_rad=turn_rad,
        read_rise_m=read_rise_m,
        read_rise_sigma_m=read_sigma_m,
    )


def _hypot(*sigmas: float | UnsetType) -> float:
    return math.hypot(*(sigma for sigma in sigmas if sigma is not UNSET))
