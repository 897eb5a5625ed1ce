"""Reads Survex data (.svx), by the manual of Survex 1.4."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from buddyline.tools.survey.old.centreline import Rows
from buddyline.tools.survey.old.model import North, OldFix, OldSurvey, StationName, SurveyPath
from buddyline.tools.survey.old.row_settings import (
    CHANGES,
    NORMAL_ORDER,
    QUANTITIES,
    STYLES,
    RowSettings,
    date_of,
    factor_of,
    sigmas_of_fix,
    with_flags,
)
from buddyline.tools.survey.old.source import DEEPEST, SourceLine, beside, lines_of

CHARACTERS: Final = {
    "blank": "\t ,",
    "comment": ";",
    "decimal": ".",
    "eol": "\r\n",
    "keyword": "*",
    "minus": "-",
    "names": "_-",
    "omit": "-",
    "plus": "+",
    "root": "\\",
    "separator": ".",
}
# Commands that change nothing that is kept.
SILENT: Final = frozenset(("require", "export"))
_SIGNS: Final = {"minus": "-", "plus": "+", "decimal": "."}
FLAGS: Final = {name: name for name in ("surface", "duplicate", "splay")}


@dataclass(frozen=True)
class _Scope:
    """What *begin keeps and *end gives back."""

    path: SurveyPath = ()
    named: str = ""
    settings: RowSettings = field(default_factory=RowSettings)
    case: str = "tolower"
    truncate: int | None = None
    characters: dict[str, str] = field(default_factory=lambda: dict(CHARACTERS))
    dash_is_splay: bool = False
    began: str = ""


class SvxReader:
    """Reads one .svx file and all that it includes into a survey."""

    def __init__(self, survey: OldSurvey) -> None:
        self.survey = survey
        self._rows = Rows(survey, self._name)
        self._scope = _Scope()
        self._stack: list[_Scope] = []
        self._system = ""
        self._deep = 0
        self._roots: list[SurveyPath] = []

    def read(self, path: Path) -> None:
        """Read a file; raise OldSurveyError naming file, line and value."""
        depth = len(self._stack)
        self._roots.append(self._scope.path)
        line = SourceLine(path, 0, "")
        for line in lines_of(path):
            self._line(line)
        self._rows.reset()
        if len(self._stack) > depth:
            raise line.error(f"*begin {self._scope.named} of {self._scope.began} has no *end")
        self._roots.pop()

    def _line(self, line: SourceLine) -> None:
        comment = line.text
        for mark in self._scope.characters["comment"]:
            comment = (
                comment.split(mark)[0]
                if '"' not in comment
                else re.split(f'{mark}(?=(?:[^"]*"[^"]*")*[^"]*$)', comment)[0]
            )
        text = comment.strip(self._scope.characters["blank"] + " \t")
        if not text:
            # A line with a comment alone is not empty to Survex's traverses either.
            if not line.text.strip():
                self._rows.blank(self._scope.settings)
            return
        if text[0] in self._scope.characters["keyword"]:
            self._command(text[1:].lstrip(), line)
        else:
            self._rows.take(self._numbers(self._words(text)), self._scope.settings, self._scope.path, line)

    def _words(self, text: str) -> list[str]:
        blank = re.escape(self._scope.characters["blank"])
        found = re.findall(rf'"([^"]*)"|([^{blank}\s]+)', text)
        return [quoted or word for quoted, word in found]

    def _numbers(self, words: list[str]) -> list[str]:
        """Return words with the usual signs and decimal points."""
        own = self._scope.characters
        if all(own[name] == CHARACTERS[name] for name in ("minus", "plus", "decimal", "omit")):
            return words
        swapped = []
        for word in words:
            if word in own["omit"]:
                swapped.append("-")
                continue
            usual = {ord(one): to for name, to in _SIGNS.items() for one in own[name]}
            swapped.append(word.translate(usual) if re.fullmatch(r"[\d\W]+", word) else word)
        return swapped

    def _name(self, word: str, line: SourceLine) -> tuple[StationName, frozenset[str]]:
        separator = self._scope.characters["separator"]
        alone = word in {one * count for one in separator for count in (1, 2, 3)}
        if alone:
            return "", frozenset() if len(word) == 3 else frozenset(("splay",)) | (
                frozenset(("wall",)) if len(word) == 2 else frozenset()
            )
        if word == "-" and self._scope.dash_is_splay:
            return "", frozenset(("splay", "wall"))
        return self._full(word, line), frozenset()

    def _full(self, word: str, line: SourceLine) -> StationName:
        """Return a station's full name."""
        own = self._scope.characters
        base = self._scope.path
        if word[0] in own["root"]:
            base, word = self._roots[-1], word[1:]
        allowed = re.escape(own["names"] + own["separator"])
        if bad := re.search(rf"[^A-Za-z0-9{allowed}]", word):
            raise line.error(f"station {word!r}: {bad[0]!r} is not allowed in names")
        parts = re.split(f"[{re.escape(own['separator'])}]", word)
        if not all(parts):
            raise line.error(f"station {word!r}: a part of the name is empty")
        return ".".join([*base, *(self._cased(part) for part in parts)])

    def _cased(self, part: str) -> str:
        case = self._scope.case
        part = part.lower() if case == "tolower" else part.upper() if case == "toupper" else part
        return part[: self._scope.truncate]

    def _take(self, settings: RowSettings) -> None:
        self._scope = replace(self._scope, settings=settings)

    def _set(self, **changes: object) -> None:
        self._take(replace(self._scope.settings, **changes))  # type: ignore[arg-type]

    def _command(self, text: str, line: SourceLine) -> None:
        match = re.match(r"[A-Za-z]+", text)
        if match is None:
            raise line.error(f"'*{text}': a command has a name")
        name, rest = match[0].lower(), text[match.end() :].strip()
        words = self._words(rest)
        if name in CHANGES:
            self._take(CHANGES[name](self._scope.settings, self._numbers(words), line))
        elif (act := getattr(self, f"_do_{name}", None)) is not None:
            act(words, line)
        elif name in ("title", "team", "instrument", "copyright", "ref"):
            self._noted(name, words)
        elif name == "solve":
            self.survey.left_out.append(f"{line.place}: *solve, because all is adjusted together")
        elif name not in SILENT:
            raise line.error(f"'*{name}' is no command of Survex")

    def _noted(self, name: str, words: list[str]) -> None:
        notes = self.survey.notes_of(self._scope.path)
        said = " ".join(words)
        if name == "title":
            notes.title = said
        elif name == "team":
            notes.team.append(words[0] if words else "")
        elif name == "instrument" and len(words) > 1:
            notes.instruments.append((words[0].lower(), " ".join(words[1:])))
        else:
            notes.notes.append(f"{name} {said}")

    def _do_begin(self, words: list[str], line: SourceLine) -> None:
        self._rows.reset()
        self._stack.append(self._scope)
        path = self._scope.path
        if words:
            word = words[0]
            base = self._roots[-1] if word[0] in self._scope.characters["root"] else path
            stripped = word.lstrip(self._scope.characters["root"])
            path = (*base, *(self._cased(part) for part in stripped.split(".") if part))
        self._scope = replace(self._scope, path=path, named=words[0] if words else "", began=line.place)

    def _do_end(self, words: list[str], line: SourceLine) -> None:
        self._rows.reset()
        if not self._stack:
            raise line.error("*end without *begin")
        named = words[0] if words else ""
        if named.lower() != self._scope.named.lower():
            raise line.error(f"*end {named}: the block of {self._scope.began} is *begin {self._scope.named}")
        self._scope = self._stack.pop()

    def _do_prefix(self, words: list[str], line: SourceLine) -> None:
        self._rows.reset()
        if not words:
            raise line.error("*prefix without a survey")
        root = self._scope.characters["root"]
        base = self._roots[-1] if words[0][0] in root else self._scope.path
        parts = tuple(self._cased(part) for part in words[0].lstrip(root).split(".") if part)
        self._scope = replace(self._scope, path=(*base, *parts))

    def _do_include(self, words: list[str], line: SourceLine) -> None:
        if not words:
            raise line.error("*include without a file")
        self._rows.reset()
        self._deep += 1
        if self._deep > DEEPEST:
            raise line.error(f"{words[0]!r}: files include each other more than {DEEPEST} times")
        path, before = beside(line, words[0], ".svx"), self._scope.path
        if path.suffix.lower() == ".th":
            advice = "take this line out, `survey import` that file as well, and join both by [[equate]] in the project"
            raise line.error(f"*include {words[0]}: Therion data would stand at the root of the survey; {advice}")
        if path.suffix.lower() in (".svx", ""):
            self.read(path)
        else:
            from buddyline.tools.survey.old.readers import read_into

            read_into(self.survey, path, before)
        self._scope = replace(self._scope, path=before)
        self._deep -= 1

    def _do_data(self, words: list[str], line: SourceLine) -> None:
        self._rows.reset()
        if not words:
            return
        style = words[0].lower()
        if style not in STYLES:
            raise line.error(f"*data {words[0]}: no such style; known: {' '.join(STYLES)}")
        columns = tuple(QUANTITIES.get(word.lower(), word.lower()) for word in words[1:] if word != "-")
        self._set(style=STYLES[style], order=NORMAL_ORDER if style == "default" else columns)

    def _do_flags(self, words: list[str], line: SourceLine) -> None:
        self._take(with_flags(self._scope.settings, words, FLAGS, line))

    def _do_equate(self, words: list[str], line: SourceLine) -> None:
        if len(words) < 2:
            raise line.error("*equate needs two stations")
        self.survey.equates.append(tuple(self._full(word, line) for word in words))

    def _do_entrance(self, words: list[str], line: SourceLine) -> None:
        self.survey.entrances += [self._full(word, line) for word in words]

    def _do_fix(self, words: list[str], line: SourceLine) -> None:
        if not words:
            raise line.error("*fix without a station")
        rest = [word for word in words[1:] if word.lower() != "reference"]
        values = [line.number_of(word, "fix") for word in self._numbers(rest)]
        if len(values) not in (0, 3, 4, 5, 6, 9):
            raise line.error(f"*fix {words[0]}: x, y and z, and 1, 2 or 3 standard errors, not {len(values)} numbers")
        x, y, z = values[:3] or (0.0, 0.0, 0.0)
        fix = OldFix(self._full(words[0], line), (x, y, z), sigmas_of_fix(values[3:]), self._system, line.place)
        self.survey.fixes.append(fix)

    def _do_cs(self, words: list[str], line: SourceLine) -> None:
        if not words:
            raise line.error("*cs without a coordinate system")
        if words[0].lower() == "out":
            # As in Survex, the first one counts: so surveys with systems of their own can be included in another.
            self.survey.system = self.survey.system or " ".join(words[1:])
        else:
            self._system = " ".join(words)

    def _do_date(self, words: list[str], line: SourceLine) -> None:
        dates = [word for word in words if word[:1].isdigit()]
        self._set(when=date_of(dates[0], line) if dates else None)

    def _do_declination(self, words: list[str], line: SourceLine) -> None:
        if words and words[0].lower() == "auto":
            x, y, z = (line.number_of(word, "declination") for word in (words[1:] + ["?"] * 3)[:3])
            self._set(north=North("model", at=(self._system, x, y, z)))
        elif len(words) == 2:
            factor = factor_of(words[1], ["declination"], line)
            self._set(north=North("grid", line.number_of(words[0], "declination") * factor))
        else:
            raise line.error(f"*declination {' '.join(words)}: not `auto X Y Z`, or a value and its unit")

    def _do_default(self, words: list[str], line: SourceLine) -> None:
        self._rows.reset()
        which = {word.lower() for word in words} or {"all"}
        blank = RowSettings()
        if which & {"all", "data"}:
            self._set(style=blank.style, order=blank.order)
        if which & {"all", "units"}:
            self._set(units={}, percent=frozenset())
        if which & {"all", "calibrate"}:
            self._set(zeros={}, scales={}, north=North())

    def _do_case(self, words: list[str], line: SourceLine) -> None:
        case = words[0].lower() if words else ""
        if case not in ("preserve", "tolower", "toupper"):
            raise line.error(f"*case {case}: not preserve, tolower or toupper")
        self._scope = replace(self._scope, case=case)

    def _do_truncate(self, words: list[str], line: SourceLine) -> None:
        count = words[0].lower() if words else ""
        if count != "off" and not count.isdigit():
            raise line.error(f"*truncate {count}: not a number of characters, or off")
        self._scope = replace(self._scope, truncate=int(count) if count.isdigit() and int(count) else None)

    def _do_alias(self, words: list[str], line: SourceLine) -> None:
        if [word.lower() for word in words[:2]] != ["station", "-"]:
            raise line.error(f"*alias {' '.join(words)}: only `station - ..` is known")
        self._scope = replace(self._scope, dash_is_splay=len(words) > 2)

    def _do_set(self, words: list[str], line: SourceLine) -> None:
        name = words[0].lower() if words else ""
        if name not in CHARACTERS:
            raise line.error(f"*set {name}: no such item; known: {' '.join(CHARACTERS)}")
        said = line.text.split(words[0], 1)[1].strip()
        found = re.findall(r"[xX]([0-9A-Fa-f]{2})|(\S)", said)
        characters = "".join(chr(int(code, 16)) if code else one for code, one in found)
        self._scope = replace(self._scope, characters=self._scope.characters | {name: characters})


def read_svx(survey: OldSurvey, path: Path, _prefix: SurveyPath) -> None:
    """Read a .svx file, and what it includes; raise OldSurveyError."""
    before = len(survey.shots)
    SvxReader(survey).read(path)
    # Vectors are from the map's north, whatever the compass's.
    for number, shot in enumerate(survey.shots[before:], before):
        if shot.style == "cartesian":
            survey.shots[number] = replace(shot, north=North())
