"""All gauges' readings adjusted alone: stations' depths, dives' tides, and readings that contradict each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.tools.survey.assembly import TIDE_M_PER_S, Assembly, depths_alone
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
    tides: list[int] = []
    assembly = depths_alone(legs, tides)
    if not assembly.observations.stations:
        return Gauges({}, {}, [])
    fit = _fit(assembly)
    visits = _visits(assembly)
    for dive in sorted({leg.dive for leg in legs}):
        if _revisited(legs, visits, dive) < LEAST_STATIONS:
            continue
        trial = depths_alone(legs, [*tides, dive])
        with_tide = _fit(trial)
        rate, _ = with_tide.unknown(f"tide in dive {dive}")
        if abs(rate) < POSSIBLE_TIDE * TIDE_M_PER_S and fit.chi2 - with_tide.chi2 > SHOWN_CHI2:
            tides, assembly, fit = [*tides, dive], trial, with_tide
    ups = 3 * np.arange(len(visits))[:, None] + 2
    sigmas_m = np.sqrt(fit.normal.blocks(ups)[:, 0, 0])
    depths = {
        name: StationDepth(float(-fit.position_m[i, 2]), float(sigmas_m[i]), len(visits[name]))
        for i, name in enumerate(assembly.observations.stations)
    }
    visits = _visits(assembly)
    rates = {dive: 3600.0 * fit.unknown(f"tide in dive {dive}")[0] for dive in tides}
    return Gauges(depths, rates, _alarms(assembly, fit, visits, limits or AlarmSettings()))


def _fit(assembly: Assembly) -> Solution:
    of = assembly.observations
    return of.adjust(np.zeros((len(of.stations), 3)))


def _visits(assembly: Assembly) -> dict[str, list[tuple[int, int]]]:
    """Return, by station, its readings as leg and row."""
    visits: dict[str, list[tuple[int, int]]] = {name: [] for name in assembly.observations.stations}
    for (leg, what), row in assembly.observations.rows.items():
        visits[assembly.ends[leg][what == "depth_to"]].append((leg, row))
    return visits


def _revisited(legs: Sequence[Leg], visits: dict[str, list[tuple[int, int]]], dive: int) -> int:
    """Return how many stations were visited in a dive with a long time between."""
    times_s = [[legs[leg].start_ns / S_NS for leg, _ in of if legs[leg].dive == dive] for of in visits.values()]
    return sum(len(one) > 1 and max(one) - min(one) > APART_S for one in times_s)


def _alarms(
    assembly: Assembly, fit: Solution, visits: dict[str, list[tuple[int, int]]], limits: AlarmSettings
) -> list[str]:
    said = []
    noise_m = fit.model.sigma
    off_sigma_m = noise_m * np.sqrt(fit.redundancies)
    for name, of_station in visits.items():
        rows = np.array([row for _, row in of_station])
        # If nothing checks a reading, its residual and its sigma are both zero.
        checked = off_sigma_m[rows] > 0.1 * noise_m[rows]
        off_m = np.abs(fit.misfit[rows])
        away = off_m > limits.depth_sigmas * off_sigma_m[rows]
        if (checked & away).any() and np.ptp(fit.model.value[rows] - fit.terms[rows]) > limits.depth_m:
            texts = []
            for leg, row in of_station:
                node = fit.observations.what[row].removeprefix("gauge of ")
                texts.append(f"{-fit.model.value[row]:.2f} m by {node} in dive {assembly.legs[leg].dive}")
            sigmas = float((off_m / np.maximum(off_sigma_m[rows], 1e-9))[checked].max())
            said.append(
                f"ALARM: gauges at station {name} differ by {sigmas:.1f} sd: {', '.join(texts)}; is it one station?"
            )
    return said
