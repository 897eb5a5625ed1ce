"""All gauges' readings as one adjustment: depths of stations, each gauge's zero and drift, each dive's water level."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.tools.survey.averages import Floats, Ints
from buddyline.tools.survey.project import Leg
from buddyline.tools.survey.settings import AlarmSettings
from msgspec import UNSET

# Time in which a gauge's zero may change by its slow error (MS5837-30BA data sheet: long-term stability; measured
# zeros of a rig that warms up change within the first hour).
DRIFT_S: Final = 3600.0
# The water level of another dive, 1 sd: tide, flood, or the air pressure at which the zero was taken.
LEVEL_M: Final = 0.5
# A tide is estimated if the readings show one: 1 sd of the level's rate, and the chi^2 of one degree of freedom that
# one dive in a thousand exceeds by chance.
TIDE_M_PER_S: Final = 0.5 / 3600.0
SHOWN_CHI2: Final = 10.83
# Stations visited again after this time show a tide; a single one may have been misread or misnamed.
APART_S: Final = 600.0
LEAST_STATIONS: Final = 2
LEAST_NOISE_M: Final = 0.002


@dataclass(frozen=True)
class StationDepth:
    """Depth below the first dive's water level, m; its 1 sd, with all that the gauges share; count of readings."""

    depth_m: float
    sigma_m: float
    readings: int


@dataclass(frozen=True)
class Gauges:
    """The result of all readings.

    depths: by station. corrected_m: by leg's index, its two depths with zeros, drifts and levels taken off.
    tides_m_per_h: by dive, where the readings show one; the level rises with positive values. alarms: in words.
    """

    depths: dict[str, StationDepth]
    corrected_m: dict[int, tuple[float, float]]
    tides_m_per_h: dict[int, float]
    alarms: list[str]


@dataclass(frozen=True, eq=False)
class _GaugeReadings:
    """Readings of n gauges' visits. station, dive: (n,) numbers; slow_m: 1 sd that all visits of a gauge share."""

    legs: list[tuple[int, str]]
    names: list[str]
    station: Ints
    node: list[str]
    dive: Ints
    time_s: Floats
    depth_m: Floats
    noise_m: Floats
    slow_m: Floats


def _readings(legs: Sequence[Leg]) -> _GaugeReadings:
    rows = []
    for index, leg in enumerate(legs):
        for end, name, node, depth_m, sigma_m, noise_m in (
            ("from", leg.from_, leg.from_node, leg.depth_from_m, leg.depth_from_sigma_m, leg.depth_from_noise_m),
            ("to", leg.to, leg.to_node, leg.depth_to_m, leg.depth_to_sigma_m, leg.depth_to_noise_m),
        ):
            if depth_m is UNSET or sigma_m is UNSET:
                continue
            noise = max(sigma_m if noise_m is UNSET else min(noise_m, sigma_m), LEAST_NOISE_M)
            slow_m = math.sqrt(max(sigma_m**2 - noise**2, 0.0))
            time_s = (leg.start_ns + leg.end_ns) / 2 / S_NS
            rows.append(((index, end), name, node, leg.dive, time_s, depth_m, noise, slow_m))
    columns: list[Any] = list(zip(*rows, strict=True)) if rows else [[] for _ in range(8)]
    at = {name: i for i, name in enumerate(dict.fromkeys(columns[1]))}
    return _GaugeReadings(
        legs=list(columns[0]),
        names=list(at),
        station=np.array([at[name] for name in columns[1]], dtype=np.int64),
        node=list(columns[2]),
        dive=np.array(columns[3], dtype=np.int64),
        time_s=np.array(columns[4], dtype=float),
        depth_m=np.array(columns[5], dtype=float),
        noise_m=np.array(columns[6], dtype=float),
        slow_m=np.array(columns[7], dtype=float),
    )


class _Unknowns:
    """Design columns (n, k) of the shared unknowns, with their prior standard deviations (k,)."""

    def __init__(self, readings: _GaugeReadings, tides: Sequence[int]) -> None:
        columns: list[Floats] = []
        sigmas: list[float] = []
        self.tide: dict[int, int] = {}
        dives = sorted(set(readings.dive.tolist()))
        for dive in dives:
            of_dive = (readings.dive == dive).astype(float)
            start_s = float(readings.time_s[readings.dive == dive].min())
            if dive != dives[0]:
                columns.append(of_dive)
                sigmas.append(LEVEL_M)
            if dive in tides:
                self.tide[dive] = len(columns)
                columns.append(of_dive * (readings.time_s - start_s))
                sigmas.append(TIDE_M_PER_S)
            for node in dict.fromkeys(
                n for n, d in zip(readings.node, readings.dive.tolist(), strict=True) if d == dive
            ):
                of_node = of_dive * np.array([one == node for one in readings.node], dtype=float)
                slow_m = float(np.median(readings.slow_m[of_node > 0]))
                columns += [of_node, of_node * (readings.time_s - start_s) / DRIFT_S]
                sigmas += [max(slow_m, LEAST_NOISE_M)] * 2
        self.columns = np.array(columns).T.reshape(len(readings.depth_m), -1)
        self.sigmas = np.array(sigmas)


def adjust_gauges(legs: Sequence[Leg], limits: AlarmSettings | None = None) -> Gauges:
    """Adjust the gauges' readings of all legs together.

    A reading = the station's depth + the gauge's zero + its drift * time + the dive's level + its tide * time + noise.
    Zero and drift have the gauge's stated slow error, so that stations visited by both gauges, twice, or in two dives
    show them. A tide is taken in only where the readings show it. limits: depth_sigmas and depth_m, both exceeded,
    make an alarm.
    """
    readings = _readings(legs)
    if not readings.names:
        return Gauges({}, {}, {}, [])
    tides: list[int] = []
    fit = _GaugeFit(readings, _Unknowns(readings, tides))
    for dive in sorted(set(readings.dive.tolist())):
        if _revisited(readings, dive) < LEAST_STATIONS:
            continue
        with_tide = _GaugeFit(readings, _Unknowns(readings, [*tides, dive]))
        possible = abs(with_tide.shared[with_tide.unknowns.tide[dive]]) < 3 * TIDE_M_PER_S
        if possible and fit.chi2 - with_tide.chi2 > SHOWN_CHI2:
            tides, fit = [*tides, dive], with_tide
    corrected = {key: float(value) for key, value in zip(readings.legs, fit.corrected_m, strict=True)}
    both = {
        i: (corrected[i, "from"], corrected[i, "to"])
        for i, end in corrected
        if end == "from" and (i, "to") in corrected
    }
    counts = np.bincount(readings.station, minlength=len(readings.names)).tolist()
    depths = {
        name: StationDepth(float(depth_m), float(sigma_m), count)
        for name, depth_m, sigma_m, count in zip(readings.names, fit.depth_m, fit.sigma_m, counts, strict=True)
    }
    rates = {dive: 3600.0 * float(fit.shared[column]) for dive, column in fit.unknowns.tide.items()}
    return Gauges(depths, both, rates, _alarms(readings, fit, limits or AlarmSettings()))


def _revisited(readings: _GaugeReadings, dive: int) -> int:
    """Return how many stations were visited in a dive with a long time between."""
    of_dive = readings.dive == dive
    visits = [readings.time_s[of_dive & (readings.station == number)] for number in range(len(readings.names))]
    return sum(len(times_s) > 1 and float(np.ptp(times_s)) > APART_S for times_s in visits)


class _GaugeFit:
    """Weighted least squares; the stations' depths are taken out of it first, so that few unknowns remain."""

    def __init__(self, readings: _GaugeReadings, unknowns: _Unknowns) -> None:
        self.unknowns = unknowns
        count, at, weight = len(readings.names), readings.station, readings.noise_m**-2
        total = np.bincount(at, weight, count)

        def mean(values: Floats) -> Floats:
            """Return the weighted mean at each station, (s, ...) of (n, ...)."""
            flat = values.reshape(len(values), -1)
            sums = [np.bincount(at, weight * column, count) / total for column in flat.T]
            return np.array(sums).T.reshape(count, *values.shape[1:])

        A, y = unknowns.columns, readings.depth_m
        A_mean, y_mean = mean(A), mean(y)
        A_own, y_own = A - A_mean[at], y - y_mean[at]
        covariance = np.linalg.inv(np.diag(unknowns.sigmas**-2) + A_own.T @ (weight[:, None] * A_own))
        self.shared = covariance @ (A_own.T @ (weight * y_own))
        self.corrected_m = y - A @ self.shared
        self.depth_m = y_mean - A_mean @ self.shared
        self.sigma_m = np.sqrt(1 / total + np.einsum("sk,kl,sl->s", A_mean, covariance, A_mean))
        self.off_m = self.corrected_m - self.depth_m[at]
        own = np.einsum("nk,kl,nl->n", A_own, covariance, A_own)
        # The variance of a residual is the noise's, minus the part that the fit has followed.
        self.off_sigma_m = np.sqrt(np.maximum(1 / weight - 1 / total[at] - own, 0.0))
        self.chi2 = float((weight * self.off_m**2).sum() + ((self.shared / unknowns.sigmas) ** 2).sum())


def _alarms(readings: _GaugeReadings, fit: _GaugeFit, limits: AlarmSettings) -> list[str]:
    said = []
    for number, name in enumerate(readings.names):
        here = np.flatnonzero(readings.station == number)
        # If nothing checks a reading, its residual and its sigma are both zero.
        checked = fit.off_sigma_m[here] > 0.1 * readings.noise_m[here]
        away = np.abs(fit.off_m[here]) > limits.depth_sigmas * fit.off_sigma_m[here]
        if (checked & away).any() and np.ptp(fit.corrected_m[here]) > limits.depth_m:
            visits = ", ".join(
                f"{readings.depth_m[i]:.2f} m by {readings.node[i]} in dive {readings.dive[i]}" for i in here.tolist()
            )
            sigmas = float((np.abs(fit.off_m[here]) / np.maximum(fit.off_sigma_m[here], 1e-9))[checked].max())
            said.append(f"ALARM: gauges at station {name} differ by {sigmas:.1f} sd: {visits}; is it one station?")
    return said
