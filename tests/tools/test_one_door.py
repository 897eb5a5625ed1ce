"""All readers take messages through one door: what is on another node's key is believed by none, and of two outcomes
of one trigger, or two rows of one stamp, all take the first."""

import csv
import io
import json
import re
import threading
from pathlib import Path

import pytest
from buddyline.protocol.codec import encode
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.messages import Depth, NodePose
from buddyline.protocol.topics import DEPTH, NODE_STATUS, key_of
from buddyline.tools.cli import main
from buddyline.tools.demo.dashboard import Dashboard
from buddyline.tools.dives import Dive
from buddyline.tools.live import follow
from buddyline.tools.monitor.coverage import Coverage
from buddyline.tools.monitor.live import subscribe
from buddyline.tools.monitor.overview import Overview
from buddyline.tools.monitor.playback import Playback, cover
from buddyline.tools.monitor.summary import summarize
from buddyline.tools.survey.live import LiveLegs, Watch
from buddyline.tools.survey.readings import of_logs

from tests.tools.evaluated import INFOS, PERIOD_NS, frame, pose, rejection, track, truth, write_log
from tests.tools.watched import status

ROOT = Path(__file__).parents[2]
NOW_NS = pose(0).stamp_ns


def depth(node: str, depth_m: float) -> Depth:
    return Depth(node=node, stamp_ns=NOW_NS, depth_m=depth_m, sigma_m=0.02)


def test_only_the_envelope_decodes_payloads():
    found = {
        str(path.relative_to(ROOT))
        for folder in ("buddyline", "protocol", "node", "solver_service", "tools")
        for path in (ROOT / folder).rglob("*.py")
        if re.search(r"codec import .*\bdecode\b", path.read_text())
    }
    assert found == {"protocol/envelope.py"}


def monitor_of(bus, took):
    overview = Overview()
    subscribe(bus, Refusals("t"), overview, threading.Lock())
    return lambda: {name: node.depth.depth_m for name, node in overview.nodes.items() if node.depth}


def follower_of(bus, took):
    depths = {}
    follow(bus, DEPTH.key_any(), Refusals("t"), lambda envelope: depths.update({envelope.node: envelope.message}))
    return lambda: {node: message.depth_m for node, message in depths.items()}


def watch_of(bus, took):
    watch = Watch(bus, Refusals("t"))
    depths = {}
    watch._legs = type("Spy", (LiveLegs,), {"handle": lambda self, m: depths.update({m.node: m.depth_m}) or []})(
        watch._legs._settings, watch._legs._limits
    )
    watch.attach()
    return lambda: depths


@pytest.mark.parametrize("client", [monitor_of, follower_of, watch_of])
def test_live_clients_refuse_a_depth_on_another_nodes_key(client):
    network = LocalNetwork()
    with network.connect() as nodes, network.connect() as topside:
        taken = client(topside, None)
        on_b = nodes.publisher(DEPTH, "b")
        on_b.put_bytes(encode(depth("b", 2.0)))
        on_b.put_bytes(encode(depth("a", 99.0)))
        nodes.publisher(DEPTH, "a").put_bytes(encode(depth("a", 1.0)))
        # All subscriptions have handed on what they hold when they are closed.
        topside.close()
        found = taken()
    assert 99.0 not in found.values()
    assert found["a"] == 1.0


def test_the_dashboard_refuses_a_status_on_another_nodes_key():
    network = LocalNetwork()
    with network.connect() as nodes, network.connect() as topside:
        dashboard = Dashboard("cavern", 1, NOW_NS, 10.0)
        dashboard.subscribe(topside)
        nodes.publisher(NODE_STATUS, "b").put_bytes(encode(status("a", NOW_NS)))
        topside.close()
    assert not dashboard._nodes


@pytest.fixture
def misplaced(tmp_path):
    """A solved dive in which a publishes on b's keys."""
    with DiveLogWriter(tmp_path / "o.mcap") as writer:
        for message in (*INFOS.values(), depth("a", 1.0), frame("a", 0), frame("b", 0), pose(0), pose(1)):
            writer.write_message(message)
        writer.write_message(truth(0), key="buddyline/pair/a/b/truth")
        for message in (depth("a", 99.0), frame("a", 1), status("a", NOW_NS)):
            writer.write_message(message, key=key_of(message).replace("/a/", "/b/"))
    return str(tmp_path / "o.mcap")


@pytest.mark.parametrize(
    "words", [["evaluate"], ["export", "--format", "tum"], ["report", "-o", "OUT"], ["solve", "-o", "OUT"]]
)
def test_commands_count_and_name_what_is_on_another_nodes_key(misplaced, tmp_path, capsys, words):
    words = [str(tmp_path / "out") if word == "OUT" else word for word in words]
    assert main([words[0], misplaced, *words[1:]]) == 1
    err = capsys.readouterr().err
    assert f"{misplaced}: buddyline/node/b/candidates: 1 refused" in err
    assert "node 'a' on key buddyline/node/b/candidates" in err


def test_playback_and_report_refuse_a_depth_on_another_nodes_key(misplaced):
    with Dive([misplaced]) as dive:
        playback = Playback(dive)
        playback.seek(playback.end_ns)
        assert "b" not in playback.picture.nodes or playback.picture.nodes["b"].depth is None
        assert playback.picture.nodes["a"].depth.depth_m == 1.0
    with Dive([misplaced]) as dive:
        assert {node: line[0][1] for node, line in summarize(dive, ("a", "b")).depths.items()} == {"a": 1.0}
        assert dive.refused == 3


def net_pose(k: int) -> NodePose:
    return NodePose(
        net="main",
        node="a",
        stamp_ns=NOW_NS + k * PERIOD_NS,
        p_m=(0.0, 0.0, 0.0),
        q_xyzw=(0.0, 0.0, 0.0, 1.0),
        v_mps=(0.0, 0.0, 0.0),
        covariance=[0.0] * 36,
        fixed=True,
        mode="filter",
        age_s=0.0,
    )


@pytest.fixture
def doubled(tmp_path):
    """Two solvers' log: triggers 0 and 1 are solved twice, 2 is solved and then rejected, 3 the other way round."""
    first = [pose(0), pose(1), pose(2), rejection(3)]
    second = [pose(0, (0.0, 0.0, 9.0)), pose(1, (0.0, 0.0, 9.0)), rejection(2), pose(3, (0.0, 0.0, 9.0))]
    inputs = [*INFOS.values(), *(frame(node, k) for node in "ab" for k in range(4)), *(truth(k) for k in range(4))]
    return write_log(tmp_path / "o.mcap", *inputs, *first, *second)


def test_of_two_outcomes_of_a_trigger_evaluate_and_export_take_the_first(doubled, capsys):
    assert main(["evaluate", doubled, "--json"]) == 0
    out = json.loads(capsys.readouterr().out)
    assert (out["poses"], out["triggers"]["rejected"], out["triggers"]["doubled"]) == (3, {"ambiguous": 1}, 4)
    assert out["accuracy"]["translation_m"]["rmse"] == 0.0
    assert main(["export", doubled, "--format", "csv", "--rejected"]) == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [row["range_m"] for row in rows] == ["3.0", "3.0", "3.0", ""]
    assert main(["export", doubled, "--format", "tum"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 3


def test_of_two_outcomes_of_a_trigger_report_view_and_survey_take_the_first(doubled, caplog):
    with Dive([doubled]) as dive:
        summary = summarize(dive, ("a", "b"))
        assert (summary.picture.solved, summary.picture.rejected.total()) == (3, 1)
        assert [pose.range_m for pose in summary.poses] == [3.0, 3.0, 3.0]
        assert dive.losses == []
    assert "4 second outcomes of triggers of a/b left out" in caplog.text
    with Dive([doubled]) as dive:
        playback = Playback(dive)
        playback.seek(playback.end_ns)
        assert (playback.picture.solved, playback.picture.rejected.total()) == (3, 1)
        coverage = Coverage(playback.start_ns, playback.end_ns)
        cover(coverage, [doubled], ("a", "b"), threading.Event())
        assert (coverage.solved.sum(), coverage.rejected.sum()) == (3, 1)
    (readings,) = of_logs([doubled])
    assert (len(readings.triggers), len(readings.rejected)) == (3, 1)
    assert readings.t_a_b_m[:, 2].tolist() == [3.0, 3.0, 3.0]


def test_rows_of_a_track_or_net_that_a_second_solver_repeats_count_once(tmp_path, capsys):
    rows = [track(k, mode=mode) for k in range(4) for mode in ("filter", "lag")]
    later = [track(k, (0.0, 0.0, 9.0), mode=mode) for k in range(4) for mode in ("filter", "lag")]
    inputs = [*INFOS.values(), *(truth(k) for k in range(4)), pose(0), pose(3)]
    log = write_log(tmp_path / "o.mcap", *inputs, *rows, *later, *(net_pose(k) for k in (0, 1, 0, 1)))
    assert main(["evaluate", log, "--pair", "a/b", "--json"]) == 0
    tracks = json.loads(capsys.readouterr().out)["tracks"]
    assert [(one["mode"], one["samples"], one["wrong"], one["covered"]) for one in tracks] == [
        ("filter", 4, 0, 1.0),
        ("lag", 4, 0, 1.0),
    ]
    with Dive([log]) as dive:
        assert len(list(dive.messages("track"))) == len(list(dive.messages("track_lag"))) == 4
        assert len(list(dive.messages("net_pose"))) == 2
        assert dive.repeated == {}


def test_the_first_outcome_is_the_first_by_time_whatever_the_logs(tmp_path):
    late = write_log(tmp_path / "late.mcap", *INFOS.values(), rejection(0), truth(0))
    with DiveLogWriter(tmp_path / "early.mcap") as writer:
        writer.write_message(pose(0), log_time_ns=NOW_NS - PERIOD_NS)
    with Dive([late, str(tmp_path / "early.mcap")]) as dive:
        assert [envelope.message for envelope in dive.messages("pose", "rejected")] == [pose(0)]
        assert dive.repeated == {"a/b": 1}
        # Read twice, it holds it once.
        assert len(list(dive.messages("pose", "rejected"))) == 1
        assert dive.repeated == {"a/b": 1}
