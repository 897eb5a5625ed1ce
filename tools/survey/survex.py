"""Survex: a survey as readings, in diving style where Survex adjusts that rightly, or as cartesian vectors."""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np
from buddyline.tools.survey.heading import Heading, Reading, heading_of, reading_of
from buddyline.tools.survey.lines import Line
from buddyline.tools.survey.network import Adjusted, fixed_points, held_depths
from buddyline.tools.survey.project import Project


def quoted(text: str) -> str:
    """Return text between quotes, which it must not hold itself."""
    return '"' + text.replace('"', "'").replace("\n", " ") + '"'


Style = Literal["auto", "diving", "normal"]


def readings(project: Project, adjusted: Adjusted, style: Style = "auto") -> str:
    """Return .svx text: tape, compass, backcompass and depths or clino, each leg with its own sds.

    auto: diving style, but the clino that follows from the depths for legs that close a loop. diving, normal: all
    legs alike, but steep ones and those without depths never in diving style.

    No Survex up to 1.4.22 adjusts diving legs rightly (datain.c, process_diving: the covariance of east and north
    has a wrong sign, and the three go on in another order than they are taken in), which bends the loops they are
    in by metres. Elsewhere covariances move nothing. Fore- and backsight have one sd, because it weighs unequal
    ones wrongly.
    """
    depths = held_depths(project)
    in_loop = {id(one.leg) for one in adjusted.residuals if one.chi2 is not None}
    body = [
        "*calibrate depth 0 -1 ; gauges read down, Survex wants altitude",
        "*units tape depth metres",
        "*units compass backcompass clino degrees",
        "*sd position 0.001 metres ; how well a node is held is in each leg's own",
    ]
    state: dict[str, str] = {}
    last = ""
    for line in adjusted.lines:
        reading = reading_of(line, project, depths)
        by_clino = line.by_clino or style == "normal" or (style == "auto" and id(line.leg) in in_loop)
        held = line.leg.from_ in depths and line.leg.to in depths and not line.by_clino
        sds = _sds(reading, by_clino, held)
        body += [f"*sd {name} {value}" for name, value in sds.items() if state.get(name) != value]
        state |= sds
        wanted = NORMAL if by_clino else DIVING
        if wanted != last:
            body.append(wanted)
            last = wanted
        body.append(_row(line, reading, by_clino))
    return _file(project, adjusted, heading_of(project, adjusted), body)


NORMAL: Final = "*data normal from to tape compass backcompass clino ignoreall"
DIVING: Final = "*data diving from to tape compass backcompass fromdepth todepth ignoreall"


def _sds(reading: Reading, by_clino: bool, held: bool) -> dict[str, str]:
    """Return a leg's sds as Survex takes them; held: its stations are held at their depths."""
    compass = f"{reading.compass_sigma_deg:.3f} degrees"
    sds = {"tape": f"{reading.tape_sigma_m:.4f} metres", "compass": compass, "backcompass": compass}
    if not by_clino:
        return sds | {"depth": f"{reading.rise_sigma_m / math.sqrt(2):.4f} metres"}
    level = math.cos(math.radians(reading.clino_deg))
    if held:
        # The rise is exact, so an error of the tape is one of the run, and none of the height. Equal sds along the
        # leg and across its slope say that: then no misclosure on the map moves a height.
        run_sigma_m = reading.tape_sigma_m / level
        clino_rad = run_sigma_m / reading.tape_m
        sds["tape"] = f"{run_sigma_m:.4f} metres"
    else:
        clino_rad = reading.rise_sigma_m / (reading.tape_m * level)
    return sds | {"clino": f"{max(math.degrees(clino_rad), 0.001):.3f} degrees"}


def _row(line: Line, reading: Reading, by_clino: bool) -> str:
    angles = [_angle(reading.compass_deg), _angle(reading.back_deg)]
    last = [f"{reading.clino_deg:+.3f}"] if by_clino else [f"{reading.depth_from_m:.4f}", f"{reading.depth_to_m:.4f}"]
    return "\t".join([line.leg.from_, line.leg.to, f"{reading.tape_m:.4f}", *angles, *last, f"; {reading.remark}"])


def _angle(angle_deg: float | None) -> str:
    return "-" if angle_deg is None else f"{angle_deg % 360:07.3f}".replace("360.000", "000.000")


def cartesian(project: Project, adjusted: Adjusted) -> str:
    """Return .svx text of full vectors, grid east, north and up; sds are each axis's own, without correlations."""
    body = [
        "; vectors are turned to the grid's north already",
        "*sd position 0.001 metres",
        "*data cartesian from to easting northing altitude ignoreall",
    ]
    for line in adjusted.lines:
        sigma = np.sqrt(np.diag(line.covariance))
        body += [f"*sd {axis} {value:.4f} metres" for axis, value in zip(("dx", "dy", "dz"), sigma, strict=True)]
        values = "\t".join(f"{value:.4f}" for value in line.vector_m)
        body.append(f"{line.leg.from_}\t{line.leg.to}\t{values}\t; n={line.leg.fixes} grade {line.leg.grade}")
    return _file(project, adjusted, heading_of(project, adjusted), body, compass=False)


def _file(project: Project, adjusted: Adjusted, heading: Heading, body: list[str], *, compass: bool = True) -> str:
    grid = adjusted.grid
    fixed = fixed_points(project, grid)
    entrances = {fix.station for fix in project.fix if fix.entrance}
    lines = [f"; {heading.title}", f"; {heading.why}", "; Buddyline; from is never swapped with to; sds are 1 sd"]
    if grid.zone is not None:
        lines += [f"*cs UTM{grid.zone}", f"*cs out UTM{grid.zone}"]
    lines += [f"*begin {heading.name}", f"*export {' '.join(fixed)}", f"*title {quoted(heading.title)}"]
    if heading.date:
        lines.append(f"*date {heading.date}")
    lines += [f"*team {quoted(person)}" for person in heading.team]
    lines += [f"*instrument {kind} {quoted(text)}" for kind, text in heading.instruments.items()]
    lines += [f"; {note}" for note in heading.notes]
    for name, (position, sigma_m) in fixed.items():
        sd = f" {sigma_m:.3f}" if sigma_m else ""
        lines.append(f"*fix {name} reference {position[0]:.4f} {position[1]:.4f} {position[2]:.4f}{sd}")
    lines += [f"*entrance {name}" for name in sorted(entrances & set(fixed))]
    if compass and heading.angle_deg is not None:
        lines.append(f"*declination {heading.angle_deg:.4f} degrees")
    for leg, why in adjusted.left_out:
        lines.append(f"; left out: {leg.name} {leg.distance_m:.2f} m, {why}")
    return "\n".join([*lines, *body, f"*end {heading.name}", ""])
