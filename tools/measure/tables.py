"""Tables for people, as aligned text or as Markdown, and for programs, as JSON, CSV or TUM's trajectories."""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import TypeVar

from buddyline.protocol.clock import S_NS

Figures = TypeVar("Figures")


def text_table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as lines, in columns: the first aligned left, the others right. The head is a row like the others."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        first, *others = (cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        lines.append("  ".join([first.strip().ljust(widths[0]), *others]).rstrip())
    return "\n".join(lines)


def cells_of(rows: Iterable[Mapping[str, object]], columns: Mapping[str, str]) -> list[list[str]]:
    """Return a table's rows, the head first. columns: each one's head, and its cells as str.format takes a row."""
    return [list(columns), *([cell.format(**row) for cell in columns.values()] for row in rows)]


def markdown_row(cells: Sequence[object]) -> str:
    """Return one row of a Markdown table, for a table that is printed row by row."""
    return "| " + " | ".join(map(str, cells)) + " |"


def markdown_head(cells: Sequence[object]) -> str:
    """Return the head of a Markdown table and the line under it."""
    return f"{markdown_row(cells)}\n|{' --- |' * len(cells)}"


def markdown_table(head: Sequence[object], rows: Sequence[Sequence[object]]) -> str:
    """Return a table as Markdown."""
    return "\n".join([markdown_head(head), *map(markdown_row, rows)]) + "\n"


def csv_lines(head: Sequence[str], rows: Iterable[Sequence[object]]) -> Iterator[str]:
    """Yield a table as lines of CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for row in chain([head], rows):
        writer.writerow(row)
        yield text.getvalue()
        text.seek(0)
        text.truncate()


def tum_line(stamp_ns: int, t_m: Sequence[float], q_xyzw: Sequence[float]) -> str:
    """Return a pose as TUM's format has it: t in s, with all nine decimals that its ns have, place, quaternion."""
    seconds, rest_ns = divmod(stamp_ns, S_NS)
    return f"{seconds}.{rest_ns:09d} {' '.join(map(repr, (*t_m, *q_xyzw)))}\n"


def number(value: float | None, digits: int = 3) -> str:
    """Return a figure, or a dash if there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    """Return a share in percent, or a dash if there is none."""
    return "-" if value is None else f"{100 * value:.1f} %"


def write(figures: Figures, as_text: Callable[[Figures], str], *, as_json: bool) -> None:
    """Print figures to stdout: for a program, or for a person."""
    text = json.dumps(figures, indent=1) if as_json else as_text(figures)
    sys.stdout.write(text.rstrip("\n") + "\n")
