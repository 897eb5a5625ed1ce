"""Plots as SVG text: points and lines with gaps, bands where something is missing, axes with round ticks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Final

MARGIN_LEFT: Final = 46
MARGIN_RIGHT: Final = 10
MARGIN_TOP: Final = 20
MARGIN_BOTTOM: Final = 24
COLOURS: Final = ("#f2a93b", "#4fb3d9", "#8bd17c", "#d97ba6")


@dataclass(frozen=True)
class Line:
    """One curve: (x, y) pairs; None breaks the line."""

    name: str
    points: Sequence[tuple[float, float] | None]
    colour: str = COLOURS[0]
    dots: bool = False


@dataclass(frozen=True)
class Plot:
    """One plot; bands: stretches of x that are marked, with their colour; equal: one scale for x and y."""

    title: str
    unit: str
    lines: Sequence[Line]
    x_range: tuple[float, float] | None = None
    bands: Sequence[tuple[float, float, str]] = field(default_factory=tuple)
    x_title: str = ""
    equal: bool = False
    y_down: bool = False
    width: int = 460
    height: int = 130


def ticks(low: float, high: float, count: int) -> list[float]:
    """Return round values between low and high, about count of them."""
    span = high - low
    if not (math.isfinite(span) and span > 0):
        return [low]
    step = 10.0 ** math.floor(math.log10(span / count))
    step *= next(factor for factor in (1, 2, 5, 10, 20) if span / (step * factor) <= count)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 10) for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _range(values: list[float], least: float) -> tuple[float, float]:
    if not values:
        return 0.0, 1.0
    low, high = min(values), max(values)
    pad = max(0.08 * (high - low), 0.5 * (least - (high - low)), 0.0)
    return low - pad, high + pad


def _tick_text(value: float) -> str:
    return f"{value:g}".replace("-", "\N{MINUS SIGN}")


def svg(plot: Plot) -> str:
    """Return a plot as an <svg> element that scales with its surroundings."""
    points = [point for line in plot.lines for point in line.points if point is not None]
    x_low, x_high = plot.x_range or _range([x for x, _ in points], 1e-3)
    inside = [y for x, y in points if x_low <= x <= x_high]
    y_low, y_high = _range(inside, 0.02 * max((abs(y) for y in inside), default=0.0) + 1e-3)
    left, top = MARGIN_LEFT, MARGIN_TOP
    across, down = plot.width - left - MARGIN_RIGHT, plot.height - top - MARGIN_BOTTOM
    if plot.equal:
        per_px = max((x_high - x_low) / across, (y_high - y_low) / down)
        x_low, x_high = _widened(x_low, x_high, per_px * across)
        y_low, y_high = _widened(y_low, y_high, per_px * down)

    def x_px(x: float) -> float:
        return left + (x - x_low) / max(x_high - x_low, 1e-12) * across

    def y_px(y: float) -> float:
        share = (y - y_low) / max(y_high - y_low, 1e-12)
        return top + (share if plot.y_down else 1.0 - share) * down

    parts = [
        f'<svg class="plot" viewBox="0 0 {plot.width} {plot.height}" role="img" aria-label="{escape(plot.title)}">',
        f'<rect class="area" x="{left}" y="{top}" width="{across}" height="{down}"/>',
    ]
    for band_begin, band_end, colour in plot.bands:
        begin, end = max(band_begin, x_low), min(band_end, x_high)
        if end > begin:
            wide = max(x_px(end) - x_px(begin), 0.7)
            parts.append(
                f'<rect x="{x_px(begin):.1f}" y="{top}" width="{wide:.1f}" height="{down}" fill="{colour}" '
                'fill-opacity="0.22"/>'
            )
    for x in ticks(x_low, x_high, 8):
        parts.append(f'<line class="grid" x1="{x_px(x):.1f}" y1="{top}" x2="{x_px(x):.1f}" y2="{top + down}"/>')
        parts.append(f'<text x="{x_px(x):.1f}" y="{top + down + 11}" text-anchor="middle">{_tick_text(x)}</text>')
    for y in ticks(y_low, y_high, max(down // 24, 2)):
        parts.append(f'<line class="grid" x1="{left}" y1="{y_px(y):.1f}" x2="{left + across}" y2="{y_px(y):.1f}"/>')
        parts.append(f'<text x="{left - 4}" y="{y_px(y) + 3:.1f}" text-anchor="end">{_tick_text(y)}</text>')
    for line in plot.lines:
        parts.append(_curve(line, x_px, y_px, (x_low, x_high)))
    parts.append(f'<text class="title" x="4" y="12">{escape(plot.title)} <tspan>{escape(plot.unit)}</tspan></text>')
    named = [line for line in plot.lines if line.name]
    for k, line in enumerate(reversed(named)):
        parts.append(
            f'<text x="{plot.width - MARGIN_RIGHT - 90 * k}" y="12" text-anchor="end" fill="{line.colour}" '
            f'style="fill:{line.colour}">{escape(line.name)}</text>'
        )
    if plot.x_title:
        parts.append(f'<text x="{left + across}" y="{plot.height - 2}" text-anchor="end">{escape(plot.x_title)}</text>')
    if not points:
        parts.append(f'<text x="{left + across / 2}" y="{top + down / 2}" text-anchor="middle">nothing yet</text>')
    return "".join(parts) + "</svg>"


def _widened(low: float, high: float, span: float) -> tuple[float, float]:
    middle = 0.5 * (low + high)
    return middle - 0.5 * span, middle + 0.5 * span


def _curve(
    line: Line, x_px: Callable[[float], float], y_px: Callable[[float], float], x_range: tuple[float, float]
) -> str:
    path, dots, pen_down = [], [], False
    for point in line.points:
        if point is None or not x_range[0] <= point[0] <= x_range[1]:
            pen_down = False
            continue
        x, y = x_px(point[0]), y_px(point[1])
        if line.dots:
            dots.append(f"M{x:.1f} {y:.1f}h0")
        else:
            path.append(f"{'L' if pen_down else 'M'}{x:.1f} {y:.1f}" + ("" if pen_down else "h0"))
        pen_down = True
    shape = "".join(dots or path)
    width = 1.5 if not line.dots else 2.6 if len(dots) > 1 else 7.0
    return (
        f'<path d="{shape}" fill="none" stroke="{line.colour}" stroke-width="{width}" stroke-linecap="round" '
        'stroke-linejoin="round"/>'
    )


STYLE: Final = (
    "svg.plot{width:100%;height:auto;display:block;font:9px system-ui,sans-serif}"
    "svg.plot text{fill:currentColor;opacity:.75}svg.plot .title{font-size:11px;opacity:1;font-weight:600}"
    "svg.plot tspan{font-weight:400;opacity:.7}"
    "svg.plot .area{fill:currentColor;fill-opacity:.04}svg.plot .grid{stroke:currentColor;stroke-opacity:.13}"
)
