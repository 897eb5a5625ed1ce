"""What a terminal understands, beyond text."""

from __future__ import annotations

from collections.abc import Iterable


def overwritten(lines: Iterable[str]) -> str:
    """Return lines that overwrite the last screen, line by line: a screen that is cleared first flickers."""
    return "\x1b[H" + "\x1b[K\n".join(lines) + "\x1b[K\x1b[J"
