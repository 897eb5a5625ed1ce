"""A dive's poses and track: over time, from above, and by depth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.tools.draw.figures import COLOURS, GAP_S, NO_POSE_COLOUR, broken, inner_limits, new_figure
from buddyline.tools.draw.survey import ELLIPSE_SD
from buddyline.tools.monitor.picture import UNCERTAINTY, Point, columns
from buddyline.tools.monitor.scene import Floats
from msgspec import UNSET

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Depths = Sequence[tuple[int, float]]
# About this many of a track's points get an ellipse on a map.
ELLIPSES: Final = 25


def over_time(
    points: Sequence[Point],
    depths: Mapping[str, Depths],
    span_ns: tuple[int, int],
    without_ns: Sequence[tuple[int, int]],
) -> Figure:
    """Draw range, direction, uncertainty, gap, latency and the nodes' depths over the time since the start.

    depths: by node, (ns, m). span_ns: the dive's start and end. without_ns: stretches without a pose, which are marked.
    """
    from matplotlib.ticker import LogFormatter

    start_ns, end_ns = span_ns
    found = columns(points, start_ns)
    rows = max(len(found) + bool(depths), 1)
    figure, axes = new_figure(9.5, 1.4 * rows + 0.5, rows, 1, sharex=True)
    for axis, (title, (t_s, values, tracked)) in zip(axes, found.items(), strict=False):
        axis.plot(t_s[~tracked], values[~tracked], ".", color=COLOURS[0], markersize=2.5, label="poses")
        if tracked.any():
            joined = broken(t_s[tracked], values[tracked], gap_s=_gap_s([point for point in points if point.tracked]))
            axis.plot(*joined, color=COLOURS[1], linewidth=1.0, label="track")
            if axis is axes[0]:
                axis.legend(loc="upper right")
        outside = 0
        if title == UNCERTAINTY:
            axis.set_yscale("log")
            # Plain numbers, and not powers of ten.
            axis.yaxis.set_major_formatter(LogFormatter())
            axis.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.0, 0.4)))
        elif (bounds := inner_limits(values)) is not None:
            axis.set_ylim(*bounds)
            outside = int(((values < bounds[0]) | (values > bounds[1])).sum())
        axis.set_title(title + (f" ({outside} outside of what is drawn)" if outside else ""), loc="left")
    if depths:
        for node, line in sorted(depths.items()):
            axes[-1].plot([(ns - start_ns) / S_NS for ns, _ in line], [metres for _, metres in line], label=node)
        axes[-1].set_title("Depth, m", loc="left")
        axes[-1].invert_yaxis()
        axes[-1].legend()
    for axis in axes:
        for begin_ns, stop_ns in without_ns:
            axis.axvspan((begin_ns - start_ns) / S_NS, (stop_ns - start_ns) / S_NS, color=NO_POSE_COLOUR, alpha=0.2)
    axes[-1].set(xlabel="s from the start; red: no pose", xlim=(0.0, (end_ns - start_ns) / S_NS))
    return figure


def plan(poses: Sequence[Point], track: Sequence[Point]) -> Figure:
    """Draw B before A from above, north up where A's attitude is known; the track with 95 % ellipses."""
    figure, (axis,) = new_figure(4.8, 4.8)
    north = any(point.frame.levelled for point in (*poses, *track))
    _path(axis, poses, track, lambda t_m, _: (t_m[:, 1], t_m[:, 0]), "Plan: B seen from A")
    for point in _some(track):
        sight_m, aside_m, _ = _sigmas_m(point)
        at_deg = math.degrees(math.atan2(point.t_m[0], point.t_m[1]))
        _ellipse(axis, (point.t_m[1], point.t_m[0]), sight_m, aside_m, at_deg)
    axis.plot(0.0, 0.0, "^", color=COLOURS[2], markersize=7)
    axis.set(xlabel="east, m" if north else "right of A, m", ylabel="north, m" if north else "ahead of A, m")
    return figure


def profile(poses: Sequence[Point], track: Sequence[Point], depths_a: Depths) -> Figure:
    """Draw B's depth over the horizontal distance from A; below A where A's depth is not known."""
    figure, (axis,) = new_figure(4.8, 4.8)
    at_ns, depth_m = np.array(depths_a, float).reshape(-1, 2).T

    def place(t_m: Floats, point_ns: Floats) -> tuple[Floats, Floats]:
        level_m = np.interp(point_ns, at_ns, depth_m) if len(at_ns) else np.zeros(len(t_m))
        return np.hypot(t_m[:, 0], t_m[:, 1]), level_m + t_m[:, 2]

    _path(axis, poses, track, place, "Profile: B seen from A")
    for point in _some(track):
        (x_m,), (y_m,) = place(np.array([point.t_m]), np.array([float(point.at_ns)]))
        sight_m, _, down_m = _sigmas_m(point)
        _ellipse(axis, (x_m, y_m), sight_m, down_m, 0.0)
    axis.plot(0.0, np.median(depth_m) if len(depth_m) else 0.0, "^", color=COLOURS[2], markersize=7)
    axis.set(xlabel="horizontal distance, m", ylabel="depth, m" if len(at_ns) else "below A, m")
    axis.invert_yaxis()
    return figure


def _path(
    axis: Axes,
    poses: Sequence[Point],
    track: Sequence[Point],
    place: Callable[[Floats, Floats], tuple[Floats, Floats]],
    title: str,
) -> None:
    """Draw poses as dots and the track as a line that breaks in its gaps; without a track the poses are the line.

    place: x and y on paper of places t_m (n, 3) in the scene at at_ns (n,).
    """
    for points, style in ((poses, "." if track else "-"), (track, "-")):
        if not points:
            continue
        at_ns = np.array([point.at_ns for point in points], float)
        x_m, y_m = place(np.array([point.t_m for point in points]), at_ns)
        if style == "-":
            _, x_m, y_m = broken(at_ns / S_NS, x_m, y_m, gap_s=_gap_s(points))
        axis.plot(x_m, y_m, style, color=COLOURS[points is track], linewidth=1.2, markersize=2.5)
    axis.set_title(title, loc="left")
    axis.set_aspect("equal", adjustable="datalim")


def _some(track: Sequence[Point]) -> Sequence[Point]:
    """Return the points of a track that get an ellipse."""
    return track[:: max(len(track) // ELLIPSES, 1)]


def _sigmas_m(point: Point) -> tuple[float, float, float]:
    """Return a place's horizontal sigma along and across the line of sight, and the one down.

    Across and down with the attitude's error, where it is known.
    """
    t_m = np.array(point.t_m)
    flat_m = float(np.hypot(t_m[0], t_m[1]))
    north, east = t_m[:2] / flat_m if flat_m > 0.0 else (1.0, 0.0)
    R_s_a = point.frame.R_s_a
    covariance = R_s_a @ np.array(point.estimate.covariance).reshape(6, 6)[:3, :3] @ R_s_a.T
    axes = np.array(((north, east, 0.0), (-east, north, 0.0), (0.0, 0.0, 1.0)))
    along_m, across_m, down_m = np.sqrt(np.maximum(np.diag(axes @ covariance @ axes.T), 0.0)).tolist()
    estimate = point.estimate
    if estimate.sigma_azimuth_rad is not UNSET and estimate.sigma_ned_m is not UNSET:
        across_m, down_m = flat_m * estimate.sigma_azimuth_rad, estimate.sigma_ned_m[2]
    return along_m, across_m, down_m


def _ellipse(axis: Axes, at_m: tuple[float, float], x_m: float, y_m: float, at_deg: float) -> None:
    """Draw the 95 % ellipse of sigmas x_m and y_m, turned by at_deg on paper."""
    from matplotlib.patches import Ellipse

    size_m = 2 * ELLIPSE_SD * x_m, 2 * ELLIPSE_SD * y_m
    axis.add_patch(Ellipse(at_m, *size_m, angle=at_deg, color=COLOURS[1], linewidth=0.6, alpha=0.3))


def _gap_s(points: Sequence[Point]) -> float:
    """Return the time, s, beyond which two points are not joined; longer dives keep fewer points."""
    steps_ns = np.diff([point.at_ns for point in points])
    return max(GAP_S, 3 * float(np.median(steps_ns)) / S_NS) if len(steps_ns) else GAP_S
