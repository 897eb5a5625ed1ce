"""Collect what a command could not read of its input. It goes to stderr at the end, and the exit status is 1."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Final

MAX_LINES: Final = 50


class Losses:
    """Lines for a person, each once: file, byte, loss."""

    def __init__(self) -> None:
        self._lines: dict[str, None] = {}

    def __bool__(self) -> bool:
        return bool(self._lines)

    def lines(self) -> list[str]:
        """Return the first of the lines, and how many more there are."""
        shown = list(self._lines)[:MAX_LINES]
        more = len(self._lines) - len(shown)
        return [*shown, f"and {more} more losses"] if more else shown

    def add(self, lines: Iterable[str]) -> None:
        """Add what was lost."""
        self._lines.update(dict.fromkeys(lines))


_of_commands: list[Losses] = []


@contextmanager
def collected() -> Iterator[Losses]:
    """Collect what is reported while a command runs (one command may call another)."""
    lost = Losses()
    _of_commands.append(lost)
    try:
        yield lost
    finally:
        _of_commands.remove(lost)


def report(lines: Iterable[str]) -> None:
    """Report what could not be read, a line each. Outside a command this does nothing: `Dive.losses` has it."""
    if _of_commands:
        _of_commands[-1].add(lines)
