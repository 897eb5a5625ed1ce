"""A survey as plan and as profile."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

from buddyline.tools.draw.figures import new_figure

if TYPE_CHECKING:
    from buddyline.tools.survey.network import Adjusted, Position
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LINE_COLOUR: Final = "#1f4e79"
ALARM_COLOUR: Final = "#c00000"
POINT_COLOUR: Final = "#2e7d32"
PATH_COLOUR: Final = "0.55"
# 95 % of a two-dimensional normal distribution lies within this many standard deviations.
ELLIPSE_SD: Final = 2.448
WIDTH_IN: Final = 7.8
MAX_HEIGHT_IN: Final = 10.0
NAME_PT: Final = 8.0
# A letter's width and height over its size, with a little room.
LETTER: Final = (0.68, 1.3)
# How far from its place a name may stand, in points, the nearest first.
RINGS_PT: Final = (5.0, 14.0, 24.0, 36.0, 50.0, 66.0, 84.0, 104.0)
# From here on a line leads to it.
LED_PT: Final = 10.0


def plan(adjusted: Adjusted, title: str) -> Figure:
    """Draw the survey from above, north up, with 95 % ellipses; legs with an alarm are red."""
    from matplotlib.patches import Ellipse

    stations = {name: position.position_m for name, position in adjusted.positions.items()}
    spots = [(LINE_COLOUR, list(adjusted.positions.values())), (POINT_COLOUR, adjusted.points)]
    places = [(float(p.position_m[0]), float(p.position_m[1])) for _, positions in spots for p in positions]
    figure, axis = _page(places, f"{title}: plan, {adjusted.grid.north} north up", "east, m", "north, m")
    for leg, names in adjusted.survey.stations_legs:
        ends_m = zip(*(stations[name][:2] for name in names), strict=True)
        axis.plot(*ends_m, color=ALARM_COLOUR if leg.alarms else LINE_COLOUR, linewidth=1.2)
    for path in adjusted.paths:
        for part_m in path.parts:
            axis.plot(*part_m[:, :2].T, color=PATH_COLOUR, linewidth=0.6)
    for colour, positions in spots:
        for position in positions:
            at = float(position.position_m[0]), float(position.position_m[1])
            major_m, minor_m, azimuth_rad = position.ellipse
            size_m = 2 * ELLIPSE_SD * minor_m, 2 * ELLIPSE_SD * major_m
            axis.add_patch(Ellipse(at, *size_m, angle=-math.degrees(azimuth_rad), fill=False, color="0.7", lw=0.6))
            axis.plot(*at, "x", color=colour)
    _names(figure, axis, [(one.name, _at(one)) for _, positions in spots for one in positions])
    # The plan's north is up; the bar is as long on paper as it says.
    north: dict[str, Any] = {"xytext": (0.97, 0.90), "xycoords": "axes fraction", "ha": "center", "va": "center"}
    axis.annotate("N", (0.97, 0.99), arrowprops={"arrowstyle": "->", "lw": 1.2}, annotation_clip=False, **north)
    low_m, high_m = axis.get_xlim()
    bar_m = _round_below((high_m - low_m) / 4)
    bar: dict[str, Any] = {"transform": axis.get_xaxis_transform(), "color": "black", "clip_on": False}
    left_m = low_m + 0.03 * (high_m - low_m)
    axis.plot([left_m, left_m + bar_m], [0.02, 0.02], linewidth=3, solid_capstyle="butt", **bar)
    axis.text(left_m + bar_m / 2, 0.03, f"{bar_m:g} m", ha="center", va="bottom", fontsize=NAME_PT, **bar)
    axis.set_xlim(low_m, high_m)
    return figure


def _at(position: Position) -> tuple[float, float]:
    return float(position.position_m[0]), float(position.position_m[1])


def _round_below(length_m: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is no longer."""
    power = 10.0 ** math.floor(math.log10(max(length_m, 1e-3)))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= max(length_m, 1e-3))


def profile(adjusted: Adjusted, title: str) -> Figure:
    """Draw the extended elevation: the way along the legs against altitude, each leg once.

    A leg goes to the right, or as its `extend` says: left, vertical, normal (as the leg before it), reverse (against
    that), a number (per cent of its run), ignore or hide (not drawn).
    """
    along_m: dict[str, float] = {}
    # By station, the way (1 right, -1 left) in which it was reached.
    ways: dict[str, float] = {}
    segments = []
    names: list[tuple[str, tuple[float, float]]] = []
    reach_m = 0.0
    for line in adjusted.lines:
        start_m, end_m = (adjusted.positions[name].position_m for name in (line.leg.from_, line.leg.to))
        extend, before = adjusted.survey.project.extend_of(line.leg), ways.get(line.leg.from_, 1.0)
        if extend in ("ignore", "hide"):
            continue
        share = _share(extend, before)
        begin_m = along_m.setdefault(line.leg.from_, reach_m)
        reached_m = begin_m + share * math.hypot(*(end_m - start_m)[:2].tolist())
        along_m.setdefault(line.leg.to, reached_m)
        ways.setdefault(line.leg.to, math.copysign(1.0, share) if share else before)
        reach_m = max(reach_m, reached_m)
        segments.append(((begin_m, reached_m), (float(start_m[2]), float(end_m[2])), bool(line.leg.alarms)))
        names += [] if names else [(line.leg.from_, (begin_m, float(start_m[2])))]
        names.append((line.leg.to, (reached_m, float(end_m[2]))))
    places = [place for along, altitude, _ in segments for place in zip(along, altitude, strict=True)]
    figure, axis = _page(places, f"{title}: extended elevation", "along the legs, m", "altitude, m")
    for along, altitude, alarm in segments:
        axis.plot(along, altitude, color=ALARM_COLOUR if alarm else LINE_COLOUR, linewidth=1.2)
    _names(figure, axis, names)
    return figure


def _share(extend: str, before: float) -> float:
    """Return how much of its run a leg goes to the right; before: the way of the leg before it."""
    if extend.isdecimal():
        return before * float(extend) / 100
    return {"left": -1.0, "vertical": 0.0, "reverse": -before, "normal": before}.get(extend, 1.0)


def _names(figure: Figure, axis: Axes, names: Sequence[tuple[str, tuple[float, float]]]) -> None:
    """Write names beside their places, none on another; those that stand away have a line to their place."""
    figure.draw_without_rendering()
    per_pt = figure.dpi / 72
    taken: list[tuple[float, float, float, float]] = []
    for name, at in dict(names).items():
        x, y = (float(value) / per_pt for value in axis.transData.transform(at))
        size = LETTER[0] * NAME_PT * len(name), LETTER[1] * NAME_PT
        away = next((one for one in _offsets(size) if not _meets(x + one[0], y + one[1], size, taken)), None)
        dx, dy = away or next(_offsets(size))
        taken.append((x + dx, y + dy, x + dx + size[0], y + dy + size[1]))
        far = math.hypot(max(dx, -dx - size[0], 0.0), max(dy, -dy - size[1], 0.0)) > LED_PT
        line = {"arrowstyle": "-", "lw": 0.4, "color": "0.5", "shrinkA": 0, "shrinkB": 2} if far else None
        # Otherwise a name with two dollar signs would be drawn as a formula.
        axis.annotate(
            name, at, xytext=(dx, dy), textcoords="offset points", parse_math=False, fontsize=NAME_PT, arrowprops=line
        )


def _offsets(size: tuple[float, float]) -> Iterator[tuple[float, float]]:
    """Yield where a name's lower left corner may stand, in points from its place."""
    for ring_pt in RINGS_PT:
        for x, y in ((1, 1), (-1, 1), (1, -1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1)):
            dx = ring_pt if x > 0 else -ring_pt - size[0] if x < 0 else -size[0] / 2
            dy = ring_pt if y > 0 else -ring_pt - size[1] if y < 0 else -size[1] / 2
            yield dx, dy


def _meets(x: float, y: float, size: tuple[float, float], taken: Sequence[tuple[float, float, float, float]]) -> bool:
    return any(x < right and x + size[0] > left and y < top and y + size[1] > low for left, low, right, top in taken)


def _page(places: list[tuple[float, float]], title: str, x_label: str, y_label: str) -> tuple[Figure, Axes]:
    """Return a figure of the places' (x, y) proportions, in metres with equal scales."""
    xs, ys = zip(*places, strict=True) if places else ((0.0,), (0.0,))
    width_m, height_m = max(max(xs) - min(xs), 1.0), max(max(ys) - min(ys), 1.0)
    height_in = min(max(WIDTH_IN * height_m / width_m, 1.5), MAX_HEIGHT_IN) + 1.0
    figure, (axis,) = new_figure(WIDTH_IN, height_in)
    axis.set_title(title, parse_math=False)
    axis.grid(color="0.9", linewidth=0.5)
    axis.set_axisbelow(True)
    axis.set(aspect="equal", xlabel=x_label, ylabel=y_label)
    axis.margins(0.07, 0.2 if height_m < 0.3 * width_m else 0.07)
    return figure, axis
