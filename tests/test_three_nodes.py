"""Three nodes, one solver: every pair has its outcomes, offline and with real processes over a hub."""

import json
from collections import Counter

import pytest
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.messages import Candidates, Rejected, RelativePose, SolverStatus
from buddyline.tools.cli import main
from msgspec.structs import replace

from tests.processes import REPOSITORY, buddyline, recorded_solver, until
from tests.solver_service.conftest import assert_same_outcomes, dive_messages

PAIRS = {("a", "b"), ("a", "c"), ("b", "c")}
THIRD_BAR = REPOSITORY.parent / "shared" / "data" / "dives" / "odd_third_bar.mcap"


def log_of(path):
    """Every message of a log that the solver made, by pair and kind."""
    with DiveLogReader(path) as reader:
        found = [record.open().message for record in reader.records(lambda key: key.startswith("buddyline/pair/"))]
    outcomes = {pair: {} for pair in PAIRS}
    counts = Counter()
    for one in found:
        if isinstance(one, RelativePose | Rejected):
            outcomes[one.node_a, one.node_b][one.trigger] = one
            counts[one.node_a, one.node_b, one.trigger] += 1
    return outcomes, counts, [one for one in found if isinstance(one, SolverStatus)]


@pytest.fixture(scope="module")
def three_logs(tmp_path_factory):
    """A sees b and c, which are at one place: pairs a, b and a, c have poses."""
    folder = tmp_path_factory.mktemp("three")
    messages, _ = dive_messages(seconds=4.0, seed=7, miss_share=0.05)
    messages += [replace(message, node="c") for message in messages if message.node == "b"]
    logs = []
    for node in ("a", "b", "c"):
        logs.append(folder / f"{node}.mcap")
        with DiveLogWriter(logs[-1]) as writer:
            for message in messages:
                if message.node == node:
                    writer.write_message(message)
    return logs, {message.trigger for message in messages if isinstance(message, Candidates)}


@pytest.fixture(scope="module")
def offline(three_logs):
    logs, _ = three_logs
    out = logs[0].with_name("offline.mcap")
    done = buddyline("solve", *logs, "-o", out, "--json")
    assert done.returncode == 0, done.stderr
    return out, json.loads(done.stdout)


def test_offline_every_pair_has_an_outcome_for_every_trigger(three_logs, offline):
    _, triggers = three_logs
    out, summary = offline
    outcomes, counts, _ = log_of(out)
    assert all(set(outcomes[pair]) == triggers for pair in PAIRS)
    assert set(counts.values()) == {1}
    for pair in (("a", "b"), ("a", "c")):
        assert sum(isinstance(one, RelativePose) for one in outcomes[pair].values()) > 20
    assert {(one["node_a"], one["node_b"]) for one in summary["pairs"]} == PAIRS
    assert summary["triggers"] == 3 * len(triggers)
    assert summary["solved"] == sum(one["solved"] for one in summary["pairs"])


@pytest.mark.parametrize("nodes", [["a,c"], ["c", "a"]])
def test_offline_the_given_nodes_restrict_the_pairs(three_logs, offline, tmp_path, capsys, nodes):
    logs = [str(log) for log in three_logs[0]]
    words = ["-o", str(tmp_path / "out.mcap"), "--track", "none", "--json", "--nodes", *nodes]
    assert main(["solve", *logs, *words]) == 0
    summary = json.loads(capsys.readouterr().out)
    first, second = nodes[0].split(",") if len(nodes) == 1 else nodes
    assert (summary["node_a"], summary["node_b"]) == (first, second)
    pairs = {one["node_a"] + one["node_b"]: one for one in offline[1]["pairs"]}
    if first == "a":
        assert summary["solved"] == pairs["ac"]["solved"]
    with DiveLogReader(tmp_path / "out.mcap") as reader:
        assert not any(key.startswith("buddyline/node/b/") for key in reader.keys)


def test_offline_two_nodes_of_one_id_are_named(three_logs, tmp_path, caplog):
    *logs, third = three_logs[0]
    twin = tmp_path / "twin.mcap"
    with DiveLogReader(third) as reader, DiveLogWriter(twin) as writer:
        for record in reader.records():
            one = replace(record.open().message, node="b", stamp_ns=record.open().message.stamp_ns + 3_000_000)
            writer.write_message(replace(one, boot="another") if isinstance(one, Candidates) else one)
    out = tmp_path / "out.mcap"
    assert main(["solve", *map(str, logs), str(twin), "-o", str(out), "--track", "none"]) == 0
    said = "two nodes have the id b: give each its own"
    assert caplog.text.count(said) == 1
    (status,) = log_of(out)[2]
    assert said in status.problem


@pytest.mark.slow
@pytest.mark.skipif(not THIRD_BAR.exists(), reason="the shared sample dives are not here")
def test_offline_a_third_bar_takes_no_outcome_from_a_pair(tmp_path):
    done = buddyline("solve", THIRD_BAR, "-o", tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    outcomes, counts, _ = log_of(tmp_path / "out.mcap")
    assert set(counts.values()) == {1}
    assert len({frozenset(found) for found in outcomes.values()}) == 1
    for pair in (("a", "b"), ("a", "c")):
        poses = [one for one in outcomes[pair].values() if isinstance(one, RelativePose)]
        assert len(poses) > 0.8 * len(outcomes[pair])


@pytest.mark.slow
def test_three_nodes_on_one_hub_and_one_solver(three_logs, offline, tmp_path):
    logs, _ = three_logs
    expected, _, _ = log_of(offline[0])
    live = tmp_path / "live.mcap"
    with recorded_solver(live) as (endpoint, _):
        played = buddyline("play", *logs, "--connect", endpoint)
        assert played.returncode == 0, played.stderr
        until(lambda: all(set(log_of(live)[0][pair]) >= set(expected[pair]) for pair in PAIRS), 0.3)
    outcomes, counts, statuses = log_of(live)
    assert set(counts.values()) == {1}
    assert {(one.node_a, one.node_b) for one in statuses} == PAIRS
    for pair in PAIRS:
        triggers = sorted(expected[pair])
        assert sorted(outcomes[pair]) == triggers
        assert_same_outcomes(map(outcomes[pair].get, triggers), map(expected[pair].get, triggers))
