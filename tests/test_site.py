"""The documents make a site, and every link in it leads somewhere."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from buddyline.protocol.topics import TOPICS

from tests.processes import PATIENCE_S, REPOSITORY

pytestmark = pytest.mark.slow


def make(script: Path, site: Path) -> subprocess.CompletedProcess[str]:
    """Make the site as `make docs` does."""
    words = [sys.executable, script, site]
    return subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def test_the_site_is_made_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("myst_parser", reason="the extra docs is not installed")
    done = make(REPOSITORY / "docs" / "site" / "make.py", tmp_path / "site")
    assert done.returncode == 0, done.stdout + done.stderr
    commands = (tmp_path / "site" / "commands.html").read_text()
    assert "buddyline sample" in commands
    assert "buddyline calibrate lights" in commands
    messages = (tmp_path / "site" / "messages.html").read_text()
    assert all(topic.schema.__name__ in messages and topic.template in messages for topic in TOPICS)
    assert "trajectories" in (tmp_path / "site" / "index.html").read_text()
