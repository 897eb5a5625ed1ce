"""Commands on the bus end properly, with or without a hub; the demo names a dead process at once."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.cli import main
from buddyline.tools.client import ClientConfig
from buddyline.tools.live import LiveClient, NoHubError, open_bus_within
from buddyline.tools.measure.children import Child, end_all

from tests.processes import PATIENCE_S, Process, buddyline, free_endpoint


@pytest.mark.parametrize(
    "words",
    [
        ["record", "out.mcap"],
        ["survey", "watch"],
        ["mark", "T4", "--node", "a"],
        ["ros2"],
        ["monitor", "--port", "0"],
    ],
    ids=lambda words: words[0],
)
def test_a_command_without_a_hub_ends_when_its_time_is_over(tmp_path, words):
    for module in {"ros2": ["rosbags"], "monitor": ["websockets"]}.get(words[0], []):
        pytest.importorskip(module)
    endpoint = free_endpoint()
    done = buddyline(*words, "--connect", endpoint, "--seconds", "0.5", cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert f"no hub at {endpoint} within 0.5 s" in done.stderr
    if words[0] == "record":
        assert "out.mcap: 0 messages, 0 dropped, 0 bad; nothing came, so no log is left" in done.stderr
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("endpoint", ["a..b:7447", "tcp/a..b:7447", f"tcp/{'x' * 64}:7447", "tcp/127.0.0.1"])
def test_an_address_that_no_hub_can_have_is_an_error(tmp_path, capsys, endpoint):
    assert main(["record", str(tmp_path / "out.mcap"), "--connect", endpoint, "--seconds", "1"]) == 2
    assert f"endpoint '{endpoint}': write it as tcp/<host>:<port>" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_ctrl_c_ends_the_wait_for_a_hub(tmp_path):
    with Process("record", tmp_path / "out.mcap", "--connect", free_endpoint()) as record:
        record.wait_for("waiting for it")
        record.send(signal.SIGINT)
        assert record.wait() == 130


def test_a_hub_that_does_not_answer_in_time_is_an_error():
    with pytest.raises(NoHubError, match=r"within 0\.2 s"):
        open_bus_within(ClientConfig(connect=free_endpoint()), 0.2)


def test_time_over_with_a_hub_is_no_error(monkeypatch):
    endpoint = free_endpoint()
    monkeypatch.setattr(LiveClient, "handle_signals", lambda self: None)
    with Child("hub", "--listen", endpoint):
        open_bus_within(ClientConfig(connect=endpoint), PATIENCE_S).close()
        # A loaded machine may need longer to connect.
        for seconds in (1.0, 30.0):
            client = LiveClient("test", ClientConfig(connect=endpoint), seconds=seconds)
            with contextlib.suppress(NoHubError):
                assert client.run(lambda bus, client=client: client.wait()) == 0
                break
        else:
            pytest.fail("no hub")

        def fails(_):
            raise BuddylineError("no disk")

        with pytest.raises(BuddylineError, match="no disk"):
            LiveClient("test", ClientConfig(connect=endpoint)).run(fails)


def test_a_child_reports_how_it_died_and_its_load():
    child, dead = Child("hub", "--listen", free_endpoint()), Child("hub", "--config", "none.toml", name="second")
    try:
        while (death := dead.death()) is None:
            time.sleep(0.02)
        # Until it has become the command, a child may have no memory of its own.
        while child.load().rss_bytes <= 2**20:
            time.sleep(0.02)
        assert child.death() is None
        assert death.startswith("second ended with status 2: ")
        assert "none.toml" in death
    finally:
        assert end_all([child, dead], within_s=PATIENCE_S) == []


def children_named(pid: int) -> dict[str, int]:
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((process / "stat").read_text().rpartition(")")[2].split()[1])
            words = (process / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if parent == pid and b"buddyline" in words:
            found[words[words.index(b"buddyline") + 1].decode()] = int(process.name)
    return found


def test_a_demo_whose_solver_dies_says_so_and_ends():
    demo = Process("demo", "--environment", "basin", "--rate", "4")
    try:
        demo.wait_for(" s  ")
        os.kill(children_named(demo.pid)["solver"], signal.SIGKILL)
        assert demo.wait() == 2
        assert "solver ended with status -9" in demo.lines[-1]
        assert children_named(demo.pid) == {}
    finally:
        demo.end()


STUB = """
import sys
from buddyline.tools.measure import children
children.free_endpoint = lambda: "tcp/127.0.0.1:{port}"
from buddyline.tools.cli import main
sys.exit(main(["demo"]))
"""


def test_a_demo_whose_hub_cannot_start_ends_with_the_reason(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        program = STUB.format(port=taken.getsockname()[1])
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
    assert done.returncode == 2
    assert "hub ended with status 2" in done.stderr.splitlines()[-1]


@pytest.mark.slow
def test_a_demo_gives_its_summary_whatever_files_are_in_the_current_folder(tmp_path):
    for name in ("protocol", "tools", "node", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('not me')\n")
    script = Path(sys.executable).with_name("buddyline")
    # A loaded machine may need longer until the first pose.
    for seconds in ("6", "60"):
        words = [script, "demo", "--environment", "basin", "--rate", "4", "--seconds", seconds, "--json"]
        done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=tmp_path)
        if done.returncode == 0:
            break
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["poses"] > 0
    assert summary["wrong_poses"] == 0
