"""A finding: one result of a check."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

Level = Literal["problem", "warning", "ok", "skipped"]
WORST_FIRST: Final[tuple[Level, ...]] = ("problem", "warning", "ok", "skipped")


@dataclass(frozen=True, slots=True)
class Finding:
    """One result of a check.

    name: what it is about, such as `clock`, `node a`, `solver`, `bus`, `pair`. skipped: it cannot be checked.
    advice: what to do, "" if nothing is to be done. since_ns: None if it is not known.
    """

    name: str
    level: Level
    text: str
    advice: str = ""
    since_ns: int | None = None


def worst_first(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings by level; those of one level keep their order."""
    return sorted(findings, key=lambda finding: WORST_FIRST.index(finding.level))


def status_of(findings: Iterable[Finding]) -> int:
    """Return the exit status: 1 where anything is a problem, else 0."""
    return int(any(finding.level == "problem" for finding in findings))
