"""Where fixed nodes would see a moving one well: the bound of its place, from above."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from buddyline.protocol.messages import NodeInfo
from buddyline.tools.bound import pose_information
from buddyline.tools.draw.figures import new_figure
from buddyline.tools.evaluation.rotation import Floats, conjugate, multiply, normalized, rotate
from msgspec import UNSET

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Points along the longer side.
POINTS: Final = 30
MARGIN_M: Final = 1.0
# Worse than this, 1 sd of a coordinate, a place counts as not seen.
WORST_M: Final = 1.0
LEVELS_M: Final = (0.005, 0.02, 0.1)


@dataclass(frozen=True, eq=False)
class SeenVolume:
    """How well a node would be placed at each point of a grid: north_m (N,), east_m (E,), all at depth down_m.

    sigma_m (N, E): bound of a coordinate from one trigger, RMS of the three; NaN where there would be no useful place.
    The node looks at one of the fixed nodes, or between them: whichever is best.
    """

    north_m: Floats
    east_m: Floats
    down_m: float
    sigma_m: Floats

    def share(self, sigma_m: float) -> float:
        """Return the share of the grid that is seen better than sigma_m."""
        with np.errstate(invalid="ignore"):
            return float((self.sigma_m < sigma_m).mean())


def seen_volume(fixed: Mapping[str, NodeInfo], moving: NodeInfo, also_m: Floats) -> SeenVolume:
    """Return how well a node like `moving` would be placed around fixed nodes, in clear water.

    also_m (n, 3): places that are in the grid as well, such as those where it was.
    """
    places = np.array([info.fixed.p_m for info in fixed.values() if info.fixed is not UNSET])
    every = np.concatenate((places, also_m.reshape(-1, 3)))
    low, high = every[:, :2].min(0) - MARGIN_M, every[:, :2].max(0) + MARGIN_M
    step = float((high - low).max()) / (POINTS - 1)
    north, east = (np.arange(start, end + 0.5 * step, step) for start, end in zip(low, high, strict=True))
    down = float(np.median(every[:, 2]))
    x, y = (axis.ravel() for axis in np.meshgrid(north, east, indexing="ij"))
    p = np.stack((x, y, np.full(len(x), down)), axis=-1)
    best = np.full(len(p), np.inf)
    for target in np.concatenate((places, places.mean(0, keepdims=True)))[: None if len(places) > 1 else 1]:
        q = _looking(np.arctan2(target[1] - y, target[0] - x))
        information = np.zeros((len(p), 6, 6))
        for info in fixed.values():
            if info.fixed is UNSET:
                continue
            q_fixed = normalized(np.array(info.fixed.q_xyzw))
            back = conjugate(q_fixed)
            t = rotate(back, p - np.array(info.fixed.p_m))
            of_fixed = pose_information(t, multiply(back, q), info, moving, moving.sigma_px)
            R = np.kron(np.eye(2), np.stack([rotate(back, axis) for axis in np.eye(3)], axis=-1))
            information += R.T @ of_fixed @ R
        known = np.linalg.eigvalsh(information)[:, 0] > 1e-6
        covariance = np.linalg.inv(information[known])
        best[known] = np.minimum(best[known], np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2) / 3.0))
    best[~(best < WORST_M)] = np.nan
    return SeenVolume(north, east, down, best.reshape(len(north), len(east)))


def _looking(heading_rad: Floats) -> Floats:
    """Return the attitudes (n, 4), camera to north-east-down, of level cameras that look along headings (n,)."""
    half, zero = heading_rad / 2, np.zeros(len(heading_rad))
    about_down = np.stack((zero, zero, np.sin(half), np.cos(half)), axis=-1)
    # The camera's x is the body's right, its y is down, its z is forward.
    return multiply(about_down, np.array((0.5, 0.5, 0.5, 0.5)))


def draw_seen_volume(volume: SeenVolume, fixed: Mapping[str, NodeInfo]) -> Figure:
    """Draw it from above: north up, the fixed nodes with the way they look."""
    from matplotlib.colors import LogNorm

    figure, (axes,) = new_figure(6.4, 5.0)
    axes.set_aspect("equal")
    colours = LogNorm(1e-3, WORST_M)
    mesh = axes.pcolormesh(volume.east_m, volume.north_m, volume.sigma_m, norm=colours, cmap="viridis_r")
    figure.colorbar(mesh, label="bound of a coordinate (1 sd), one trigger [m]")
    if np.isfinite(volume.sigma_m).sum() > 3:
        filled = np.nan_to_num(volume.sigma_m, nan=WORST_M)
        lines = axes.contour(volume.east_m, volume.north_m, filled, LEVELS_M, colors="black", linewidths=0.6)
        axes.clabel(lines, fmt=lambda level: f"{level:g} m")
    for node, info in fixed.items():
        if info.fixed is UNSET:
            continue
        x, y, _ = info.fixed.p_m
        ahead = rotate(normalized(np.array(info.fixed.q_xyzw)), np.array((0.0, 0.0, 1.0)))
        axes.annotate("", (y + ahead[1], x + ahead[0]), (y, x), arrowprops={"arrowstyle": "->", "color": "tab:red"})
        axes.annotate(node, (y, x), color="tab:red", weight="bold")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.set_title(f"Seen at {volume.down_m:.1f} m depth in clear water, turned as best")
    return figure
