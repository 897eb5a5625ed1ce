"""The survey's report: one HTML file with plan, profile, legs, loops, and all contradictions."""

from __future__ import annotations

import math
from collections.abc import Callable
from html import escape
from typing import Final

from buddyline.tools.draw import page as html
from buddyline.tools.draw.figures import inline_svg
from buddyline.tools.draw.survey import plan, profile
from buddyline.tools.survey.lines import SightPair, bearing_of
from buddyline.tools.survey.network import Adjusted
from buddyline.tools.survey.project import Leg
from buddyline.tools.survey.sheet import Sheet
from msgspec import UNSET

# An instrument's error is said from this many sd on.
SHOWN_SIGMAS: Final = 3.0
# Numbers are aligned to the right, words to the left.
CSS: Final = (
    "td,th{text-align:right;white-space:nowrap}td:last-child{text-align:left;white-space:normal;min-width:16em}"
)


def summary(sheet: Sheet) -> list[str]:
    """Return the summary: lengths, loops, blunders and alarms, a line each."""
    project, adjusted = sheet.project, sheet.adjusted
    lines = [
        f"{sheet.title}: {len(adjusted.survey.stations_legs)} legs, {adjusted.length_m:.1f} m, "
        f"{len(adjusted.positions)} stations, {len(adjusted.points)} points",
        sheet.why,
    ]
    for loop in adjusted.loops:
        share = loop.error_m / loop.length_m if loop.length_m else 0.0
        lines.append(
            f"loop {'-'.join(loop.stations)}: {loop.length_m:.1f} m, misclosure {loop.error_m:.2f} m ({share:.2%}), "
            f"H {loop.horizontal_ratio:.2f} V {loop.vertical_ratio:.2f}"
        )
    lines += tests_of(adjusted)
    lines += [f"BLUNDER: {blunder.text}" for blunder in adjusted.blunders]
    lines += [f"QUESTION: {one.text}" for one in adjusted.proposals]
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


def tests_of(adjusted: Adjusted) -> list[str]:
    """Return the global test, and what the instruments are found to be off, where the survey shows it."""
    fit = adjusted.fit
    lines = [f"adjustment: {fit.verdict}"]
    for name, (value, sigma, unit) in fit.instruments.items():
        if abs(value) > SHOWN_SIGMAS * sigma:
            lines.append(f"{name}: {value:+.2f} {unit}, sd {sigma:.2f}; taken off")
    return lines


# The table of legs: a column's head, and its text for a leg, its bearing (None: it has none) and its residual's chi^2.
COLUMNS: Final[dict[str, Callable[[Leg, SightPair | None, float | None], str]]] = {
    "leg": lambda leg, _b, _c: leg.name,
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
    "alarms and notes": lambda leg, _b, _c: "\n".join(said for said in [*leg.alarms, leg.note] if said),
}


def page(sheet: Sheet) -> str:
    """Return the report as one HTML file without outside requests."""
    chi2 = {id(one.leg): one.chi2 for one in sheet.adjusted.residuals}
    legs = sheet.project.leg + sheet.project.point
    rows = []
    for leg in legs:
        bearing = bearing_of(leg, sheet.project)
        rows.append([text(leg, bearing, chi2.get(id(leg))) for text in COLUMNS.values()])
    facts = [sheet.date, ", ".join(sheet.team), *(f"{kind}: {text}" for kind, text in sheet.instruments.items())]
    return html.page(
        sheet.title,
        "<p>" + "<br>".join(escape(fact) for fact in [*facts, *sheet.notes] if fact) + "</p>",
        "<ul>" + "".join(_item(line) for line in summary(sheet)) + "</ul>",
        inline_svg(plan(sheet.adjusted, sheet.title), "plan"),
        inline_svg(profile(sheet.adjusted, sheet.title), "profile"),
        html.table(rows, list(COLUMNS), [number for number, leg in enumerate(legs) if leg.alarms]),
        css=CSS,
    )


def _item(line: str) -> str:
    wrong = line.startswith(("ALARM", "BLUNDER", "left out", "NO LEG"))
    return f"<li class='alarm'>{escape(line)}</li>" if wrong else f"<li>{escape(line)}</li>"


def _number(value: object, digits: int) -> str:
    return "" if value is UNSET else f"{value:.{digits}f}"
