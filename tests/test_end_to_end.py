"""Real processes over a real hub on loopback."""

import json
import signal
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.messages import Candidates, Rejected, RelativePose
from buddyline.tools.dives import Dive

from tests.processes import Process, buddyline, free_endpoint, recorded_solver, until
from tests.solver_service.conftest import assert_same_outcomes, dive_messages


def results_of(path):
    with DiveLogReader(path) as reader:
        found = [record.open().message for record in reader.records(lambda key: key.startswith("buddyline/pair/"))]
    return {m.trigger: m for m in found if isinstance(m, RelativePose | Rejected)}, Counter(
        m.trigger for m in found if isinstance(m, RelativePose | Rejected)
    )


def modes_of(path, topic):
    with Dive([path]) as dive:
        return {envelope.message.mode for envelope in dive.messages(topic)}


def children_of(pid):
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[1]) == pid:
                found.append(int(entry.name))
    return found


@pytest.fixture
def two_logs(tmp_path):
    messages, _ = dive_messages(seconds=4.0, seed=7, miss_share=0.05, imu=True)
    # Sensors go on after the last frames: live, which of the last samples come before a frame's turn is chance.
    last_ns = max(message.stamp_ns for message in messages if isinstance(message, Candidates)) - S_NS // 2
    messages = [one for one in messages if not isinstance(one, Candidates) or one.stamp_ns <= last_ns]
    for node in ("a", "b"):
        with DiveLogWriter(tmp_path / f"{node}.mcap") as writer:
            for message in messages:
                if message.node == node:
                    writer.write_message(message)
    return [tmp_path / "a.mcap", tmp_path / "b.mcap"]


@pytest.mark.parametrize("speed", [pytest.param("1", marks=pytest.mark.slow), "0"])
def test_live_playback_gives_the_offline_poses(tmp_path, two_logs, speed):
    offline = buddyline("solve", *two_logs, "-o", tmp_path / "offline.mcap", "--json")
    assert offline.returncode == 0, offline.stderr
    recorded = tmp_path / "live.mcap"
    with recorded_solver(recorded) as (endpoint, record):
        played = buddyline("play", *two_logs, "--connect", endpoint, "--speed", speed)
        assert played.returncode == 0, played.stderr
        expected, _ = results_of(tmp_path / "offline.mcap")
        last = max(expected)
        # The recorder syncs every second. The last trigger's outcome comes before the track up to it.
        until(lambda: last in results_of(recorded)[0] and modes_of(recorded, "track_lag"), 0.2)
        assert record.end(signal.SIGINT) == 130
    live, counts = results_of(recorded)
    assert sorted(live) == sorted(expected)
    both = [(live[trigger], expected[trigger]) for trigger in sorted(live)]
    if speed == "1":
        assert_same_outcomes(*zip(*both, strict=True))
    # All at once, it is chance on a loaded machine whether the attitude right after a frame comes before its turn.
    for found, wanted in both:
        assert type(found) is type(wanted)
        if isinstance(found, RelativePose):
            off_m, covariance = np.subtract(found.t_a_b_m, wanted.t_a_b_m), np.reshape(wanted.covariance, (6, 6))
            assert off_m @ np.linalg.solve(covariance[:3, :3], off_m) < 0.1**2
    assert set(counts.values()) == {1}
    with DiveLogReader(recorded) as reader:
        assert reader.damage == []
    with Dive([recorded]) as dive:
        assert sum(1 for _ in dive.messages("imu")) == 2 * 400
    assert modes_of(recorded, "track") == {"filter"}
    assert modes_of(recorded, "track_lag") == {"lag"}


@pytest.mark.parametrize("number", [pytest.param(signal.SIGHUP, marks=pytest.mark.slow), signal.SIGKILL])
def test_a_killed_demo_leaves_nothing_running(number):
    demo = Process("demo", "--environment", "basin", "--rate", "4")
    try:
        demo.wait_for(" s  ")
        children = children_of(demo.pid)
        assert len(children) == 4
        demo.send(number)
        assert demo.wait() in (0, -signal.SIGKILL)
        until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in children))
    finally:
        demo.end()


def test_demo_shows_poses_and_leaves_nothing_running(tmp_path):
    demo = Process("demo", "--environment", "basin", "--rate", "4", "--record", tmp_path)
    try:
        demo.wait_for("range")
        children = children_of(demo.pid)
        assert len(children) == 4
        demo.send(signal.SIGINT)
        assert demo.wait() == 130
        assert not [pid for pid in children if Path(f"/proc/{pid}").exists()]
    finally:
        demo.end()
    kept = [path.name.partition("-")[0] for path in sorted(tmp_path.glob("*.mcap"))]
    assert kept == ["a", "b", "solved", "truth"]
    assert [path.suffix for path in tmp_path.glob("report-*")] == [".html"]
    solved, truth = (next(tmp_path.glob(f"{name}-*.mcap")) for name in ("solved", "truth"))
    judged = buddyline("evaluate", solved, "--truth", truth)
    assert judged.returncode == 0, judged.stderr
    assert "wrong poses (position off by more than 10% of the range): 0 of" in judged.stdout
    logs = sorted(tmp_path.glob("[ab]-*.mcap"))
    for log in logs:
        with DiveLogReader(log) as reader:
            names = {key.rpartition("/")[2] for key in reader.keys}
            assert {"info", "candidates", "attitude", "depth", "imu"} <= names
            assert reader.damage == []
        with Dive([log]) as dive:
            assert dive.nodes("image") == [log.name[0]]
            assert dive.losses == []


def node_toml(path, node, endpoint, **tables):
    text = f'node = "{node}"\nconnect = "{endpoint}"\nrate_hz = 5.0\n[record]\ndirectory = "{path.parent}"\n'
    for table, values in tables.items():
        text += f"[{table}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())
    path.write_text(text)
    return path


def test_node_and_solver_wait_for_the_hub_and_a_second_node_is_refused(tmp_path):
    endpoint = free_endpoint()
    config = node_toml(tmp_path / "a.toml", "a", endpoint)
    with (
        Process("node", "--config", config) as node,
        Process("solver", "--connect", endpoint) as solver,
    ):
        node.wait_for("no hub")
        solver.wait_for("no hub")
        with Process("hub", "--listen", endpoint) as hub:
            hub.wait_for("listens")
            node.wait_for("connected")
            solver.wait_for("connected")
            taken = buddyline("hub", "--listen", endpoint)
            assert taken.returncode == 2
            assert endpoint.rpartition(":")[2] in taken.stderr
            twin = Process("node", "--config", config)
            assert twin.wait() == 2
            assert any("another node" in line for line in twin.lines)
            assert twin.end() == 2
            # A thread that does not end in time would make the status 1.
            for process in (node, solver):
                assert process.end(signal.SIGTERM) == 0
    # From the start, hub or not, the node has recorded.
    first = min(tmp_path.glob("a-*.mcap"))
    with DiveLogReader(first) as reader:
        assert reader.damage == []
        assert "buddyline/node/a/info" in reader.keys


def test_a_node_detects_in_stored_pictures(tmp_path):
    import cv2
    import numpy as np

    folder = tmp_path / "pictures"
    folder.mkdir()
    for i in range(6):
        picture = np.zeros((120, 160, 3), np.uint8)
        cv2.circle(picture, (40 + i, 60), 4, (255, 255, 255), -1)
        cv2.imwrite(str(folder / f"{i}.png"), picture)
    (folder / "2.png").write_bytes((folder / "2.png").read_bytes()[:60])
    camera = {"name": "stored", "path": str(folder), "width_px": 160, "height_px": 120}
    config = node_toml(tmp_path / "c.toml", "c", free_endpoint(), camera=camera, sensors={"name": "none"})
    config.write_text(
        config.read_text()
        + "[calibration]\nlight_left_m = [-0.44, 0.0, 0.0]\nlight_right_m = [0.44, 0.0, 0.0]\n"
        + '[calibration.camera]\nmodel = "pinhole"\nfx_px = 200.0\nfy_px = 200.0\ncx_px = 79.5\ncy_px = 59.5\n'
        + "distortion = [0.0, 0.0, 0.0, 0.0, 0.0]\n"
    )
    with Process("node", "--config", config) as node:
        node.wait_for("2.png")
        node.wait_for("no more pictures")
        assert node.end() == 0
    (log,) = tmp_path.glob("c-*.mcap")
    with DiveLogReader(log) as reader:
        frames = [r.open().message for r in reader.records(lambda key: key.endswith("candidates"))]
    assert len(frames) == 5
    assert all(abs(frame.blobs[0].u_px - (40 + i)) < 1 for i, frame in zip((0, 1, 3, 4, 5), frames, strict=True))
