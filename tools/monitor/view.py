"""`buddyline view`: a stored dive on the monitor's page, with play, pause, speed and a scrubber."""

from __future__ import annotations

import argparse
import logging
import threading
from typing import TYPE_CHECKING, Any, Final

from buddyline.protocol.clock import S_NS, Clock, SystemClock
from buddyline.protocol.service import Service
from buddyline.tools.monitor import panel
from buddyline.tools.monitor.coverage import Coverage, clock_words
from buddyline.tools.monitor.live import PLOTS_EVERY, TEXTS_EVERY, TICK_S, add_page_arguments, open_page
from buddyline.tools.monitor.playback import Playback, survey

if TYPE_CHECKING:
    from buddyline.tools.monitor.page import Page

log = logging.getLogger(__name__)

SPEEDS: Final = ("0.25", "1", "4", "16", "64")
# After so many records the survey of the whole dive lets playback and page go first.
PACE: Final = 256


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="one dive: a solved log, or each node's own")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="seconds from the dive's start")
    parser.add_argument("--paused", action="store_true", help="do not begin to play at once")
    parser.add_argument("--seconds", type=float, metavar="S", help="end after this long; default: at Ctrl-C")
    add_page_arguments(parser)


class Controls:
    """What a viewer can press, and where the playback stands; its state is read by the playing thread."""

    def __init__(self, page: Page, duration_s: float, playing: bool) -> None:
        gui = page.server.gui
        self.playing = playing
        self.speed = 1.0
        self._lock = threading.Lock()
        self._wanted_s: float | None = None
        with gui.add_folder("Playback", order=-1):
            self._button = gui.add_button(self._button_text())
            self._speeds = gui.add_button_group("Speed", SPEEDS)
            # viser declares a value that can be set as if it could not.
            self._slider: Any = gui.add_slider("Seconds", 0.0, max(round(duration_s, 1), 0.1), 0.1, 0.0)
            self._strip = gui.add_html("")
        self._button.on_click(self._toggle)
        self._speeds.on_click(self._choose)
        self._slider.on_update(self._scrub)
        self._said = ""

    def _button_text(self) -> str:
        return "Pause" if self.playing else "Play"

    def _toggle(self, _: Any) -> None:
        self.playing = not self.playing
        self._button.label = self._button_text()

    def _choose(self, event: Any) -> None:
        self.speed = float(event.target.value)

    def _scrub(self, event: Any) -> None:
        # Our own moving of the slider comes back without a client.
        if event.client_id is not None:
            with self._lock:
                self._wanted_s = float(event.target.value)

    def wanted_s(self) -> float | None:
        """Return where a viewer has asked to go since the last call, in seconds from the start."""
        with self._lock:
            wanted_s, self._wanted_s = self._wanted_s, None
            return wanted_s

    def pause(self) -> None:
        """Stop at the dive's end."""
        if self.playing:
            self._toggle(None)

    def show(self, coverage: Coverage, position_ns: int) -> None:
        """Show where the playback stands, in slider and strip."""
        at_s = (position_ns - coverage.begin_ns) / S_NS
        whole_s = (coverage.end_ns - coverage.begin_ns) / S_NS
        if self._wanted_s is None:
            self._slider.value = round(at_s, 1)
        legend = (
            "green: poses; yellow: some triggers without; red: most without; grey: nothing to solve"
            if coverage.complete
            else "reading the whole dive ..."
        )
        text = panel.block(
            "<style>.strip{width:100%;height:20px;display:block;border-radius:3px}</style>",
            f"<b>{clock_words(at_s)}</b> of {clock_words(whole_s)}, speed {self.speed:g}"
            f"{'' if self.playing else ', paused'}",
            coverage.strip(position_ns),
            f'<div class="dim">{legend}</div>',
        )
        if text != self._said:
            self._said = text
            self._strip.content = text


def run(args: argparse.Namespace) -> int:
    """Serve the page until stopped."""
    service = Service("view")
    service.handle_signals()
    with Playback(args.dives) as playback:
        page = open_page(args, "Buddyline dive", live=False)
        coverage = Coverage(playback.start_ns, playback.end_ns)
        controls = Controls(page, (playback.end_ns - playback.start_ns) / S_NS, not args.paused)
        if args.start:
            playback.seek(playback.start_ns + round(args.start * S_NS))
        service.spawn("survey", lambda: _survey(service, args.dives, coverage))
        service.spawn("page", lambda: _play(service, page, playback, controls, coverage, SystemClock()))
        service.wait(args.seconds)
        status = service.join()
        page.close()
    return status


def _survey(service: Service, paths: list[str], coverage: Coverage) -> None:
    for count, _ in enumerate(survey(paths, coverage)):
        if count % PACE == 0 and service.stop.wait(0.001):
            return


def _play(
    service: Service, page: Page, playback: Playback, controls: Controls, coverage: Coverage, clock: Clock
) -> None:
    tick = 0
    before_ns = clock.now_ns()
    seen: frozenset[int] = frozenset()
    while not service.stop.wait(TICK_S):
        now_ns = clock.now_ns()
        passed_ns, before_ns = max(now_ns - before_ns, 0), now_ns
        viewers = page.viewers()
        wanted_s = controls.wanted_s()
        tick = 0 if viewers - seen or wanted_s is not None else tick + 1
        if wanted_s is not None:
            playback.seek(playback.start_ns + round(wanted_s * S_NS))
        elif controls.playing and seen:
            # A dive waits for its viewers, and a slow machine plays it slower rather than in jumps.
            step_ns = min(passed_ns, round(3 * TICK_S * S_NS))
            playback.advance(playback.position_ns + round(step_ns * controls.speed))
            if playback.position_ns >= playback.end_ns:
                controls.pause()
        seen = viewers
        picture, at_ns = playback.picture, playback.position_ns
        page.draw_scene(picture, at_ns)
        if tick % TEXTS_EVERY == 0:
            page.draw_texts(picture, at_ns)
            controls.show(coverage, at_ns)
        if tick % PLOTS_EVERY == 0:
            page.draw_plots(picture, at_ns)
