"""`buddyline view`: a stored dive on the monitor's page, with play, pause, speed and a scrubber."""

from __future__ import annotations

import argparse
import logging
import threading
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, Final

from buddyline.protocol.clock import S_NS
from buddyline.tools.monitor.live import add_page_arguments, open_page
from buddyline.tools.pairs import add_pair_argument, solved_pair

if TYPE_CHECKING:
    from buddyline.tools.monitor.coverage import Coverage
    from buddyline.tools.monitor.page import Page
    from buddyline.tools.monitor.picture import PairPicture

log = logging.getLogger(__name__)

SPEEDS: Final = ("0.25", "1", "4", "16", "64")
# A slow machine plays a dive more slowly, instead of in jumps longer than this.
MAX_STEP_NS: Final = 3 * S_NS // 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="one dive: a solved log, or each node's own")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="seconds from the dive's start")
    parser.add_argument("--paused", action="store_true", help="do not start to play at once")
    add_pair_argument(parser, "the first in the logs")
    add_page_arguments(parser)


class Controls:
    """The page's controls and the playback's position; the playing thread reads their state."""

    def __init__(self, page: Page, duration_s: float, playing: bool) -> None:
        gui = page.server.gui
        self.playing = playing
        self.speed = 1.0
        self._page = page
        self._lock = threading.Lock()
        self._wanted_s: float | None = None
        with gui.add_folder("Playback", order=-1):
            self._button = gui.add_button(self._button_text())
            speeds = gui.add_button_group("Speed", SPEEDS)
            # viser's types wrongly say that the value cannot be set.
            self._slider: Any = gui.add_slider("Seconds", 0.0, max(round(duration_s, 1), 0.1), 0.1, 0.0)
            self._strip = gui.add_html("")
        self._button.on_click(self._toggle)
        speeds.on_click(self._choose)
        self._slider.on_update(self._scrub)

    def _button_text(self) -> str:
        return "Pause" if self.playing else "Play"

    def _toggle(self, _: Any) -> None:
        self.playing = not self.playing
        self._button.label = self._button_text()

    def _choose(self, event: Any) -> None:
        self.speed = float(event.target.value)

    def _scrub(self, event: Any) -> None:
        # The playback moves the slider too: such an event names no client.
        if event.client_id is not None:
            with self._lock:
                self._wanted_s = float(event.target.value)

    def wanted_s(self) -> float | None:
        """Return where a viewer has moved the slider since the last call, s from the start; None: nowhere."""
        with self._lock:
            wanted_s, self._wanted_s = self._wanted_s, None
            return wanted_s

    def pause(self) -> None:
        """Pause the playback, at the dive's end."""
        if self.playing:
            self._toggle(None)

    def show(self, coverage: Coverage, position_ns: int) -> None:
        """Show the playback's position in slider and strip."""
        from buddyline.tools.monitor import panel
        from buddyline.tools.monitor.coverage import CSS, LEGEND, clock_words

        at_s = (position_ns - coverage.begin_ns) / S_NS
        whole_s = (coverage.end_ns - coverage.begin_ns) / S_NS
        if self._wanted_s is None and self._slider.value != round(at_s, 1):
            self._slider.value = round(at_s, 1)
        text = panel.block(
            f"<style>{CSS}</style><b>{clock_words(at_s)}</b> of {clock_words(whole_s)}, speed {self.speed:g}"
            f"{'' if self.playing else ', paused'}",
            coverage.strip(position_ns),
            f'<div class="dim">{LEGEND if coverage.complete else "reading the whole dive ..."}</div>',
        )
        self._page.set_html(self._strip, text)


def run(args: argparse.Namespace) -> int:
    """Serve the page until stopped."""
    from buddyline.protocol.clock import SystemClock
    from buddyline.protocol.service import Service
    from buddyline.tools.dives import Dive
    from buddyline.tools.monitor.coverage import Coverage
    from buddyline.tools.monitor.playback import Playback, cover

    service = Service("view")
    service.handle_signals()
    clock = SystemClock()
    with Dive(args.dives, one_rig=False) as dive:
        pair = solved_pair(dive, args.pair)
        playback = Playback(dive, pair)
        page = open_page(args, "Buddyline dive", live=False)
        coverage = Coverage(playback.start_ns, playback.end_ns)
        controls = Controls(page, dive.seconds, not args.paused)
        if args.start:
            playback.seek(playback.start_ns + round(args.start * S_NS))
        before_ns = clock.now_ns()

        def step(watched: bool) -> tuple[PairPicture, int, bool]:
            nonlocal before_ns
            now_ns = clock.now_ns()
            passed_ns, before_ns = max(now_ns - before_ns, 0), now_ns
            wanted_s = controls.wanted_s()
            if wanted_s is not None:
                playback.seek(playback.start_ns + round(wanted_s * S_NS))
            elif controls.playing and watched:
                # Without viewers the playback waits.
                playback.advance(playback.position_ns + round(min(passed_ns, MAX_STEP_NS) * controls.speed))
                if playback.position_ns >= playback.end_ns:
                    controls.pause()
            controls.show(coverage, playback.position_ns)
            return playback.picture, playback.position_ns, wanted_s is not None

        service.spawn("coverage", lambda: cover(coverage, args.dives, pair, service.stop))
        service.spawn("page", lambda: page.draw_until(service.stop, step, nullcontext()))
        service.wait(args.seconds)
        status = service.join()
        page.close()
    return status
