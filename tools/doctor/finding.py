"""One line of the doctor's."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Level = Literal["ok", "warning", "problem", "skipped"]


@dataclass(frozen=True, slots=True)
class Finding:
    """What was found of one thing. advice: what to do, "" where nothing is to be done; skipped: it cannot be told."""

    name: str
    level: Level
    text: str
    advice: str = ""


def status_of(findings: Iterable[Finding]) -> int:
    """Return the exit status: 1 where anything is a problem, else 0."""
    return int(any(finding.level == "problem" for finding in findings))
