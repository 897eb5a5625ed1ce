"""Survex and Therion: the same readings in two languages that differ in details."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Final

from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.old.systems import map_system
from buddyline.tools.survey.old.writing import (
    SVX,
    TH,
    InForce,
    Written,
    one_line,
    quoted,
    survex_system,
    svx_of,
    svx_system,
    th_of,
    therion_person,
    therion_system,
)
from buddyline.tools.survey.sheet import Reading, Sheet, remark_on


@dataclass(frozen=True)
class Language:
    """The form of a language. command, comment: their first characters; ending: closes a list of columns."""

    command: str
    comment: str
    tape: str
    gap: str
    ending: str = ""
    back_sd: bool = False
    # Whether the program itself can correct readings; if not, they are written corrected.
    corrects: bool = True
    # Whether the program itself turns from true north to the north of a coordinate system.
    turns: bool = False

    @property
    def normal(self) -> str:
        """The columns of legs with an inclination."""
        return f"{self.command}data normal from to {self.tape} compass backcompass clino{self.ending}"

    @property
    def diving(self) -> str:
        """The columns of legs with two depths."""
        return f"{self.command}data diving from to {self.tape} compass backcompass fromdepth todepth{self.ending}"

    def data(self, sheet: Sheet, readings: Iterable[Reading], by_clino: Callable[[Reading], bool]) -> Iterator[str]:
        """Yield every leg's row, after the standard deviations and column names if they have changed."""
        state = InForce()
        for as_read in readings:
            reading = as_read if self.corrects else corrected(as_read)
            clino = by_clino(reading)
            now = {f"{self.command}sd {name}": value for name, value in self._sds(reading, clino).items()}
            if sheet.north_known:
                north_deg = reading.declination_deg if self.turns else reading.turn_deg
                now[f"{self.command}declination"] = f"{north_deg + 0.0:.3f} degrees"
            off_deg, back_deg = reading.off_deg
            for name, read_too_much in (("compass", off_deg), ("backcompass", back_deg)):
                if round(read_too_much, 3) or f"{self.command}calibrate {name}" in state:
                    now[f"{self.command}calibrate {name}"] = f"{read_too_much + 0.0:.3f}"
            if abs(reading.scale - 1) > 1e-6 or f"{self.command}calibrate {self.tape}" in state:
                now[f"{self.command}calibrate {self.tape}"] = f"0 {reading.scale:.6f}"
            now[self.normal if clino else self.diving] = ""
            yield from state.lines(now, f"{self.command}data")
            rise = [reading.clino_deg] if clino else [reading.depth_from_m, reading.depth_to_m]
            numbers = [f"{value:+.3f}" if clino else f"{value:.4f}" for value in rise]
            angles = [self._angle(angle) for angle in (reading.compass_deg, reading.back_deg)]
            ends, remark = (reading.leg.from_, reading.leg.to), f"{self.comment} {reading.remark}"
            yield self.gap.join([*ends, f"{reading.distance_m:.4f}", *angles, *numbers, remark])

    def _sds(self, reading: Reading, clino: bool) -> dict[str, str]:
        line, distance_m = reading.line, reading.distance_m
        tape_m, level = line.measures.distance[1], math.cos(math.radians(reading.clino_deg))
        if not clino:
            rise = {"depth": f"{line.rise_sigma_m / math.sqrt(2):.4f} metres"}
        else:
            clino_rad = line.rise_sigma_m / (distance_m * level)
            if reading.held:
                # The rise is exact, so an error of the tape is one of the run, and none of the height. Equal sds
                # along the leg and across its slope say that: then no misclosure on the map moves a height.
                tape_m = line.run_sigma_m
                clino_rad = tape_m / distance_m
            rise = {"clino": f"{max(math.degrees(clino_rad), 0.001):.3f} degrees"}
        compass = f"{reading.compass_sigma_deg:.3f} degrees"
        back = {"backcompass": compass} if self.back_sd else {}
        return {self.tape: f"{tape_m:.4f} metres", "compass": compass} | back | rise

    def unplaced(self, sheet: Sheet) -> Iterator[str]:
        """Yield the legs that make no vector: as lines between stations, with the distance in the remark."""
        if sheet.undirected:
            yield f"{self.command}data nosurvey from to"
        for leg in sheet.undirected:
            ends = [sheet.local(leg.from_), sheet.local(leg.to)]
            yield self.gap.join([*ends, f"{self.comment} {leg.distance_m:.4f} m {remark_on(leg)}"])

    def fix(self, name: str, position_m: Floats, sigmas_m: Floats) -> str:
        """Return the line of a fixed station."""
        # Without correlations Survex takes standard deviations of both axes on the map, and of height.
        shown = [sigmas_m[0], sigmas_m[2]] if self is SURVEX else sigmas_m
        sds = [f"{max(one, 0.001):.3f}" for one in shown] if sigmas_m.any() else []
        return " ".join([f"{self.command}fix {name}", *(f"{one:.4f}" for one in position_m), *sds])

    @staticmethod
    def _angle(angle_deg: float | None) -> str:
        return "-" if angle_deg is None else f"{angle_deg % 360:07.3f}".replace("360.000", "000.000")


SURVEX: Final = Language("*", ";", "tape", "\t", " ignoreall", back_sd=True)
# Therion's `calibrate` knows no backcompass.
THERION: Final = Language("", "#", "length", " ", corrects=False, turns=True)
THERION_INSTRUMENTS: Final = ("tape", "length", "compass", "backcompass", "clino", "depth")


def coordinate_system(sheet: Sheet) -> str:
    """Return the map grid as both languages name it; empty without one."""
    projection = sheet.adjusted.grid.projection
    return "" if projection is None else f"EPSG:{projection.epsg}"


def corrected(reading: Reading) -> Reading:
    """Return a reading with what the instruments are found to be off taken off, and what was read in its remark."""
    if not any(round(off, 3) for off in reading.off_deg) and abs(reading.scale - 1) <= 1e-6:
        return reading
    fore, back = (
        None if read is None else read - off
        for read, off in zip((reading.compass_deg, reading.back_deg), reading.off_deg, strict=True)
    )
    return _reread(reading, "corrected", reading.distance_m * reading.scale, fore, back)


def _adjusted(sheet: Sheet, reading: Reading) -> Reading:
    """Return a leg's reading as it would be between the adjusted stations."""
    leg = reading.leg
    start, end = (sheet.adjusted.positions[name].position_m for name in (leg.from_, leg.to))
    east_m, north_m, up_m = (end - start).tolist()
    ahead_deg = math.degrees(math.atan2(east_m, north_m)) - reading.turn_deg
    distance_m = math.hypot(east_m, north_m, up_m)
    fore = None if reading.compass_deg is None else ahead_deg
    back = None if reading.back_deg is None else ahead_deg + 180
    changed = replace(reading, clino_deg=math.degrees(math.asin(up_m / distance_m)))
    return _reread(changed, "adjusted", distance_m, fore, back)


def _reread(reading: Reading, how: str, distance_m: float, fore: float | None, back: float | None) -> Reading:
    """Return a reading with another distance and other angles that need no correction, and in its remark the read."""
    read = [f"{reading.leg.distance_m:.3f} m"]
    read += [f"{angle:.2f}" for angle in (reading.compass_deg, reading.back_deg) if angle is not None]
    return replace(
        reading,
        distance_m=distance_m,
        compass_deg=fore,
        back_deg=back,
        off_deg=(0.0, 0.0),
        scale=1.0,
        remark=f"{how}, read {' '.join(read)}; {reading.remark}",
    )


def svx(sheet: Sheet, style: str = "auto") -> str:
    """Return .svx text: tape, compass, backcompass and depths or clino, each leg with its own sds.

    auto: diving style, but for legs that close a loop the clino that follows from the depths. diving, normal: all
    legs alike, but steep ones and those without depths never in diving style.

    No Survex up to 1.4.22 adjusts diving legs correctly (datain.c, process_diving: the covariance of east and north
    has a wrong sign, and the three are passed on in another order than they are read), which bends loops by metres.
    Outside of loops covariances move nothing. Foresight and backsight have one sd, because Survex weighs unequal
    ones wrongly.
    """

    def by_clino(reading: Reading) -> bool:
        return reading.by_clino or style == "normal" or (style == "auto" and reading.looped)

    body = [
        "*calibrate depth 0 -1 ; gauges read down, Survex wants altitude",
        "*units tape depth metres",
        "*units compass backcompass clino degrees",
        "*sd position 0.001 metres ; how well a node is held is in each leg's own",
        *SURVEX.data(sheet, map(sheet.renamed, sheet.readings), by_clino),
        *SURVEX.unplaced(sheet),
        *(row for sections in sheet.passages for row in SVX.sections(sections, sheet.local)),
    ]
    return _svx_file(sheet, body)


def svx_cartesian(sheet: Sheet) -> str:
    """Return .svx text of full vectors, grid east, north and up; sds are each axis's own, without correlations."""
    body = [
        "; vectors are turned to the grid's north already",
        "*sd position 0.001 metres",
        "*data cartesian from to easting northing altitude ignoreall",
    ]
    for line in (reading.line for reading in sheet.readings):
        for i, axis in enumerate(("dx", "dy", "dz")):
            body.append(f"*sd {axis} {math.sqrt(line.covariance[i, i]):.4f} metres")
        values = "\t".join(f"{value:.4f}" for value in line.vector_m)
        ends = "\t".join(map(sheet.local, (line.leg.from_, line.leg.to)))
        body.append(f"{ends}\t{values}\t; n={line.leg.fixes} grade {line.leg.grade}")
    return _svx_file(sheet, [*body, *SURVEX.unplaced(sheet)])


def _svx_file(sheet: Sheet, body: list[str]) -> str:
    fixed, grid = sheet.own_fixed, coordinate_system(sheet)
    lines = [
        f"; {sheet.title}",
        f"; {sheet.why}",
        "; Buddyline; from is never swapped with to; sds are 1 sd",
        "*case preserve",
        *([f"*cs {grid}", f"*cs out {grid}"] if grid else []),
        f"*begin {sheet.name}",
        # Where one survey states its exports, Survex expects them of all.
        *([f"*export {' '.join(fixed)}"] if not sheet.olds else []),
        f"*title {quoted(sheet.title)}",
        *([f"*date {sheet.date}"] if sheet.date else []),
        *(f"*team {quoted(person)}" for person in sheet.team),
        *(f"*instrument {kind} {quoted(text)}" for kind, text in sheet.instruments.items()),
        *(f"; {note}" for note in sheet.notes),
    ]
    lines += [SURVEX.fix(name, *at) for name, at in fixed.items()]
    lines += [f"*entrance {name}" for name in sorted(sheet.entrances) if name in fixed]
    own_legs = sheet.readings or sheet.undirected
    lines += [f"; left out: {leg.name} {leg.distance_m:.2f} m, {one_line(why)}" for leg, why in sheet.adjusted.left_out]
    if sheet.olds and not own_legs:
        return "\n".join([*lines[: lines.index(f"*begin {sheet.name}")], *_svx_olds(sheet, grid), ""])
    return "\n".join([*lines, *body, f"*end {sheet.name}", *_svx_olds(sheet, grid), ""])


def _svx_olds(sheet: Sheet, grid: str) -> Iterator[str]:
    """Yield the old surveys as they were read, each in a block of its own, and what joins them to this one."""
    olds = [svx_of(old, grid, sheet.grid_turn_deg) for old in sheet.olds]
    for number, written in enumerate(olds):
        if not grid and not number:
            yield from svx_system(sheet.olds[0])
        yield from ["*begin", *written.lines, "*end"]
    joints, fixes = _joints(sheet, olds, SURVEX, lambda name: f"{sheet.name}.{sheet.local(name)}")
    system = map_system(sheet.olds[0]) if olds and not grid else ""
    yield from [*joints, *[f"*cs {survex_system(system)}"] * bool(fixes and system), *fixes]


def _joints(sheet: Sheet, olds: list[Written], to: Language, own: Callable[[str], str]) -> tuple[list[str], list[str]]:
    """Return what joins old surveys to this one, and stations that must be told where they are.

    own: the name that the file has for a station of this one.
    """
    name_of = {name: one.name(name) for old, one in zip(sheet.olds, olds, strict=True) for name in old.stations}

    def named(name: str) -> str:
        return name_of.get(name) or own(name)

    fixes = [to.fix(named(name), *at) for name, at in sheet.held.items()] if sheet.olds else []
    return [f"{to.command}equate {' '.join(map(named, same))}" for same in sheet.joints], fixes


def th(sheet: Sheet, style: str = "auto") -> str:
    """Return .th text: a centreline in diving style; steep legs, and those without depths, with a clino.

    auto: legs that close a loop are written as adjusted, with what was read in the remark. Therion 6 hands Survex
    each leg's standard deviations by axis, without their correlations, which bends loops of readings by decimetres.
    diving: as read.
    """
    readings = [
        sheet.renamed(_adjusted(sheet, one) if style == "auto" and one.looped else one) for one in sheet.readings
    ]
    grid = coordinate_system(sheet)
    rows = [
        *([f"date {sheet.date}"] if sheet.date else []),
        *(f"team {therion_person(person)}" for person in sheet.team),
        *(
            f"instrument {kind} {quoted(what)}"
            for kind, what in sheet.instruments.items()
            if kind in THERION_INSTRUMENTS
        ),
        *(f"# {note}" for note in sheet.notes),
        *([f"cs {grid}"] if grid else []),
        *(THERION.fix(name, *at) for name, at in sheet.own_fixed.items()),
        *(f'station {name} "" entrance' for name in sheet.entrances if name in sheet.own_fixed),
        "units length depth metres",
        "units compass clino degrees",
        "calibrate depth 0 -1",
        *THERION.data(sheet, readings, lambda reading: reading.by_clino),
        *THERION.unplaced(sheet),
        *(row for sections in sheet.passages for row in TH.sections(sections, sheet.local)),
    ]
    head = ["encoding utf-8", f"# {sheet.why}", f"survey {sheet.name} -title {quoted(sheet.title)}", "  centreline"]
    body = [*head, *(f"    {row}" for row in rows), "  endcentreline", "endsurvey"]
    return "\n".join(
        [*(body if readings or sheet.undirected or not sheet.olds else head[:2]), *_th_olds(sheet, grid), ""]
    )


def _th_olds(sheet: Sheet, grid: str) -> Iterator[str]:
    olds = [th_of(old, grid, sheet.grid_turn_deg) for old in sheet.olds]
    for written in olds:
        yield from written.lines
    joints, fixes = _joints(sheet, olds, THERION, lambda name: f"{sheet.local(name)}@{sheet.name}")
    yield from joints
    system = therion_system(map_system(sheet.olds[0])) if olds and not grid else grid
    if fixes:
        yield from ["centreline", *[f"  cs {system}"] * bool(system), *(f"  {one}" for one in fixes), "endcentreline"]
