"""A dive's poses: over time, from above, and by depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.tools.draw.figures import COLOURS, GAP_S, NO_POSE_COLOUR, broken, new_figure
from buddyline.tools.monitor.picture import Point, columns
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Depths = Sequence[tuple[int, float]]


def over_time(
    points: Sequence[Point],
    depths: Mapping[str, Depths],
    span_ns: tuple[int, int],
    without_ns: Sequence[tuple[int, int]],
) -> Figure:
    """Draw range, direction, gap, latency and the nodes' depths over the time since the start.

    depths: by node, (ns, m). span_ns: the dive's start and end. without_ns: stretches without a pose, which are marked.
    """
    start_ns, end_ns = span_ns
    found = columns(points, start_ns)
    rows = max(len(found) + bool(depths), 1)
    figure, axes = new_figure(9.5, 1.4 * rows + 0.5, rows, 1, sharex=True)
    for axis, (title, (t_s, values)) in zip(axes, found.items(), strict=False):
        axis.plot(*broken(t_s, values, gap_s=_gap_s(points)), color=COLOURS[0], linewidth=1.0)
        axis.set_title(title, loc="left")
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


def plan(points: Sequence[Point]) -> Figure:
    """Draw B before A from above, north up where A's attitude is known."""
    figure, (axis,) = new_figure(4.8, 4.8)
    north = any(point.frame.levelled for point in points)
    t_m = np.array([point.t_m for point in points]).reshape(-1, 3)
    _track(axis, points, t_m[:, 1], t_m[:, 0], "Plan: B seen from A")
    axis.plot(0.0, 0.0, "^", color=COLOURS[1], markersize=7)
    axis.set(xlabel="east, m" if north else "right of A, m", ylabel="north, m" if north else "ahead of A, m")
    return figure


def profile(points: Sequence[Point], depths_a: Depths) -> Figure:
    """Draw B's depth over the horizontal distance from A; below A where A's depth is not known."""
    figure, (axis,) = new_figure(4.8, 4.8)
    t_m = np.array([point.t_m for point in points]).reshape(-1, 3)
    at_ns, depth_m = np.array(depths_a, float).reshape(-1, 2).T
    level_m = np.interp([point.at_ns for point in points], at_ns, depth_m) if len(at_ns) else np.zeros(len(points))
    _track(axis, points, np.hypot(t_m[:, 0], t_m[:, 1]), level_m + t_m[:, 2], "Profile: B seen from A")
    axis.plot(0.0, np.median(depth_m) if len(depth_m) else 0.0, "^", color=COLOURS[1], markersize=7)
    axis.set(xlabel="horizontal distance, m", ylabel="depth, m" if len(at_ns) else "below A, m")
    axis.invert_yaxis()
    return figure


def _track(axis: Axes, points: Sequence[Point], x_m: NDArray[np.float64], y_m: NDArray[np.float64], title: str) -> None:
    t_s = np.array([point.at_ns / S_NS for point in points], float)
    _, x_m, y_m = broken(t_s, x_m, y_m, gap_s=_gap_s(points))
    axis.plot(x_m, y_m, color=COLOURS[0], linewidth=1.2)
    axis.set_title(title, loc="left")
    axis.set_aspect("equal", adjustable="datalim")


def _gap_s(points: Sequence[Point]) -> float:
    """Return the time past which two points are not joined: of a long dive only some points are kept."""
    steps_ns = np.diff([point.at_ns for point in points])
    return max(GAP_S, 3 * float(np.median(steps_ns)) / S_NS) if len(steps_ns) else GAP_S
