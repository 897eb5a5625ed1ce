"""From a dive's readings to legs, points and stations: the whole of the pure core in one call."""

from __future__ import annotations

import math
from collections import defaultdict
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any, Final

import numpy as np
from buddyline.tools.survey import alarms
from buddyline.tools.survey.averages import Mean
from buddyline.tools.survey.chain import BOTH, Standing, Stop, Who, stand
from buddyline.tools.survey.project import STATION_NAME, Leg, Problem, Station
from buddyline.tools.survey.readings import Readings
from buddyline.tools.survey.rests import Rest, rests
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from buddyline.tools.survey.shots import Shot, Sight, shoot
from buddyline.tools.survey.sights import Sights, sights
from msgspec import UNSET
from msgspec.structs import replace

# A mark this far from any rest says nothing of one.
MARK_NEAR_NS: Final = 20_000_000_000


class Derived:
    """What dives give: legs, points, problems; and notes on stations by name."""

    def __init__(self) -> None:
        self.legs: list[Leg] = []
        self.points: list[Leg] = []
        self.problems: list[Problem] = []
        self.notes: dict[str, list[str]] = defaultdict(list)

    def add(self, readings: Readings, settings: SurveySettings, limits: AlarmSettings, dive: int = 1) -> None:
        """Add one dive's legs and points."""
        _OneDive(self, readings, settings, limits, dive).derive()

    def stations(self) -> list[Station]:
        """Return all stations in the order of the legs, each with the weighted mean of its gauges' readings."""
        seen: dict[str, list[tuple[float, float]]] = {}
        for leg in self.legs:
            for name, depth_m, sigma_m in (
                (leg.from_, leg.depth_from_m, leg.depth_from_sigma_m),
                (leg.to, leg.depth_to_m, leg.depth_to_sigma_m),
            ):
                of_station = seen.setdefault(name, [])
                if isinstance(depth_m, float) and isinstance(sigma_m, float):
                    of_station.append((depth_m, sigma_m))
        return [_station(name, depths, self.notes.get(name, [])) for name, depths in seen.items()]


def _station(name: str, depths: list[tuple[float, float]], notes: list[str]) -> Station:
    if not depths:
        return Station(name=name, notes=notes)
    depth_m, sigma_m = np.array(depths).T
    weight = 1 / sigma_m**2
    # A gauge errs alike at each of its visits: averaging them gains little, so none is counted on.
    return Station(
        name=name,
        depth_m=round(float(weight @ depth_m / weight.sum()), 4),
        depth_sigma_m=round(float(sigma_m.min()), 4),
        readings=len(depths),
        notes=notes,
    )


class _OneDive:
    def __init__(
        self, out: Derived, readings: Readings, settings: SurveySettings, limits: AlarmSettings, dive: int
    ) -> None:
        self.out, self.readings, self.settings, self.limits, self.dive = out, readings, settings, limits, dive
        self.seen: Sights = sights(readings, settings)
        self.who: dict[str, Who] = dict(zip(readings.nodes, BOTH, strict=True))
        self.first: Who = self.who.get(settings.first, "a")

    def derive(self) -> None:
        every = rests(self.readings, self.seen, self.settings)
        found = [one for one in every if not one.too_short]
        for one in every:
            if one.too_short:
                least = f"a leg takes {self.settings.rest_s:g} s with {self.settings.rest_fixes} fixes"
                self._say(f"NO LEG: rest at {_time_text(one.start_ns)}: {one.too_short}; {least}")
        shots = [shoot(self.readings, self.seen, one.chosen, self.settings, one.unused) for one in found]
        named = self._named(found)
        stops = [
            Stop(one.line_m, {"a": _value(shot.depth_a), "b": _value(shot.depth_b)}, named[k])
            for k, (one, shot) in enumerate(zip(found, shots, strict=True))
        ]
        standings = stand(stops, self.settings.procedure, self.first) if stops else []
        usual = alarms.usual_fields(shots)
        legs: list[Leg] = []
        doubtful = _after_lost(every)
        for one, shot, standing in zip(found, shots, standings, strict=True):
            leg = self._leg(shot, standing.station["a"], standing.station["b"], standing.rear, usual)
            if standing.problem:
                leg = replace(leg, alarms=[*leg.alarms, f"stations: {standing.problem}"])
            if one.start_ns in doubtful and len(named[len(legs)]) < 2:
                said = "stations: a rest before this one makes no leg; mark both nodes' stations, or they may be wrong"
                leg = replace(leg, alarms=[*leg.alarms, said])
            legs.append(leg)
        off = [
            dict(zip(self.readings.nodes, alarms.off_fields(shot, usual, self.limits), strict=True)) for shot in shots
        ]
        self.out.legs += alarms.disturbed_alike(legs, off)
        self._points(found, standings, usual)
        if not found:
            least = f"{self.settings.rest_s:g} s with {self.settings.rest_fixes} fixes"
            self._say(f"dive {self.dive}: no rest of {least}")

    def _say(self, text: str) -> None:
        self.out.problems.append(Problem(text=text))

    def _named(self, found: list[Rest]) -> list[dict[Who, str]]:
        """Give marked stations to the rests nearest to their marks; the last word counts."""
        named: list[dict[Who, str]] = [{} for _ in found]
        for mark in self.readings.marks:
            if mark.kind == "note" and mark.note:
                self._say(f"note at {_time_text(mark.stamp_ns)}: {mark.note}")
            if mark.kind != "station" or mark.node not in self.who:
                continue
            if not STATION_NAME.match(mark.name):
                self._say(
                    f"mark at {_time_text(mark.stamp_ns)}: {mark.name!r} is no station's name: 1-12 of A-Z a-z 0-9 _ -"
                )
                continue
            if mark.note and mark.note not in self.out.notes[mark.name]:
                self.out.notes[mark.name].append(mark.note)
            gaps = [max(one.start_ns - mark.stamp_ns, mark.stamp_ns - one.end_ns, 0) for one in found]
            if not gaps or min(gaps) > MARK_NEAR_NS:
                if not any(other.kind == "point" for other in self.readings.marks):
                    self._say(f"mark {mark.name} at {_time_text(mark.stamp_ns)}: no rest near it")
                continue
            named[gaps.index(min(gaps))][self.who[mark.node]] = mark.name
        return named

    def _points(self, found: list[Rest], standings: list[Standing], usual: alarms.UsualFields) -> None:
        half_ns = round(self.settings.point_s * 1e9)
        for mark in self.readings.marks:
            if mark.kind != "point" or mark.node not in self.who:
                continue
            name = mark.name or f"p{len(self.out.points) + 1}"
            other: Who = "b" if self.who[mark.node] == "a" else "a"
            station = self._standing_at(mark.stamp_ns, other, found, standings)
            if station is None:
                node = self.readings.nodes[BOTH.index(other)]
                self._say(f"point {name}: where node {node} stood is not known")
                continue
            near = np.abs(self.seen.stamps_ns - mark.stamp_ns) <= half_ns
            if int(near.sum()) < 3:
                within = f"within {self.settings.point_s:g} s of its mark"
                self._say(f"point {name}: {int(near.sum())} fixes {within}")
                continue
            shot = shoot(self.readings, self.seen, near, self.settings)
            ends = {other: station, self.who[mark.node]: name}
            leg = self._leg(shot, ends["a"], ends["b"], other, usual)
            self.out.points.append(replace(leg, note=mark.note))

    def _standing_at(self, stamp_ns: int, who: Who, found: list[Rest], standings: list[Standing]) -> str | None:
        """Return where a node stood: its last mark's station where it has one, or that of the rests around."""
        node = self.readings.nodes[BOTH.index(who)]
        before = [i for i, one in enumerate(found) if one.start_ns <= stamp_ns]
        after = [i for i, one in enumerate(found) if one.end_ns >= stamp_ns]
        around = {standings[i].station[who] for i in (before[-1:] + after[:1])}
        marked = [m for m in self.readings.marks if m.kind == "station" and m.node == node and m.stamp_ns <= stamp_ns]
        if len(around) == 1:
            return next(iter(around))
        return marked[-1].name if marked and not around else None

    def _leg(self, shot: Shot, at_a: str, at_b: str, rear: Who, usual: alarms.UsualFields) -> Leg:
        nodes = self.readings.nodes
        leg = one_leg(shot, nodes, (at_a, at_b), rear)
        leg = replace(leg, dive=self.dive, disturbed=alarms.disturbed(shot, usual, self.limits, nodes))
        leg = replace(leg, alarms=alarms.of_leg(leg, shot, usual, self.limits, nodes))
        return replace(leg, grade=alarms.grade(leg))


def one_leg(shot: Shot, nodes: tuple[str, str], at: tuple[str, str] = ("a", "b"), rear: Who = "a") -> Leg:
    """Return a shot as a leg from the rear node's station; nodes, at: ids and stations of a and b."""
    a = (at[0], nodes[0], shot.sight_a, shot.depth_a, shot.field_a)
    b = (at[1], nodes[1], shot.sight_b, shot.depth_b, shot.field_b)
    (from_, from_node, fore, depth_from, field_from), (to, to_node, back, depth_to, field_to) = (
        (a, b) if rear == "a" else (b, a)
    )
    return Leg(
        from_=from_,
        to=to,
        from_node=from_node,
        to_node=to_node,
        start_ns=shot.start_ns,
        end_ns=shot.end_ns,
        distance_m=round(shot.distance.value, 4),
        distance_sigma_m=round(shot.distance.sigma, 4),
        **_angles("", fore),
        **_angles("back_", back),
        **_depth("from", depth_from),
        **_depth("to", depth_to),
        field_from_ut=round(field_from.norm_t * 1e6, 2) if field_from else UNSET,
        field_to_ut=round(field_to.norm_t * 1e6, 2) if field_to else UNSET,
        dip_from_deg=round(math.degrees(field_from.dip_rad), 2) if field_from else UNSET,
        dip_to_deg=round(math.degrees(field_to.dip_rad), 2) if field_to else UNSET,
        heading_gap_deg=UNSET if shot.heading_gap_rad is None else round(math.degrees(shot.heading_gap_rad), 2),
        fixes=len(shot.used),
        fixes_used=ranges(shot.used.tolist()),
        unused={reason: ranges(triggers) for reason, triggers in sorted(shot.unused.items())},
    )


def _after_lost(every: list[Rest]) -> set[int]:
    """Return the starts of the rests that follow one which makes no leg: who moved since is a guess."""
    return {rest.start_ns for before, rest in pairwise(every) if before.too_short and not rest.too_short}


def _angles(prefix: str, sight: Sight | None) -> dict[str, Any]:
    if sight is None:
        return {}
    return {
        f"{prefix}azimuth_deg": round(math.degrees(sight.azimuth.value), 3),
        f"{prefix}azimuth_sigma_deg": round(math.degrees(sight.azimuth.sigma), 3),
        f"{prefix}inclination_deg": round(math.degrees(sight.inclination.value), 3),
        f"{prefix}inclination_sigma_deg": round(math.degrees(sight.inclination.sigma), 3),
    }


def _depth(end: str, depth: Mean | None) -> dict[str, Any]:
    if depth is None:
        return {}
    return {
        f"depth_{end}_m": round(depth.value, 4),
        f"depth_{end}_sigma_m": round(depth.sigma, 4),
        f"depth_{end}_noise_m": round(depth.noise, 4),
    }


def _value(mean: Mean | None) -> float | None:
    return mean.value if mean else None


def _time_text(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).isoformat().replace("+00:00", "Z")


def ranges(triggers: list[int]) -> str:
    """Write trigger numbers as ranges: `3-7 9`."""
    parts: list[list[int]] = []
    for trigger in sorted(set(triggers)):
        if parts and trigger == parts[-1][1] + 1:
            parts[-1][1] = trigger
        else:
            parts.append([trigger, trigger])
    return " ".join(str(first) if first == last else f"{first}-{last}" for first, last in parts)
