"""Make docs/page.png, README's picture of the page: `python -m tests.page_picture` (playwright and Chromium)."""

from __future__ import annotations

import tempfile
from pathlib import Path

from buddyline.tools.cli import main

from tests.processes import REPOSITORY
from tests.tools.browsed import Processes, chromium_browser, free_port, looking, wait_for_server

# Of the sample's thirty seconds: a path to look at, both nodes' pictures, and all four lights in view.
SHOWN_AT = "0:17."


def draw() -> None:
    """Solve the sample, view it, and take the picture."""
    processes, port = Processes(), free_port()
    with tempfile.TemporaryDirectory() as folder, chromium_browser() as chromium, looking(chromium, "page") as seen:
        logs = [str(Path(folder) / name) for name in ("sample.mcap", "solved.mcap")]
        assert main(["sample", "-o", logs[0]]) == 0
        assert main(["solve", logs[0], "-o", logs[1]]) == 0
        try:
            processes.start("view", "view", *logs, "--port", str(port))
            wait_for_server(f"http://127.0.0.1:{port}")
            seen.page.goto(f"http://127.0.0.1:{port}")
            seen.wait_for(SHOWN_AT)
            seen.page.screenshot(path=str(REPOSITORY / "docs" / "page.png"))
        finally:
            processes.end()


if __name__ == "__main__":
    draw()
