"""The monitor's cost: CPU and memory of its server with viewers, the solver's latency meanwhile, the page's size.

A simulated dive of candidates is played at 30 Hz in a loop, through a hub and the solver, with pictures of two nodes
twice a second. A viewer is a connection like the page's, which receives everything and draws nothing. With a browser
(playwright and Chromium) the time until the page shows the scene is measured too.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from buddyline.protocol.bus import Bus
from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Candidates, CompressedImage, FoxgloveTime, RelativePose
from buddyline.protocol.options import finite
from buddyline.protocol.topics import CANDIDATES, IMAGE, POSE
from buddyline.tools.client import ClientConfig
from buddyline.tools.extras import needed
from buddyline.tools.live import follow, open_bus_within
from buddyline.tools.measure.children import Child, free_endpoint, free_port
from buddyline.tools.measure.tables import cells_of, text_table
from buddyline.tools.monitor.server import FILES

RATE_HZ: Final = 30
DIVE_S: Final = 120
PREVIEW_S: Final = 0.5
PREVIEW_PX: Final = (410, 308)
WINDOW_S: Final = 30.0
READY_S: Final = 60.0
# Time after a monitor's start that does not count.
SETTLE_S: Final = 5.0
# The page draws its first picture in software, which may take this long.
BROWSER_MS: Final = 120_000
SOLVED: Final = "± is 1 sd"
CHROMIUM_FLAGS: Final = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmark's arguments."""
    parser.add_argument("--minutes", type=finite, default=2.0, help="when CPU and memory are read again; default: 2")
    parser.add_argument("--viewers", type=int, nargs="+", default=[1, 3], metavar="N", help="default: 1 3")
    parser.add_argument("--rounds", type=int, default=4, help="of latency with and without; default: 4")
    parser.add_argument("--round-s", type=finite, default=15.0, help="default: 15")


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Return the page's size, the latency with and without a monitor by turns, and the servers' CPU and memory."""
    if args.minutes < 1 or min(args.viewers) < 1 or args.rounds < 0:
        raise BuddylineError("--minutes: 1 or more; --viewers: 1 or more; --rounds: 0 or more")
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as directory, playing(Path(directory), endpoint) as bus:
        return {
            "latency": measure_latency(bus, endpoint, args.rounds, args.round_s),
            "page": measure_page(endpoint),
            "servers": measure_servers(endpoint, args.viewers, args.minutes),
        }


@contextmanager
def playing(directory: Path, endpoint: str) -> Iterator[Bus]:
    """Run hub, solver and a dive in a loop, with previews; yield a bus to listen on when the first pose has come."""
    dive = str(directory / "dive.mcap")
    made = [sys.executable, "-P", "-m", "buddyline", "simulate", dive, "--rate", str(RATE_HZ), "--seconds", str(DIVE_S)]
    subprocess.run([*made, "--undisturbed", "--range-max", "8"], check=True, capture_output=True)
    stop, came = threading.Event(), threading.Event()
    with (
        Child("hub", "--listen", endpoint),
        Child("solver", "--connect", endpoint),
        open_bus_within(ClientConfig(connect=endpoint), READY_S) as bus,
        Child("play", dive, "--loop", "--connect", endpoint),
    ):
        previews = threading.Thread(target=_previews, args=(bus, stop))
        previews.start()
        try:
            watching = bus.subscribe(POSE.key_any(), lambda _: came.set(), history=False)
            if not came.wait(READY_S):
                raise BuddylineError(f"no pose within {READY_S:g} s")
            watching.close()
            yield bus
        finally:
            stop.set()
            previews.join(10)


def _previews(bus: Bus, stop: threading.Event) -> None:
    import cv2

    width, height = PREVIEW_PX
    noise = np.random.default_rng(1).normal(40, 12, (height, width)).clip(0, 255).astype(np.uint8)
    data = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()
    publishers = {node: bus.publisher(IMAGE, node) for node in "ab"}
    while not stop.wait(PREVIEW_S):
        now_ns = time.time_ns()
        stamp = FoxgloveTime(sec=now_ns // S_NS, nsec=now_ns % S_NS)
        for node, publisher in publishers.items():
            publisher.put(CompressedImage(timestamp=stamp, frame_id=f"{node}_camera", data=data, format="jpeg"))


class Latencies:
    """The time of each pose after the later of its two Candidates messages, as a third process receives them."""

    def __init__(self) -> None:
        self._frames_ns: dict[int, list[int]] = {}
        self._poses_ns: dict[int, int] = {}

    def take(self, envelope: Envelope) -> None:
        """Take a frame's candidates or a pose."""
        if isinstance(envelope.message, Candidates):
            self._frames_ns.setdefault(envelope.message.trigger, []).append(envelope.time_ns)
        elif isinstance(envelope.message, RelativePose):
            self._poses_ns[envelope.message.trigger] = envelope.time_ns

    def seconds(self) -> list[float]:
        """Return all latencies so far. Frames and poses come from two threads, in any order; they are matched here."""
        return [
            (pose_ns - max(frames_ns)) / 1e9
            for trigger, pose_ns in self._poses_ns.items()
            if len(frames_ns := self._frames_ns.get(trigger, [])) == 2
        ]


def measure_latency(bus: Bus, endpoint: str, rounds: int, round_s: float) -> dict[str, list[float]]:
    """Return the candidates-to-pose medians and p99, s, of rounds without and with a monitor and a viewer, by turns."""
    result: dict[str, list[float]] = {"without_s": [], "with_s": [], "without_p99_s": [], "with_p99_s": []}
    for _ in range(rounds):
        for name in ("without", "with"):
            with ExitStack() as stack:
                if name == "with":
                    address = stack.enter_context(monitor(endpoint))[1]
                    stack.enter_context(viewer(address))
                time.sleep(SETTLE_S)
                latencies, refusals = Latencies(), Refusals("bench")
                subscriptions = [
                    follow(bus, topic.key_any(), refusals, latencies.take, history=False)
                    for topic in (CANDIDATES, POSE)
                ]
                time.sleep(round_s)
                for subscription in subscriptions:
                    subscription.close()
            latencies_s = latencies.seconds()
            if not latencies_s:
                raise BuddylineError("no poses came")
            result[f"{name}_s"].append(statistics.median(latencies_s))
            result[f"{name}_p99_s"].append(float(np.percentile(latencies_s, 99)))
    return result


@contextmanager
def monitor(endpoint: str) -> Iterator[tuple[Child, str]]:
    """Run a monitor; yield it and its page's address when the page answers."""
    port = free_port()
    address = f"127.0.0.1:{port}"
    with Child("monitor", "--connect", endpoint, "--port", str(port)) as child:
        ends_s = time.monotonic() + READY_S
        while True:
            try:
                urllib.request.urlopen(f"http://{address}", timeout=5).close()
            except OSError as error:
                if (death := child.death()) or time.monotonic() > ends_s:
                    raise BuddylineError(death or "the monitor's page does not come up") from error
                time.sleep(0.1)
            else:
                break
        yield child, address


@contextmanager
def viewer(address: str) -> Iterator[list[int]]:
    """Connect to a page as its client does, and receive everything; yield a list with the number of bytes so far."""
    client = needed("websockets.sync.client", "a viewer", "monitor")
    taken = [0]

    def take(connection: Any) -> None:
        for data in connection:
            taken[0] += len(data)

    with client.connect(f"ws://{address}/ws", max_size=None) as connection:
        taker = threading.Thread(target=take, args=(connection,))
        taker.start()
        try:
            yield taken
        finally:
            connection.close()
            taker.join(10)


def measure_servers(endpoint: str, viewers: list[int], minutes: float) -> list[dict[str, float]]:
    """Return CPU (share of a core), memory (MiB) and traffic of monitors, after one minute and after `minutes`.

    viewers: number of viewers of each monitor. All monitors run at once, each in its own process.
    """
    rows: list[dict[str, float]] = []
    with ExitStack() as stack:
        started = []
        for count in viewers:
            child, address = stack.enter_context(monitor(endpoint))
            started.append((count, child, [stack.enter_context(viewer(address)) for _ in range(count)]))
        began_s = time.monotonic()
        for at_s in sorted({60.0, minutes * 60}):
            time.sleep(max(began_s + at_s - WINDOW_S - time.monotonic(), 0))
            before = [(child.load(), sum(one[0] for one in taken), time.monotonic()) for _, child, taken in started]
            time.sleep(max(began_s + at_s - time.monotonic(), 1.0))
            for (count, child, taken), (early, taken_before, then_s) in zip(started, before, strict=True):
                late, span_s = child.load(), time.monotonic() - then_s
                row = {
                    "viewers": count,
                    "minutes": at_s / 60,
                    "cpu_share": (late.cpu_s - early.cpu_s) / span_s,
                    "rss_mib": late.rss_mib,
                    "to_each_kbyte_s": (sum(one[0] for one in taken) - taken_before) / count / span_s / 1e3,
                }
                rows.append(row)
                print(json.dumps(row), file=sys.stderr, flush=True)
    return rows


def measure_page(endpoint: str) -> dict[str, float]:
    """Return the page's size as served and, with a browser, the seconds until it shows the scene."""
    with monitor(endpoint) as (_, address):
        size = 0
        for path in FILES:
            request = urllib.request.Request(f"http://{address}{path}", headers={"Accept-Encoding": "gzip"})
            with urllib.request.urlopen(request, timeout=30) as file:
                size += len(file.read())
        figures = {"page_kbyte": size / 1e3}
        with viewer(address) as taken:
            time.sleep(2.0)
            figures["first_two_seconds_kbyte"] = taken[0] / 1e3
        seconds = _first_scene_s(address)
    return figures if seconds is None else figures | {"first_scene_s": seconds}


def _first_scene_s(address: str) -> float | None:
    """Return the seconds until the page shows the pair in Chromium; None without Chromium, or after a time-out."""
    chromium = shutil.which("chromium")
    try:
        from playwright.sync_api import TimeoutError as TooLate
        from playwright.sync_api import sync_playwright
    except ImportError:
        return None
    if chromium is None:
        return None
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(CHROMIUM_FLAGS))
        try:
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            began_s = time.monotonic()
            page.goto(f"http://{address}")
            page.wait_for_function(
                "text => document.querySelector('canvas') && document.body.innerText.includes(text)",
                arg=SOLVED,
                timeout=BROWSER_MS,
            )
            return time.monotonic() - began_s
        except TooLate:
            return None
        finally:
            browser.close()


def table(figures: dict[str, Any]) -> str:
    """Return the figures for a person."""
    page, latency = figures["page"], figures["latency"]
    lines = [f"page {page['page_kbyte']:.0f} KB as served; first two seconds {page['first_two_seconds_kbyte']:.0f} KB"]
    if "first_scene_s" in page:
        lines.append(f"first scene after {page['first_scene_s']:.1f} s (Chromium, drawing in software)")
    if latency["with_s"]:
        ratios = [a / b for a, b in zip(latency["with_s"], latency["without_s"], strict=True)]
        ms = {name: 1e3 * statistics.median(values) for name, values in latency.items()}
        lines.append(
            f"candidates to pose, median: {ms['without_s']:.2f} ms without, {ms['with_s']:.2f} ms with; "
            f"ratio {statistics.median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f} in {len(ratios)} rounds); "
            f"p99 {ms['without_p99_s']:.1f} and {ms['with_p99_s']:.1f} ms"
        )
    columns = {
        "viewers": "{viewers}",
        "minutes": "{minutes:.0f}",
        "CPU, of a core": "{cpu_share:.1%}",
        "RSS, MiB": "{rss_mib:.0f}",
        "KB/s to each": "{to_each_kbyte_s:.0f}",
    }
    return "\n".join([*lines, text_table(cells_of(figures["servers"], columns))])
