"""HTML pages that are complete in one file: no request to any network, and no markup out of data."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Final

CSS: Final = (
    ":root{--text:#1b232b;--back:#fff;--dim:#5b6670;--line:#ccd3da;--warn:#fff3d6;--alarm:#c00000}"
    "body{font:15px/1.5 system-ui,sans-serif;max-width:1000px;margin:0 auto;padding:12px 16px;color:var(--text);"
    "background:var(--back)}h1{font-size:1.5em;margin:.3em 0}h2{font-size:1.15em;margin:1.6em 0 .4em;"
    "border-bottom:1px solid var(--line)}table{border-collapse:collapse;font-variant-numeric:tabular-nums}"
    "td,th{padding:2px 14px 2px 0;text-align:left;vertical-align:top;overflow-wrap:break-word}"
    ".scroll{overflow-x:auto}.alarm{color:var(--alarm)}.dim,figcaption{color:var(--dim);font-size:.87em}"
    ".warn{background:var(--warn);border-left:4px solid #d9a520;padding:4px 10px}svg,img{max-width:100%;height:auto}"
    # Drawings are black on white: in the dark they are turned round, hues kept.
    "@media screen and (prefers-color-scheme:dark){:root{color-scheme:dark;--text:#e3e8ed;--back:#12181f;--dim:#a3aeb9;"
    "--line:#36424e;--warn:#3d3213;--alarm:#ff7b74}svg[role=img]{filter:invert(.9) hue-rotate(180deg)}}"
    # On paper nothing can be scrolled: cells break, drawings shrink.
    "@media print{.scroll{overflow:visible}table{width:100%}td,th{overflow-wrap:anywhere;white-space:normal!important}"
    "svg,table,h2+*{break-inside:avoid}tr{break-inside:avoid}h2{break-after:avoid}}"
)
# The browser makes no request, whatever text a log contains.
_POLICY: Final = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


def page(title: str, *parts: str, css: str = "") -> str:
    """Return a whole page with its title as heading; parts: HTML."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        f"<title>{escape(title)}</title><style>{CSS}{css}</style></head>"
        f"<body><h1>{escape(title)}</h1>{''.join(parts)}</body></html>\n"
    )


def section(heading: str, *parts: str) -> str:
    """Return parts of HTML under a heading, nothing if all are empty."""
    content = "".join(parts)
    return f"<h2>{escape(heading)}</h2>{content}" if content else ""


def table(rows: Sequence[Sequence[str]], head: Sequence[str] = (), alarms: Sequence[int] = ()) -> str:
    """Return a table as HTML; rows: plain text, a line break in a cell stays one; alarms: the rows in red."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = [f"<tr>{top}</tr>"] if head else []
    for number, row in enumerate(rows):
        cells = "".join(f"<td>{escape(cell).replace(chr(10), '<br>')}</td>" for cell in row)
        lines.append(f'<tr class="alarm">{cells}</tr>' if number in alarms else f"<tr>{cells}</tr>")
    return f'<div class="scroll"><table>{"".join(lines)}</table></div>'


def data_block(name: str, data: object) -> str:
    """Return data as JSON inside a page, for programs: `<script type="application/json" id="name">`."""
    # `</script` would end the script, and after `<!--<script` its own end would not.
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="{escape(name)}">{text}</script>'


def picture(path: Path, words: str) -> str:
    """Return a PNG file inside the page, with its caption."""
    source = f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"
    return f'<figure><img alt="{escape(words)}" src="{source}"><figcaption>{escape(words)}</figcaption></figure>'
