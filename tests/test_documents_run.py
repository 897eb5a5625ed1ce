"""The commands in the documents work as they stand: each document's are run in order, in a folder of its own.

Addresses are replaced, and what would take long is shortened. What needs hardware, another machine, root or a person is
left out by name. Every other command of the programs in COMMAND must end well. Python in fences runs as well.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from buddyline.tools.cli import main

from tests.golden.logs import read_log, write_log
from tests.processes import PATIENCE_S, REPOSITORY, Process, free_endpoint

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
GOLDEN = REPOSITORY / "tests" / "data" / "golden"
DOCUMENTS = (
    "README.md",
    "docs/tutorial.md",
    "docs/dives.md",
    "docs/network.md",
    "docs/security.md",
    "docs/install.md",
    "node/README.md",
    "tools/survey/README.md",
)
COMMAND = re.compile(
    r"^(?:\$ )?(?:buddyline|make|mkdir|pipx|sha256sum|sudo|kill|\.|git|scp|pip|python3?|\.venv/bin/\S+) ?"
)
LEFT_OUT = {
    r"^sudo |^git |^scp ": "another machine, or root",
    r"^pipx? |^sha256sum ": "a release; tests/test_release.py",
    r"^make ": "the tests of the Makefile run it, or .ci/run",
    r"^\. \.venv": "the programs are on the path",
    r"^buddyline (view|monitor)": "a page until Ctrl-C; tests/tools/test_monitor_browser.py",
    r"^buddyline survey watch": "runs until Ctrl-C; tests/tools/test_survey_legs.py",
    r"^buddyline setup": "a Raspberry Pi; tests/tools/test_setup_pi.py, tests/chroots.py",
    r"^buddyline node --config": "a real camera and sensors; tests/node/test_service.py",
    r"^buddyline (hub|solver)( --config \S+| --share)?$": "run until Ctrl-C; the fixture runs them",
    r"^buddyline solve .* --authority ": "logs of nodes that have keys; tests/tools/test_authenticity.py",
    r"^buddyline experiments": "takes minutes; tests/tools/test_experiments.py",
}
SHORTER = {
    r"demo --seconds 30": "demo --seconds 8",
    r"--rate 4$": "--rate 4 --seconds 8",
    r"--images --imu$": "--images --imu --seconds 4 --rate 5",
    r"--speed 4$": "--speed 0",
}
# It says that its input is damaged.
DAMAGED = re.compile(r"^buddyline repair ")
LOCAL = re.compile(r"^buddyline (mark|play|record|hub|solver)\b")


def commands(text: str) -> Iterator[str]:
    """Yield the commands of a document's indented blocks; those joined by `&` to the next line, as one."""
    joined = ""
    for line in text.splitlines():
        if not line.startswith("    "):
            continue
        command = re.sub(r"\s+# .*$", "", line.strip())
        if not COMMAND.match(command):
            continue
        joined += command
        if joined.endswith("&") or (" & " in joined and "kill" not in joined):
            joined += "\n"
            continue
        yield joined
        joined = ""


def left_out(command: str) -> bool:
    """Whether a command is left out, for one of the reasons above."""
    return any(re.search(pattern, command) for pattern in LEFT_OUT)


def local(command: str, endpoint: str) -> str:
    """Return a command with our endpoint, and shortened."""
    for pattern, instead in SHORTER.items():
        command = re.sub(pattern, instead, command, flags=re.MULTILINE)
    parts = re.split(r"( &[ \n]|\n| &$)", command)
    for i, part in enumerate(parts):
        if match := LOCAL.match(part):
            parts[i] = f"{part} {'--listen' if match[1] == 'hub' else '--connect'} {endpoint}"
    return "".join(parts)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what the documents take for yours: nodes' logs, pictures, a cut log, a recording, a survey."""
    monkeypatch.chdir(tmp_path)
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "buddyline").write_text(f'#!/bin/sh\nexec {sys.executable} -P -m buddyline "$@"\n')
    (programs / "buddyline").chmod(0o755)
    surveyed = read_log(GOLDEN / "survey.mcap")
    marks = [entry for entry in surveyed if entry.topic == "mark"]
    write_log(tmp_path / "topside.mcap", marks)
    for node in "ab":
        (tmp_path / node).mkdir()
        shutil.copy(GOLDEN / f"night_reef_{node}.mcap", tmp_path / node / f"{node}-1.mcap")
        write_log(tmp_path / f"{node}.mcap", [one for one in surveyed if one.key.startswith(f"buddyline/node/{node}/")])
    assert main(["sample"]) == 0
    assert main(["detect", "sample.mcap", "-o", "found.mcap", "--draw", "photos"]) == 0
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "sample.mcap").read_bytes()[:900_000])
    (tmp_path / "sample.mcap").unlink()
    (tmp_path / "found.mcap").unlink()
    about = re.search(r"```toml\n(title.*?)```", (REPOSITORY / "docs" / "dives.md").read_text(), re.DOTALL)
    assert about is not None
    (tmp_path / "about.toml").write_text(about[1])
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "161.svx").write_text("*begin 161\n1 2 10.23 106 -02\n2 3 6.77 098 -04\n*end 161\n")
    shutil.copytree(REPOSITORY / "examples" / "datums", tmp_path / "examples" / "datums")
    shutil.copytree(REPOSITORY / "node" / "examples", tmp_path / "node" / "examples")
    return tmp_path


def run(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in bash; all that it started ends with it."""
    own = {"PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(REPOSITORY), "HOME": str(folder)}
    child = subprocess.Popen(
        ["bash", "-c", command],
        cwd=folder,
        env={**os.environ, **own},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        out, _ = child.communicate(timeout=3 * PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(child.pid, signal.SIGKILL)
        out, _ = child.communicate()
        return subprocess.CompletedProcess(command, -9, out)
    return subprocess.CompletedProcess(command, child.returncode, out)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_all_commands_of_a_document_end_well(name: str, folder: Path) -> None:
    document = list(commands((REPOSITORY / name).read_text(encoding="utf-8")))
    assert document, "the document has no commands"
    hub = ""
    with ExitStack() as stack:
        if any(LOCAL.match(command) and "&" not in command and not left_out(command) for command in document):
            hub = free_endpoint()
            stack.enter_context(Process("hub", "--listen", hub))
        for command in document:
            if left_out(command):
                continue
            done = run(local(command, free_endpoint() if "&" in command else hub), folder)
            wanted = 1 if DAMAGED.match(command) else 0
            assert done.returncode == wanted, (
                f"{name}: `{command}` ended with {done.returncode}:\n{done.stdout[-2000:]}"
            )


@pytest.mark.parametrize("name", ["README.md", "docs/library.md", "docs/theory.md"])
def test_the_python_of_a_document_runs(name: str, folder: Path) -> None:
    text = (REPOSITORY / name).read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert blocks, "the document has no Python"
    assert main(["sample"]) == 0
    for solved in ("solved.mcap", "poses.mcap"):
        assert main(["solve", "sample.mcap", "-o", solved]) == 0
    endpoint = free_endpoint()
    script = "\n".join(blocks).replace('"tcp/192.168.2.1:7447"', f'"{endpoint}", seconds=5')
    with ExitStack() as stack:
        if endpoint in script:
            for words in (("hub", "--listen"), ("solver", "--connect"), ("play", "sample.mcap", "--loop", "--connect")):
                stack.enter_context(Process(*words, endpoint, cwd=folder))
        (folder / "script.py").write_text(script)
        done = run(f"{sys.executable} -W error script.py", folder)
    assert done.returncode == 0, done.stdout[-2000:]
    assert endpoint not in script or len(done.stdout.splitlines()) > 3, "no poses have come"
