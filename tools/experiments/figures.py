"""The report's pictures, as PNG; without pyplot, so that no display is needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np
from buddyline.node.detect import draw, make_detector
from buddyline.node.drivers.stored import decode_picture
from buddyline.protocol.clock import trigger_index
from buddyline.protocol.messages import Candidates, CompressedImage, RelativePose
from buddyline.tools.dives import Dive
from buddyline.tools.evaluation.poses import PoseErrors
from buddyline.tools.evaluation.rotation import Floats
from buddyline.tools.experiments.runs import OURS, TAGS, Rendered
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI: Final = 80
_COLOURS: Final = {OURS: "tab:blue", TAGS: "tab:orange"}
_SHAPES: Final = {OURS: ".", TAGS: "x"}
# What divers do between two poses this far apart is not known: lines break there.
_GAP_S: Final = 1.6


def _figure(rows: int, columns: int, width_in: float, height_in: float) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns)))


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=_DPI)


def _sound(errors: PoseErrors) -> PoseErrors:
    return errors.select(~errors.wrong)


def trajectories(dives: Sequence[Rendered], truths: Mapping[str, Floats], path: Path) -> None:
    """Draw B before A in each environment, from above and from the side, on a grid of 1 m."""
    from matplotlib.ticker import MultipleLocator

    figure, axes = _figure(2, len(dives), 3.1 * len(dives), 6.4)
    for column, dive in enumerate(dives):
        true_m = truths[dive.environment]
        for row, across, name in ((0, 0, "right"), (1, 1, "down")):
            axis = axes[row * len(dives) + column]
            axis.plot(true_m[:, across], true_m[:, 2], "-", color="0.7", linewidth=1.0, label="truth")
            for method in (OURS, TAGS):
                if method in dive.results:
                    t_m = _sound(dive.results[method].errors).t_m
                    axis.plot(
                        t_m[:, across], t_m[:, 2], _SHAPES[method], color=_COLOURS[method], markersize=4, label=method
                    )
            axis.plot(0, 0, "k^", markersize=7)
            axis.set(xlabel=f"{name}, m", aspect="equal")
            axis.xaxis.set_major_locator(MultipleLocator(1))
            axis.yaxis.set_major_locator(MultipleLocator(1))
            axis.grid(visible=True, linewidth=0.4)
            if row == 0:
                axis.set_title(dive.environment.replace("_", " "))
    axes[0].set_ylabel("from above: forward, m")
    axes[len(dives)].set_ylabel("from the side: forward, m")
    axes[0].legend(fontsize=7)
    _save(figure, path)


def over_time(dive: Rendered, times_s: Floats, truth_m: Floats, start_ns: int, path: Path) -> None:
    """Draw position, its error and the rotation's error over time, ours and tags, with their gaps."""
    figure, axes = _figure(3, 1, 9.0, 6.6)
    for across, dashes, name in ((0, ":", "right"), (1, "--", "down"), (2, "-", "forward")):
        axes[0].plot(times_s, truth_m[:, across], dashes, color="0.65", linewidth=1.0, label=f"truth, {name}")
    for method in (OURS, TAGS):
        if method not in dive.results:
            continue
        errors = _sound(dive.results[method].errors)
        t_s = (errors.stamp_ns - start_ns) / 1e9
        style: dict[str, Any] = {"color": _COLOURS[method], "markersize": 4, "linewidth": 0.7}
        for across in range(3):
            axes[0].plot(t_s, errors.t_m[:, across], _SHAPES[method], **style, label=method if across == 0 else None)
        for axis, values in ((axes[1], errors.translation_m), (axes[2], np.degrees(errors.rotation_rad))):
            axis.semilogy(*_broken(t_s, values), f"{_SHAPES[method]}-", **style)
    for axis, label in zip(axes, ("position, m", "position error, m", "rotation error, deg"), strict=True):
        axis.set_ylabel(label)
        axis.grid(visible=True, linewidth=0.4)
        axis.set_xlim(float(times_s.min()), float(times_s.max()))
    axes[0].legend(fontsize=7, ncols=5)
    axes[0].set_title(f"{dive.environment.replace('_', ' ')}: lights and AR tags")
    axes[2].set_xlabel("time, s")
    _save(figure, path)


def _broken(t_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Put NaN into gaps, so that no line crosses them."""
    gaps = np.flatnonzero(np.diff(t_s) > _GAP_S) + 1
    return np.insert(t_s, gaps, np.nan), np.insert(values, gaps, np.nan)


def over_range(
    distance: Mapping[str, Sequence[Mapping[str, Any]]], range_m: Floats, bound_m: Floats, path: Path
) -> None:
    """Draw the median position error by range, a line a method, beside the Cramér-Rao bound and the paper's 0.08 m."""
    figure, (axis,) = _figure(1, 1, 7.5, 4.6)
    order = np.argsort(range_m)
    known = order[np.isfinite(bound_m[order])]
    axis.plot(range_m[known], bound_m[known], ".", color="0.75", markersize=2, label="Cramér-Rao bound (RMS)")
    for name, rows in distance.items():
        middles_m = [(row["from_m"] + row["to_m"]) / 2 for row in rows]
        axis.plot(middles_m, [row["position_median_m"] for row in rows], "o-", markersize=4, label=name)
    axis.plot([1.5, 4.0], [0.08, 0.08], "k--", label="the paper reports, 1.5 to 4 m")
    axis.set(xlabel="true range, m", ylabel="position error, median, m", yscale="log")
    axis.grid(visible=True, which="both", linewidth=0.3)
    axis.legend(fontsize=8)
    _save(figure, path)


def detections(dive: Rendered, path: Path) -> int | None:
    """Draw A's and B's pictures of one trigger, raw, with candidates, and with the chosen pair; return the trigger."""
    errors = dive.results[OURS].errors
    good = errors.select((errors.right_pair == 1.0) & (errors.true_range_m > 2.0))
    if not len(good):
        return None
    trigger = int(good.trigger[len(good) // 2])
    with Dive([dive.dive]) as log:
        infos = log.infos()
        pictures = {}
        for envelope in log.messages("image"):
            message, node = envelope.message, envelope.node
            if not isinstance(message, CompressedImage):
                continue
            if trigger_index(message.stamp_ns, infos[node].trigger_period_ns) == trigger:
                pictures[node] = decode_picture(message.data, envelope.key)
    with Dive([dive.logs[OURS]]) as log:
        found = [envelope.message for envelope in log.messages("pose", "candidates")]
        pose = next(one for one in found if isinstance(one, RelativePose) and one.trigger == trigger)
        blobs = {one.node: one.blobs for one in found if isinstance(one, Candidates) and one.trigger == trigger}
    rows = []
    for node, chosen in (("a", pose.blobs_a), ("b", pose.blobs_b)):
        raw = pictures[node]
        candidates = draw(raw, make_detector().detect(raw))
        pair = raw.copy()
        for index, colour in zip(chosen, ((80, 80, 255), (80, 255, 80)), strict=True):
            if index >= 0:
                blob = blobs[node][index]
                cv2.circle(pair, (round(blob.u_px), round(blob.v_px)), 22, colour, 2, cv2.LINE_AA)
        rows.append(np.hstack([_small(picture) for picture in (raw, candidates, pair)]))
    cv2.imwrite(str(path), np.vstack(rows), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return trigger


def _small(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
