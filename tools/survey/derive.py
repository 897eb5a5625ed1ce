"""From dives' readings to legs, points and stations: the pure core of the survey."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Mark
from buddyline.tools.survey import alarms
from buddyline.tools.survey.averages import Mean
from buddyline.tools.survey.chain import Stop, find_standings
from buddyline.tools.survey.gauges import StationDepth
from buddyline.tools.survey.magnetism import iron_rad, usual_field
from buddyline.tools.survey.project import STATION_NAME, Leg, Problem, Station, Swim, Turn
from buddyline.tools.survey.readings import PairReadings
from buddyline.tools.survey.rests import Rest, pauses, rests
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from buddyline.tools.survey.shots import Shot, shoot
from buddyline.tools.survey.sights import sights
from buddyline.tools.survey.swims import swims_of
from buddyline.tools.survey.turns import turns_of
from msgspec import UNSET
from msgspec.structs import replace

# A mark belongs to the nearest rest, but not to one further away than this.
MARK_NEAR_NS: Final = 20_000_000_000
LEAST_POINT_FIXES: Final = 3
# The track's row nearest to a mark is no further from it than this.
TRACK_NEAR_NS: Final = 150_000_000


class Derived:
    """The result of all dives: legs, points, turns, problems; notes on stations by name.

    numbered: stations that no mark has named, and the dive that numbered them. faults: number of unusable marks.
    """

    def __init__(self) -> None:
        self.legs: list[Leg] = []
        self.points: list[Leg] = []
        self.turns: list[Turn] = []
        self.swims: list[Swim] = []
        self.problems: list[Problem] = []
        self.notes: dict[str, list[str]] = defaultdict(list)
        self.numbered: dict[str, int] = {}
        self.faults = 0

    def add(
        self,
        pairs: list[PairReadings],
        settings: SurveySettings,
        limits: AlarmSettings,
        dive: int = 1,
        by_hand: Iterable[Mark] = (),
    ) -> None:
        """Add one dive's legs and points; each pair of nodes is a chain of its own.

        by_hand: marks besides the logs'. They take precedence, so that a person can correct mistyped marks.
        """
        corrections = list(by_hand)
        marks = sorted([*pairs[0].marks, *corrections], key=lambda mark: mark.stamp_ns)
        corrected = {id(mark) for mark in corrections}
        chains = []
        for readings in pairs:
            chain = _Chain(self, readings, marks, corrected, settings, limits, dive)
            self.legs += chain.legs
            self.turns += chain.turns
            self.swims += chain.swims
            chains.append(chain)
        nodes = {node for chain in chains for node in chain.readings.nodes}
        placed = {id(mark) for chain in chains for mark in chain.placed}
        passing = {
            id(mark): [chain.passed(mark) for chain in chains if mark.node in chain.readings.nodes]
            for mark in marks
            if mark.kind == "station" and mark.tag is UNSET and id(mark) not in placed and STATION_NAME.match(mark.name)
        }
        passed = [leg for found in passing.values() for leg in found if isinstance(leg, Leg)]
        self.legs += passed
        marked = {name for chain in chains for stations in chain.named for name in stations.values()}
        marked |= {leg.to for leg in passed}
        for leg in self.legs:
            for name in {leg.from_, leg.to} - marked:
                self.numbered.setdefault(name, leg.dive)
        for mark in marks:
            if mark.kind == "point" and mark.node in nodes:
                name = mark.name or f"p{len(self.points) + 1}"
                # Of several nodes that saw the point, the first with enough fixes.
                found = [chain.point(mark, name) for chain in chains if mark.node in chain.readings.nodes]
                shot = next((one for one in found if isinstance(one, Leg)), None)
                if shot is not None:
                    self.points.append(shot)
                else:
                    self.add_problem(f"point {name}: {found[0]}")
        from_marks = {leg.from_ for leg in (*passed, *self.points)}
        for mark in marks:
            at = time_text(mark.stamp_ns)
            if mark.node not in nodes and mark.kind != "note":
                self.faults += 1
                known = ", ".join(sorted(nodes))
                self.add_problem(
                    f"mark {mark.name} at {at}: node {mark.node} is in no pair of dive {dive}; known: {known}"
                )
            elif mark.kind == "note" and mark.note:
                self.add_problem(f"note at {at}: {mark.note}")
            elif mark.kind == "station" and mark.node in nodes:
                if not STATION_NAME.match(mark.name):
                    self.add_problem(f"mark at {at}: {mark.name!r} is no station's name: 1-12 of A-Z a-z 0-9 _ -")
                    continue
                if mark.note and mark.note not in self.notes[mark.name]:
                    self.notes[mark.name].append(mark.note)
                why = passing.get(id(mark), [])
                if why and mark.name not in from_marks and not any(isinstance(one, Leg) for one in why):
                    self.faults += 1
                    self.add_problem(f"mark {mark.name} at {at}: no rest near it; in passing: {why[0]}")

    def add_problem(self, text: str) -> None:
        """Add a problem."""
        self.problems.append(Problem(text=text))

    def equate(self, stations: list[str]) -> None:
        """Give stations that are the same place the first one's name; raise BuddylineError for an unknown station."""
        known = {name for leg in self.legs + self.points for name in (leg.from_, leg.to)}
        for name in stations:
            if name not in known:
                raise BuddylineError(f"equate of {name!r}: no leg has this station; known: {', '.join(sorted(known))}")
        first, *others = stations

        def renamed(name: str) -> str:
            return first if name in others else name

        self.legs = [replace(leg, from_=renamed(leg.from_), to=renamed(leg.to)) for leg in self.legs]
        self.points = [replace(leg, from_=renamed(leg.from_)) for leg in self.points]
        self.swims = [
            replace(one, station=renamed(one.station), from_=renamed(one.from_), to=renamed(one.to))
            for one in self.swims
        ]
        for other in others:
            self.notes[first] += [note for note in self.notes.pop(other, []) if note not in self.notes[first]]

    def stations(self, depths: Mapping[str, StationDepth]) -> list[Station]:
        """Return all stations in the order of the legs. depths: by station, from the gauges."""
        stations = []
        for name in dict.fromkeys(name for leg in self.legs for name in (leg.from_, leg.to)):
            known: dict[str, Any] = {}
            if name in depths:
                of = depths[name]
                known = {
                    "depth_m": round(of.depth_m, 4),
                    "depth_sigma_m": round(of.sigma_m, 4),
                    "readings": of.readings,
                }
            stations.append(Station(name=name, notes=self.notes.get(name, []), **known))
        return stations


class _Chain:
    """One pair's legs in one dive. placed: marks that name a station of a rest."""

    def __init__(
        self,
        out: Derived,
        readings: PairReadings,
        marks: list[Mark],
        corrected: set[int],
        settings: SurveySettings,
        limits: AlarmSettings,
        dive: int,
    ) -> None:
        if settings.pause_s:
            if readings.track is None:
                raise BuddylineError(f"settings.pause_s: dive {dive} has no track; solve it with one (buddyline solve)")
            readings = readings.track
        self.readings, self.marks, self.settings, self.limits, self.dive = readings, marks, settings, limits, dive
        self.seen = sights(readings, settings)
        self.placed: list[Mark] = []
        if settings.pause_s:
            every, least = pauses(readings, self.seen, settings), f"{settings.pause_s:g} s by the track"
        else:
            every = rests(readings, self.seen, settings)
            least = f"{settings.rest_s:g} s with {settings.rest_fixes} fixes"
        for rest in every:
            if rest.too_short:
                out.add_problem(f"NO LEG: rest at {time_text(rest.start_ns)}: {rest.too_short}; a leg takes {least}")
        # After a rest without a leg, it is a guess who has moved.
        doubtful = {id(rest) for before, rest in pairwise(every) if before.too_short}
        self.found = [rest for rest in every if not rest.too_short]
        if not self.found:
            pair = f", nodes {' and '.join(readings.nodes)}"
            out.add_problem(f"dive {dive}{pair}: no rest of {least}")
        shots = [shoot(readings, self.seen, rest.chosen, settings, rest.unused) for rest in self.found]
        self.usual = {
            node: usual_field([shot.ends[i].field for shot in shots]) for i, node in enumerate(readings.nodes)
        }
        # By rest, the nodes that have their names by a tag.
        self.tagged: list[set[str]] = [set() for _ in self.found]
        self.named = self._named(out, corrected)
        stops = [
            stop_of(rest, shot, stations, tagged)
            for rest, shot, stations, tagged in zip(self.found, shots, self.named, self.tagged, strict=True)
        ]
        taken = {name for leg in out.legs for name in (leg.from_, leg.to)}
        self.standings = find_standings(stops, settings.procedure, settings.first, taken)
        legs = []
        for rest, shot, standing, stations in zip(self.found, shots, self.standings, self.named, strict=True):
            leg = self._leg(shot, standing.station, standing.rear)
            doubts = doubt_of(standing.problem, stations, after_lost=id(rest) in doubtful)
            legs.append(replace(leg, alarms=[*leg.alarms, *doubts]))
        used = [np.isin(self.seen.triggers, shot.used) for shot in shots]
        self.turns = turns_of(readings, used, dive, settings)
        named = [one.station for one in self.standings]
        self.swims = swims_of(readings, used, named, self.turns, dive, settings)
        self.legs = alarms.disturbed_alike(legs, [alarms.off_fields(shot, self.usual, limits) for shot in shots])

    def _named(self, out: Derived, corrected: set[int]) -> list[dict[str, str]]:
        """Return, for each rest, the stations that are known by node: by marks, or by another pair's leg meanwhile.

        A mark belongs to the rest nearest to it; of two marks one by hand (corrected) counts, else a person's before a
        tag's, else the later one.
        """
        named: list[dict[str, str]] = [{} for _ in self.found]
        for leg in out.legs:
            for rest, stations in zip(self.found, named, strict=True):
                if leg.dive == self.dive and leg.start_ns <= rest.end_ns and rest.start_ns <= leg.end_ns:
                    both = {leg.from_node: leg.from_, leg.to_node: leg.to}
                    stations |= {node: name for node, name in both.items() if node in self.readings.nodes}
        joined: set[str] = set()
        for mark in sorted(self.marks, key=lambda one: (id(one) in corrected, one.tag is UNSET)):
            if mark.kind != "station" or mark.node not in self.readings.nodes or not STATION_NAME.match(mark.name):
                continue
            if (at := rest_of(mark, self.found)) is not None:
                before = named[at].get(mark.node, mark.name)
                if before != mark.name and id(mark) not in corrected:
                    when = time_text(self.found[at].start_ns)
                    out.add_problem(
                        f"rest at {when}: node {mark.node} is at {before} and at {mark.name}; {mark.name} counts"
                    )
                note_name(mark, named[at], self.tagged[at])
                self.placed.append(mark)
                earlier = out.numbered.get(mark.name, self.dive)
                if earlier != self.dive and mark.name not in joined:
                    joined.add(mark.name)
                    out.add_problem(
                        f"mark {mark.name} in dive {self.dive}: taken for station {mark.name} of dive {earlier}, which "
                        f"got that number because no mark named it; is it the same place?"
                    )
        return named

    def point(self, mark: Mark, name: str) -> Leg | str:
        """Return the leg from the other node's station to a marked point, or why there is none."""
        other = next(node for node in self.readings.nodes if node != mark.node)
        station = self._standing_at(mark.stamp_ns, other)
        if station is None:
            return f"where node {other} stood is not known"
        near = np.abs(self.seen.stamps_ns - mark.stamp_ns) <= self.settings.point_s * S_NS
        if int(near.sum()) < LEAST_POINT_FIXES:
            return f"{int(near.sum())} fixes within {self.settings.point_s:g} s of its mark"
        shot = shoot(self.readings, self.seen, near, self.settings)
        return replace(self._leg(shot, {other: station, mark.node: name}, other), note=mark.note)

    def passed(self, mark: Mark) -> Leg | str:
        """Return the leg from the other node's station to a place that was swum past, or why there is none."""
        other = next(node for node in self.readings.nodes if node != mark.node)
        station = self._standing_at(mark.stamp_ns, other)
        track = self.readings if self.settings.pause_s else self.readings.track
        if station is None or station == mark.name:
            return f"where node {other} stood is not known"
        if track is None or (off_ns := np.abs(track.stamps_ns - mark.stamp_ns)).min() > TRACK_NEAR_NS:
            return "no track at this time"
        held_m = math.hypot(self.settings.centering_m, self.settings.passing_m) / math.sqrt(2)
        settings = replace(self.settings, centering_m=held_m)
        shot = shoot(track, sights(track, settings), np.arange(len(off_ns)) == off_ns.argmin(), settings)
        leg = self._leg(shot, {other: station, mark.node: mark.name}, other)
        return replace(leg, fixes=0, fixes_used="", note=" ".join(filter(None, ("swum past", mark.note))))

    def _standing_at(self, stamp_ns: int, node: str) -> str | None:
        """Return a node's station: that of the rests before and after, or its last mark's if there are none."""
        before = [i for i, rest in enumerate(self.found) if rest.start_ns <= stamp_ns]
        after = [i for i, rest in enumerate(self.found) if rest.end_ns >= stamp_ns]
        around = {self.standings[i].station[node] for i in (before[-1:] + after[:1])}
        if around:
            return around.pop() if len(around) == 1 else None
        marked = [m.name for m in self.marks if m.kind == "station" and m.node == node and m.stamp_ns <= stamp_ns]
        return marked[-1] if marked else None

    def _leg(self, shot: Shot, station: dict[str, str], rear: str) -> Leg:
        bad = alarms.disturbed(shot, self.usual, self.limits)
        leg = replace(one_leg(shot, station, rear, self.usual), dive=self.dive, disturbed=bad)
        leg = replace(leg, alarms=alarms.of_leg(leg, shot, self.usual, self.limits))
        if self.settings.pause_s:
            # Rows of the track are no triggers.
            leg = replace(leg, fixes_used="", unused={})
        return replace(leg, grade=alarms.grade(leg))


def note_name(mark: Mark, stations: dict[str, str], tagged: set[str]) -> None:
    """Note the station of a mark's node at a rest, and whether a tag says it."""
    stations[mark.node] = mark.name
    (tagged.discard if mark.tag is UNSET else tagged.add)(mark.node)


def stop_of(rest: Rest, shot: Shot, stations: dict[str, str], tagged: set[str]) -> Stop:
    """Return a rest as the chain of stations needs it. stations: known by node; tagged: nodes named by a tag."""
    depths_m = {end.node: end.depth.value if end.depth else None for end in shot.ends}
    return Stop(rest.line_m, depths_m, stations, frozenset(tagged))


def rest_of(mark: Mark, found: Sequence[Rest]) -> int | None:
    """Return the rest that a mark belongs to: the nearest one, if it is near enough.

    A tag is read at a station before the rest there; after a rest it may be the next station's, or one swum past.
    """
    gaps = [(max(rest.start_ns - mark.stamp_ns, mark.stamp_ns - rest.end_ns, 0), i) for i, rest in enumerate(found)]
    if mark.tag is not UNSET:
        gaps = [(gap_ns, i) for gap_ns, i in gaps if mark.stamp_ns <= found[i].end_ns]
    gap_ns, nearest = min(gaps, default=(MARK_NEAR_NS + 1, 0))
    return nearest if gap_ns <= MARK_NEAR_NS else None


def doubt_of(problem: str, stations: Mapping[str, str], *, after_lost: bool) -> list[str]:
    """Return alarms of a leg's stations: the chain's problem, and that a rest without a leg was before it.

    stations: by node, as marked.
    """
    said = [problem] if problem else []
    if after_lost and len(stations) < 2:
        said.append("a rest before this one makes no leg; mark both nodes' stations, or they may be wrong")
    return [f"stations: {text}" for text in said]


def one_leg(shot: Shot, station: dict[str, str], rear: str, usual: alarms.UsualFields) -> Leg:
    """Return a shot as a leg from the rear node's station; station: by node. usual: fields, which tell of iron."""
    fields: dict[str, Any] = {}
    ends = sorted(shot.ends, key=lambda end: end.node != rear)
    for end, at, prefix, name in zip(ends, ("from_", "to"), ("", "back_"), ("from", "to"), strict=True):
        fields |= {at: station[end.node], f"{name}_node": end.node}
        azimuth = end.azimuth
        if azimuth is not None:
            iron = iron_rad(end.field, usual.get(end.node))
            azimuth = Mean(azimuth.value, math.hypot(azimuth.sigma, iron), azimuth.count, azimuth.noise)
        for angle, what in ((azimuth, "azimuth"), (end.inclination, "inclination")):
            fields |= _rounded(angle, 3, math.degrees(1), f"{prefix}{what}_deg", f"{prefix}{what}_sigma_deg")
        fields |= _rounded(end.depth, 4, 1.0, *(f"depth_{name}_{part}" for part in ("m", "sigma_m", "noise_m")))
        if end.field is not None:
            fields[f"field_{name}_ut"] = round(end.field.norm_t * 1e6, 2)
            fields[f"dip_{name}_deg"] = round(math.degrees(end.field.dip_rad), 2)
    if shot.heading_gap_rad is not None:
        fields["heading_gap_deg"] = round(math.degrees(shot.heading_gap_rad), 2)
    return Leg(
        start_ns=shot.start_ns,
        end_ns=shot.end_ns,
        fixes=len(shot.used),
        fixes_used=ranges(shot.used.tolist()),
        unused={reason: ranges(triggers) for reason, triggers in sorted(shot.unused.items())},
        **_rounded(shot.distance, 4, 1.0, "distance_m", "distance_sigma_m"),
        **fields,
    )


def _rounded(mean: Mean | None, digits: int, scale: float, *names: str) -> dict[str, Any]:
    """Return a mean's value, sigma and noise, rounded, under the given names; nothing if it was not measured."""
    if mean is None:
        return {}
    values = (mean.value, mean.sigma, mean.noise)
    return {name: round(scale * value, digits) for name, value in zip(names, values, strict=False)}


def time_text(stamp_ns: int) -> str:
    """Return a time as UTC."""
    return datetime.fromtimestamp(stamp_ns // S_NS, UTC).isoformat().replace("+00:00", "Z")


def ranges(triggers: list[int]) -> str:
    """Write trigger numbers as ranges: `3-7 9`."""
    parts: list[list[int]] = []
    for trigger in sorted(set(triggers)):
        if parts and trigger == parts[-1][1] + 1:
            parts[-1][1] = trigger
        else:
            parts.append([trigger, trigger])
    return " ".join(str(first) if first == last else f"{first}-{last}" for first, last in parts)
