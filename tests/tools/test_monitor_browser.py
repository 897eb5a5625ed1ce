"""The page in a real browser: a running pair, a stored dive, a report. Screenshots go to build/screenshots."""

from __future__ import annotations

import shutil
import signal
import subprocess
import tarfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.processes import until
from tests.tools.browsed import (
    PATIENCE_MS,
    SCREENSHOTS,
    SIZES,
    Browser,
    CuttableLine,
    Film,
    Processes,
    chromium_browser,
    free_port,
    hold,
    looking,
    wait_for_server,
)
from tests.tools.evaluated import INFOS, rejection, write_log
from tests.tools.watched import at, image, tick

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

pytest.importorskip("websockets", reason="websockets is not installed")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with chromium_browser() as browser:
        yield browser


@pytest.fixture
def processes() -> Iterator[Processes]:
    started = Processes()
    yield started
    started.end()


def box_of(part: Any) -> dict[str, float]:
    """Return where a part of the page is. What is drawn anew between two looks has no place for a moment."""
    found: list[dict[str, float] | None] = []

    def looked() -> bool:
        found.append(part.bounding_box())
        return found[-1] is not None

    until(looked)
    box = found[-1]
    assert box is not None
    return box


def test_a_running_pair_is_watched_through_faults(chromium: Any, processes: Processes, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    port = free_port()
    # The page is there before the hub is, and finds it by itself.
    processes.start_monitor(endpoint, port)
    line = CuttableLine(port)
    with looking(chromium, "live") as seen, closing(line):
        seen.page.goto(f"http://127.0.0.1:{line.port}")
        seen.wait_for("Nothing has come over the bus yet")
        processes.start_pair(tmp_path, endpoint)
        seen.wait_for("Pose at ")
        seen.wait_for_green()
        assert seen.colours("#scene") > 50
        # Everything is there at once: nothing has to be scrolled.
        assert seen.page.evaluate("document.documentElement.scrollHeight") <= 800
        for part in ("#figures", "#scene", "#cam0 svg", "#cam1 svg", "#health", ".plot:nth-child(3) canvas"):
            box = box_of(seen.page.locator(part).first)
            assert box["height"] > 40, part
            assert box["y"] + box["height"] <= 800, part
        seen.screenshot("well")
        seen.page.click("#deck")
        assert min(seen.page.evaluate(FIGURE_PX)) >= 80
        seen.screenshot("deck")
        seen.page.click("#deck")
        seen.page.set_viewport_size({"width": 390, "height": 844})
        assert seen.page.evaluate("document.documentElement.scrollWidth") <= 390
        seen.page.wait_for_timeout(1000)
        seen.screenshot("well-on-a-phone")
        seen.page.set_viewport_size({"width": 1280, "height": 800})

        # Whatever is cut, green falls; it comes again by itself.
        for name in ("monitor", "solver", "b", "hub"):
            seen.wait_for_green()
            processes.running[name].send(signal.SIGSTOP)
            seen.wait_for_green(False)
            seen.screenshot(f"{name}-stopped")
            processes.running[name].send(signal.SIGCONT)
        seen.wait_for_green()
        line.cut()
        seen.wait_for("No news from the monitor")
        line.mend()
        seen.wait_for_green()

        processes.kill("b")
        seen.wait_for("Node b has left the bus")
        seen.wait_for("STALE")
        processes.kill("hub")
        seen.wait_for("Nothing comes over the bus any more")
        processes.start("hub", "hub", "--listen", endpoint)
        processes.start("b", "node", "--config", str(tmp_path / "b.toml"))
        seen.wait_for_green()
        processes.kill("monitor")
        seen.wait_for("No news from the monitor")
        processes.start_monitor(endpoint, port)
        seen.wait_for_green()
        # While the monitor was away the browser has said, in its console, that nobody answers.
        seen.complaints = [said for said in seen.complaints if "WebSocket connection to" not in said]
        seen.check_clean()


GROUND = "() => getComputedStyle(document.body).backgroundColor.match(/[0-9]+/g).map(Number)"
BEYOND_SCREEN = """() => [...document.querySelectorAll(".figure .big, .figure .big *")].filter(
    each => Math.max(each.scrollWidth, each.getBoundingClientRect().right) > innerWidth).map(each => each.outerHTML)"""
BEYOND_PAPER = """() => [...document.querySelectorAll("td, th, p, svg, img, canvas")].filter(
    each => each.getBoundingClientRect().right > innerWidth + 1).map(each => each.outerHTML.slice(0, 99))"""
# A cell of more lines than words.
BROKEN_NAMES = """() => [...document.querySelectorAll("td:first-child")].filter(each => {
    const text = document.createRange();
    text.selectNodeContents(each);
    return text.getClientRects().length > each.textContent.split(" ").length;
}).map(each => each.textContent)"""
# How long the page's thread is held: long enough for a loaded machine to film the end of green within it.
HELD_S = 20.0
FIGURE_PX = """() => [...document.querySelectorAll("#figures .big")].map(
    each => parseFloat(getComputedStyle(each).fontSize))"""


def test_green_fades_in_a_page_whose_script_hangs(chromium: Any, processes: Processes, tmp_path: Path) -> None:
    """A dive that plays is green; then the page's thread is held, and the screen is filmed from outside it."""
    port = free_port()
    whole = [*INFOS.values(), *(message for k in range(3000) for message in tick(k))]
    processes.start("view", "view", write_log(tmp_path / "well.mcap", *whole), "--port", str(port))
    wait_for_server(f"http://127.0.0.1:{port}")
    with looking(chromium, "hang") as seen, closing(Film(chromium, seen)) as film:
        seen.page.goto(f"http://127.0.0.1:{port}")
        seen.wait_for_green()
        film.wait_for_green()
        hold(seen, HELD_S)
        film.wait_for_green(False, HELD_S)


def dive_log(directory: Path) -> str:
    """A dive of a minute: no pose from 20 s to 26 s, a picture of each node every second."""
    messages = list(INFOS.values())
    for k in range(600):
        said = [m for m in tick(k) if not (200 <= k < 260 and type(m).__name__ == "RelativePose")]
        messages += said  # type: ignore[arg-type]
        if 200 <= k < 260:
            messages.append(rejection(k))  # type: ignore[arg-type]
        if k % 10 == 0:
            messages += [image("a", at(k)), image("b", at(k))]  # type: ignore[list-item]
    return write_log(directory / "dive.mcap", *messages)


@pytest.mark.parametrize("size", list(SIZES))
def test_a_stored_dive_is_played_and_scrubbed(chromium: Any, processes: Processes, tmp_path: Path, size: str) -> None:
    port = free_port()
    address = f"http://127.0.0.1:{port}"
    processes.start("view", "view", dive_log(tmp_path), "--paused", "--port", str(port))
    wait_for_server(address)
    with looking(chromium, "view", size) as seen:
        seen.page.goto(address)
        seen.wait_for("green: poses")
        seen.wait_for("0:00.0 of 0:59.9")
        seen.page.locator("#at").fill("22")
        seen.wait_for("0:22.0 of 0:59.9")
        seen.wait_for("No pose: more than one arrangement fits")
        seen.screenshot("no-pose")
        seen.page.locator("#speed").select_option("64")
        seen.page.locator("#play").click()
        seen.wait_for("0:59.9 of 0:59.9")
        seen.wait_for("paused")
        assert seen.colours("#scene") > 50
        seen.page.keyboard.press("p")
        seen.wait_for("0:19.9 of 0:59.9")
        seen.page.keyboard.press("ArrowLeft")
        seen.wait_for("0:19.8 of 0:59.9")
        seen.screenshot("end")
        seen.page.locator("#above").click()
        # From above: what is north is up, and what is east is right.
        seen.page.wait_for_function(
            """() => { const [north, east] = [[1, 0, 0], [0, 1, 0]].map((by) => scene.project(plus(scene.target, by)));
            const middle = scene.project(scene.target);
            return scene.fitted && north[1] < middle[1] - 10 && Math.abs(north[0] - middle[0]) < 1
                && east[0] > middle[0] + 10 && Math.abs(east[1] - middle[1]) < 1; }"""
        )
        seen.screenshot("above")
        seen.check_clean()


@pytest.fixture(scope="module")
def axe(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The source of axe-core, which finds what people with other senses or hands cannot use."""
    npm, folder = shutil.which("npm"), tmp_path_factory.mktemp("axe")
    if npm is None:
        pytest.skip("npm is not installed")
    done = subprocess.run([npm, "pack", "axe-core@4"], cwd=folder, capture_output=True, timeout=300, check=False)
    packed = list(folder.glob("*.tgz"))
    if done.returncode or not packed:
        pytest.skip("axe-core cannot be had from npm here")
    with tarfile.open(packed[0]) as archive:
        source = archive.extractfile("package/axe.min.js")
        assert source is not None
        return source.read().decode()


def test_everyone_can_use_it_in_every_layout(chromium: Any, processes: Processes, tmp_path: Path, axe: str) -> None:
    port = free_port()
    processes.start("view", "view", dive_log(tmp_path), "--paused", "--start", "22", "--port", str(port))
    wait_for_server(f"http://127.0.0.1:{port}")
    context = chromium.new_context(bypass_csp=True)
    try:
        for size, (width, height) in SIZES.items():
            seen = Browser(context.new_page(), f"layout-{size}")
            seen.page.set_viewport_size({"width": width, "height": height})
            seen.page.goto(f"http://127.0.0.1:{port}")
            seen.wait_for("No pose: more than one arrangement fits")
            seen.page.evaluate(axe)
            # Light and dark, with and without large figures alone.
            for key in ("", "l", "d", "l"):
                if key:
                    seen.page.keyboard.press(key)
                seen.page.wait_for_timeout(1200)
                pressed = [
                    name for name in ("deck", "light") if seen.page.locator(f"#{name}[aria-pressed=true]").count()
                ]
                found = seen.page.evaluate("axe.run()")["violations"]
                assert [(one["id"], one["nodes"][0]["html"][:120]) for one in found] == [], pressed
                assert seen.page.evaluate("document.documentElement.scrollWidth") <= width
                if "deck" in pressed:
                    assert min(seen.page.evaluate(FIGURE_PX)) >= 80
                    assert seen.page.evaluate(BEYOND_SCREEN) == []
                    assert seen.page.inner_text("#advice") == "What to do: come 1.0 m closer."
                seen.screenshot("-".join(pressed) or "dark")
            seen.check_clean()
            seen.page.close()
    finally:
        context.close()


def test_on_a_phone_every_figure_of_the_deck_is_seen(chromium: Any, processes: Processes, tmp_path: Path) -> None:
    port = free_port()
    processes.start("view", "view", dive_log(tmp_path), "--port", str(port))
    wait_for_server(f"http://127.0.0.1:{port}")
    with looking(chromium, "deck", "phone") as seen:
        seen.page.goto(f"http://127.0.0.1:{port}?deck")
        seen.wait_for("is 1 sd")
        assert min(seen.page.evaluate(FIGURE_PX)) >= 80
        # Without attitudes the range alone has its sigma below it; there is room for three such figures.
        box = box_of(seen.page.locator(".figure").first)
        assert box["y"] + 3 * box["height"] <= SIZES["phone"][1]


def test_fields_of_messages_are_plotted_beside_each_other(chromium: Any, processes: Processes, tmp_path: Path) -> None:
    port = free_port()
    processes.start("view", "view", dive_log(tmp_path), "--port", str(port))
    wait_for_server(f"http://127.0.0.1:{port}")
    wanted = (
        "buddyline/node/a/candidates blobs[0].u_px",
        "buddyline/pair/a/b/pose covariance[14]",
        "buddyline/node/b/attitude q_ned_body_xyzw[3]",
    )
    with looking(chromium, "fields") as seen:
        seen.page.goto(f"http://127.0.0.1:{port}")
        seen.wait_for("Pose at ")
        for k, name in enumerate(wanted):
            select = seen.page.locator(".plot select").nth(k)
            select.focus()
            seen.page.wait_for_function(
                "([k, name]) => [...document.querySelectorAll('.plot select')[k].options].some(o => o.value === name)",
                arg=[k, name],
            )
            select.select_option(name)
        seen.page.wait_for_function(
            "names => names.every(name => (state.probes[name] || []).length > 5)", arg=list(wanted)
        )
        seen.page.locator("#still").select_option("a, with its camera")
        seen.page.wait_for_timeout(1000)
        assert seen.page.locator(".plot canvas").count() == 3
        seen.screenshot("three")
        seen.check_clean()


@pytest.mark.parametrize("size", list(SIZES))
def test_a_report_is_read_without_a_network(chromium: Any, tmp_path: Path, size: str) -> None:
    from buddyline.tools.cli import main

    output = tmp_path / "report.html"
    assert main(["report", dive_log(tmp_path), "-o", str(output)]) == 0
    with looking(chromium, "report", size) as seen:
        seen.page.goto(output.as_uri())
        seen.wait_for("Dive report: dive.mcap")
        assert seen.colours("#replay") > 10
        before = seen.page.locator("#said").inner_text()
        seen.page.locator("#at").fill("900")
        assert seen.page.locator("#said").inner_text() != before
        assert seen.page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        seen.page.screenshot(path=str(SCREENSHOTS / f"report-{size}.png"), full_page=True, timeout=PATIENCE_MS)
        light = seen.page.evaluate(GROUND)
        seen.page.emulate_media(color_scheme="dark")
        dark = seen.page.evaluate(GROUND)
        assert min(light) > 200
        assert max(dark) < 60
        seen.page.screenshot(path=str(SCREENSHOTS / f"report-{size}-dark.png"), full_page=True, timeout=PATIENCE_MS)
        # On paper: light again, and nothing is wider than an A4 page between its margins.
        seen.page.emulate_media(media="print", color_scheme="dark")
        seen.page.set_viewport_size({"width": 718, "height": 1000})
        assert seen.page.evaluate(GROUND) == light
        assert seen.page.evaluate(BEYOND_PAPER) == []
        # What is turned with the mouse is not printed, and no word of a table's names is broken.
        assert not seen.page.locator("#replay").is_visible()
        assert seen.page.evaluate(BROKEN_NAMES) == []
        seen.check_clean("file:///")
