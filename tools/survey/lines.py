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
# Sights further apart than this are no error of reading: one of them is wrong, and the network tells which.
TURNED_RAD: Final = math.radians(90.0)
# On steeper legs the clinometers give the horizontal distance better than the depths do.
STEEP_RAD: Final = math.radians(55.0)
SLOPE_STEPS: Final = 3
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
    (fore, back), (fore_sigma, back_sigma) = sights_apart(leg, project)
    both = leg.azimuth_deg is not UNSET and leg.back_azimuth_deg is not UNSET
    gap = wrap(math.radians(leg.azimuth_deg - leg.back_azimuth_deg - 180)) if both else None  # type: ignore[operator]
    bad_fore, bad_back = leg.from_node in leg.disturbed, leg.to_node in leg.disturbed
    edit = project.edit_of(leg)
    if (edit is None or edit.compass is UNSET) and fore is not None and back is not None and bad_fore != bad_back:
        fore, back = (None, back) if bad_fore else (fore, None)
    return _weighed(fore, back, fore_sigma, back_sigma, gap)


def sights_apart(leg: Leg, project: Project) -> tuple[list[float | None], list[float]]:
    """Return foresight and backsight as read, without what an edit takes out, and their own sigmas, radians."""
    fore, back, fore_sigma, back_sigma = map(
        _radians, (leg.azimuth_deg, leg.back_azimuth_deg, leg.azimuth_sigma_deg, leg.back_azimuth_sigma_deg)
    )
    disturbed = math.radians(project.settings.disturbed_deg)
    edit = project.edit_of(leg)
    if edit is not None and edit.compass is not UNSET:
        fore = None if edit.compass == "back" else fore
        back = None if edit.compass == "fore" else back
    return [fore, back], [
        math.hypot(fore_sigma or 0.0, disturbed * (leg.from_node in leg.disturbed)),
        math.hypot(back_sigma or 0.0, disturbed * (leg.to_node in leg.disturbed)),
    ]


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
            grown = chi if chi > CONTRADICT and abs(gap) < TURNED_RAD else 1.0
            fore_sigma, back_sigma = grown * fore_sigma, grown * back_sigma
    return SightPair(fore, back, fore_sigma, back_sigma, gap)


def is_steep(leg: Leg) -> bool:
    """Tell whether the clinometers are used: where depths are missing, or give the horizontal distance badly."""
    from_m, to_m = leg.depth_from_m, leg.depth_to_m
    return from_m is UNSET or to_m is UNSET or abs(from_m - to_m) > leg.distance_m * math.sin(STEEP_RAD)


@dataclass(frozen=True)
class Measures:
    """What goes into a leg's vector, with 1 sd each: metres and radians.

    azimuth: from the grid's north. rise: up, and None without depths. slopes: inclinations in use, up positive.
    """

    distance: tuple[float, float]
    azimuth: tuple[float, float]
    rise: tuple[float, float] | None
    slopes: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, eq=False)
class Line:
    """A leg as a vector: east, north, up of the grid; covariance (3, 3), m^2. turn_rad: grid azimuth minus magnetic.

    rise_m: up. rise_sigma_m, run_sigma_m: of the slope's two parts. by_clino: clinometers took part in it.
    measures: what it is made of.
    """

    leg: Leg
    measures: Measures
    vector_m: Floats
    covariance: Floats
    rise_m: float
    rise_sigma_m: float
    run_sigma_m: float
    by_clino: bool
    turn_rad: float

    @property
    def length_m(self) -> float:
        """Length of the vector."""
        return float(np.linalg.norm(self.vector_m))


def measures_of(
    leg: Leg, project: Project, turn_rad: float, depths_m: dict[str, float], *, alone: bool = False
) -> Measures | None:
    """Return what a leg's readings say by themselves; None if its bearing or its rise is unknown.

    depths_m: stations held at these depths; others by their readings. alone: no other legs share the gauges' slow
    errors, so the rise has all of them.
    """
    bearing = bearing_of(leg, project)
    if bearing is None:
        return None
    fore = wrap(bearing.back + math.pi) if bearing.back is not None else bearing.fore
    if fore is None:
        return None
    azimuth = turn_rad + (fore if bearing.fore is None else fore + 0.5 * wrap(bearing.fore - fore))
    distance_sigma_m = leg.distance_sigma_m
    held = leg.from_ in depths_m and leg.to in depths_m
    own = leg.depth_from_m, leg.depth_to_m
    from_m, to_m = (depths_m[leg.from_], depths_m[leg.to]) if held else own
    rise = None
    if from_m is not UNSET and to_m is not UNSET:
        gauges_m = _hypot(leg.depth_from_sigma_m, leg.depth_to_sigma_m)
        if held:
            rise = from_m - to_m, math.sqrt(2) * ABSOLUTE_DEPTH_SIGMA_M
            # Held depths have errors as well; their effect on the horizontal distance is added to the distance's sigma.
            distance_sigma_m = math.hypot(distance_sigma_m, rise[0] / leg.distance_m * gauges_m)
        else:
            noises = leg.depth_from_noise_m, leg.depth_to_noise_m
            # A node keeps its gauge, and mostly its station, from leg to leg, so slow errors cancel along the line.
            rise = from_m - to_m, gauges_m if alone or UNSET in noises else _hypot(*noises)
    return Measures((leg.distance_m, distance_sigma_m), (azimuth, bearing.sigma), rise, slopes_of(leg))


def slopes_of(leg: Leg) -> tuple[tuple[float, float], ...]:
    """Return the inclinations that are used, up positive, and their sigmas; none where depths do better."""
    clino = clino_of(leg) if is_steep(leg) else None
    if clino is None:
        return ()
    sights = (clino.fore, clino.fore_sigma), (None if clino.back is None else -clino.back, clino.back_sigma)
    return tuple((angle, sigma) for angle, sigma in sights if angle is not None)


def line_of(leg: Leg, measures: Measures | None, turn_rad: float) -> Line | None:
    """Return a leg's vector; None if its rise is not known, or longer than its distance.

    Distance, bearing, rise and inclinations are independent; the run along follows from distance and rise, or by
    least squares from all of them.
    """
    if measures is None:
        return None
    (distance_m, distance_sigma_m), (azimuth, azimuth_sigma) = measures.distance, measures.azimuth
    slopes, rise = measures.slopes, measures.rise
    if slopes:
        (run_m, up_m), covariance = _sloped(measures)
    elif rise is not None and abs(rise[0]) < distance_m:
        up_m, rise_var = rise[0], rise[1] ** 2
        run_m = math.sqrt(distance_m**2 - up_m**2)
        tilt = up_m / run_m
        run_var = (distance_m / run_m * distance_sigma_m) ** 2 + tilt**2 * rise_var
        covariance = [[run_var, -tilt * rise_var], [-tilt * rise_var, rise_var]]
    else:
        return None
    east, north = math.sin(azimuth), math.cos(azimuth)
    # Of run, rise, and aside.
    (run_var, shared), (_, rise_var) = covariance
    aside_var = (run_m * azimuth_sigma) ** 2
    between = east * north * (run_var - aside_var)
    return Line(
        leg=leg,
        measures=measures,
        vector_m=np.array([run_m * east, run_m * north, up_m]),
        covariance=np.array(
            [
                [east**2 * run_var + north**2 * aside_var, between, east * shared],
                [between, north**2 * run_var + east**2 * aside_var, north * shared],
                [east * shared, north * shared, rise_var],
            ]
        ),
        rise_m=up_m,
        rise_sigma_m=math.sqrt(rise_var),
        run_sigma_m=math.sqrt(run_var),
        by_clino=bool(slopes),
        turn_rad=turn_rad,
    )


def _sloped(measures: Measures) -> tuple[tuple[float, float], list[list[float]]]:
    """Return run and rise by least squares of distance, inclinations and rise, and their covariance (2, 2)."""
    distance_m, distance_sigma_m = measures.distance
    slope = sum(angle for angle, _ in measures.slopes) / len(measures.slopes)
    sloped = np.array([distance_m * math.cos(slope), distance_m * math.sin(slope)])
    for _ in range(SLOPE_STEPS):
        run_m, up_m = sloped.tolist()
        far_m, angle = math.hypot(run_m, up_m), math.atan2(up_m, run_m)
        rows = [(run_m / far_m, up_m / far_m, distance_m - far_m, distance_sigma_m)]
        if measures.rise is not None:
            rows.append((0.0, 1.0, measures.rise[0] - up_m, measures.rise[1]))
        rows += [(-up_m / far_m**2, run_m / far_m**2, one - angle, sigma) for one, sigma in measures.slopes]
        table = np.array(rows)
        A = table[:, :2] / table[:, 3:]
        covariance = np.linalg.inv(A.T @ A)
        sloped = sloped + covariance @ (A.T @ (table[:, 2] / table[:, 3]))
    run_m, up_m = sloped.tolist()
    return (run_m, up_m), covariance.tolist()


def _hypot(*sigmas: float | UnsetType) -> float:
    return math.hypot(*(sigma for sigma in sigmas if sigma is not UNSET))
