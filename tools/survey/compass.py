"""Compass: a .dat file, in feet and degrees as that program wants them."""

from __future__ import annotations

from datetime import datetime

from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.heading import heading_of, reading_of
from buddyline.tools.survey.network import Adjusted, held_depths
from buddyline.tools.survey.project import Project

FOOT_M = 0.3048
MISSING = "-999.00"
# Bearings in degrees, lengths and passages in feet, inclinations in degrees; backsights present.
FORMAT = "DDDDLUDRLADadBF"


def dat(project: Project, adjusted: Adjusted) -> str:
    """Return .dat text; raise BuddylineError without declination or date, for which the format has no blank."""
    heading = heading_of(project, adjusted)
    if heading.angle_deg is None:
        raise BuddylineError("Compass files must state a declination, and it is not known: give [place] in the project")
    if not heading.date:
        raise BuddylineError("Compass files must state a date: give survey.date in the project")
    when = datetime.strptime(heading.date, "%Y.%m.%d")
    comment = f"{heading.title}; {heading.why}".replace("\n", " ")[:76]
    rows = [
        heading.name,
        f"SURVEY NAME: {heading.name[:12]}",
        f"SURVEY DATE: {when.month} {when.day} {when.year}  COMMENT:{comment}",
        "SURVEY TEAM:",
        ", ".join(heading.team),
        f"DECLINATION: {heading.angle_deg:7.2f}  FORMAT: {FORMAT}  CORRECTIONS:  0.00 0.00 0.00",
        "",
        "FROM TO LENGTH BEARING INC LEFT UP DOWN RIGHT AZM2 INC2 FLAGS COMMENTS",
        "",
    ]
    depths = held_depths(project)
    for line in adjusted.lines:
        reading = reading_of(line, project, depths)
        fore_deg, back_deg, remark = reading.compass_deg, reading.back_deg, reading.remark
        if fore_deg is None and back_deg is not None:
            # The format has no leg without a bearing.
            fore_deg, remark = (back_deg + 180) % 360, f"bearing by backsight; {remark}"
        angles = [MISSING if angle is None else f"{angle:.2f}" for angle in (fore_deg, back_deg)]
        rows.append(
            f"{line.leg.from_:>12} {line.leg.to:>12} {reading.tape_m / FOOT_M:.3f} {angles[0]} {reading.clino_deg:.3f} "
            f"-9.90 -9.90 -9.90 -9.90 {angles[1]} {MISSING} {remark}"
        )
    return "\r\n".join(rows) + "\r\n\f\r\n"
