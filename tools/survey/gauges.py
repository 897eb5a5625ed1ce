"""All gauges' readings adjusted alone: stations' depths, dives' tides, and readings that contradict each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.tools.survey.assembly import TIDE_M_PER_S, DepthReading, depths_alone, readings_of
from buddyline.tools.survey.observations import Solution
from buddyline.tools.survey.project import Leg
from buddyline.tools.survey.settings import AlarmSettings

# A tide is estimated if the readings show one: the chi^2 of one degree of freedom that one dive in a thousand exceeds
# by chance, and no more than this many sd of it.
SHOWN_CHI2: Final = 10.83
POSSIBLE_TIDE: Final = 3.0
# Stations visited again after this time show a tide; a single one may have been misread or misnamed.
APART_S: Final = 600.0
LEAST_STATIONS: Final = 2


@dataclass(frozen=True)
class StationDepth:
    """Depth below the first dive's water level, m; its 1 sd, with all that the gauges share; count of readings."""

    depth_m: float
    sigma_m: float
    readings: int


@dataclass(frozen=True)
class Gauges:
    """The result of all readings.

    depths: by station. tides_m_per_h: by dive, where the readings show one; the level rises with positive values.
    alarms: in words.
    """

    depths: dict[str, StationDepth]
    tides_m_per_h: dict[int, float]
    alarms: list[str]


def adjust_gauges(legs: Sequence[Leg], limits: AlarmSettings | None = None) -> Gauges:
    """Adjust the gauges' readings of all legs together, with each gauge's zero and drift, and each dive's level.

    Zero and drift have the gauge's stated slow error, so that stations visited by both gauges, twice, or in two dives
    show them. A tide is taken in only where the readings show it. limits: depth_sigmas and depth_m, both exceeded,
    make an alarm.
    """
    readings = readings_of(legs)
    if not readings:
        return Gauges({}, {}, [])
    tides, fit = _with_tides(readings)
    visits = _visits(readings)
    columns = np.array([fit.observations.unknown(name) for name in visits])
    sigmas_m = np.sqrt(fit.variances(columns))
    depths = {
        name: StationDepth(float(fit.x[column]), float(sigma_m), len(visits[name]))
        for name, column, sigma_m in zip(visits, columns.tolist(), sigmas_m.tolist(), strict=True)
    }
    rates = {dive: 3600.0 * fit.unknown(f"tide in dive {dive}")[0] for dive in tides}
    return Gauges(depths, rates, _alarms(fit, visits, limits or AlarmSettings()))


def tides_of(legs: Sequence[Leg]) -> list[int]:
    """Return the dives whose gauges' readings show a tide."""
    readings = readings_of(legs)
    return _with_tides(readings)[0] if _revisiting(readings) else []


def _with_tides(readings: Sequence[DepthReading]) -> tuple[list[int], Solution]:
    tides: list[int] = []
    fit = _fit(readings, tides)
    for dive in _revisiting(readings):
        rate, explained = _tide(readings, fit, dive)
        if abs(rate) < POSSIBLE_TIDE * TIDE_M_PER_S and explained > SHOWN_CHI2:
            tides = [*tides, dive]
            fit = _fit(readings, tides)
    return tides, fit


def _tide(readings: Sequence[DepthReading], fit: Solution, dive: int) -> tuple[float, float]:
    """Return the rate of a dive's tide, m/s, if it were one more unknown, and by how much chi^2 would fall."""
    of_dive = [one for one in readings if one.gauge[0] == dive]
    by = np.zeros(len(fit.misfit))
    by[[fit.observations.rows[one.key] for one in of_dive]] = [one.time_s for one in of_dive]
    weighed = fit.weights * by
    (at, columns), values = fit.at, fit.values
    push = np.bincount(columns, values * weighed[at], len(fit.x)).astype(float)
    information = weighed @ by - push @ fit.normal.solve(push) + TIDE_M_PER_S**-2
    right = float(weighed @ fit.misfit)
    return right / float(information), right**2 / float(information)


def _fit(readings: Sequence[DepthReading], tides: Sequence[int]) -> Solution:
    return depths_alone(readings, tides).adjust(np.empty((0, 3)), linear=True)


def _visits(readings: Sequence[DepthReading]) -> dict[str, list[DepthReading]]:
    """Return each station's readings."""
    visits: dict[str, list[DepthReading]] = {}
    for one in readings:
        visits.setdefault(one.station, []).append(one)
    return visits


def _revisiting(readings: Sequence[DepthReading]) -> list[int]:
    """Return the dives in which enough stations were visited with a long time between."""
    times_s: dict[tuple[int, str], list[float]] = {}
    for one in readings:
        times_s.setdefault((one.gauge[0], one.station), []).append(one.time_s)
    again = Counter(dive for (dive, _), at_s in times_s.items() if max(at_s) - min(at_s) > APART_S)
    return sorted(dive for dive, count in again.items() if count >= LEAST_STATIONS)


def _alarms(fit: Solution, visits: dict[str, list[DepthReading]], limits: AlarmSettings) -> list[str]:
    said = []
    noise_m, of = fit.model.sigma, fit.observations
    off_sigma_m = noise_m * np.sqrt(fit.redundancies)
    for name, of_station in visits.items():
        rows = np.array([of.rows[one.key] for one in of_station])
        # If nothing checks a reading, its residual and its sigma are both zero.
        checked = off_sigma_m[rows] > 0.1 * noise_m[rows]
        off_m = fit.misfit[rows]
        away = np.abs(off_m) > limits.depth_sigmas * off_sigma_m[rows]
        if (checked & away).any() and np.ptp(off_m) > limits.depth_m:
            texts = [f"{one.depth_m:.2f} m by {one.gauge[1]} in dive {one.gauge[0]}" for one in of_station]
            sigmas = float((np.abs(off_m) / np.maximum(off_sigma_m[rows], 1e-9))[checked].max())
            said.append(
                f"ALARM: gauges at station {name} differ by {sigmas:.1f} sd: {', '.join(texts)}; is it one station?"
            )
    return said
