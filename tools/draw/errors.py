"""Errors of poses against truth, as figures: what `evaluate --plots` and `experiments` draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from buddyline.tools.draw.figures import broken, new_figure, save
from buddyline.tools.evaluation.poses import PoseErrors
from buddyline.tools.evaluation.result import Result
from buddyline.tools.evaluation.rotation import Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The width of a printed page between its margins, inches: a figure that is not scaled keeps the size of its letters.
PRINTED_IN: Final = 7.2
# A panel's width and the bounds of its height, inches, and how far apart the numbers at its axes are at least.
PANEL_IN: Final = 3.0
PANEL_HEIGHTS_IN: Final = (1.4, 3.4)
NUMBERS_APART_IN: Final = (0.25, 0.2)
FILES: Final = ("trajectory.png", "errors_over_time.png", "errors_over_range.png", "normalized_error.png")


@dataclass(frozen=True, eq=False)
class ErrorCurve:
    """The poses of one method, or of one verdict, under one name."""

    name: str
    errors: PoseErrors
    colour: str = "tab:blue"
    marker: str = "."

    @property
    def style(self) -> dict[str, Any]:
        """How matplotlib draws it: markers, no line."""
        return {"color": self.colour, "marker": self.marker, "linestyle": "none", "label": self.name}


def by_verdict(errors: PoseErrors) -> list[ErrorCurve]:
    """Return the curve of the right poses and, if there are any, that of the wrong ones."""
    curves = [ErrorCurve("poses", errors.select(~errors.wrong))]
    return (
        [*curves, ErrorCurve("wrong poses", errors.select(errors.wrong), "tab:red")] if errors.wrong.any() else curves
    )


def trajectories(dives: Mapping[str, tuple[Floats, Sequence[ErrorCurve]]]) -> Figure:
    """Draw B before A in each dive, from above and from the side; of each its true positions (n, 3), m. Grid: 1 m."""
    heights_in = [_height_in(true_m) for true_m, _ in dives.values()]
    figure, axes = new_figure(
        PRINTED_IN, 0.6 + sum(heights_in) + 0.4 * len(dives), len(dives), 2, gridspec_kw={"height_ratios": heights_in}
    )
    for row, (title, (true_m, curves)) in enumerate(dives.items()):
        for axis, across, name in ((axes[2 * row], 0, "right"), (axes[2 * row + 1], 1, "down")):
            axis.plot(true_m[:, 2], true_m[:, across], ".", color="0.7", markersize=3, label="truth")
            for curve in curves:
                axis.plot(curve.errors.t_m[:, 2], curve.errors.t_m[:, across], **curve.style)
            axis.plot(0, 0, "k>", markersize=6)
            axis.set(ylabel=f"{name}, m", aspect="equal", adjustable="datalim")
            for one in (axis.xaxis, axis.yaxis):
                one.set_major_locator(_multiples(1.0))
                one.set_minor_locator(_multiples(1.0))
            axis.grid(visible=True, which="both")
            # What is right of A, or below it, is drawn below A.
            axis.invert_yaxis()
        axes[2 * row].set_title(f"{title}: from above", loc="left")
        axes[2 * row + 1].set_title("from the side", loc="left")
    for axis in axes[-2:]:
        axis.set_xlabel("forward, m")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=4)
    # The limits of axes of one scale follow from the panels' sizes, and these from the layout.
    figure.draw_without_rendering()
    for axis in axes:
        panel = axis.get_window_extent()
        for one, limits_m, length_px, apart_in in (
            (axis.xaxis, axis.get_xlim(), panel.width, NUMBERS_APART_IN[0]),
            (axis.yaxis, axis.get_ylim(), panel.height, NUMBERS_APART_IN[1]),
        ):
            m_per_in = abs(limits_m[1] - limits_m[0]) / (length_px / figure.dpi)
            one.set_major_locator(_multiples(_step_m(apart_in * m_per_in)))
    return figure


def _height_in(true_m: Floats) -> float:
    """Return how high a panel must be that shows these positions, and A, in one scale."""
    seen_m = np.vstack([true_m, np.zeros(3)])
    right_m, down_m, forward_m = np.ptp(seen_m, axis=0)
    return float(np.clip(PANEL_IN * max(right_m, down_m) / max(forward_m, 1e-3), *PANEL_HEIGHTS_IN))


def _step_m(least_m: float) -> float:
    """Return the first of 1, 2, 5, 10, 20, ... m that is at least this."""
    decade_m = 1.0
    while True:
        for step in (1.0, 2.0, 5.0):
            if step * decade_m >= least_m:
                return step * decade_m
        decade_m *= 10.0


def _multiples(step: float) -> Any:
    from matplotlib.ticker import MultipleLocator

    return MultipleLocator(step)


def over_time(curves: Sequence[ErrorCurve], stamps_ns: Sequence[int], true_m: Floats, title: str) -> Figure:
    """Draw position, its error and the rotation's error over time, with gaps; true_m: (n, 3) at stamps_ns (n,)."""
    figure, axes = new_figure(PRINTED_IN, 6.6, 3, 1, sharex=True)
    start_ns = stamps_ns[0]
    times_s = np.array([stamp_ns - start_ns for stamp_ns in stamps_ns]) / 1e9
    for across, shade, name in ((0, "0.75", "right"), (1, "0.5", "down"), (2, "0.25", "forward")):
        axes[0].plot(times_s, true_m[:, across], ".", color=shade, markersize=2, label=f"truth, {name}")
    for curve in curves:
        errors = curve.errors
        t_s = (errors.stamp_ns - start_ns) / 1e9
        for across in range(3):
            axes[0].plot(t_s, errors.t_m[:, across], **(curve.style | ({"label": None} if across else {})))
        for axis, values in ((axes[1], errors.translation_m), (axes[2], np.degrees(errors.rotation_rad))):
            axis.semilogy(*broken(t_s, _shown(values)), **(curve.style | {"linestyle": "-", "linewidth": 0.7}))
    for axis, label in zip(axes, ("position, m", "position error, m", "rotation error, deg"), strict=True):
        axis.set_ylabel(label)
    axes[0].legend(ncols=5)
    axes[0].set_title(title)
    axes[2].set_xlabel("time, s")
    return figure


def over_range(curves: Sequence[ErrorCurve]) -> Figure:
    """Draw the errors of position, range and rotation over the true range."""
    figure, axes = new_figure(PRINTED_IN, 8.0, 3, 1, sharex=True)
    for curve in curves:
        errors = curve.errors
        for axis, values in zip(
            axes,
            (_shown(errors.translation_m), errors.range_m, _shown(np.degrees(errors.rotation_rad))),
            strict=True,
        ):
            axis.plot(errors.true_range_m, values, **curve.style)
    for axis, label in zip(axes, ("position error, m", "range error, m", "rotation error, deg"), strict=True):
        axis.set(ylabel=label, yscale="linear" if label.startswith("range") else "log")
    axes[0].legend()
    axes[2].set_xlabel("true range, m")
    return figure


def medians_over_range(
    methods: Mapping[str, Sequence[Mapping[str, Any]]], bound: Sequence[Mapping[str, float]]
) -> Figure:
    """Draw the median position error by range, a line a method, beside the bound's median and the paper's 0.08 m."""
    figure, (axis,) = new_figure(PRINTED_IN, 4.6)
    middles_m = [(row["from_m"] + row["to_m"]) / 2 for row in bound]
    medians_m = [row["bound_median_m"] for row in bound]
    axis.plot(middles_m, medians_m, color="0.6", linewidth=5, alpha=0.6, label="Cramér-Rao bound, median")
    for name, rows in methods.items():
        if not rows:
            continue
        middles_m = [(row["from_m"] + row["to_m"]) / 2 for row in rows]
        axis.plot(middles_m, [row["position_median_m"] for row in rows], "o-", label=name)
    axis.plot([1.5, 4.0], [0.08, 0.08], "k--", label="the paper reports, 1.5 to 4 m")
    axis.set(xlabel="true range, m", ylabel="position error, median, m", yscale="log")
    axis.legend()
    return figure


def normalized_errors(errors: PoseErrors) -> Figure:
    """Draw the shares of poses below a normalized error (NEES), beside an honest covariance's median and 95 % point."""
    figure, axes = new_figure(PRINTED_IN, 3.6, 1, 2)
    for axis, values, name, median, gate in (
        (axes[0], errors.nees6, "pose", 5.348, 12.592),
        (axes[1], errors.nees3, "position", 2.366, 7.815),
    ):
        known = np.sort(values[np.isfinite(values)])
        axis.plot(_shown(known), np.arange(1, len(known) + 1) / max(len(known), 1))
        axis.plot([median, gate], [0.5, 0.95], "o", color="tab:orange", label="an honest covariance")
        axis.set(xscale="log", xlabel=f"normalized error (NEES), {name}", ylabel="share of poses below")
        axis.legend()
    return figure


def _shown(errors: Floats) -> Floats:
    """Return errors with exact zeros raised to 1e-6: a logarithmic axis has no zero."""
    return np.maximum(errors, 1e-6)


def write_figures(result: Result, folder: Path) -> list[Path]:
    """Draw a result's errors into a folder; return the files."""
    errors = result.errors
    if not len(errors):
        return []
    curves, title = by_verdict(errors), f"{result.node_b} as {result.node_a} sees it"
    figures = (
        trajectories({title: (errors.true_t_m, curves)}),
        over_time(curves, errors.stamp_ns.tolist(), errors.true_t_m, title),
        over_range(curves),
        normalized_errors(errors),
    )
    paths = [folder / name for name in FILES]
    for figure, path in zip(figures, paths, strict=True):
        save(figure, path)
    return paths
