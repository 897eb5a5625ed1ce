"""Plots of a result, as PNG files; needs matplotlib (the extra `plots`)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.evaluation.result import Result
from buddyline.tools.evaluation.rotation import Floats
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILES: Final = ("trajectory.png", "errors_over_time.png", "errors_over_range.png", "normalized_error.png")
_DPI: Final = 100


def check(directory: Path) -> None:
    """Raise BuddylineError where the plots could not be written: known before the work is done."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise BuddylineError("plots need matplotlib: pip install 'buddyline[plots]'") from None
    for name in FILES:
        if (directory / name).exists():
            raise BuddylineError(f"{directory / name}: exists; name another directory or remove it first")
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BuddylineError(f"{directory}: cannot be made: {error.strerror}") from error


def write(result: Result, directory: Path) -> list[Path]:
    """Draw the poses' errors into a directory; return the files."""
    if not len(result.errors):
        return []
    figures = (_trajectory(result), _over_time(result), _over_range(result), _normalized(result))
    paths = [directory / name for name in FILES]
    for figure, path in zip(figures, paths, strict=True):
        figure.savefig(path, dpi=_DPI)
    return paths


def _figure(rows: int, columns: int, width_in: float, height_in: float) -> tuple[Figure, list[Axes]]:
    # Without pyplot: no display, and nothing global is left behind.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns)))


def _split(result: Result) -> list[tuple[str, str, NDArray[np.bool_]]]:
    """Return (label, colour, chosen) of the poses that hold and those that are wrong."""
    wrong = result.errors.wrong
    return (
        [("poses", "tab:blue", ~wrong), ("wrong poses", "tab:red", wrong)]
        if wrong.any()
        else [("poses", "tab:blue", ~wrong)]
    )


def _logarithmic(errors: Floats) -> Floats:
    """Lift exact zeros, which a logarithmic axis cannot show."""
    return np.maximum(errors, 1e-6)


def _trajectory(result: Result) -> Figure:
    """Node b in a's camera frame, from above and from the side, on a 1 m grid."""
    from matplotlib.ticker import MultipleLocator

    errors = result.errors
    figure, axes = _figure(2, 1, 8.0, 8.0)
    true_m, ahead_m = errors.true_t_m, errors.true_t_m[:, 2]
    grid_m = max(1.0, float(np.ceil(np.abs(true_m).max() / 20)))
    for axis, across, name in ((axes[0], 0, "right"), (axes[1], 1, "down")):
        axis.plot(ahead_m, true_m[:, across], ".", color="0.6", markersize=5, label="truth")
        for label, colour, chosen in _split(result):
            axis.plot(errors.t_m[chosen, 2], errors.t_m[chosen, across], ".", color=colour, markersize=3, label=label)
        axis.set(xlabel=f"forward of {result.node_a}, m", ylabel=f"{name}, m", aspect="equal")
        axis.set_xlim(min(0.0, float(ahead_m.min())) - 0.5, float(ahead_m.max()) + 1.0)
        axis.set_ylim(float(true_m[:, across].max()) + 1.0, float(true_m[:, across].min()) - 1.0)
        axis.xaxis.set_major_locator(MultipleLocator(grid_m))
        axis.yaxis.set_major_locator(MultipleLocator(grid_m))
        axis.grid(visible=True, linewidth=0.4)
    axes[0].legend()
    axes[0].set_title(f"{result.node_b} as {result.node_a} sees it: from above, from the side")
    return figure


def _over_time(result: Result) -> Figure:
    errors = result.errors
    t_s = (errors.stamp_ns - errors.stamp_ns[0]) / 1e9
    figure, axes = _figure(3, 1, 9.0, 8.0)
    for label, colour, chosen in _split(result):
        axes[0].plot(
            t_s[chosen], _logarithmic(errors.translation_m[chosen]), ".", color=colour, markersize=3, label=label
        )
        axes[1].plot(
            t_s[chosen], _logarithmic(np.degrees(errors.rotation_rad[chosen])), ".", color=colour, markersize=3
        )
    axes[2].plot(t_s, errors.true_range_m, ".", color="0.5", markersize=3)
    for axis, label in zip(axes, ("position error, m", "rotation error, deg", "true range, m"), strict=True):
        axis.set_ylabel(label)
        axis.grid(visible=True, linewidth=0.4)
    for axis in axes[:2]:
        axis.set_yscale("log")
    axes[0].legend()
    axes[2].set_xlabel("time, s")
    return figure


def _over_range(result: Result) -> Figure:
    errors = result.errors
    figure, axes = _figure(3, 1, 9.0, 9.0)
    for label, colour, chosen in _split(result):
        range_m = errors.true_range_m[chosen]
        axes[0].plot(range_m, _logarithmic(errors.translation_m[chosen]), ".", color=colour, markersize=3, label=label)
        axes[1].plot(range_m, errors.range_m[chosen], ".", color=colour, markersize=3)
        axes[2].plot(range_m, _logarithmic(np.degrees(errors.rotation_rad[chosen])), ".", color=colour, markersize=3)
    labels = ("position error, m", "range error, m", "rotation error, deg")
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label)
        axis.grid(visible=True, linewidth=0.4)
    axes[0].set_yscale("log")
    axes[2].set_yscale("log")
    axes[0].legend()
    axes[2].set_xlabel("true range, m")
    return figure


def _normalized(result: Result) -> Figure:
    """Sorted NEES beside its honest median and 95 % point."""
    errors = result.errors
    figure, axes = _figure(1, 2, 9.0, 4.0)
    for axis, values, name, median, gate in (
        (axes[0], errors.nees6, "pose", 5.348, 12.592),
        (axes[1], errors.nees3, "position", 2.366, 7.815),
    ):
        known = np.sort(values[np.isfinite(values)])
        axis.plot(_logarithmic(known), np.arange(1, len(known) + 1) / max(len(known), 1))
        axis.plot([median, gate], [0.5, 0.95], "o", color="tab:orange", label="an honest covariance")
        axis.set(xscale="log", xlabel=f"normalized error (NEES), {name}", ylabel="share of poses below")
        axis.grid(visible=True, linewidth=0.4)
        axis.legend()
    return figure
