"""`make release` makes what a tag releases, and refuses what would not be one."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tarfile
from pathlib import Path

import pytest

from tests.processes import PATIENCE_S
from tests.wheels import PIP, copy_sources, run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed"),
]
OWN = {"GIT_AUTHOR_NAME": "a", "GIT_AUTHOR_EMAIL": "a@b", "GIT_COMMITTER_NAME": "a", "GIT_COMMITTER_EMAIL": "a@b"}


class Checkout:
    """A repository of its own with what is here now, committed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        copy_sources(folder)
        self.git("init", "--quiet")
        self.commit()

    def git(self, *words: str) -> None:
        subprocess.run(["git", *words], cwd=self.folder, check=True, capture_output=True, env={**os.environ, **OWN})

    def commit(self) -> None:
        self.git("add", "--all")
        self.git("commit", "--quiet", "--message", "all")

    def release(self) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [self.folder / ".ci" / "release"],
            capture_output=True,
            text=True,
            timeout=5 * PATIENCE_S,
            check=False,
            env={name: value for name, value in os.environ.items() if not name.startswith("PYTHON")},
        )


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def test_a_tag_becomes_a_release(checkout: Checkout) -> None:
    assert "HEAD has no tag" in checkout.release().stderr
    checkout.git("tag", "v7.8.9")
    assert "no section '## 7.8.9'" in checkout.release().stderr
    changes = (checkout.folder / "CHANGELOG.md").read_text()
    (checkout.folder / "CHANGELOG.md").write_text(changes.replace("## Unreleased", "## 7.8.9 - 2026-01-02", 1))
    assert "not committed" in checkout.release().stderr
    checkout.commit()
    checkout.git("tag", "--force", "v7.8.9")
    done = checkout.release()
    if re.search("No matching distribution|Could not find a version", done.stderr):
        pytest.skip("the tools of a release cannot be fetched from here")
    assert done.returncode == 0, done.stdout + done.stderr
    dist = checkout.folder / "dist"
    suffixes = {".whl", ".gz", ".json", ".md", ".txt", ".bash", ".zsh", ".tcsh"}
    assert {path.suffix for path in dist.glob("buddyline-7.8.9*")} == suffixes
    names = {name.partition("/")[2] for name in tarfile.open(dist / "buddyline-7.8.9.tar.gz").getnames()}
    for name in ("docs/tutorial.md", "examples/01_solve_a_dive.py", "node/examples/pi.toml", "tools/sample.mcap"):
        assert name in names
    assert "solve" in (dist / "buddyline-7.8.9.bash").read_text()
    parts = json.loads((dist / "buddyline-7.8.9.cdx.json").read_text())["components"]
    assert {"buddyline", "numpy", "eclipse-zenoh", "mcap"} <= {part["name"] for part in parts}
    pinned = (dist / "buddyline-7.8.9.requirements.txt").read_text()
    assert re.search(r"^numpy==\S+( \\\n    --hash=sha256:[0-9a-f]{64}){6}$", pinned, re.MULTILINE)
    assert "://" not in pinned
    assert re.search(r"^cryptography==\S+ \\$", pinned, re.MULTILINE), "the extras are missing"
    fleet = ("install", "--dry-run", "--ignore-installed", "--require-hashes", "--only-binary", ":all:")
    done = run(*PIP, *fleet, "-r", dist / "buddyline-7.8.9.requirements.txt", cwd=dist)
    assert done.returncode == 0, done.stderr
    assert "### Poses" in (dist / "buddyline-7.8.9.notes.md").read_text()
    subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=dist, check=True)
    assert "dist exists" in checkout.release().stderr
