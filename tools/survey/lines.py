"""Legs as lines: one bearing out of both compasses, and the vector with its covariance that follows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.tools.survey.averages import Floats, wrap
from buddyline.tools.survey.project import Leg, Project
from msgspec import UNSET

# Of two sights, the mean is worse than the better one alone where their sigmas differ by more than this.
WORTH_BOTH: Final = math.sqrt(3)
# Sights further apart than this many of their sigmas have sigmas that are wrong.
CONTRADICT: Final = 2.5
# Above this the depths say little of the run along; the clinometers say more.
STEEP_RAD: Final = math.radians(55.0)
# Readings of absolute depth: what is left of them in a leg, so that no misclosure along it moves a depth.
ABSOLUTE_DEPTH_SIGMA_M: Final = 0.002


@dataclass(frozen=True)
class Sights:
    """Foresight and backsight in use, radians, magnetic for azimuths; sigma as they deserve to be weighed.

    back is as read, from the far station. None: not taken, or not to be believed.
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


def bearing_of(leg: Leg, project: Project) -> Sights | None:
    """Return the compasses of a leg that are to be used; None where there are none.

    One that is disturbed gives way to one that is not; a person's edit goes before both.
    """
    fore = _radians(leg.azimuth_deg)
    back = _radians(leg.back_azimuth_deg)
    fore_sigma = _radians(leg.azimuth_sigma_deg) or 0.0
    back_sigma = _radians(leg.back_azimuth_sigma_deg) or 0.0
    gap = None if fore is None or back is None else wrap(fore - back - math.pi)
    bad_fore, bad_back = leg.from_node in leg.disturbed, leg.to_node in leg.disturbed
    if bad_fore:
        fore_sigma = math.hypot(fore_sigma, math.radians(project.settings.disturbed_deg))
    if bad_back:
        back_sigma = math.hypot(back_sigma, math.radians(project.settings.disturbed_deg))
    edit = project.edit_of(leg)
    if edit is not None and edit.compass is not UNSET:
        fore = None if edit.compass == "back" else fore
        back = None if edit.compass == "fore" else back
    elif fore is not None and back is not None and bad_fore != bad_back:
        fore, back = (None, back) if bad_fore else (fore, None)
    return _weighed(fore, back, fore_sigma, back_sigma, gap)


def clino_of(leg: Leg) -> Sights | None:
    """Return the inclinations of a leg by the nodes' own tilt, up positive, as read; None where there are none."""
    fore, back = _radians(leg.inclination_deg), _radians(leg.back_inclination_deg)
    gap = None if fore is None or back is None else fore + back
    return _weighed(
        fore, back, _radians(leg.inclination_sigma_deg) or 0.0, _radians(leg.back_inclination_sigma_deg) or 0.0, gap
    )


def _radians(value: object) -> float | None:
    return math.radians(value) if isinstance(value, float | int) else None


def _weighed(
    fore: float | None, back: float | None, fore_sigma: float, back_sigma: float, gap: float | None
) -> Sights | None:
    if fore is None and back is None:
        return None
    if fore is not None and back is not None and gap is not None:
        if max(fore_sigma, back_sigma) > WORTH_BOTH * min(fore_sigma, back_sigma):
            fore, back = (fore, None) if fore_sigma < back_sigma else (None, back)
        else:
            # Where the two contradict each other, the truth is as far from their mean as they are.
            chi = abs(gap) / math.hypot(fore_sigma, back_sigma)
            grown = chi if chi > CONTRADICT else 1.0
            fore_sigma, back_sigma = grown * fore_sigma, grown * back_sigma
    return Sights(fore, back, fore_sigma, back_sigma, gap)


@dataclass(frozen=True, eq=False)
class Line:
    """A leg to adjust. vector_m: east, north, up of the grid; covariance (3, 3), m^2. turn_m: (3,), per rad of azimuth.

    rise_m: up; its sigma; by_clino: whether it is the clinometers'. distance_sigma_m: as weighed.
    """

    leg: Leg
    vector_m: Floats
    covariance: Floats
    turn_m: Floats
    rise_m: float
    rise_sigma_m: float
    distance_sigma_m: float
    by_clino: bool

    @property
    def length_m(self) -> float:
        """Length of the vector."""
        return float(np.linalg.norm(self.vector_m))


def line_of(
    leg: Leg, project: Project, to_grid_rad: float, depths_m: dict[str, float], *, alone: bool = False
) -> Line | None:
    """Return a leg as a vector; None where it has no bearing or nothing that gives its rise.

    to_grid_rad: grid azimuth minus magnetic. depths_m: stations held at these depths; others by their readings.
    alone: the leg is not one of many in which the gauges err alike, so its rise has all of their error.
    Distance, bearing and rise are independent; the run along follows from distance and rise, except for steep
    legs, where the clinometers give both.
    """
    bearing = bearing_of(leg, project)
    if bearing is None:
        return None
    both = (bearing.fore, None if bearing.back is None else wrap(bearing.back + math.pi))
    known = [angle for angle in both if angle is not None]
    magnetic = known[0] if len(known) == 1 else known[0] + 0.5 * wrap(known[1] - known[0])
    azimuth = magnetic + to_grid_rad
    distance_m, distance_sigma_m = leg.distance_m, leg.distance_sigma_m
    rise = _rise(leg, depths_m, alone)
    clino = clino_of(leg)
    steep = rise is None or abs(rise[0]) > distance_m * math.sin(STEEP_RAD)
    if steep and clino is not None:
        known = [a for a in (clino.fore, None if clino.back is None else -clino.back) if a is not None]
        slope = sum(known) / len(known)
        run_m, rise_m = distance_m * math.cos(slope), distance_m * math.sin(slope)
        by_distance, by_other = (math.cos(slope), math.sin(slope)), (-rise_m, run_m)
        other_sigma, rise_sigma_m = clino.sigma, distance_m * clino.sigma
    elif rise is not None and abs(rise[0]) < distance_m:
        rise_m, rise_sigma_m = rise
        if leg.from_ in depths_m and leg.to in depths_m:
            # Held depths err as well; what that does to the run along is put on the distance.
            distance_sigma_m = math.hypot(distance_sigma_m, rise_m / distance_m * _depth_sigma_m(leg))
        run_m = math.sqrt(distance_m**2 - rise_m**2)
        by_distance, by_other = (distance_m / run_m, 0.0), (-rise_m / run_m, 1.0)
        other_sigma = rise_sigma_m
    else:
        return None
    east, north = math.sin(azimuth), math.cos(azimuth)
    jacobian = np.array(
        [
            [by_distance[0] * east, run_m * north, by_other[0] * east],
            [by_distance[0] * north, -run_m * east, by_other[0] * north],
            [by_distance[1], 0.0, by_other[1]],
        ]
    )
    variances = np.array([distance_sigma_m, bearing.sigma, other_sigma]) ** 2
    return Line(
        leg,
        np.array([run_m * east, run_m * north, rise_m]),
        jacobian @ np.diag(variances) @ jacobian.T,
        jacobian[:, 1],
        rise_m,
        rise_sigma_m,
        distance_sigma_m,
        steep,
    )


def _rise(leg: Leg, depths_m: dict[str, float], alone: bool) -> tuple[float, float] | None:
    if leg.from_ in depths_m and leg.to in depths_m:
        return depths_m[leg.from_] - depths_m[leg.to], math.sqrt(2) * ABSOLUTE_DEPTH_SIGMA_M
    if leg.depth_from_m is UNSET or leg.depth_to_m is UNSET:
        return None
    noises = leg.depth_from_noise_m, leg.depth_to_noise_m
    if alone or UNSET in noises:
        return leg.depth_from_m - leg.depth_to_m, _depth_sigma_m(leg)
    # A node keeps its gauge, and mostly its place, from leg to leg: what errs slowly cancels along the line.
    return leg.depth_from_m - leg.depth_to_m, math.hypot(*(float(s) for s in noises if s is not UNSET))


def _depth_sigma_m(leg: Leg) -> float:
    sigmas = leg.depth_from_sigma_m, leg.depth_to_sigma_m
    return math.hypot(*(float(s) for s in sigmas if s is not UNSET))
