"""All nodes of a net: from above, and their depths over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from buddyline.tools.draw.figures import broken, new_figure
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class NodePath:
    """Where one node was in the net's frame. t_s (n,): since the dive's start. p_m (n, 3): north, east, down."""

    t_s: NDArray[np.float64]
    p_m: NDArray[np.float64]
    fixed: bool


def draw_net(paths: Mapping[str, NodePath], origin: str | None) -> Figure:
    """Draw all nodes from above, north up, and how deep they were.

    origin: the node that is the frame's zero, and moves with it; None where fixed nodes hold the frame.
    """
    figure, (above, deep) = new_figure(9.5, 4.8, 1, 2)
    for index, (node, path) in enumerate(sorted(paths.items())):
        colour = f"C{index % 10}"
        north, east, down = path.p_m.T
        if path.fixed or node == origin:
            above.plot(east[:1], north[:1], "^", color=colour, markersize=8)
        else:
            above.plot(*broken(path.t_s, east, north)[1:], color=colour, linewidth=1.2)
            above.plot(east[-1:], north[-1:], "o", color=colour)
        above.annotate(node, (east[-1], north[-1]), (6, 4), textcoords="offset points", color=colour, weight="bold")
        deep.plot(*broken(path.t_s, down), color=colour, linewidth=1.2, label=node)
    above.margins(0.1)
    above.set_aspect("equal", adjustable="datalim")
    above.set(xlabel="east, m", ylabel="north, m")
    above.set_title("From above (dot: where its path ends)", loc="left")
    deep.invert_yaxis()
    deep.set(xlabel="s from the start", ylabel="down, m" if origin is None else f"below {origin}, m")
    deep.set_title("Depth in the net's frame", loc="left")
    deep.legend()
    return figure
