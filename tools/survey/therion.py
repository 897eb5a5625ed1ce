"""Therion: a centreline in diving style."""

from __future__ import annotations

import math

from buddyline.tools.survey.heading import heading_of, reading_of
from buddyline.tools.survey.network import Adjusted, fixed_points, held_depths
from buddyline.tools.survey.project import Project
from buddyline.tools.survey.survex import quoted


def centreline(project: Project, adjusted: Adjusted) -> str:
    """Return .th text; steep legs, and those without depths, are written with clino."""
    heading, grid = heading_of(project, adjusted), adjusted.grid
    depths = held_depths(project)
    lines = [
        "encoding utf-8",
        f"# {heading.why}",
        f"survey {heading.name} -title {quoted(heading.title)}",
        "  centreline",
    ]
    rows = []
    if heading.date:
        rows.append(f"date {heading.date}")
    rows += [f"team {quoted(person)}" for person in heading.team]
    rows += [f"instrument {kind} {quoted(text)}" for kind, text in heading.instruments.items() if kind in INSTRUMENTS]
    rows += [f"# {note}" for note in heading.notes]
    if grid.zone is not None:
        rows.append(f"cs UTM{grid.zone.removesuffix('N')}")
    for name, (position, _) in fixed_points(project, grid).items():
        rows.append(f"fix {name} {position[0]:.4f} {position[1]:.4f} {position[2]:.4f}")
    rows += [f"station {fix.station} {quoted('')} entrance" for fix in project.fix if fix.entrance]
    if heading.angle_deg is not None:
        rows.append(f"declination {heading.angle_deg:.4f} degrees")
    rows += ["units length depth metres", "units compass clino degrees", "calibrate depth 0 -1"]
    style = ""
    for line in adjusted.lines:
        reading = reading_of(line, project, depths)
        sds = {"length": f"{reading.tape_sigma_m:.4f} metres"}
        sds["compass"] = f"{reading.compass_sigma_deg:.3f} degrees"
        if line.by_clino:
            wanted = "data normal from to length compass backcompass clino"
            sds["clino"] = f"{math.degrees(reading.rise_sigma_m / reading.tape_m):.3f} degrees"
            last = [f"{reading.clino_deg:.3f}"]
        else:
            wanted = "data diving from to length compass backcompass fromdepth todepth"
            sds["depth"] = f"{reading.rise_sigma_m / math.sqrt(2):.4f} metres"
            last = [f"{reading.depth_from_m:.4f}", f"{reading.depth_to_m:.4f}"]
        rows += [f"sd {name} {value}" for name, value in sds.items()]
        if wanted != style:
            rows.append(wanted)
            style = wanted
        angles = ["-" if angle is None else f"{angle:.3f}" for angle in (reading.compass_deg, reading.back_deg)]
        rows.append(
            " ".join([line.leg.from_, line.leg.to, f"{reading.tape_m:.4f}", *angles, *last, f"# {reading.remark}"])
        )
    lines += [f"    {row}" for row in rows]
    return "\n".join([*lines, "  endcentreline", "endsurvey", ""])


INSTRUMENTS = ("tape", "length", "compass", "backcompass", "clino", "depth")
