"""The page, served by viser: the pair in space, and the panel beside it with texts, pictures and plots."""

from __future__ import annotations

import io
import logging
import math
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, redirect_stdout
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.topics import TRACK
from buddyline.tools.monitor import panel
from buddyline.tools.monitor.picture import PairPicture, columns
from buddyline.tools.monitor.scene import Floats
from buddyline.tools.monitor.space import SceneDrawing

if TYPE_CHECKING:
    import viser

log = logging.getLogger(__name__)

# The rate of the track.
TICK_S: Final = 1.0 / TRACK.rate_hz
TEXTS_EVERY: Final = 6
PLOTS_EVERY: Final = 20
PLOTTED_S: Final = 120.0
PLOT_PX: Final = 120
MISSES: Final = "Triggers without a pose, a second"
POSE_COLOUR: Final = "#f2a93b"
TRACK_COLOUR: Final = "#5aa0ff"
NO_POSE_COLOUR: Final = "#e0574f"


def open_server(host: str, port: int, title: str) -> viser.ViserServer:
    """Serve the page on host and port; raise BuddylineError if viser is missing or the port cannot be used."""
    try:
        import viser
    except ImportError as error:
        raise BuddylineError(
            f"the page needs viser, which is not installed ({error.name}): make install EXTRAS=monitor"
        ) from error
    logging.getLogger("websockets").setLevel(logging.WARNING)
    try:
        # viser prints a banner to standard output, which is for data.
        with redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    except (OSError, RuntimeError, OverflowError) as error:
        raise BuddylineError(f"--host {host} --port {port}: cannot be served: {error}") from error
    if port not in (0, server.get_port()):
        taken = server.get_port()
        log.warning("port %d is in use: the page is on port %d", port, taken)
    server.gui.configure_theme(
        dark_mode=True, show_logo=False, show_share_button=False, control_layout="collapsible", control_width="large"
    )
    server.gui.set_panel_label(title)
    server.scene.set_up_direction("-z")
    return server


class TimePlots:
    """Plots of the last two minutes: poses and track, and the number of triggers without a pose in each second."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._folder = gui.add_folder("Last two minutes: poses (amber), track (blue)")
        self._plots: dict[str, viser.GuiUplotHandle] = {}

    def draw(self, picture: PairPicture, now_ns: int) -> None:
        """Draw each quantity; a plot without values is removed."""
        points = [point for point in picture.points if 0 <= now_ns - point.at_ns <= PLOTTED_S * S_NS]
        plots: dict[str, tuple[Floats, ...]] = {
            title: (t_s, np.where(tracked, np.nan, values), np.where(tracked, values, np.nan))
            for title, (t_s, values, tracked) in columns(points, now_ns).items()
        }
        if picture.misses:
            missed_s = [(miss.at_ns - now_ns) / S_NS for miss in picture.misses]
            counts, edges_s = np.histogram(missed_s, int(PLOTTED_S), (-PLOTTED_S, 0.0))
            plots[MISSES] = edges_s[1:], counts.astype(float)
        for title, data in plots.items():
            scales = _scales(data[1:])
            plot = self._plots.get(title)
            if plot is None:
                self._plots[title] = self._add(title, data, scales)
                continue
            # New scales make the browser rebuild the whole plot; new data do not.
            if plot.scales != scales:
                plot.scales = scales
            plot.data = data
        for title, plot in self._plots.items():
            if plot.visible != (title in plots):
                plot.visible = title in plots

    def _add(self, title: str, data: tuple[Floats, ...], scales: Any) -> viser.GuiUplotHandle:
        drawn = [_series(title, NO_POSE_COLOUR, 0, 1)] if title == MISSES else [
            _series("pose", POSE_COLOUR, 4, 0),
            _series("track", TRACK_COLOUR, 2, 0),
        ]  # fmt: skip
        series: Any = ({"label": "s before now"}, *drawn)
        with self._folder:
            return self._gui.add_uplot(
                data,
                series,
                title=title,
                scales=scales,
                axes=({"size": 26}, {}),
                legend={"show": False},
                height=PLOT_PX,
            )


def _scales(columns: Sequence[Floats]) -> Any:
    """Return the scales of a plot: the browser cannot find them itself if some values are NaN.

    The limits are round numbers, so that they seldom change.
    """
    values = np.concatenate(columns)
    least, most = float(np.nanmin(values)), float(np.nanmax(values))
    step = 10.0 ** math.floor(math.log10(max(most - least, 1e-3 * abs(most), 1e-3))) / 2
    low, high = step * math.floor(least / step - 0.1), step * math.ceil(most / step + 0.1)
    return {"x": {"time": False, "range": (-PLOTTED_S, 0.0)}, "y": {"range": (low, high)}}


def _series(label: str, colour: str, dot_px: int, line_px: int) -> dict[str, Any]:
    """Return the style of a series.

    Poses and track are dots, those of the track small and close together. A line would cross the gaps: the page can
    mark a missing value only as NaN, and leaves NaN out.
    """
    points = {"show": dot_px > 0, "size": dot_px, "fill": colour, "stroke": colour}
    return {"label": label, "stroke": colour, "width": line_px, "points": points}


class Page:
    """Scene and panel of one server; live: a running pair, not a stored dive."""

    def __init__(self, server: viser.ViserServer, *, live: bool) -> None:
        self.server = server
        self._live = live
        gui = server.gui
        self._headline = gui.add_html(panel.block("Starting."))
        self.scene = SceneDrawing(server)
        gui.add_button("Show both nodes").on_click(lambda _: self.scene.fit_all())
        with gui.add_folder("What is happening"):
            self._health = gui.add_html("")
        with gui.add_folder("Cameras"):
            self._cameras: list[viser.GuiHtmlHandle] = [gui.add_html("", visible=False) for _ in range(2)]
        self._plots = TimePlots(gui)
        self._content: dict[int, str] = {}

    def close(self) -> None:
        """Stop serving."""
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def draw_until(
        self,
        stop: threading.Event,
        step: Callable[[bool], tuple[PairPicture, int, bool]],
        lock: AbstractContextManager[Any],
    ) -> None:
        """Draw what step returns, 20 times a second, until stop is set; lock: held while the picture is read.

        step(watched): the picture, its present time (ns), and whether all is to be drawn at once; watched: whether
        anyone looks at the page.
        """
        tick = 0
        seen: frozenset[int] = frozenset()
        while not stop.wait(TICK_S):
            viewers = frozenset(self.server.get_clients())
            with lock:
                picture, now_ns, jumped = step(bool(viewers))
                # A new viewer gets everything at once.
                tick = 0 if jumped or viewers - seen else tick + 1
                seen = viewers
                if viewers:
                    self._draw(picture, now_ns, tick)

    def _draw(self, picture: PairPicture, now_ns: int, tick: int) -> None:
        self.scene.draw(picture, now_ns)
        if tick % TEXTS_EVERY == 0:
            self.set_html(self._headline, panel.headline(picture, now_ns, live=self._live))
            self.set_html(self._health, panel.health(picture, now_ns, live=self._live))
            for slot, node in zip(self._cameras, picture.end_nodes(), strict=True):
                slot.visible = node is not None
                if node is not None:
                    self.set_html(slot, panel.camera(picture, node, now_ns))
            self.scene.draw_trail(picture, now_ns)
        if tick % PLOTS_EVERY == 0:
            self._plots.draw(picture, now_ns)

    def set_html(self, handle: viser.GuiHtmlHandle, content: str) -> None:
        """Show HTML if it has changed, because each update is sent to every viewer."""
        if self._content.get(id(handle)) != content:
            self._content[id(handle)] = content
            handle.content = content
