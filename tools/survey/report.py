"""The survey's report: one HTML file with plan, profile, legs, loops, and all that does not fit."""

from __future__ import annotations

import html
import math

from buddyline.tools.survey.drawing import plan, profile
from buddyline.tools.survey.heading import heading_of
from buddyline.tools.survey.lines import bearing_of
from buddyline.tools.survey.network import Adjusted
from buddyline.tools.survey.project import Project
from msgspec import UNSET

CLASS_ALARM = ' class="alarm"'
STYLE = (
    "body{font:14px/1.4 sans-serif;margin:2em auto;padding:0 1em;max-width:72em}table{border-collapse:collapse}"
    "td,th{border:1px solid #ccc;padding:2px 6px;text-align:right;white-space:nowrap}"
    "td:last-child{text-align:left;white-space:normal;min-width:16em}.wide{overflow-x:auto}"
    ".alarm{color:#c00000}svg{max-width:100%;height:auto}"
)


def summary(project: Project, adjusted: Adjusted) -> list[str]:
    """Return what a person wants to know first, a line each."""
    legs = project.leg
    alarms = [(leg, alarm) for leg in legs + project.point for alarm in leg.alarms]
    heading = heading_of(project, adjusted)
    lines = [
        f"{heading.title}: {len(adjusted.lines)} legs, {adjusted.length_m:.1f} m, {len(adjusted.positions)} stations, "
        f"{len(adjusted.points)} points",
        heading.why,
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
    lines += [f"ALARM: leg {leg.name}: {alarm}" for leg, alarm in alarms]
    lines += [problem.text for problem in project.problem]
    if adjusted.positions:
        far = max(adjusted.positions.values(), key=lambda p: p.ellipse[0])
        major_m, minor_m, azimuth = far.ellipse
        lines.append(
            f"least certain station: {far.name}, {major_m:.2f} x {minor_m:.2f} m (1 sd) towards "
            f"{math.degrees(azimuth):.0f} deg, {far.up_sigma_m:.2f} m up"
        )
    return lines


def page(project: Project, adjusted: Adjusted) -> str:
    """Return the report as one HTML file without outside requests."""
    heading = heading_of(project, adjusted)
    chi2 = {id(one.leg): one.chi2 for one in adjusted.residuals}
    rows = []
    for leg in project.leg + project.point:
        bearing = bearing_of(leg, project)
        # Rounded first, so that there is no -0.0.
        gap = "" if bearing is None or bearing.gap is None else f"{round(math.degrees(bearing.gap), 1) + 0.0:+.1f}"
        value = chi2.get(id(leg))
        cells = [
            leg.name,
            f"{leg.distance_m:.2f} ± {leg.distance_sigma_m:.2f}",
            _number(leg.azimuth_deg, 1),
            _number(leg.back_azimuth_deg, 1),
            gap,
            "" if bearing is None else f"{math.degrees(bearing.sigma):.1f}",
            _number(leg.depth_from_m, 2),
            _number(leg.depth_to_m, 2),
            str(leg.fixes),
            str(leg.grade),
            "" if value is None else f"{value:.1f}",
            "<br>".join(html.escape(said) for said in [*leg.alarms, leg.note] if said),
        ]
        kind = CLASS_ALARM if leg.alarms else ""
        rows.append(f"<tr{kind}>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    names = "leg,distance m,foresight°,backsight°,gap°,± °,depth from,depth to,fixes,grade,residual χ²,alarms and notes"
    head = "".join(f"<th>{name}</th>" for name in names.split(","))
    title = html.escape(heading.title)
    facts = [heading.date, ", ".join(heading.team), *(f"{k}: {v}" for k, v in heading.instruments.items())]
    return "\n".join(
        [
            "<!doctype html><html><head><meta charset='utf-8'>",
            "<meta name='viewport' content='width=device-width'>",
            f"<title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>",
            "<p>" + "<br>".join(html.escape(fact) for fact in [*facts, *heading.notes] if fact) + "</p><ul>",
            *(_item(line) for line in summary(project, adjusted)),
            "</ul>",
            plan(adjusted, heading.title).svg(),
            profile(adjusted, heading.title).svg(),
            f"<div class='wide'><table><tr>{head}</tr>",
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
