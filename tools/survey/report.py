"""The survey's report: one HTML file with plan, profile, legs, loops, and all that does not fit."""

from __future__ import annotations

import html
import math
from collections.abc import Callable
from typing import Final

from buddyline.tools.draw.figures import inline_svg
from buddyline.tools.draw.survey import plan, profile
from buddyline.tools.survey.lines import SightPair, bearing_of
from buddyline.tools.survey.project import Leg
from buddyline.tools.survey.sheet import Sheet
from msgspec import UNSET

CLASS_ALARM: Final = ' class="alarm"'
STYLE: Final = (
    "body{font:14px/1.4 sans-serif;margin:2em auto;padding:0 1em;max-width:72em}table{border-collapse:collapse}"
    "td,th{border:1px solid #ccc;padding:2px 6px;text-align:right;white-space:nowrap}"
    "td:last-child{text-align:left;white-space:normal;min-width:16em}.wide{overflow-x:auto}"
    ".alarm{color:#c00000}svg{max-width:100%;height:auto}"
)


def summary(sheet: Sheet) -> list[str]:
    """Return what a person wants to know first, a line each."""
    project, adjusted = sheet.project, sheet.adjusted
    lines = [
        f"{sheet.title}: {len(adjusted.lines)} legs, {adjusted.length_m:.1f} m, {len(adjusted.positions)} stations, "
        f"{len(adjusted.points)} points",
        sheet.why,
    ]
    for loop in adjusted.loops:
        share = loop.error_m / loop.length_m if loop.length_m else 0.0
        lines.append(
            f"loop {'-'.join(loop.stations)}: {loop.length_m:.1f} m, misclosure {loop.error_m:.2f} m ({share:.2%}), "
            f"H {loop.horizontal_ratio:.2f} V {loop.vertical_ratio:.2f}"
        )
    for blunder in adjusted.blunders:
        off = "" if math.isnan(blunder.off_m) else f" by {blunder.off_m:.2f} m"
        first, *others = blunder.legs
        also = f" (or {', '.join(others)})" if others else ""
        lines.append(f"BLUNDER: leg {first}{also} is off{off}, chi2 {blunder.chi2:.0f}")
    lines += [f"left out: leg {leg.name}, {why}" for leg, why in adjusted.left_out]
    lines += [f"ALARM: leg {leg.name}: {alarm}" for leg in project.leg + project.point for alarm in leg.alarms]
    lines += [problem.text for problem in project.problem]
    if adjusted.positions:
        far = max(adjusted.positions.values(), key=lambda position: position.ellipse[0])
        major_m, minor_m, azimuth = far.ellipse
        lines.append(
            f"least certain station: {far.name}, {major_m:.2f} x {minor_m:.2f} m (1 sd) towards "
            f"{math.degrees(azimuth):.0f} deg, {far.sigmas_m[2]:.2f} m up"
        )
    return lines


# The table of legs: a column's head, and its text for a leg, its bearing (None: it has none) and its residual's chi^2.
COLUMNS: Final[dict[str, Callable[[Leg, SightPair | None, float | None], str]]] = {
    "leg": lambda leg, _b, _c: html.escape(leg.name),
    "distance m": lambda leg, _b, _c: f"{leg.distance_m:.2f} ± {leg.distance_sigma_m:.2f}",
    "foresight°": lambda leg, _b, _c: _number(leg.azimuth_deg, 1),
    "backsight°": lambda leg, _b, _c: _number(leg.back_azimuth_deg, 1),
    # Rounded first, so that there is no -0.0.
    "gap°": lambda _, bearing, _c: (
        "" if bearing is None or bearing.gap is None else f"{round(math.degrees(bearing.gap), 1) + 0.0:+.1f}"
    ),
    "± °": lambda _, bearing, _c: "" if bearing is None else f"{math.degrees(bearing.sigma):.1f}",
    "depth from": lambda leg, _b, _c: _number(leg.depth_from_m, 2),
    "depth to": lambda leg, _b, _c: _number(leg.depth_to_m, 2),
    "fixes": lambda leg, _b, _c: str(leg.fixes),
    "grade": lambda leg, _b, _c: str(leg.grade),
    "residual χ²": lambda _, _b, chi2: "" if chi2 is None else f"{chi2:.1f}",
    "alarms and notes": lambda leg, _b, _c: "<br>".join(html.escape(s) for s in [*leg.alarms, leg.note] if s),
}


def page(sheet: Sheet) -> str:
    """Return the report as one HTML file without outside requests."""
    chi2 = {id(one.leg): one.chi2 for one in sheet.adjusted.residuals}
    rows = []
    for leg in sheet.project.leg + sheet.project.point:
        given = leg, bearing_of(leg, sheet.project), chi2.get(id(leg))
        cells = "".join(f"<td>{text(*given)}</td>" for text in COLUMNS.values())
        rows.append(f"<tr{CLASS_ALARM if leg.alarms else ''}>{cells}</tr>")
    title = html.escape(sheet.title)
    facts = [sheet.date, ", ".join(sheet.team), *(f"{kind}: {text}" for kind, text in sheet.instruments.items())]
    return "\n".join(
        [
            "<!doctype html><html><head><meta charset='utf-8'>",
            "<meta name='viewport' content='width=device-width'>",
            f"<title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>",
            "<p>" + "<br>".join(html.escape(fact) for fact in [*facts, *sheet.notes] if fact) + "</p><ul>",
            *(_item(line) for line in summary(sheet)),
            "</ul>",
            inline_svg(plan(sheet.adjusted, sheet.title), "plan"),
            inline_svg(profile(sheet.adjusted, sheet.title), "profile"),
            f"<div class='wide'><table><tr>{''.join(f'<th>{name}</th>' for name in COLUMNS)}</tr>",
            *rows,
            "</table></div></body></html>",
            "",
        ]
    )


def _item(line: str) -> str:
    wrong = line.startswith(("ALARM", "BLUNDER", "left out", "NO LEG"))
    return f"<li{CLASS_ALARM if wrong else ''}>{html.escape(line)}</li>"


def _number(value: object, digits: int) -> str:
    return "" if value is UNSET else f"{value:.{digits}f}"
