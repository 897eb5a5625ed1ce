"""What is wrong with a track's input, in words, and what no longer is."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

# A problem that is not found again for so long has ended; units are checked every 2 s.
ENDED_S: Final = 5.0
_ENDED: Final = " (ended)"
_FIGURE: Final = re.compile(r"[-+]?\d+(\.\d+)?")


def as_ended(problems: Iterable[str]) -> list[str]:
    """Return problems in words that say that they have ended."""
    return [f"{problem.removesuffix(_ENDED)}{_ENDED}" for problem in problems]


def present(problems: Iterable[str]) -> list[str]:
    """Return the problems that last."""
    return [problem for problem in problems if not problem.endswith(_ENDED)]


def kind_of(problem: str) -> tuple[str, str]:
    """Return what a problem is of: its nodes, whose ids may have digits, and its text behind them without figures."""
    nodes, _, text = problem.removesuffix(_ENDED).partition(":")
    return nodes, _FIGURE.sub("#", text)


def merged(problems: Iterable[str]) -> list[str]:
    """Return the last problem of each kind, in the order of the kinds' first ones."""
    return list({kind_of(problem): problem for problem in problems}.values())


class Problems:
    """Problems by kind, each with its newest figures."""

    def __init__(self) -> None:
        self._said: dict[tuple[str, str], tuple[str, float]] = {}
        self._now_s = -float("inf")

    def report(self, problem: str, t_s: float) -> None:
        """Say a problem, found at t_s."""
        kind = kind_of(problem)
        said, last_s = self._said.get(kind, (problem, t_s))
        self._said[kind] = (problem, t_s) if t_s >= last_s else (said, last_s)
        self.pass_to(t_s)

    def pass_to(self, t_s: float) -> None:
        """Note how far the time has gone."""
        self._now_s = max(self._now_s, t_s)

    def texts(self) -> list[str]:
        """Return all problems; those that have ended say so."""
        return [f"{text}{_ENDED}" if self._now_s - last_s > ENDED_S else text for text, last_s in self._said.values()]
