"""What a command could not read of its input: said on stderr when the command ends, which then exits with 1."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

_collected: list[list[str]] = []


@contextmanager
def collected() -> Iterator[list[str]]:
    """Collect what is lost while a command runs; the list grows until then."""
    lost: list[str] = []
    _collected.append(lost)
    try:
        yield lost
    finally:
        _collected.remove(lost)


def report(lines: list[str]) -> None:
    """Say what could not be read, a line each: file, byte, loss. Whoever is not a command reads `Dive.losses`."""
    if _collected:
        _collected[-1].extend(line for line in lines if line not in _collected[-1])
