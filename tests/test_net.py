"""Four nodes, a hub and one solver as processes: all nodes in one frame, live as offline."""

import json

import pytest
from buddyline.protocol.codec import encode
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.messages import FixedPlace
from msgspec.structs import replace

from tests.processes import buddyline, recorded_solver, until


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    path = tmp_path_factory.mktemp("net") / "dive.mcap"
    done = buddyline("simulate", path, "--nodes", "4", "--fixed", "a", "--seconds", "4", "--imu", "--seed", "3")
    assert done.returncode == 0, done.stderr
    return path


def told_of(path, node):
    """Return how often a node's place was told."""
    with DiveLogReader(path) as reader:
        return sum(1 for _ in reader.records(lambda key: key == f"buddyline/net/main/{node}"))


@pytest.mark.slow
def test_four_nodes_on_one_hub_are_in_one_frame(dive, tmp_path):
    live = tmp_path / "live.mcap"
    with recorded_solver(live) as (endpoint, _):
        played = buddyline("play", dive, "--connect", endpoint)
        assert played.returncode == 0, played.stderr
        until(lambda: all(told_of(live, node) > 25 for node in "abcd"), 0.3)
    told = buddyline("evaluate", live, "--net", "--truth", dive, "--json")
    assert told.returncode == 0, told.stderr
    found = {one["node"]: one for one in json.loads(told.stdout)["network"]}
    assert sorted(found) == ["a", "b", "c", "d"]
    for node in "bcd":
        assert found[node]["samples"] > 20
        assert found[node]["position_m"]["median"] < 0.05
        assert found[node]["wrong"] == 0


@pytest.fixture
def tripod(dive, tmp_path):
    """The NodeInfo of c in a file, as of a tripod of lamps alone, and the other nodes' logs."""
    with DiveLogReader(dive) as reader:
        told = [record.open().message for record in reader.records(lambda key: key == "buddyline/node/c/info")]
        true = [record.open() for record in reader.records(lambda key: key == "buddyline/net/main/truth/c")]
    start = true[0].message
    fixed = FixedPlace(p_m=start.p_m, q_xyzw=start.q_xyzw, sigma_m=0.3, sigma_rad=0.3)
    (tmp_path / "c.json").write_bytes(encode(replace(told[0], role="lights", fixed=fixed)))
    logs = []
    for node in "abd":
        logs.append(tmp_path / f"{node}.mcap")
        with DiveLogReader(dive) as reader, DiveLogWriter(logs[-1]) as writer:
            for record in reader.records(lambda key, own=f"buddyline/node/{node}/": key.startswith(own)):
                if "truth" not in record.key:
                    writer.write_message(record.open().message)
    return tmp_path / "c.json", logs


@pytest.mark.slow
def test_a_live_solver_takes_a_tripod_of_lamps_alone_from_its_file(tripod, tmp_path):
    lamps, logs = tripod
    live = tmp_path / "live.mcap"
    with recorded_solver(live, "--lights", lamps) as (endpoint, _):
        played = buddyline("play", *logs, "--connect", endpoint)
        assert played.returncode == 0, played.stderr
        until(lambda: all(told_of(live, node) > 25 for node in "abcd"), 0.3)


def test_a_tripod_of_lamps_alone_is_used_by_its_file(tripod, tmp_path):
    """Node c is fixed and has two lamps, no camera and no log: its NodeInfo comes from a file."""
    lamps, logs = tripod
    out = tmp_path / "out.mcap"
    done = buddyline("solve", *logs, "-o", out, "--track", "filter", "--info", f"c={lamps}", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert {(one["node_a"], one["node_b"]) for one in told["pairs"]} == {("a", "b"), ("a", "d"), ("b", "d")}
    assert {one["node"] for one in told["network"]} == {"a", "b", "c", "d"}
