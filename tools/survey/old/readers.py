"""The registry of readers: the ending of a file to what reads it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Final, TypeAlias

from buddyline.tools.survey.old.model import OldSurvey, SurveyPath
from buddyline.tools.survey.old.source import OldSurveyError

Reader: TypeAlias = Callable[[OldSurvey, Path, SurveyPath], None]

# Ending to module, function and what it is.
READERS: Final[Mapping[str, tuple[str, str, str]]] = {
    ".svx": ("svx", "read_svx", "Survex"),
    ".th": ("therion", "read_th", "Therion"),
    ".dat": ("compass", "read_dat", "Compass"),
    ".mak": ("compass", "read_mak", "Compass"),
    ".srv": ("walls", "read_srv", "Walls"),
    ".csv": ("columns", "read_csv", "a table"),
    ".txt": ("columns", "read_pockettopo", "PocketTopo"),
    ".dmp": ("mnemo", "read_dmp", "Mnemo, JedEye"),
    ".tml": ("ariane", "read_tml", "Ariane"),
}


def read_into(survey: OldSurvey, path: Path, prefix: SurveyPath = ()) -> None:
    """Add a file to a survey, below the surveys of `prefix`; raise OldSurveyError naming file, line and value."""
    known = READERS.get(path.suffix.lower())
    if known is None:
        endings = ", ".join(f"{ending} ({what})" for ending, (_, _, what) in READERS.items())
        raise OldSurveyError(f"{path}: no reader for {path.suffix!r}; known: {endings}")
    module, function, _ = known
    reader: Reader = getattr(import_module(f"buddyline.tools.survey.old.{module}"), function)
    reader(survey, path, prefix)


def read_old(path: Path) -> OldSurvey:
    """Read an old survey; raise OldSurveyError naming file, line and value."""
    survey = OldSurvey()
    read_into(survey, path)
    if not survey.shots and not survey.fixes:
        raise OldSurveyError(f"{path}: no shot in it")
    return survey
