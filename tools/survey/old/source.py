"""Lines of a text file, and errors that name file, line and value."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from buddyline.protocol.errors import BuddylineError

# Old files are in many encodings; the last of these decodes anything.
ENCODINGS: Final = ("utf-8-sig", "cp1252", "latin-1")
DEEPEST: Final = 50


class OldSurveyError(BuddylineError):
    """A file of an old survey cannot be read: file, line and value are in the text."""


@dataclass(frozen=True)
class SourceLine:
    """A line of a file, with its number from 1."""

    path: Path
    number: int
    text: str

    @property
    def place(self) -> str:
        """File and line, for errors and remarks."""
        return f"{self.path.name}:{self.number}"

    def error(self, text: str) -> OldSurveyError:
        """Return an error at this line."""
        return OldSurveyError(f"{self.path}:{self.number}: {text}")

    def number_of(self, word: str, what: str) -> float:
        """Return a word as a finite number; raise OldSurveyError."""
        try:
            value = float(word)
        except ValueError:
            raise self.error(f"{what}: {word!r} is not a number") from None
        if not abs(value) < 1e12:
            raise self.error(f"{what}: {word!r} is out of range")
        return value


def text_of(path: Path, encoding: str = "") -> str:
    """Return a file's text; raise OldSurveyError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise OldSurveyError(f"{path}: cannot be read: {error.strerror}") from error
    if b"\0" in data:
        raise OldSurveyError(f"{path}: byte {data.index(0)} is zero: this is no text file")
    for one in (encoding, *ENCODINGS) if encoding else ENCODINGS:
        try:
            return data.decode(one)
        except (UnicodeDecodeError, LookupError):
            continue
    raise AssertionError("latin-1 decodes anything")


def lines_of(path: Path, encoding: str = "") -> Iterator[SourceLine]:
    """Yield a file's lines without their ends; raise OldSurveyError."""
    text = text_of(path, encoding).replace("\r\n", "\n").replace("\r", "\n")
    # DOS programs end a text with this character.
    if text.rstrip("\n").endswith("\x1a"):
        text = text.rstrip("\n\x1a") + "\n"
    for number, line in enumerate(text.split("\n"), 1):
        yield SourceLine(path, number, line)


def beside(line: SourceLine, name: str, ending: str, exists: Callable[[Path], bool] = Path.is_file) -> Path:
    """Return the file that a line names, relative to its own; raise OldSurveyError if there is none."""
    wanted = line.path.parent / name.replace("\\", "/")
    tried = [wanted, wanted.with_name(wanted.name + ending), wanted.with_name((wanted.name + ending).lower())]
    for one in [*tried, wanted.with_name(wanted.name.lower())]:
        if exists(one):
            return one
    raise line.error(f"{name!r}: no such file beside {line.path}")
