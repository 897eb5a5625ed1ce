"""Reads Therion data (.th): surveys, centrelines, equates; drawings and maps are left out."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from buddyline.tools.survey.old.centreline import Rows
from buddyline.tools.survey.old.model import North, OldFix, OldSurvey, StationName, SurveyPath
from buddyline.tools.survey.old.row_settings import (
    CHANGES,
    QUANTITIES,
    STYLES,
    RowSettings,
    date_of,
    factor_of,
    sigmas_of_fix,
    with_flags,
)
from buddyline.tools.survey.old.source import DEEPEST, SourceLine, beside, lines_of

CENTRELINES: Final = frozenset(("centreline", "centerline"))
# Blocks of drawings, left out to their ends; and commands that say nothing of positions.
DRAWN: Final = frozenset(("map", "surface", "scrap", "scan", "lookup", "layout", "comment", "grade"))
SILENT: Final = frozenset(("join", "select", "source", "export", "revise", "encoding"))
SILENT_INSIDE: Final = frozenset(
    ("copyright", "explo-date", "explo-team", "walls", "vthreshold", "mark", "grade", "break")
)
FLAGS: Final = {name: name for name in ("surface", "splay", "duplicate", "approximate")} | {"approx": "approximate"}
ROLES: Final = re.compile(r"/")
DASHED: Final = frozenset((".", "-"))


@dataclass
class _Centreline:
    """What is in force in a centreline."""

    settings: RowSettings = field(default_factory=RowSettings)
    system: str = ""
    prefix: str = ""
    suffix: str = ""
    own_north: bool = False
    groups: list[RowSettings] = field(default_factory=list)


class ThReader:
    """Reads one .th file and all that it takes in into a survey."""

    def __init__(self, survey: OldSurvey) -> None:
        self.survey = survey
        self._rows = Rows(survey, self._name)
        self._paths: list[SurveyPath] = [()]
        self._names: list[str] = []
        self._block = ""
        self._in: _Centreline | None = None
        self._deep = 0
        # Survey declinations, by path: those of `survey -declination`.
        self._norths: dict[SurveyPath, North] = {}

    @property
    def path(self) -> SurveyPath:
        """The survey that the next line is in."""
        return self._paths[-1]

    def read(self, path: Path) -> None:
        """Read a file; raise OldSurveyError naming file, line and value."""
        depth = len(self._paths)
        line = SourceLine(path, 0, "")
        for line in _logical(path):
            words = _words(line)
            if words:
                self._line(words, line)
        if self._in is not None:
            raise line.error("centreline has no endcentreline")
        if self._block:
            raise line.error(f"{self._block} has no end{self._block}")
        if len(self._paths) > depth:
            raise line.error(f"survey {self._names[-1]} has no endsurvey")

    def _line(self, words: list[str], line: SourceLine) -> None:
        name = words[0].lower()
        if self._block:
            if name == f"end{self._block}":
                self._block = ""
        elif self._in is not None:
            self._inside(self._in, name, words, line)
        elif name in CENTRELINES:
            north = self._norths.get(self.path)
            settings = RowSettings() if north is None else RowSettings(north=north)
            self._in = _Centreline(settings, own_north=north is not None)
        elif name == "survey":
            self._begin(words, line)
        elif name == "endsurvey":
            if len(self._paths) < 2:
                raise line.error("endsurvey without survey")
            if len(words) > 1 and words[1] != self._names[-1]:
                raise line.error(f"endsurvey {words[1]}: the survey is {self._names[-1]}")
            self._paths.pop()
            self._names.pop()
        elif name in ("input", "load"):
            self._input(words, line)
        elif name == "equate":
            self._equate(words, line)
        elif name in DRAWN:
            self._block = name
            if name in ("map", "surface", "scrap"):
                self.survey.left_out.append(f"{line.place}: {name}")
        elif name == "import":
            self.survey.left_out.append(f"{line.place}: import of {' '.join(words[1:2])}")
        elif name not in SILENT:
            raise line.error(f"{words[0]!r} is no command that a survey file has here")

    def _begin(self, words: list[str], line: SourceLine) -> None:
        if len(words) < 2:
            raise line.error("survey without a name")
        path = (*self.path, words[1])
        self._paths.append(path)
        self._names.append(words[1])
        options = dict(zip(words[2::2], words[3::2], strict=False))
        if title := options.get("-title", ""):
            self.survey.notes_of(path).title = title
        if said := options.get("-declination"):
            self._norths[path] = self._north(said.strip("[]").split(), line)
        elif path[:-1] in self._norths:
            self._norths[path] = self._norths[path[:-1]]

    def _input(self, words: list[str], line: SourceLine) -> None:
        if len(words) < 2:
            raise line.error("input without a file")
        self._deep += 1
        if self._deep > DEEPEST:
            raise line.error(f"{words[1]!r}: files take each other in more than {DEEPEST} times")
        if words[1].lower().endswith(".th2"):
            self.survey.left_out.append(f"{line.place}: drawing {words[1]}")
        else:
            self.read(beside(line, words[1], ".th"))
        self._deep -= 1

    def _equate(self, words: list[str], line: SourceLine) -> None:
        if len(words) < 3:
            raise line.error("equate needs two stations")
        self.survey.equates.append(tuple(self._full(word, line) for word in words[1:]))

    def _name(self, word: str, line: SourceLine) -> tuple[StationName, frozenset[str]]:
        if word in DASHED:
            return "", frozenset(("splay", "wall")) if word == "-" else frozenset(("splay",))
        return self._full(word, line, shots=True), frozenset()

    def _full(self, word: str, line: SourceLine, *, shots: bool = False) -> StationName:
        station, _, where = word.partition("@")
        if not station:
            raise line.error(f"station {word!r}: the name is empty")
        if shots and self._in is not None:
            station = f"{self._in.prefix}{station}{self._in.suffix}"
        return ".".join([*self.path, *(reversed(where.split(".")) if where else ()), station])

    def _north(self, words: list[str], line: SourceLine) -> North:
        if words == ["-"]:
            return North("model")
        if len(words) != 2:
            raise line.error(f"declination {' '.join(words)!r}: not a value and its unit")
        return North("true", line.number_of(words[0], "declination") * factor_of(words[1], ["declination"], line))

    def _inside(self, now: _Centreline, name: str, words: list[str], line: SourceLine) -> None:
        rest, settings = words[1:], now.settings
        if name in ("endcentreline", "endcenterline"):
            self._rows.reset()
            self._in = None
        elif name == "group":
            now.groups.append(settings)
        elif name == "endgroup":
            if not now.groups:
                raise line.error("endgroup without group")
            self._rows.reset()
            now.settings = now.groups.pop()
        elif name in CHANGES:
            now.settings = replace(CHANGES[name](settings, rest, line), north=settings.north)
        elif name == "data":
            self._data(now, rest, line)
        elif name == "date":
            when = None if not rest or rest == ["-"] else date_of(rest[0], line)
            north = North("model") if when is not None and not now.own_north else settings.north
            now.settings = replace(settings, when=when, north=north)
        elif name == "declination":
            now.own_north = True
            now.settings = replace(settings, north=self._north(rest, line))
        elif name == "grid-angle":
            value = line.number_of(rest[0], "grid-angle") if rest else 0.0
            now.settings = replace(settings, north=replace(settings.north, kind="grid", value_deg=-value))
        elif name == "flags":
            now.settings = with_flags(settings, rest, FLAGS, line)
        elif name == "cs":
            now.system = " ".join(rest)
        elif name == "fix":
            self._fix(now, rest, line)
        elif name == "equate":
            self._equate(words, line)
        elif name == "station":
            self._station(rest, line)
        elif name == "extend":
            now.settings = _extended(settings, rest)
            if len(rest) > 1:
                self.survey.notes_of(self.path).notes.append(" ".join(words))
        elif name == "station-names":
            now.prefix, now.suffix = [*rest, "", ""][:2]
        elif name in ("team", "instrument"):
            self._noted(name, rest)
        elif name not in SILENT_INSIDE:
            self._rows.take(
                [word.strip("[]") if word.startswith("[") else word for word in _sides(words)],
                settings,
                self.path,
                line,
            )

    def _data(self, now: _Centreline, rest: list[str], line: SourceLine) -> None:
        self._rows.reset()
        style = rest[0].lower() if rest else ""
        if style not in STYLES:
            raise line.error(f"data {style!r}: no such style; known: {' '.join(STYLES)}")
        columns = tuple(QUANTITIES.get(word.lower(), word.lower()) for word in rest[1:])
        if style == "cartesian":
            columns = tuple({"x": "dx", "y": "dy", "z": "dz"}.get(one, one) for one in columns)
        now.settings = replace(now.settings, style=STYLES[style], order=columns)

    def _fix(self, now: _Centreline, rest: list[str], line: SourceLine) -> None:
        numbers = [line.number_of(word, "fix") for word in rest[1:]]
        if len(numbers) not in (3, 4, 5, 6, 9):
            raise line.error(
                f"fix {' '.join(rest[:1])}: x, y and z, and standard deviations, not {len(numbers)} numbers"
            )
        x, y, z, *errors = numbers
        station = self._full(rest[0], line)
        system = now.system
        if system.lower() == "lat-long":
            system, x, y = "long-lat", y, x
        self.survey.fixes.append(OldFix(station, (x, y, z), sigmas_of_fix(errors), system, line.place))

    def _station(self, rest: list[str], line: SourceLine) -> None:
        if not rest:
            raise line.error("station without a name")
        name = self._full(rest[0], line)
        if "entrance" in rest[2:]:
            self.survey.entrances.append(name)
        if len(rest) > 1 and (said := " ".join(word for word in rest[1:] if word and word != "entrance")):
            self.survey.station_notes[name] = said

    def _noted(self, name: str, rest: list[str]) -> None:
        notes = self.survey.notes_of(self.path)
        if name == "team" and rest:
            notes.team.append(ROLES.sub(" ", rest[0]))
        elif len(rest) > 1:
            notes.instruments.append((rest[0].lower(), " ".join(rest[1:])))


def _logical(path: Path) -> Iterator[SourceLine]:
    """Yield lines without comments, those that end with a backslash joined."""
    encoding, kept = "", None
    for line in lines_of(path):
        match = re.match(r"\s*encoding\s+(\S+)", line.text)
        if match:
            encoding = match[1]
        break
    for line in lines_of(path, encoding):
        text = re.sub(r'#(?=(?:[^"]*"[^"]*")*[^"]*$).*', "", line.text)
        start = kept or SourceLine(line.path, line.number, "")
        whole = replace(start, text=f"{start.text}{text.rstrip()}")
        if text.rstrip().endswith("\\"):
            kept = replace(whole, text=whole.text[:-1] + " ")
        else:
            kept = None
            yield whole


def _words(line: SourceLine) -> list[str]:
    found = re.findall(r'"((?:[^"]|"")*)"|(\[[^\]]*\])|(\S+)', line.text)
    return [quoted.replace('""', '"') or bracket or word for quoted, bracket, word in found]


def _sides(words: list[str]) -> list[str]:
    """Return words with the first of two sides: `[2 3]` is of both ends."""
    return [
        word.strip("[]").split()[0] if word.startswith("[") and word.strip("[]").split() else word for word in words
    ]


def _extended(settings: RowSettings, rest: list[str]) -> RowSettings:
    """Return settings after `extend left|right|...`, which holds for the shots that follow."""
    return replace(settings, extend=rest[0].lower()) if len(rest) == 1 else settings


def read_th(survey: OldSurvey, path: Path, _prefix: SurveyPath) -> None:
    """Read a .th file, and what it takes in; raise OldSurveyError."""
    before = len(survey.shots)
    ThReader(survey).read(path)
    known = next((fix for fix in survey.fixes if fix.system), None)
    # Therion takes the magnetic model where dates and a place are known; else bearings are from the map's north.
    north = North() if known is None else North("model", at=(known.system, *known.position))
    for number, shot in enumerate(survey.shots[before:], before):
        if shot.north.kind == "model":
            survey.shots[number] = replace(shot, north=north)
        elif known is not None and shot.north == North():
            survey.shots[number] = replace(shot, north=North("true"))
