"""A project's observations: legs, points, turns, known lines and fixed points, with their instruments' unknowns."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Final, NamedTuple, TypeAlias

from buddyline.protocol.clock import S_NS
from buddyline.tools.survey.averages import Floats, wrap
from buddyline.tools.survey.lines import bearing_of, line_of, measures_of, sights_apart, slopes_of
from buddyline.tools.survey.observations import Observations
from buddyline.tools.survey.project import Known, Leg, Project
from msgspec import UNSET

EXACT_M: Final = 1e-4
LEAST_NOISE_M: Final = 0.002
# A leg's stated sd of distance holds the scale's: at least this share of it is the leg's own.
OWN_SHARE: Final = 0.25
# 1 sd of a scale that the survey itself determines better than its calibration.
SCALE_FREE: Final = 0.02
# Shares of a compass's stated variance: constant, and each of cosine and sine of the heading (what calibration leaves
# of hard iron). The rest is new in each leg.
ZERO_SHARE: Final = 0.1
IRON_SHARE: Final = 0.4
# Of the rest, where legs follow each other within seconds: the share of the variance that lasts, and for how long.
SLOW_SHARE: Final = 0.4
SLOW_S: Final = 60.0
# Time in which a gauge's zero may change by its slow error (MS5837-30BA data sheet: long-term stability; measured
# zeros of a rig that warms up change within the first hour).
DRIFT_S: Final = 3600.0
# Time in which the zero of a gyroscope forgets by how much it was off its mean (Allan deviations of MEMS gyroscopes
# are flat from one to ten minutes).
WANDER_S: Final = 300.0
# The water level of another dive, 1 sd: tide, flood, or the air pressure at which the zero was taken.
LEVEL_M: Final = 0.5
# 1 sd of a tide's rate.
TIDE_M_PER_S: Final = 0.5 / 3600.0
# The surface's altitude, where fixed points' altitudes alone tell it.
WATER_M: Final = 1e4
NORTH: Final = "north"
WATER: Final = "water level"
# What the names of unknowns begin with that are no instruments': a leg's azimuth, and a gyroscope's wander in one turn.
SIGHT: Final = "sight"
WANDER: Final = "wander"

# Position (3,) and its standard deviations (3,): east, north, up, m.
Fixed: TypeAlias = dict[str, tuple[Floats, Floats]]


def scale_name(leg: Leg) -> str:
    """Return the name of the unknown scale of a leg's two nodes."""
    return "scale of {} and {}".format(*sorted((leg.from_node, leg.to_node)))


def compass_name(dive: int, node: str) -> str:
    """Return the name of a compass of a dive."""
    return f"compass of {node} in dive {dive}"


def gauge_name(dive: int, node: str) -> str:
    """Return the name of a gauge of a dive."""
    return f"gauge of {node} in dive {dive}"


@dataclass
class Assembly:
    """Legs and their observations. ends: each leg's stations. turns_rad: by leg, grid azimuth minus magnetic."""

    observations: Observations
    legs: Sequence[Leg]
    ends: list[tuple[str, str]]
    turns_rad: Sequence[float]


class DepthReading(NamedTuple):
    """A gauge's depth at a leg's end (0, 1), m: its noise, and its slow error (1 sd).

    station: as the leg names it. gauge: its dive and node. time_s: of the leg's middle, since that of the dive's first.
    """

    leg: int
    end: int
    station: str
    gauge: tuple[int, str]
    time_s: float
    depth_m: float
    noise_m: float
    slow_m: float

    @property
    def key(self) -> tuple[int, str]:
        """Its key in Observations.rows."""
        return self.leg, "depth_to" if self.end else "depth_from"

    @property
    def what(self) -> str:
        """Its name in words."""
        return f"gauge of {self.gauge[1]}" if self.gauge[1] else f"depth of {self.station}"


def readings_of(legs: Sequence[Leg]) -> list[DepthReading]:
    """Return all depths that were read."""
    middles_s = [(leg.start_ns + leg.end_ns) / 2 / S_NS for leg in legs]
    first_s: dict[int, float] = {}
    for leg, middle_s in zip(legs, middles_s, strict=True):
        first_s[leg.dive] = min(first_s.get(leg.dive, math.inf), middle_s)
    found = []
    tabled: set[tuple[str, float]] = set()
    for number, (leg, middle_s) in enumerate(zip(legs, middles_s, strict=True)):
        ends = (leg.from_, leg.from_node), (leg.to, leg.to_node)
        for end, ((station, node), depth) in enumerate(zip(ends, depths_of(leg), strict=True)):
            # Tables repeat the one depth of a station beside each of its distances.
            again = not node and depth is not None and (station, depth[0]) in tabled
            if depth is not None and not again:
                tabled |= set() if node else {(station, depth[0])}
                gauge, time_s = (leg.dive, node), middle_s - first_s[leg.dive]
                found.append(DepthReading(number, end, station, gauge, time_s, *depth))
    return found


class _GaugeTerms:
    """Unknowns of all gauges."""

    def __init__(self, of: Observations, readings: Sequence[DepthReading], tides: Sequence[int]) -> None:
        self._of, self._tides = of, tides
        slow: dict[tuple[int, str], list[float]] = defaultdict(list)
        for one in readings:
            slow[one.gauge].append(one.slow_m)
        self._slow_m = {key: max(median(values), LEAST_NOISE_M) for key, values in slow.items()}
        self._first = min((dive for dive, _ in slow), default=1)
        # By dive and node: zero and drift, and the dive's level and tide, None where they are no unknowns.
        self._columns: dict[tuple[int, str], tuple[int, int, int | None, int | None]] = {}

    def terms(self, one: DepthReading, sign: float) -> list[tuple[int, float]]:
        """Return zero, drift, level and tide of one reading."""
        if not one.gauge[1]:
            return []
        zero, drift, level, tide = self._columns.get(one.gauge) or self._unknowns(one.gauge)
        terms = [(zero, sign), (drift, sign * one.time_s / DRIFT_S)]
        terms += [(level, sign)] if level is not None else []
        return [*terms, (tide, sign * one.time_s)] if tide is not None else terms

    def _unknowns(self, key: tuple[int, str]) -> tuple[int, int, int | None, int | None]:
        of, (dive, node), slow_m = self._of, key, self._slow_m[key]
        name = gauge_name(dive, node)
        self._columns[key] = found = (
            of.unknown(f"{name}: zero", slow_m),
            of.unknown(f"{name}: drift", slow_m),
            of.unknown(f"water level in dive {dive}", LEVEL_M) if dive != self._first else None,
            of.unknown(f"tide in dive {dive}", TIDE_M_PER_S) if dive in self._tides else None,
        )
        return found


def depths_of(leg: Leg) -> tuple[tuple[float, float, float] | None, tuple[float, float, float] | None]:
    """Return the depths read at the leg's start and end, each with its noise and its slow error (1 sd), m."""
    return (
        _depth(leg.depth_from_m, leg.depth_from_sigma_m, leg.depth_from_noise_m),
        _depth(leg.depth_to_m, leg.depth_to_sigma_m, leg.depth_to_noise_m),
    )


def _depth(depth_m: object, sigma_m: object, noise_m: object) -> tuple[float, float, float] | None:
    if not isinstance(depth_m, float | int) or not isinstance(sigma_m, float | int):
        return None
    noise = max(min(noise_m, sigma_m) if isinstance(noise_m, float | int) else sigma_m, LEAST_NOISE_M)
    return float(depth_m), float(noise), math.sqrt(max(sigma_m**2 - noise**2, 0.0))


def depths_alone(readings: Sequence[DepthReading], tides: Sequence[int]) -> Observations:
    """Return the observations of all gauges alone, a row for each reading: stations' depths are unknowns by name."""
    of = Observations([])
    gauges = _GaugeTerms(of, readings, tides)
    for one in readings:
        terms = [(of.unknown(one.station), 1.0), *gauges.terms(one, 1.0)]
        of.rows[one.key] = of.add("number", -1, -1, one.depth_m, one.noise_m, terms, leg=one.leg, what=one.what)
    return of


def _add_depths(to: Assembly, tides: Sequence[int], level_m: float, *, free_level: bool = False) -> None:
    of, readings = to.observations, readings_of(to.legs)
    gauges = _GaugeTerms(of, readings, tides)
    for one in readings:
        terms = gauges.terms(one, -1.0)
        if free_level:
            terms.append((of.unknown(WATER, WATER_M), -1.0))
        of.rows[one.key] = of.add(
            "up",
            of.at[to.ends[one.leg][one.end]],
            -1,
            level_m - one.depth_m,
            one.noise_m,
            terms,
            leg=one.leg,
            what=one.what,
        )


def assemble(
    project: Project,
    legs: Sequence[Leg],
    ends: list[tuple[str, str]],
    stations: list[str],
    fixed: Fixed,
    turns_rad: Sequence[float],
    tides: Sequence[int],
    level_m: float,
    origin_m: Floats,
    north_along: tuple[str, str] | None = None,
) -> Observations:
    """Return all observations of these legs.

    fixed: with the altitudes that count, NaN elsewhere. origin_m: (3,), to which coordinates are relative.
    north_along: stations whose line is the north of a survey without any direction.
    """
    of = Observations(stations)
    to = Assembly(of, legs, ends, turns_rad)
    sighted = _Compasses(project, of, legs)
    turned = {(one.dive, ns) for one in project.turn for ns in (one.from_ns, one.to_ns)}
    for number, (leg, names) in enumerate(zip(legs, ends, strict=True)):
        start, end = of.at[names[0]], of.at[names[1]]
        if not leg.from_node and leg.azimuth_deg is not UNSET:
            _add_vector(to, number, project, start, end)
            continue
        _add_distance(to, number, start, end, project.settings.range_share if leg.from_node else 0.0)
        if project.adjust.compass == "use":
            sighted.add(to, number, start, end, turned=(leg.dive, leg.start_ns) in turned)
        elif (leg.dive, leg.start_ns) in turned:
            sighted.carry(to, number, start, end)
        for slope, sigma in slopes_of(leg):
            of.add("inclination", start, end, slope, sigma, leg=number, what="clinometers")
    level_stated = project.place.water_level_m is not UNSET
    free_level = not level_stated and any(not math.isnan(position[2]) for position, _ in fixed.values())
    if project.adjust.depth == "absolute":
        _add_depths(to, tides, level_m - origin_m[2], free_level=free_level)
    else:
        _add_rises(to, tides)
    _add_turns(to, project, sighted)
    _add_known(to, project.known)
    if north_along is not None:
        of.add("azimuth", of.at[north_along[0]], of.at[north_along[1]], 0.0, 1e-6, what="arbitrary north")
    _add_fixed(to, fixed, origin_m)
    return of


def _add_distance(to: Assembly, number: int, start: int, end: int, share: float) -> None:
    """Add a leg's distance. share: 1 sd of the scale that all distances of its two rigs share, 0 for none."""
    of, leg = to.observations, to.legs[number]
    sigma_m = math.sqrt(
        max(leg.distance_sigma_m**2 - (share * leg.distance_m) ** 2, (OWN_SHARE * leg.distance_sigma_m) ** 2)
    )
    terms = []
    if share:
        name = scale_name(leg)
        if of.has(name) is None:
            # Known lines or fixed points may tell the scale better than the calibration does.
            beforehand = len(of.value)
            of.loosen[beforehand] = of.unknown(name, share), SCALE_FREE
        terms = [(of.unknown(name), 1.0)]
    of.rows[number, "distance"] = of.add(
        "distance", start, end, leg.distance_m, sigma_m, terms, leg=number, what="distance"
    )


def _add_fixed(to: Assembly, fixed: Fixed, origin_m: Floats) -> None:
    """Add fixed points. origin_m: (3,), to which coordinates are relative."""
    of = to.observations
    for name, (position_m, sigmas_m) in fixed.items():
        if name not in of.at:
            continue
        away_m = position_m - origin_m
        for kind, value_m, known_m in zip(("east", "north", "up"), away_m.tolist(), sigmas_m.tolist(), strict=True):
            # Depths give the other altitudes, where there is any depth.
            if not math.isnan(value_m) or not to.legs:
                at_m = 0.0 if math.isnan(value_m) else value_m
                of.add(kind, of.at[name], -1, at_m, max(known_m, EXACT_M), what=f"fixed point {name}")  # type: ignore[arg-type]


def _add_vector(to: Assembly, number: int, project: Project, start: int, end: int) -> None:
    """Add an old survey's leg as the vector that it is read as, along it, aside and across its slope."""
    of, leg, turn_rad = to.observations, to.legs[number], to.turns_rad[number]
    line = line_of(leg, measures_of(leg, project, turn_rad, {}), turn_rad)
    if line is None:
        return
    slope, azimuth = line.measures.slopes[0], line.measures.azimuth
    (sine, cosine), (east, north) = sincos(slope[0]), sincos(azimuth[0])
    length_m, sigma_m = line.measures.distance
    axes = {
        "length": ((cosine * east, cosine * north, sine), sigma_m),
        "direction, aside": ((north, -east, 0.0), length_m * abs(cosine) * azimuth[1]),
        "slope, across": ((-sine * east, -sine * north, cosine), length_m * slope[1]),
    }
    for what, (axis, own_m) in axes.items():
        terms = [(3 * at + k, sign * one) for at, sign in ((end, 1.0), (start, -1.0)) for k, one in enumerate(axis)]
        value_m = length_m if what == "length" else 0.0
        row = of.add("number", -1, -1, value_m, max(own_m, EXACT_M), terms, leg=number, what=what)
        of.rows.setdefault((number, "distance"), row)


def sincos(angle: float) -> tuple[float, float]:
    """Return sine and cosine."""
    return math.sin(angle), math.cos(angle)


def _add_rises(to: Assembly, tides: Sequence[int]) -> None:
    """Let each leg keep the difference of its own two readings."""
    of, readings = to.observations, readings_of(to.legs)
    gauges = _GaugeTerms(of, readings, tides)
    for start, end in pairwise(readings):
        if start.leg != end.leg:
            continue
        of.rows[start.leg, "rise"] = of.add(
            "rise",
            of.at[to.ends[start.leg][0]],
            of.at[to.ends[start.leg][1]],
            start.depth_m - end.depth_m,
            math.hypot(start.noise_m, end.noise_m),
            gauges.terms(start, 1.0) + gauges.terms(end, -1.0),
            leg=start.leg,
            what="gauges",
        )


class _Compasses:
    """Azimuths of legs, by compasses, and the unknown azimuths of sights that gyroscopes carry from leg to leg."""

    def __init__(self, project: Project, of: Observations, legs: Sequence[Leg]) -> None:
        self._project, self._of = project, of
        # By dive, leg's start_ns and node: the unknown azimuth of the leg, and the node's sight from it.
        self.sights: dict[tuple[int, int, str], tuple[int, float]] = {}
        sigmas: dict[tuple[int, str], list[float]] = defaultdict(list)
        for leg in legs:
            for node, sigma_deg in (
                (leg.from_node, leg.azimuth_sigma_deg),
                (leg.to_node, leg.back_azimuth_sigma_deg),
            ):
                if sigma_deg is not UNSET:
                    sigmas[leg.dive, node].append(math.radians(sigma_deg))
        self._sigma = {key: median(values) for key, values in sigmas.items()}
        # By dive and node: zero, iron ahead and iron abeam.
        self._columns: dict[tuple[int, str], tuple[int, int, int]] = {}
        # By compass: when it was read last, and the column of its slow error then.
        self._slow: dict[tuple[int, str], tuple[int, int]] = {}

    def _slow_term(self, leg: Leg, node: str) -> tuple[int, float]:
        """Return the term of a compass's slow error in a leg, which is partly that of the leg before."""
        of, key, sigma = self._of, (leg.dive, node), math.sqrt(SLOW_SHARE) * self._sigma[leg.dive, node]
        before_ns, before = self._slow.get(key, (leg.start_ns, -1))
        if before >= 0 and before_ns == leg.start_ns:
            return before, 1.0
        kept = 0.0 if before < 0 else math.exp(-abs(leg.start_ns - before_ns) / S_NS / SLOW_S)
        column = of.unknown(f"{WANDER} {leg.start_ns} {compass_name(leg.dive, node)}")
        terms = [(column, 1.0)] if before < 0 else [(column, 1.0), (before, -kept)]
        of.add("angle", -1, -1, 0.0, sigma * math.sqrt(1 - kept**2), terms, what=f"{WANDER} of a compass")
        self._slow[key] = leg.start_ns, column
        return column, 1.0

    def _terms(self, leg: Leg, node: str, heading: float) -> list[tuple[int, float]]:
        common = math.radians(self._project.settings.compass_common_deg)
        north = [(self._of.unknown(NORTH, common), 1.0)] if common else []
        zero, ahead, abeam = self._columns.get((leg.dive, node)) or self._unknowns(leg.dive, node)
        return [*north, (zero, 1.0), (ahead, math.cos(heading)), (abeam, math.sin(heading))]

    def _unknowns(self, dive: int, node: str) -> tuple[int, int, int]:
        of, name, sigma = self._of, compass_name(dive, node), self._sigma[dive, node]
        self._columns[dive, node] = found = (
            of.unknown(f"{name}: zero", math.sqrt(ZERO_SHARE) * sigma),
            of.unknown(f"{name}: iron ahead", math.sqrt(IRON_SHARE) * sigma),
            of.unknown(f"{name}: iron abeam", math.sqrt(IRON_SHARE) * sigma),
        )
        return found

    def carry(self, to: Assembly, number: int, start: int, end: int) -> int:
        """Add the unknown azimuth of a leg's line from camera to camera; return its column."""
        leg = to.legs[number]
        guess = _guess(leg, to.turns_rad[number])
        column = self._of.unknown(f"{SIGHT} {number}", None, guess)
        run_m = max(leg.distance_m, 0.3)
        held = math.sqrt(2) * max(self._project.settings.centering_m, 1e-3) / run_m
        self._of.add("azimuth", start, end, 0.0, held, [(column, -1.0)], leg=number, what="centering")
        for node, facing in ((leg.from_node, 0.0), (leg.to_node, math.pi)):
            self.sights[leg.dive, leg.start_ns, node] = column, facing
        return column

    def add(self, to: Assembly, number: int, start: int, end: int, *, turned: bool) -> None:
        """Add a leg's azimuths. turned: others hang on this one by gyroscopes, so that a disturbed compass shows."""
        leg, of, turn_rad = to.legs[number], self._of, to.turns_rad[number]
        quick = bool(self._project.settings.pause_s)
        own = math.sqrt(1 - ZERO_SHARE - IRON_SHARE - (SLOW_SHARE if quick else 0.0))
        column = self.carry(to, number, start, end) if turned else None
        bearing = bearing_of(leg, self._project)
        if bearing is None:
            return
        both = bearing.fore is not None and bearing.back is not None
        # Equal weights for both, as all cave programs have it: then their plain mean is the leg's.
        sigmas = [own * bearing.sigma * (math.sqrt(2) if both else 1.0)] * 2
        angles = [bearing.fore, bearing.back]
        if column is not None:
            angles, sigmas = sights_apart(leg, self._project)
        for what, node, angle, sigma, against in (
            ("fore", leg.from_node, angles[0], sigmas[0], 0.0),
            ("back", leg.to_node, angles[1], sigmas[1], math.pi),
        ):
            if angle is None:
                continue
            terms = self._terms(leg, node, angle)
            if quick:
                terms.append(self._slow_term(leg, node))
            value, words = wrap(angle - against + turn_rad), f"compass of {node}"
            if column is None:
                row = of.add("azimuth", start, end, value, sigma, terms, leg=number, what=words)
            else:
                terms.append((column, 1.0))
                row = of.add("angle", -1, -1, value, own * sigma, terms, leg=number, what=words, robust=True)
            of.rows[number, what] = row


def _guess(leg: Leg, turn_rad: float) -> float:
    if leg.azimuth_deg is not UNSET:
        return wrap(math.radians(leg.azimuth_deg) + turn_rad)
    return 0.0 if leg.back_azimuth_deg is UNSET else wrap(math.radians(leg.back_azimuth_deg) + math.pi + turn_rad)


def _add_turns(to: Assembly, project: Project, sighted: _Compasses) -> None:
    of, settings = to.observations, project.settings
    # By gyroscope: begin of its last turn, that turn's length, and the column of the angle that its wander made of it.
    last: dict[str, tuple[int, float, int]] = {}
    for one in project.turn:
        ends = [sighted.sights.get((one.dive, ns, one.node)) for ns in (one.from_ns, one.to_ns)]
        if ends[0] is None or ends[1] is None:
            continue
        (column_0, facing_0), (column_1, facing_1) = ends[0], ends[1]
        angle, name = math.radians(one.angle_deg), f"gyroscope of {one.node} in dive {one.dive}"
        what = f"gyroscope of {one.node}"
        # A zero that wanders adds up over many turns as one that is new in each of them does not.
        wander = of.unknown(f"{WANDER} {one.from_ns} {name}")
        before_ns, before_s, before = last.get(name, (one.from_ns, one.seconds, wander))
        kept = 0.0 if before == wander else math.exp(-abs(one.from_ns - before_ns) / S_NS / WANDER_S)
        sigma = math.radians(settings.gyro_wander_dps) * one.seconds * math.sqrt(1 - kept**2)
        of.add("angle", -1, -1, 0.0, sigma, [(wander, 1.0), (before, -kept * one.seconds / before_s)], what=what)
        last[name] = one.from_ns, one.seconds, wander
        terms = [
            (column_1, 1.0),
            (column_0, -1.0),
            (wander, 1.0),
            (of.unknown(f"{name}: zero", math.radians(settings.gyro_zero_dps)), one.seconds),
            (of.unknown(f"{name}: scale", settings.gyro_scale), angle),
        ]
        value = wrap(angle - facing_1 + facing_0)
        of.add("angle", -1, -1, value, math.radians(one.sigma_deg), terms, what=what)


def _add_known(to: Assembly, known: Sequence[Known]) -> None:
    of = to.observations
    for one in known:
        start, end = of.at.get(one.from_), of.at.get(one.to)
        if start is None or end is None:
            continue
        name = f"known line {one.from_}-{one.to}"
        if one.distance_m is not UNSET:
            of.add("distance", start, end, one.distance_m, max(one.sigma_m, EXACT_M), what=name)
        if one.azimuth_deg is not UNSET:
            angle, sigma = math.radians(one.azimuth_deg), math.radians(one.azimuth_sigma_deg)
            of.add("azimuth", start, end, wrap(angle), max(sigma, 1e-5), what=name)
