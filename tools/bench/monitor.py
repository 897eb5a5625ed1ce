"""What the monitor costs: its server's CPU and memory with viewers, the solver's latency beside it, the page's weight.

A simulated dive of candidates is played at 30 Hz, over and over, through a hub and the solver; pictures of two nodes
come twice a second. Viewers are connections as the page makes them, which take all and draw nothing; with a browser
(playwright and Chromium) the time until the page shows the scene is measured as well.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from buddyline.protocol.bus import Bus, Received
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Candidates, CompressedImage, FoxgloveTime, RelativePose
from buddyline.protocol.topics import CANDIDATES, IMAGE, POSE

RATE_HZ: Final = 30
DIVE_S: Final = 120
PREVIEW_S: Final = 0.5
PREVIEW_PX: Final = (410, 308)
WINDOW_S: Final = 30.0
READY_S: Final = 60.0
# What starting a monitor costs is not what it costs while it runs.
SETTLE_S: Final = 5.0
# As long as the page draws its first picture in software.
BROWSER_MS: Final = 120_000
SOLVED: Final = "the solver finds the pose"
CHROMIUM_FLAGS: Final = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def main(argv: list[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m buddyline.tools.bench monitor", description=__doc__)
    parser.add_argument("--minutes", type=float, default=2.0, help="when CPU and memory are read again; default: 2")
    parser.add_argument("--viewers", type=int, nargs="+", default=[1, 3], metavar="N", help="default: 1 3")
    parser.add_argument("--rounds", type=int, default=4, help="of latency with and without; default: 4")
    parser.add_argument("--round-s", type=float, default=15.0, help="default: 15")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    if args.minutes < 1 or min(args.viewers) < 1 or args.rounds < 0:
        raise BuddylineError("--minutes: 1 or more; --viewers: 1 or more; --rounds: 0 or more")
    with tempfile.TemporaryDirectory() as directory, ExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        bus = stack.enter_context(playing(Path(directory), endpoint))
        latencies = measure_latency(bus, endpoint, args.rounds, args.round_s)
        figures = {
            "page": measure_page(endpoint),
            "latency": latencies,
            "servers": measure_servers(endpoint, args.viewers, args.minutes),
        }
    print(json.dumps(figures) if args.json else "\n".join(table(figures)))
    return 0


def free_port() -> int:
    """Return a port of loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def running(*words: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a `buddyline` command until left."""
    with tempfile.TemporaryFile() as said:
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", "buddyline", *words], stdin=subprocess.DEVNULL, stdout=said, stderr=said
        )
        try:
            yield child
        finally:
            early = child.poll()
            child.terminate()
            try:
                child.wait(10)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait(10)
            if early is not None:
                said.seek(0)
                last = said.read().decode(errors="replace").splitlines()[-5:]
                print(f"buddyline {words[0]} ended with {early}: {' | '.join(last)}", file=sys.stderr)


@contextmanager
def playing(directory: Path, endpoint: str) -> Iterator[Bus]:
    """Run hub, solver and a dive over and over, with previews; give a bus to listen on once poses come."""
    from buddyline.protocol.zenoh_bus import connect

    dive = str(directory / "dive.mcap")
    made = [sys.executable, "-P", "-m", "buddyline", "simulate", dive, "--rate", str(RATE_HZ), "--seconds", str(DIVE_S)]
    subprocess.run([*made, "--undisturbed", "--range-max", "8"], check=True, capture_output=True)
    stop = threading.Event()
    with running("hub", "--listen", endpoint), running("solver", "--connect", endpoint):
        bus = connect(endpoint, namespace=None, stop=stop, on_wait=lambda _: None)
        if bus is None:
            raise BuddylineError("no hub came up")
        with bus, running("play", dive, "--loop", "--connect", endpoint):
            previews = threading.Thread(target=_previews, args=(bus, stop))
            previews.start()
            try:
                came = threading.Event()
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


@dataclass
class Listener:
    """How long each pose takes to come after the later of its two candidates, s, as a third party hears both."""

    _frames_ns: dict[int, dict[str, int]] = field(default_factory=dict)
    _poses_ns: dict[int, int] = field(default_factory=dict)

    def candidates(self, received: Received) -> None:
        """Take a frame's candidates."""
        message = received.open().message
        if isinstance(message, Candidates):
            self._frames_ns.setdefault(message.trigger, {})[message.node] = received.receive_ns

    def pose(self, received: Received) -> None:
        """Take a pose."""
        message = received.open().message
        if isinstance(message, RelativePose):
            self._poses_ns[message.trigger] = received.receive_ns

    @property
    def latencies_s(self) -> list[float]:
        """All so far. Threads take frames and poses in any order, so they are matched here."""
        return [
            (pose_ns - max(frames_ns.values())) / 1e9
            for trigger, pose_ns in self._poses_ns.items()
            if len(frames_ns := self._frames_ns.get(trigger, {})) == 2
        ]


def measure_latency(bus: Bus, endpoint: str, rounds: int, round_s: float) -> dict[str, list[float]]:
    """Return candidates-to-pose medians (s) of turns without and with the monitor and a viewer, one after another."""
    result: dict[str, list[float]] = {"without_s": [], "with_s": [], "without_p99_s": [], "with_p99_s": []}
    for _ in range(rounds):
        for name in ("without", "with"):
            with ExitStack() as stack:
                if name == "with":
                    address = stack.enter_context(monitor(endpoint))[1]
                    stack.enter_context(viewer(address))
                time.sleep(SETTLE_S)
                listener = Listener()
                subscriptions = [
                    bus.subscribe(CANDIDATES.key_any(), listener.candidates, history=False),
                    bus.subscribe(POSE.key_any(), listener.pose, history=False),
                ]
                time.sleep(round_s)
                for subscription in subscriptions:
                    subscription.close()
            latencies_s = listener.latencies_s
            if not latencies_s:
                raise BuddylineError("no poses came")
            result[f"{name}_s"].append(statistics.median(latencies_s))
            result[f"{name}_p99_s"].append(float(np.percentile(latencies_s, 99)))
    return result


@contextmanager
def monitor(endpoint: str) -> Iterator[tuple[int, str]]:
    """Run a monitor; give its process id and the page's address once that answers."""
    port = free_port()
    with running("monitor", "--connect", endpoint, "--port", str(port)) as child:
        address = f"127.0.0.1:{port}"
        deadline_s = time.monotonic() + READY_S
        while True:
            try:
                urllib.request.urlopen(f"http://{address}", timeout=5).close()
            except OSError as error:
                if time.monotonic() > deadline_s or child.poll() is not None:
                    raise BuddylineError("the monitor's page does not come up") from error
                time.sleep(0.1)
            else:
                break
        yield child.pid, address


@contextmanager
def viewer(address: str) -> Iterator[list[int]]:
    """Look at a page as its own client does, taking all that comes; give the bytes so far, in a list of one."""
    try:
        import msgspec
        import viser
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol
    except ImportError as error:
        raise BuddylineError(f"{error.name} is not installed: pip install 'buddyline[monitor]'") from error
    eye: dict[str, Any] = {
        **{"type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (3.0, 3.0, 3.0), "fov": 1.0},
        **{"near": 0.1, "far": 100.0, "image_height": 800, "image_width": 1280},
        **{"look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, -1.0)},
    }
    taken = [0]

    def take(connection: Any) -> None:
        for data in connection:
            taken[0] += len(data)

    spoken = [Subprotocol(f"viser-v{viser.__version__}")]
    with connect(f"ws://{address}", subprotocols=spoken, max_size=None, compression=None) as connection:
        connection.send(msgspec.msgpack.encode(eye))
        taker = threading.Thread(target=take, args=(connection,))
        taker.start()
        try:
            yield taken
        finally:
            connection.close()
            taker.join(10)


def measure_servers(endpoint: str, viewers: list[int], minutes: float) -> list[dict[str, float]]:
    """Return CPU (share of a core), memory (MiB) and traffic of monitors with so many viewers, early and late.

    All of them run at once, each a process of its own.
    """
    rows: list[dict[str, float]] = []
    with ExitStack() as stack:
        started = []
        for count in viewers:
            pid, address = stack.enter_context(monitor(endpoint))
            started.append((count, pid, [stack.enter_context(viewer(address)) for _ in range(count)]))
        began_s = time.monotonic()
        for at_s in sorted({60.0, minutes * 60}):
            time.sleep(max(began_s + at_s - WINDOW_S - time.monotonic(), 0))
            before = [(_cpu_s(pid), sum(one[0] for one in taken), time.monotonic()) for _, pid, taken in started]
            time.sleep(max(began_s + at_s - time.monotonic(), 1.0))
            for (count, pid, taken), (cpu_s, taken_before, then_s) in zip(started, before, strict=True):
                span_s = time.monotonic() - then_s
                row = {
                    "viewers": count,
                    "minutes": at_s / 60,
                    "cpu_share": (_cpu_s(pid) - cpu_s) / span_s,
                    "rss_mib": _rss_mib(pid),
                    "to_each_kbyte_s": (sum(one[0] for one in taken) - taken_before) / count / span_s / 1e3,
                }
                rows.append(row)
                print(json.dumps(row), file=sys.stderr, flush=True)
    return rows


def _cpu_s(pid: int) -> float:
    fields = _proc(pid, "stat").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _rss_mib(pid: int) -> float:
    rows = [row for row in _proc(pid, "status").splitlines() if row.startswith("VmRSS:")]
    if not rows:
        raise BuddylineError(f"process {pid} has ended")
    return int(rows[0].split()[1]) / 1024


def _proc(pid: int, name: str) -> str:
    try:
        return Path(f"/proc/{pid}/{name}").read_text()
    except OSError as error:
        raise BuddylineError(f"process {pid} cannot be measured: {error.strerror}") from error


def measure_page(endpoint: str) -> dict[str, float]:
    """Return the page's weight as served, and, with a browser, the seconds until it has the scene."""
    with monitor(endpoint) as (_, address):
        request = urllib.request.Request(f"http://{address}", headers={"Accept-Encoding": "gzip"})
        with urllib.request.urlopen(request, timeout=30) as page:
            figures = {"page_kbyte": len(page.read()) / 1e3}
        with viewer(address) as taken:
            time.sleep(2.0)
            figures["first_two_seconds_kbyte"] = taken[0] / 1e3
        seconds = _first_scene_s(address)
    return figures if seconds is None else figures | {"first_scene_s": seconds}


def _first_scene_s(address: str) -> float | None:
    """Return how long Chromium takes until the page shows the pair; None without it, or where it takes for ever."""
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


def table(figures: dict[str, Any]) -> list[str]:
    """Return the figures as lines."""
    page, latency = figures["page"], figures["latency"]
    rows = [f"page {page['page_kbyte']:.0f} KB as served; first two seconds {page['first_two_seconds_kbyte']:.0f} KB"]
    if "first_scene_s" in page:
        rows.append(f"first scene after {page['first_scene_s']:.1f} s (Chromium, drawing in software)")
    if latency["with_s"]:
        ratios = [a / b for a, b in zip(latency["with_s"], latency["without_s"], strict=True)]
        rows.append(
            f"candidates to pose, median: {1e3 * statistics.median(latency['without_s']):.2f} ms without, "
            f"{1e3 * statistics.median(latency['with_s']):.2f} ms with; ratio {statistics.median(ratios):.2f} "
            f"({min(ratios):.2f}-{max(ratios):.2f} in {len(ratios)} rounds); "
            f"p99 {1e3 * statistics.median(latency['without_p99_s']):.1f} and "
            f"{1e3 * statistics.median(latency['with_p99_s']):.1f} ms"
        )
    rows.append(f"{'viewers':>8}{'minutes':>9}{'CPU, % of a core':>18}{'RSS, MiB':>10}{'KB/s to each':>14}")
    for row in figures["servers"]:
        rows.append(
            f"{row['viewers']:8}{row['minutes']:9.0f}{100 * row['cpu_share']:18.1f}{row['rss_mib']:10.0f}"
            f"{row['to_each_kbyte_s']:14.0f}"
        )
    return rows
