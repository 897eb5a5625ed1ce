"""The commands in the documents work as they stand: each document's are run in order, in a folder of its own.

Addresses are replaced, and what would take long is shortened. What runs until Ctrl-C runs on beside the commands that
follow it. What needs hardware, another machine, root or a person is left out by name. Every other command of the
programs in COMMAND must end well. Python in fences runs as well.
"""

from __future__ import annotations

import os
import re
import shlex
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
from tests.test_documents import DOCUMENTS as MARKDOWN

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
GOLDEN = REPOSITORY / "tests" / "data" / "golden"
COMMAND = re.compile(
    r"^(?:\$ )?(?:buddyline|make|mkdir|pipx|sha256sum|sudo|kill|\.|git|scp|pip|python3?|\.venv/bin/\S+|pytest|docker"
    r"|ros2|export|i2cdetect|rpicam-hello|jq)(?: |$)"
)
LEFT_OUT = {
    r"^sudo |^git |^scp ": "another machine, or root",
    r"^pipx? |^sha256sum ": "a release; tests/test_release.py",
    r"^make ": "the tests of the Makefile run it, or .ci/run",
    r"^\. \.venv": "the programs are on the path",
    r"^(\.venv/bin/)?pytest ": "the tests themselves; tests/golden/test_references.py rewrites references",
    r"^\.venv/bin/(pip|jupyter) ": "Jupyter; tests/test_notebooks.py",
    r"^docker |^ros2 |^export ": "programs that are not here; tests/tools/test_bridge*.py, test_ros2.py",
    r"^i2cdetect |^rpicam-hello ": "a Raspberry Pi",
    r"^jq ": "not here; reads what tests/node/test_service.py checks",
    r"^buddyline setup": "a Raspberry Pi; tests/tools/test_setup_pi.py, tests/chroots.py",
    r"^buddyline (node|doctor) --config ~/": "a real camera and sensors; tests/node/test_service.py, test_doctor.py",
    r"^buddyline solve .* --authority ": "logs of nodes that have keys; tests/tools/test_authenticity.py",
    r"^(\.venv/bin/)?buddyline experiments": "takes minutes; tests/tools/test_experiments.py",
    r"^buddyline tune --fit": "takes minutes; tests/tools/test_fit_score.py, test_fit_sigma.py",
}
BRIEF = "--scenes 1 --seconds 3 --environment cavern"
SHORTER = {
    r"--rate 4$": "--rate 4 --seconds 30",
    r"--images --imu$": "--images --imu --seconds 4 --rate 5",
    r"--speed 4$": "--speed 0",
    r"bench lights$": f"bench lights {BRIEF}",
    r"--scenes 10": BRIEF,
    r"bench instructions$": "bench instructions --environment cavern --pictures 1 --width 205",
    r"demo_seeds 8 (.*) --waters 5 --seconds 15": r"demo_seeds 1 \1 --waters 1 --seconds 3",
    r"^buddyline (monitor|view)(.*?)( --open)?$": r"buddyline \1\2 --port 0",
}
# It says that its input is damaged.
DAMAGED = re.compile(r"^buddyline repair ")
LOCAL = re.compile(r"^buddyline (mark|play|record|hub|solver|node|monitor|bridge|survey watch)\b")
# Runs until Ctrl-C.
STAYS = re.compile(r"^buddyline (hub|solver|node|monitor|view|bridge|survey watch)\b(?!.*&)")
# Takes the logs of nodes that have been started before.
TAKES_LOGS = re.compile(r"\bcp dives/")
KEYS = ("keys init --hub 127.0.0.1", "keys node a", "keys node b", "keys solver", "keys viewer")
TLS_NODE = "init node --simulated --connect tls/127.0.0.1:7447 --node"
# What a document takes for done before its first command.
DONE = {
    "docs/pool_day.md": (*KEYS, f"{TLS_NODE} a -o keys/a.toml", f"{TLS_NODE} b -o keys/b.toml"),
}
# And what runs beside it: nodes that wait for their hub.
BESIDE = {"docs/pool_day.md": tuple(f"buddyline node --config keys/{node}.toml" for node in "ab")}


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


def to_run(path: Path) -> list[str]:
    """Return the commands of a document that are not left out."""
    return [command for command in commands(path.read_text(encoding="utf-8")) if not left_out(command)]


DOCUMENTS = [str(path.relative_to(REPOSITORY)) for path in MARKDOWN if to_run(path)]


def local(command: str, endpoint: str) -> str:
    """Return a command with our endpoint and other addresses of this machine, and shortened."""
    for pattern, instead in SHORTER.items():
        command = re.sub(pattern, instead, command, flags=re.MULTILINE)
    command = re.sub(r"\b(?:192\.168\.2\.\d+|0\.0\.0\.0)(?=:|$)", "127.0.0.1", command)
    command = re.sub(r"\b127\.0\.0\.1:\d+", lambda _: free_endpoint().removeprefix("tcp/"), command)
    parts = re.split(r"( &[ \n]|\n| &$)", command)
    for i, part in enumerate(parts):
        if (match := LOCAL.match(part)) and "--config" not in part:
            parts[i] = f"{part} {'--listen' if match[1] == 'hub' else '--connect'} {endpoint}"
    return "".join(parts)


def use_port(folder: Path, endpoint: str) -> None:
    """Let every configuration in a folder name our hub."""
    for path in folder.rglob("*.toml"):
        text = path.read_text(encoding="utf-8")
        path.write_text(re.sub(r"(?:127\.0\.0\.1|0\.0\.0\.0):7447", endpoint.removeprefix("tcp/"), text))


class Running:
    """The commands that run until Ctrl-C, each until the document's end; a hub ends those of the hub before it."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._processes = folder, dict[str, Process]()

    def start(self, command: str) -> None:
        words = shlex.split(command)[1:]
        if words[0] == "hub" and any(other.startswith("buddyline hub") for other in self._processes):
            self.end("hub", "solver", "monitor", "node")
        process = Process(*words, cwd=self._folder)
        self._processes[command] = process
        process.wait_for("")

    def wait_for_nodes(self) -> None:
        """Wait until the nodes that were started before their hub have found it."""
        for command, process in self._processes.items():
            if command.startswith("buddyline node"):
                process.wait_for("connected")

    def end(self, *names: str) -> None:
        """End the commands of these names, or all; each must end well."""
        for command in reversed(list(self._processes)):
            if not names or command.split()[1] in names:
                process = self._processes.pop(command)
                assert process.end() == 0, f"`{command}` ended badly:\n" + "\n".join(process.lines)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what the documents take for yours: nodes' logs, pictures, a cut log, a recording, a survey."""
    monkeypatch.chdir(tmp_path)
    programs = tmp_path / "bin"
    programs.mkdir()
    for program, words in (("buddyline", "-P -m buddyline"), ("python", "-P")):
        (programs / program).write_text(f'#!/bin/sh\nexec {sys.executable} {words} "$@"\n')
        (programs / program).chmod(0o755)
    surveyed = read_log(GOLDEN / "survey.mcap")
    marks = [entry for entry in surveyed if entry.topic == "mark"]
    write_log(tmp_path / "topside.mcap", marks)
    for node in "ab":
        (tmp_path / node).mkdir()
        shutil.copy(GOLDEN / f"night_reef_{node}.mcap", tmp_path / node / f"{node}-1.mcap")
        shutil.copytree(tmp_path / node, tmp_path / f"pool-{node}")
        write_log(tmp_path / f"{node}.mcap", [one for one in surveyed if one.key.startswith(f"buddyline/node/{node}/")])
    assert main(["sample"]) == 0
    assert main(["detect", "sample.mcap", "-o", "found.mcap", "--draw", "photos"]) == 0
    for name in ("FOLDER", "l2uwe/data/OceanDark2_0", "dds/annotated_100/images", "dds/accuracy"):
        shutil.copytree("photos", name)
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
    document = to_run(REPOSITORY / name)
    endpoint = free_endpoint()
    for words in DONE.get(name, ()):
        assert main(words.split()) == 0
    use_port(folder, endpoint)
    with ExitStack() as stack:
        running = Running(folder)
        stack.callback(running.end)
        has_hub = any(command.startswith("buddyline hub") and STAYS.match(command) for command in document)
        if not has_hub and any(LOCAL.match(command) and "&" not in command for command in document):
            running.start(f"buddyline hub --listen {endpoint}")
        for command in BESIDE.get(name, ()):
            running.start(command)
        for command in document:
            here = local(command, free_endpoint() if "&" in command else endpoint)
            if TAKES_LOGS.search(command):
                # As the text says, the nodes have been ended before: a log that is being written is not closed.
                running.end()
            if STAYS.match(command):
                running.start(here)
                if command.startswith("buddyline hub"):
                    running.wait_for_nodes()
                continue
            done = run(here, folder)
            use_port(folder, endpoint)
            wanted = 1 if DAMAGED.match(command) else 0
            assert done.returncode == wanted, (
                f"{name}: `{command}` ended with {done.returncode}:\n{done.stdout[-2000:]}"
            )


def test_modules_named_in_documents_know_their_options() -> None:
    found = {
        (match[1], match[2] or "", option)
        for path in MARKDOWN
        for match in re.finditer(
            r"python3? -m ((?:tests|buddyline)\.[\w.]+)( (?!FOLDER)[a-z]+)?([^`\n]*)", path.read_text(encoding="utf-8")
        )
        for option in re.findall(r" (--[a-z-]+)", match[3])
    }
    assert len({module for module, _, _ in found}) >= 5
    told: dict[tuple[str, ...], str | None] = {}
    for module, subcommand, option in sorted(found):
        words = [subcommand.strip()] if module.endswith(".bench") and subcommand else []
        if (module, *words) not in told:
            child = subprocess.run(
                [sys.executable, "-m", module, *words, "--help"],
                capture_output=True,
                text=True,
                cwd=REPOSITORY,
                check=False,
            )
            # What needs a program or package that is missing says so; then its options cannot be read here.
            lacking = "\nSkipped: " in child.stderr
            assert child.returncode == 0 or lacking, f"{module} {words}: {child.stderr[-1000:]}"
            told[(module, *words)] = None if lacking else child.stdout
        known = told[(module, *words)]
        assert known is None or option in known, f"{module} {words}: no {option}"


@pytest.mark.parametrize("name", ["README.md", "docs/library.md", "docs/theory.md"])
def test_the_python_of_a_document_runs(name: str, folder: Path) -> None:
    text = (REPOSITORY / name).read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert blocks, "the document has no Python"
    assert main(["sample"]) == 0
    assert main(["solve", "sample.mcap", "-o", "solved.mcap"]) == 0
    endpoint = free_endpoint()
    script = "\n".join(blocks).replace("live_poses()", f'live_poses("{endpoint}", seconds=5)')
    with ExitStack() as stack:
        if endpoint in script:
            for words in (("hub", "--listen"), ("solver", "--connect"), ("play", "sample.mcap", "--loop", "--connect")):
                stack.enter_context(Process(*words, endpoint, cwd=folder))
        (folder / "script.py").write_text(script)
        done = run(f"{sys.executable} -W error script.py", folder)
    assert done.returncode == 0, done.stdout[-2000:]
    assert endpoint not in script or len(done.stdout.splitlines()) > 3, "no poses have come"
