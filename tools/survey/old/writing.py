"""Writes old surveys again, as they were read: in the language of Survex, and in that of Therion."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal

from buddyline.tools.survey.old.model import (
    SIGMAS,
    CrossSection,
    North,
    OldShot,
    OldSurvey,
    Passage,
    StationName,
    SurveyPath,
    merged,
)
from buddyline.tools.survey.old.systems import DEGREES, convergence_deg, map_system

UNITS: Final = {name: "metres" for name in SIGMAS} | {
    name: "degrees" for name in SIGMAS if "compass" in name or "clino" in name or name in ("level", "plumb")
}


@dataclass
class _Block:
    """A survey of the hierarchy, what is in it, and the surveys in it."""

    path: SurveyPath
    shots: list[OldShot] = field(default_factory=list)
    passages: list[Passage] = field(default_factory=list)
    inside: dict[str, _Block] = field(default_factory=dict)

    def at(self, path: SurveyPath) -> _Block:
        """Return the survey at a path below this one, made where there is none."""
        block = self
        for part in path:
            block = block.inside.setdefault(part, _Block((*block.path, part)))
        return block


def tree_of(survey: OldSurvey) -> _Block:
    """Return the hierarchy."""
    root = _Block(())
    for shot in survey.shots:
        root.at(shot.survey).shots.append(shot)
    for passage in survey.passages:
        root.at(passage.survey).passages.append(passage)
    for path in survey.surveys:
        root.at(path)
    return root


class _Names:
    """Stations' names within surveys, and what has to be equated because it has several."""

    def __init__(self, allowed: str) -> None:
        self._allowed = allowed
        # By full name: the first survey it is named in, and its name there.
        self.home: dict[StationName, tuple[SurveyPath, str]] = {}
        self._local: dict[tuple[SurveyPath, StationName], str] = {}
        self._taken: set[tuple[SurveyPath, str]] = set()
        self.equates: list[tuple[tuple[SurveyPath, str], tuple[SurveyPath, str]]] = []

    def local(self, name: StationName, path: SurveyPath) -> str:
        """Return a station's name in a survey."""
        if (path, name) in self._local:
            return self._local[path, name]
        inside = ".".join(path) + "."
        short = name[len(inside) :] if path and name.startswith(inside) else name
        short = re.sub(rf"[^{self._allowed}]", "_", short)
        while (path, short) in self._taken:
            short += "_"
        self._taken.add((path, short))
        self._local[path, name] = short
        if name in self.home:
            self.equates.append((self.home[name], (path, short)))
        else:
            self.home[name] = path, short
        return short

    def anywhere(self, name: StationName) -> tuple[SurveyPath, str]:
        """Return a survey and a station's name in it."""
        if name not in self.home:
            self.local(name, ())
        return self.home[name]


def one_line(text: str) -> str:
    """Return text on one line: what follows a line end would be a line of data in another program's file."""
    return " ".join(text.splitlines())


def quoted(text: str) -> str:
    """Return text in quotes, on one line; quotes in it are replaced."""
    return '"' + one_line(text.replace('"', "'")) + '"'


def therion_person(name: str) -> str:
    """Return a name as Therion takes it: first names, a slash, surname; two words at most without the slash."""
    words = name.replace("/", " ").split()
    return quoted(" ".join(words) if len(words) < 3 else f"{' '.join(words[:-1])}/{words[-1]}")


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value + 0.0:.{digits}f}"


def _columns(shot: OldShot) -> dict[str, str]:
    """Return a shot's readings by column, those of both languages; backsights only where there are any."""
    if shot.vector_m is not None:
        return {name: _number(value, 4) for name, value in zip(("dx", "dy", "dz"), shot.vector_m, strict=True)}
    if shot.style in ("nosurvey", "distance"):
        return {}
    row = {"tape": _number(shot.tape_m, 4), "compass": _angle(shot.compass_deg)}
    row |= {} if shot.back_deg is None else {"backcompass": _angle(shot.back_deg)}
    if shot.style != "normal":
        # Altitudes: up is positive in both languages.
        return row | {"depthchange": _number(shot.rise_m, 4)}
    if shot.clino_word or shot.clino_deg is not None or shot.back_clino_deg is None:
        row["clino"] = shot.clino_word or _number(shot.clino_deg, 4)
    return row | ({} if shot.back_clino_deg is None else {"backclino": _number(shot.back_clino_deg, 4)})


def _style(shot: OldShot) -> str:
    """Return a shot's style in both languages, which have no distances alone."""
    return "nosurvey" if shot.style == "distance" else shot.style


def _angle(angle_deg: float | None) -> str:
    return _number(None if angle_deg is None else angle_deg % 360, 4)


@dataclass(frozen=True)
class Written:
    """Lines of a file, and how it names a station from outside of all surveys."""

    lines: list[str]
    name: Callable[[StationName], str]


def svx_of(survey: OldSurvey, system: str = "", turn_deg: float | None = None) -> Written:
    """Return a survey in the language of Survex, without a heading.

    system, turn_deg: the map grid and the azimuth of its north, if not the survey's own.
    """
    turn_deg = convergence_deg(survey, system) if turn_deg is None else turn_deg
    more = _more_names(survey)
    names = _Names("A-Za-z0-9_.\\-" + re.escape(more))
    lines = ["*case preserve", "*alias station - .."]
    if more:
        lines.append(f"*set names _-{more}")
    lines += _svx_block(survey, tree_of(survey), names, turn_deg)
    lines += [f"*equate {' '.join(_dotted(names.anywhere(one)) for one in same)}" for same in survey.equates]
    lines += _fixes(survey, "*fix", lambda name: f"*cs {survex_system(name)}", " reference", names, _dotted)
    lines += [f"*entrance {_dotted(names.anywhere(one))}" for one in survey.entrances]
    lines += [f"*equate {_dotted(one)} {_dotted(other)}" for one, other in names.equates]
    return Written(lines, lambda name: _dotted(names.anywhere(name)))


def svx_system(survey: OldSurvey) -> list[str]:
    """Return the line that names a survey's map grid, if it has one."""
    system = map_system(survey)
    return [f"*cs out {survex_system(system)}"] if system else []


def _fixes(
    survey: OldSurvey,
    command: str,
    system_line: Callable[[str], str],
    after: str,
    names: _Names,
    name_of: Callable[[tuple[SurveyPath, str]], str],
) -> Iterator[str]:
    system = ""
    for fix in survey.fixes:
        if fix.system and fix.system != system:
            yield system_line(fix.system)
        system = fix.system or system
        digits = 9 if fix.system.lower() == DEGREES else 4
        numbers = [_number(value, digits) for value in fix.position]
        numbers += [f"{one:.4f}" for one in fix.sigmas_m] if any(fix.sigmas_m) else []
        yield " ".join([command, name_of(names.anywhere(fix.station)) + after, *numbers])


def _more_names(survey: OldSurvey) -> str:
    """Return characters of stations' names that are not usual in Survex."""
    every = {c for shot in survey.shots for c in shot.start + shot.end}
    return "".join(sorted(c for c in every if c.isascii() and not c.isalnum() and c not in '_-.;* \t,"\\'))


def _dotted(where: tuple[SurveyPath, str]) -> str:
    return ".".join([*where[0], where[1]])


class InForce(dict[str, str]):
    """Commands of a file that hold until they are given again, with their values."""

    def lines(self, now: Mapping[str, str], data: str) -> list[str]:
        """Return the commands that are not in force as in `now`, and put them into force.

        Of the commands that begin with `data` one alone is in force.
        """
        new = [f"{name} {value}".rstrip() for name, value in now.items() if self.get(name) != value]
        for name in [name for name in self if name.startswith(data) and name not in now]:
            del self[name]
        self.update(now)
        return new


@dataclass(frozen=True)
class _Dialect:
    """How a language says the same. command, comment: their first characters; gap: between columns.

    taken: a shot as the language takes it, by the map's turn (degrees). north: the commands that say from where its
    bearings are. nameless: an end without a name.
    """

    command: str
    comment: str
    gap: str
    passage: str
    flags: frozenset[str]
    sigmas: Sequence[str]
    taken: Callable[[OldShot, float], OldShot]
    north: Callable[[OldShot, Mapping[str, str], float], dict[str, str]]
    nameless: Callable[[OldShot], str]

    def shots(self, block: _Block, names: _Names, turn_deg: float) -> Iterator[str]:
        """Yield the shots and passages of one survey of the hierarchy, without those inside."""
        in_force, flags, c, extend = InForce(), frozenset[str](), self.command, ""
        for shot in (self.taken(one, turn_deg) for one in block.shots):
            stated = [name for name in shot.sigmas if name in self.sigmas]
            stated += [name for name in self.sigmas if f"{c}sd {name}" in in_force and name not in stated]
            now = {f"{c}sd {name}": f"{shot.sigma(name):.5f} {UNITS[name]}" for name in stated}
            if shot.when is not None:
                now[f"{c}date"] = f"{shot.when:%Y.%m.%d}"
            now |= self.north(shot, in_force, turn_deg)
            row = _columns(shot)
            now[f"{c}data {' '.join([_style(shot), 'from', 'to', *row])}"] = ""
            yield from in_force.lines(now, f"{c}data")
            known = shot.flags & self.flags
            if known != flags:
                words = [*sorted(known - flags), *(f"not {flag}" for flag in sorted(flags - known))]
                yield f"{c}flags {' '.join(words)}"
            flags = known
            if not c and shot.extend != extend:
                yield f"extend {shot.extend or 'normal'}"
                extend = shot.extend
            ends = [names.local(name, block.path) if name else self.nameless(shot) for name in (shot.start, shot.end)]
            yield self.gap.join([*ends, *row.values(), f"{self.comment} {remark_of(shot)}"])
        for passage in block.passages:
            yield from self.sections(passage.sections, lambda name: names.local(name, block.path))

    def sections(self, sections: Sequence[CrossSection], name: Callable[[StationName], str]) -> Iterator[str]:
        """Yield cross-sections of one passage. name: gives a station's name in the file."""
        yield f"{self.command}data {self.passage} station left right up down"
        for one in sections:
            yield self.gap.join([name(one.station), *(_number(side, 3) for side in one.sides_m)])


def _svx_block(survey: OldSurvey, block: _Block, names: _Names, turn_deg: float) -> Iterator[str]:
    notes = survey.surveys.get(block.path)
    if notes is not None:
        yield from [f"*title {quoted(notes.title)}"] * bool(notes.title)
        yield from (f"*team {quoted(person)}" for person in notes.team)
        yield from (f"*instrument {kind} {quoted(what)}" for kind, what in notes.instruments)
        yield from (f"; {note}" for note in notes.notes)
    yield from SVX.shots(block, names, turn_deg)
    for name, inner in block.inside.items():
        yield f"*begin {name}"
        yield from _svx_block(survey, inner, names, turn_deg)
        yield f"*end {name}"


def _on_the_map(shot: OldShot, turn_deg: float) -> OldShot:
    """Return a shot whose vector is from the map's north: Therion's are from the compass's."""
    if shot.vector_m is None or shot.north == North():
        return shot
    angle = math.radians(shot.north.value_deg - (turn_deg if shot.north.kind == "true" else 0.0))
    east_m, north_m, up_m = shot.vector_m
    sine, cosine = math.sin(angle), math.cos(angle)
    vector_m = east_m * cosine + north_m * sine, north_m * cosine - east_m * sine, up_m
    return replace(shot, vector_m=vector_m, north=North())


def _svx_nameless(shot: OldShot) -> str:
    return "..." if "splay" not in shot.flags else ".." if "wall" in shot.flags else "."


def _svx_north(shot: OldShot, state: Mapping[str, str], turn_deg: float) -> dict[str, str]:
    north = shot.north
    if shot.style in ("cartesian", "nosurvey", "distance"):
        return {}
    if north.kind == "model" and north.at is not None:
        system, *xyz = north.at
        now = {"*cs": survex_system(system)} if system else {}
        digits = 9 if system.lower() in ("long-lat", "lat-long") else 3
        return now | {"*declination": "auto " + " ".join(f"{one:.{digits}f}" for one in xyz)}
    value_deg = north.value_deg - (turn_deg if north.kind == "true" else 0.0)
    if value_deg or "*declination" in state:
        return {"*declination": f"{value_deg + 0.0:.4f} degrees"}
    return {}


def remark_of(shot: OldShot) -> str:
    """Return what was read, where it was, and what else was said of it."""
    other = sorted(shot.flags - {"surface", "duplicate", "splay", "wall"})
    words = [
        shot.place,
        f"{shot.tape_m:.4f} m" if shot.style == "distance" else "",
        *other,
        *([f"extend {shot.extend}"] if shot.extend else []),
        shot.note,
    ]
    return " ".join(word for word in words if word)


def th_of(survey: OldSurvey, system: str = "", turn_deg: float | None = None) -> Written:
    """Return a survey in the language of Therion, without a heading; see svx_of."""
    names = _Names("A-Za-z0-9_.\\-'/+*")
    turn_deg = convergence_deg(survey, system) if turn_deg is None else turn_deg
    survey, refused, known_as = _accepted_by_therion(survey)
    lines = list(_th_block(survey, tree_of(survey), names, turn_deg))
    lines += [f"# no shot, as both its ends are one station: {remark_of(shot)}" for shot in refused]
    tail = list(_fixes(survey, "fix", lambda name: f"cs {therion_system(name)}", "", names, _at))
    tail += [f'station {_at(names.anywhere(one))} "" entrance' for one in survey.entrances]
    lines += ["centreline", *(f"  {line}" for line in tail), "endcentreline"] if tail else []
    every: Sequence[Sequence[tuple[SurveyPath, str]]] = [
        *([names.anywhere(one) for one in same] for same in survey.equates),
        *names.equates,
    ]
    lines += [f"equate {' '.join(map(_at, same))}" for same in every]
    return Written(lines, lambda name: _at(names.anywhere(known_as(name))))


def _accepted_by_therion(survey: OldSurvey) -> tuple[OldSurvey, list[OldShot], Callable[[StationName], StationName]]:
    """Return a survey without what Therion refuses a file for, its shots without a length, and what to name a station.

    Refused are shots between equated stations, a place's second fixed point, and stations without shot or fixed point.
    """
    place = merged(survey.equates)
    within = [bool(shot.start and shot.end) and place(shot.start) == place(shot.end) for shot in survey.shots]
    fixes = {place(fix.station): fix for fix in reversed(survey.fixes)}
    shots = [shot for shot, out in zip(survey.shots, within, strict=True) if not out]
    kept = replace(survey, shots=shots, fixes=list(reversed(fixes.values())))
    places: dict[StationName, list[StationName]] = {}
    for name in kept.stations:
        places.setdefault(place(name), []).append(name)

    def known_as(name: StationName) -> StationName:
        there = places.get(place(name), [name])
        return name if name in there else there[0]

    return (
        replace(
            kept,
            equates=[tuple(same) for same in places.values() if len(same) > 1],
            entrances=[known_as(one) for one in survey.entrances if place(one) in places],
        ),
        [shot for shot, out in zip(survey.shots, within, strict=True) if out],
        known_as,
    )


def survex_system(system: str) -> str:
    """Return a coordinate system's name as Survex has it: a PROJ string in quotes."""
    return re.sub(r"(?i)^custom\s+(.*)$", r'custom "\1"', system)


def therion_system(system: str) -> str:
    """Return a coordinate system's name as Therion has it."""
    return re.sub(r"(?i)^custom\s+", "", system)


def _at(where: tuple[SurveyPath, str]) -> str:
    path, name = where
    return f"{name}@{'.'.join(reversed(path))}" if path else name


def _th_block(survey: OldSurvey, block: _Block, names: _Names, turn_deg: float) -> Iterator[str]:
    gap = "  " * len(block.path)
    notes = survey.surveys.get(block.path)
    rows = list(TH.shots(block, names, turn_deg))
    if notes is not None:
        head = [f"team {therion_person(person)}" for person in notes.team if person]
        head += [f"# {note}" for note in notes.notes]
        rows = head + rows if rows else rows
    if rows:
        yield f"{gap}centreline"
        yield from (f"{gap}  {row}" for row in rows)
        yield f"{gap}endcentreline"
    for name, inner in block.inside.items():
        title = survey.surveys[inner.path].title if inner.path in survey.surveys else ""
        yield f"{gap}survey {name}" + (f" -title {quoted(title)}" if title else "")
        yield from _th_block(survey, inner, names, turn_deg)
        yield f"{gap}endsurvey {name}"


def _for_therion(shot: OldShot, _turn_deg: float) -> OldShot:
    """Return a shot that Therion takes: it has no level sights, and none without a clino or beyond the vertical."""
    if shot.clino_word == "level" or (shot.style == "normal" and shot.clino_deg is shot.back_clino_deg is None):
        shot = replace(shot, clino_deg=None if shot.clino_word in ("up", "down") else 0.0, clino_word=_plumb(shot))
    short = shot.style == "diving" and shot.tape_m < abs(shot.rise_m or 0.0)
    over = max(abs(one or 0.0) for one in (shot.clino_deg, shot.back_clino_deg)) > 90
    if shot.vector_m is not None or not (short or over or shot.tape_m < 0):
        return shot
    distance_m, azimuth_deg, slope_deg = shot.polar
    run_m, azimuth = distance_m * math.cos(math.radians(slope_deg)), math.radians(azimuth_deg)
    up_m = distance_m * math.sin(math.radians(slope_deg))
    return replace(shot, style="cartesian", vector_m=(run_m * math.sin(azimuth), run_m * math.cos(azimuth), up_m))


def _plumb(shot: OldShot) -> Literal["", "up", "down"]:
    return "" if shot.clino_word == "level" else shot.clino_word


def _th_north(shot: OldShot, state: Mapping[str, str], turn_deg: float) -> dict[str, str]:
    if shot.style in ("nosurvey", "distance"):
        return {}
    if shot.north.kind == "model" and shot.when is not None:
        return {"declination": "- degrees"} if "declination" in state else {}
    # Therion itself turns from true north to the grid's; without a day Survex's model and ours give 0.
    value_deg = shot.north.value_deg + (turn_deg if shot.north.kind == "grid" else 0.0)
    if value_deg or turn_deg or shot.north.kind == "model" or "declination" in state:
        return {"declination": f"{value_deg + 0.0:.4f} degrees"}
    return {}


_FLAGS: Final = frozenset(("surface", "duplicate", "splay"))
SVX: Final = _Dialect("*", ";", "\t", "passage", _FLAGS, list(SIGMAS), _on_the_map, _svx_north, _svx_nameless)
TH: Final = _Dialect(
    command="",
    comment="#",
    gap=" ",
    passage="dimensions",
    flags=_FLAGS | {"approximate"},
    sigmas=[name for name in SIGMAS if name not in ("level", "plumb")],
    taken=_for_therion,
    north=_th_north,
    nameless=lambda shot: "-" if "wall" in shot.flags else ".",
)
