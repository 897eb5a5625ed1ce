"""`buddyline view`: a stored dive on the monitor's page; each viewer plays, steps and scrubs for himself."""

from __future__ import annotations

import argparse
import bisect
import logging
import threading
from typing import TYPE_CHECKING, Any, Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.options import finite
from buddyline.tools.monitor.live import add_page_arguments, open_page
from buddyline.tools.pairs import add_pair_argument, solved_pair

if TYPE_CHECKING:
    from buddyline.protocol.clock import Clock
    from buddyline.tools.monitor.coverage import Coverage
    from buddyline.tools.monitor.overview import Overview
    from buddyline.tools.monitor.playback import Playback

log = logging.getLogger(__name__)

MIN_SPEED, MAX_SPEED = 0.05, 64.0
# A slow machine plays a dive more slowly, instead of in jumps longer than this.
MAX_STEP_NS: Final = 3 * S_NS // 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="one dive: a solved log, or each node's own")
    parser.add_argument("--start", type=finite, default=0.0, metavar="S", help="seconds from the dive's start")
    parser.add_argument("--paused", action="store_true", help="do not start to play at once")
    add_pair_argument(parser, "the first in the logs")
    add_page_arguments(parser)


class DiveSession:
    """One viewer's playback. Commands: play, loop, speed, seek (s), step and gap (1: to the next one, -1: back)."""

    def __init__(self, playback: Playback, coverage: Coverage, clock: Clock, *, playing: bool) -> None:
        self.lock = threading.Lock()
        self._playback = playback
        self._coverage = coverage
        self._clock = clock
        self._playing = playing
        self._loop = False
        self._speed = 1.0
        self._before_ns = clock.now_ns()
        self._told_strip = False

    def step(self, commands: list[dict[str, Any]]) -> tuple[Overview, int, bool]:
        """Obey, and play on by the time that has passed."""
        playback = self._playback
        now_ns = self._clock.now_ns()
        passed_ns, self._before_ns = max(now_ns - self._before_ns, 0), now_ns
        to_ns: int | None = None
        for command in commands:
            to_ns = self._obey(command, to_ns)
        if to_ns is not None:
            playback.seek(to_ns)
            return playback.overview, playback.position_ns, True
        if self._playing:
            playback.advance(playback.position_ns + round(min(passed_ns, MAX_STEP_NS) * self._speed))
            if playback.position_ns >= playback.end_ns:
                if self._loop:
                    playback.seek(playback.start_ns)
                    return playback.overview, playback.position_ns, True
                self._playing = False
        return playback.overview, playback.position_ns, False

    def _obey(self, command: dict[str, Any], to_ns: int | None) -> int | None:
        """Take one command; return where the playback goes, None if it goes nowhere."""
        at_ns = self._playback.position_ns if to_ns is None else to_ns
        for name, value in command.items():
            if isinstance(value, bool):
                if name == "play":
                    self._playing = value
                    if value and at_ns >= self._playback.end_ns:
                        to_ns = self._playback.start_ns
                elif name == "loop":
                    self._loop = value
            elif isinstance(value, int | float):
                if name == "speed":
                    self._speed = min(max(float(value), MIN_SPEED), MAX_SPEED)
                elif name == "seek":
                    to_ns = self._playback.start_ns + round(min(max(value, 0.0), 1e9) * S_NS)
                elif name == "step":
                    self._playing = False
                    to_ns = _next(self._coverage.times(), at_ns, value > 0)
                elif name == "gap":
                    begins = sorted(stretch.begin_at_ns for stretch in self._coverage.without())
                    to_ns = _next(begins, at_ns, value > 0)
        return to_ns

    def close(self) -> None:
        """Close the logs."""
        self._playback.close()

    def playback(self) -> dict[str, Any]:
        """Return position and length (s), whether it plays, its speed, and once the strip of the whole dive."""
        coverage, playback = self._coverage, self._playback
        said: dict[str, Any] = {
            "at": (playback.position_ns - playback.start_ns) / S_NS,
            "length": (playback.end_ns - playback.start_ns) / S_NS,
            "playing": self._playing,
            "speed": self._speed,
            "loop": self._loop,
        }
        if coverage.complete and not self._told_strip:
            from buddyline.tools.monitor.coverage import LEGEND

            self._told_strip = True
            said |= {"strip": coverage.strip(), "legend": LEGEND}
        return said


def _next(times_ns: list[int], at_ns: int, forward: bool) -> int | None:
    """Return the next, or the last, of ordered times; None if there is none."""
    index = bisect.bisect_right(times_ns, at_ns) if forward else bisect.bisect_left(times_ns, at_ns) - 1
    return times_ns[index] if 0 <= index < len(times_ns) else None


def run(args: argparse.Namespace) -> int:
    """Serve the page until stopped."""
    from buddyline.protocol.clock import SystemClock
    from buddyline.protocol.service import Service
    from buddyline.tools.dives import Dive
    from buddyline.tools.monitor.coverage import Coverage
    from buddyline.tools.monitor.playback import Playback, cover

    service = Service("view")
    service.handle_signals()
    with Dive(args.dives, one_rig=False) as dive:
        pair = solved_pair(dive, args.pair)
        start_ns = dive.start_ns + round(args.start * S_NS)
        coverage = Coverage(dive.start_ns, dive.end_ns)

        def open_session() -> DiveSession:
            # What is damaged has been said of the first reader.
            playback = Playback(Dive(args.dives, one_rig=False), pair)
            playback.seek(start_ns)
            return DiveSession(playback, coverage, SystemClock(), playing=not args.paused)

        page = open_page(args, "Buddyline dive", open_session, live=False)
        service.spawn("coverage", lambda: cover(coverage, args.dives, pair, service.stop))
        service.spawn("page", lambda: page.run(service.stop))
        service.wait(args.seconds)
        status = service.join()
        page.close()
    return status
