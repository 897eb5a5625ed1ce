"""What is wrong with a track's input, in words, and what no longer is."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

# A problem that is not found again for so long has ended; units are checked every 2 s.
ENDED_S: Final = 5.0
_ENDED: Final = " (ended)"


def as_ended(problems: Iterable[str]) -> list[str]:
    """Return problems in words that say that they have ended."""
    return [f"{problem.removesuffix(_ENDED)}{_ENDED}" for problem in problems]


def present(problems: Iterable[str]) -> list[str]:
    """Return the problems that last."""
    return [problem for problem in problems if not problem.endswith(_ENDED)]


class Problems:
    """Problems by kind: what they begin and end with around their colons, so that a number between may change."""

    def __init__(self) -> None:
        self._said: dict[tuple[str, str], tuple[str, float]] = {}
        self._now_s = -float("inf")

    def report(self, problem: str, t_s: float) -> None:
        """Say a problem, found at t_s."""
        parts = problem.split(":")
        kind = parts[0], parts[-1]
        # The first text stays: numbers in it would change it again and again.
        text, last_s = self._said.get(kind, (problem, t_s))
        self._said[kind] = problem if t_s - last_s > ENDED_S else text, max(last_s, t_s)
        self.pass_to(t_s)

    def pass_to(self, t_s: float) -> None:
        """Note how far the time has gone."""
        self._now_s = max(self._now_s, t_s)

    def texts(self) -> list[str]:
        """Return all problems; those that have ended say so."""
        return [f"{text}{_ENDED}" if self._now_s - last_s > ENDED_S else text for text, last_s in self._said.values()]
