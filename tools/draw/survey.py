"""A survey as plan and as profile."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from buddyline.tools.draw.figures import new_figure

if TYPE_CHECKING:
    from buddyline.tools.survey.network import Adjusted
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LINE_COLOUR: Final = "#1f4e79"
ALARM_COLOUR: Final = "#c00000"
POINT_COLOUR: Final = "#2e7d32"
# 95 % of a two-dimensional normal distribution lies within this many standard deviations.
ELLIPSE_SD: Final = 2.448
WIDTH_IN: Final = 7.8
MAX_HEIGHT_IN: Final = 10.0


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
    for colour, positions in spots:
        for position in positions:
            at = float(position.position_m[0]), float(position.position_m[1])
            major_m, minor_m, azimuth_rad = position.ellipse
            size_m = 2 * ELLIPSE_SD * minor_m, 2 * ELLIPSE_SD * major_m
            axis.add_patch(Ellipse(at, *size_m, angle=-math.degrees(azimuth_rad), fill=False, color="0.7", lw=0.6))
            axis.plot(*at, "x", color=colour)
            _name(axis, position.name, at)
    return figure


def profile(adjusted: Adjusted, title: str) -> Figure:
    """Draw the survey unrolled: the way along the legs against altitude, each leg once."""
    along_m: dict[str, float] = {}
    segments = []
    names: list[tuple[str, tuple[float, float]]] = []
    reach_m = 0.0
    for line in adjusted.lines:
        start_m, end_m = (adjusted.positions[name].position_m for name in (line.leg.from_, line.leg.to))
        begin_m = along_m.setdefault(line.leg.from_, reach_m)
        reached_m = begin_m + math.hypot(*(end_m - start_m)[:2].tolist())
        along_m.setdefault(line.leg.to, reached_m)
        reach_m = max(reach_m, reached_m)
        segments.append(((begin_m, reached_m), (float(start_m[2]), float(end_m[2])), bool(line.leg.alarms)))
        names += [] if names else [(line.leg.from_, (begin_m, float(start_m[2])))]
        names.append((line.leg.to, (reached_m, float(end_m[2]))))
    places = [place for along, altitude, _ in segments for place in zip(along, altitude, strict=True)]
    figure, axis = _page(places, f"{title}: profile, unrolled along the legs", "along the legs, m", "altitude, m")
    for along, altitude, alarm in segments:
        axis.plot(along, altitude, color=ALARM_COLOUR if alarm else LINE_COLOUR, linewidth=1.2)
    for name, at in names:
        _name(axis, name, at)
    return figure


def _name(axis: Axes, name: str, at: tuple[float, float]) -> None:
    # Otherwise a name with two dollar signs would be drawn as a formula.
    axis.annotate(name, at, xytext=(4, 3), textcoords="offset points", parse_math=False)


def _page(places: list[tuple[float, float]], title: str, x_label: str, y_label: str) -> tuple[Figure, Axes]:
    """Return a figure of the places' (x, y) proportions, in metres with equal scales."""
    xs, ys = zip(*places, strict=True) if places else ((0.0,), (0.0,))
    width_m, height_m = max(max(xs) - min(xs), 1.0), max(max(ys) - min(ys), 1.0)
    height_in = min(max(WIDTH_IN * height_m / width_m, 1.5), MAX_HEIGHT_IN) + 1.0
    figure, (axis,) = new_figure(WIDTH_IN, height_in)
    axis.set_title(title, parse_math=False)
    axis.set(aspect="equal", xlabel=x_label, ylabel=y_label)
    axis.margins(0.07, 0.2 if height_m < 0.3 * width_m else 0.07)
    return figure, axis
