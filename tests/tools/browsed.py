"""A page in a headless Chromium, the commands that it shows, and the line between them."""

from __future__ import annotations

import base64
import shutil
import signal
import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import pytest
from buddyline.node.sim.scenario import Scenario
from buddyline.tools.demo.command import write_nodes

from tests.processes import REPOSITORY, Process, free_endpoint, until

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium")
if CHROMIUM is None:
    pytest.skip("chromium is not installed", allow_module_level=True)

SCREENSHOTS = REPOSITORY / "build" / "screenshots"
SIZES = {"desk": (1280, 800), "phone": (390, 844), "tablet": (820, 1180)}
FLAGS = [
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]
# On a busy machine the browser may need a minute for a single look at the page.
PATIENCE_MS = 240_000
GREEN = """() => document.getElementById("banner").className === "ok"
    && Number(getComputedStyle(document.getElementById("well")).opacity) > 0.5"""
WELL_BGR = [160, 224, 127]


class Browser:
    """One page of a headless Chromium, and all that it asked for and complained of."""

    def __init__(self, page: Any, name: str) -> None:
        self.page = page
        self.requests: list[str] = []
        self.complaints: list[str] = []
        self._name = name
        page.set_default_timeout(PATIENCE_MS)
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", lambda said: self.complaints.append(said.text) if said.type == "error" else None)

    def wait_for(self, text: str, timeout_s: float = PATIENCE_MS / 1e3) -> None:
        """Wait until the page says this."""
        try:
            self.page.wait_for_function(
                "text => document.body.innerText.includes(text)", arg=text, timeout=timeout_s * 1e3, polling=100
            )
        except sync_api.TimeoutError:
            said = self.page.inner_text("body")
            pytest.fail(f"no {text!r} in {timeout_s:g} s; complaints {self.complaints}; the page says:\n{said}")

    def wait_for_green(self, green: bool = True) -> None:
        """Wait until the page says that all is well, or no longer does."""
        wanted = f"() => ({GREEN})() === {str(green).lower()}"
        try:
            self.page.wait_for_function(wanted, timeout=PATIENCE_MS, polling=50)
        except sync_api.TimeoutError:
            pytest.fail(f"not {'green' if green else 'fallen'}; the page says:\n{self.page.inner_text('body')}")

    def screenshot(self, what: str) -> None:
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=str(SCREENSHOTS / f"{self._name}-{what}.png"), timeout=PATIENCE_MS)

    def colours(self, selector: str = "canvas") -> int:
        """Return how many different colours a part of the page shows."""
        import cv2
        import numpy as np

        data = self.page.locator(selector).first.screenshot(timeout=PATIENCE_MS)
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).reshape(-1, 3)
        return len(np.unique(pixels, axis=0))

    def check_clean(self, *allowed: str) -> None:
        outside = [
            url for url in self.requests if not url.startswith(("data:", "blob:", "http://127.0.0.1:", *allowed))
        ]
        assert outside == []
        assert self.complaints == []


@contextmanager
def chromium_browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@contextmanager
def looking(chromium: Any, name: str, size: str = "desk") -> Iterator[Browser]:
    width, height = SIZES[size]
    page = chromium.new_page(viewport={"width": width, "height": height})
    try:
        yield Browser(page, f"{name}-{size}")
    finally:
        page.close()


# A screen that shows something for this long does not only flicker.
STEADY_S: Final = 1.0


class Film:
    """The banner as the screen shows it, filmed from outside the page: it goes on while the page's thread is held."""

    def __init__(self, chromium: Any, seen: Browser) -> None:
        self._clock = chromium.new_page()
        self._camera = seen.page.context.new_cdp_session(seen.page)
        self._green: bool | None = None
        self._shown_s = self._since_s = self._turned_s = 0.0
        self._camera.on("Page.screencastFrame", self._filmed)
        # Small pictures: while one waits to be taken, others are left out.
        small = {"maxWidth": 320, "maxHeight": 200}
        self._camera.send("Page.startScreencast", {"format": "png", "everyNthFrame": 1, **small})

    def _filmed(self, frame: dict[str, Any]) -> None:
        import cv2
        import numpy as np

        picture = cv2.imdecode(np.frombuffer(base64.b64decode(frame["data"]), np.uint8), cv2.IMREAD_COLOR)
        # They may come in another order.
        if frame["metadata"]["timestamp"] > self._shown_s:
            green, self._shown_s = picture[5, 175].tolist() == WELL_BGR, frame["metadata"]["timestamp"]
            if green != self._green:
                self._green, self._since_s, self._turned_s = green, self._shown_s, time.monotonic()
        self._camera.send("Page.screencastFrameAck", {"sessionId": frame["sessionId"]})

    def wait_for_green(self, green: bool = True, timeout_s: float = PATIENCE_MS / 1e3) -> float:
        """Wait until the screen shows for STEADY_S that all is well, or not; return since when (epoch, s)."""
        began_s = time.monotonic()
        while self._green is not green or time.monotonic() < self._turned_s + STEADY_S:
            assert time.monotonic() < began_s + timeout_s, f"{'not' if green else 'still'} green"
            self._clock.wait_for_timeout(20)
        return self._since_s

    def close(self) -> None:
        self._camera.detach()
        self._clock.close()


def hold(seen: Browser, seconds: float) -> None:
    """Let the page's thread do nothing else for a while, as in a frozen tab."""
    held = f"const from = performance.now(); while (performance.now() < from + {1e3 * seconds});"
    seen.page.evaluate(f"setTimeout(() => {{ {held} }}, 9)")


class Processes:
    """`buddyline` commands by name, ended with the test."""

    def __init__(self) -> None:
        self.running: dict[str, Process] = {}

    def start(self, name: str, *words: str) -> None:
        self.running[name] = Process(*words)

    def start_pair(self, folder: Path, endpoint: str) -> None:
        """Start hub, two simulated nodes at 2 Hz, a and b, and the solver."""
        self.start("hub", "hub", "--listen", endpoint)
        scenario = Scenario(environment="cavern", seed=1, start_ns=time.time_ns())
        for node, config in write_nodes(folder, folder, endpoint, scenario, 2.0):
            self.start(node, "node", "--config", str(config))
        self.start("solver", "solver", "--connect", endpoint)

    def start_monitor(self, endpoint: str, port: int) -> None:
        """Start the monitor, and wait for its page."""
        self.start("monitor", "monitor", "--connect", endpoint, "--port", str(port))
        wait_for_server(f"http://127.0.0.1:{port}")

    def kill(self, name: str) -> None:
        self.running.pop(name).end(signal.SIGKILL)

    def end(self) -> None:
        # Also one that a failed test has left stopped.
        for child in self.running.values():
            child.end(signal.SIGKILL)


def free_port() -> int:
    return int(free_endpoint().rpartition(":")[2])


def wait_for_server(address: str) -> None:
    def answers() -> bool:
        try:
            urllib.request.urlopen(address, timeout=5).close()
        except OSError:
            return False
        return True

    until(answers, pause_s=0.1)


class CuttableLine:
    """A line between page and monitor that can be cut: what is sent then waits, as on a dead network."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._open = threading.Event()
        self._open.set()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._sockets: list[socket.socket] = [self._listener]
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        self._open.clear()

    def mend(self) -> None:
        self._open.set()

    def _accept(self) -> None:
        while True:
            try:
                near = self._listener.accept()[0]
            except OSError:
                return
            self._sockets.append(near)
            try:
                far = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                near.close()
                continue
            self._sockets.append(far)
            for one, other in ((near, far), (far, near)):
                threading.Thread(target=self._carry, args=(one, other), daemon=True).start()

    def _carry(self, one: socket.socket, other: socket.socket) -> None:
        try:
            while data := one.recv(65536):
                self._open.wait()
                other.sendall(data)
        except OSError:
            pass
        for each in (one, other):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._open.set()
        for each in self._sockets:
            each.close()
