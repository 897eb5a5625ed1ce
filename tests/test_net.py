"""Four nodes, a hub and one solver as processes: all nodes in one frame, live as offline."""

import json

import pytest
from buddyline.protocol.divelog import DiveLogReader

from tests.processes import buddyline, recorded_solver, until


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    path = tmp_path_factory.mktemp("net") / "dive.mcap"
    done = buddyline("simulate", path, "--nodes", "4", "--fixed", "a", "--seconds", "4", "--imu", "--seed", "3")
    assert done.returncode == 0, done.stderr
    return path


def nodes_told(path):
    with DiveLogReader(path) as reader:
        return {
            key.rsplit("/", 1)[1] for key in reader.keys if key.startswith("buddyline/net/main/") and "truth" not in key
        }


def test_four_nodes_on_one_hub_are_in_one_frame(dive, tmp_path):
    live = tmp_path / "live.mcap"
    with recorded_solver(live) as (endpoint, _):
        played = buddyline("play", dive, "--connect", endpoint)
        assert played.returncode == 0, played.stderr
        until(lambda: nodes_told(live) >= set("abcd"), 0.3)
    told = buddyline("evaluate", live, "--net", "--truth", dive, "--json")
    assert told.returncode == 0, told.stderr
    found = {one["node"]: one for one in json.loads(told.stdout)["network"]}
    assert sorted(found) == ["a", "b", "c", "d"]
    for node in "bcd":
        assert found[node]["samples"] > 20
        assert found[node]["position_m"]["median"] < 0.05
        assert found[node]["wrong"] == 0
