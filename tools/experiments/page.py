"""The report: one HTML page that needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

_CSS: Final = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:1000px;margin:0 auto;padding:12px 16px;color:#1b232b}"
    "table{border-collapse:collapse;font-variant-numeric:tabular-nums}td,th{padding:3px 12px 3px 0;text-align:left;"
    "border-bottom:1px solid #dde3e9}img{max-width:100%}h2{margin-top:1.6em}"
)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as HTML."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{top}</tr>{body}</table>"


def picture(path: Path, words: str) -> str:
    """Return a PNG inside the page, with words for those who do not see it."""
    data = base64.b64encode(path.read_bytes()).decode()
    image = f'<img alt="{escape(words)}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{escape(words)}</figcaption></figure>"


def page(title: str, sections: Sequence[tuple[str, str]]) -> str:
    """Return the page; sections: headings and their HTML."""
    body = "".join(f"<h2>{escape(heading)}</h2>{content}" for heading, content in sections)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{escape(title)}</title><style>{_CSS}</style><h1>{escape(title)}</h1>{body}</html>\n"
    )


def number(value: Any, digits: int = 3) -> str:
    """Return a figure, or a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}" if isinstance(value, float) else str(value)


def pair_rows(pairs: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> list[list[str]]:
    """Return the rows of the table of right pairs."""
    return [
        [
            method,
            environment.replace("_", " "),
            str(row["visible"]),
            *(number(None if row[key] is None else 100 * row[key], 1) for key in ("right_share", "right_of_poses")),
            str(row["other_pair"]),
            str(row["wrong"]),
        ]
        for method, rows in pairs.items()
        for environment, row in rows.items()
    ]
