"""A report of more than two nodes: each node's figures in one frame, and each pair's triggers."""

from pathlib import Path

import numpy as np
import pytest
from buddyline.tools.cli import main
from msgspec.structs import replace

from tests.tools import evaluated
from tests.tools.recompute_report import numbers_in
from tests.tools.test_network import START_NS, STEP_NS, info, pose, write

SECTION = "All nodes in one frame"


def report(tmp_path: Path, *messages: object) -> str:
    log = write(tmp_path / "net.mcap", *messages)
    assert main(["report", log, "-o", str(tmp_path / "net.html")]) == 0
    return (tmp_path / "net.html").read_text("utf-8")


def outcome(k, one, two, *, solved):
    """What the pair of two nodes gave at a trigger."""
    found = evaluated.pose(k) if solved else evaluated.rejection(k)
    return replace(found, node_a=one, node_b=two, stamp_ns=START_NS + k * STEP_NS)


def test_each_node_and_each_pair_is_reported(tmp_path):
    """A is fixed, b is off by 0.02 m in every second row, c is once wrong, and has no row for 0.3 s and at the end."""
    messages = [info("a"), info("b"), info("c")]
    for k in range(10):
        true = {"a": (0.0, 0.0, 5.0), "b": (4.0 + 0.1 * k, 0.0, 5.0), "c": (5.0, 1.0, 6.0)}
        messages += [pose(node, k, p, mode="truth", sigma_m=0.0) for node, p in true.items()]
        messages.append(pose("a", k, true["a"], mode="smooth", sigma_m=1e-4, fixed=True))
        messages.append(pose("b", k, (true["b"][0], 0.02 * (k % 2), 5.0), mode="smooth"))
        # Live rows of the same dive do not count beside smoothed ones.
        messages.append(pose("b", k, (9.0, 9.0, 9.0)))
        if k not in (5, 6, 8, 9):
            messages.append(replace(pose("c", k, (5.0, 1.0 + (k == 3), 6.0), mode="smooth"), age_s=0.1 * (k == 7)))
        messages += [outcome(k, "a", "b", solved=True), outcome(k, "b", "c", solved=k < 4)]
    page = report(tmp_path, *messages)
    found = numbers_in(page)["network"]
    assert found["origin"] is None
    assert found["pairs"] == {"a/b": {"total": 10, "with_pose": 10}, "b/c": {"total": 10, "with_pose": 4}}
    nodes = found["nodes"]
    assert {node: (one["fixed"], one["rows"], one["covered"]) for node, one in nodes.items()} == {
        "a": (True, 10, 1.0),
        "b": (False, 10, 1.0),
        "c": (False, 6, 0.6),
    }
    assert nodes["b"]["sigma_median_m"] == pytest.approx(0.02 * np.sqrt(3))
    assert [nodes[node]["longest_without_row_s"] for node in "bc"] == pytest.approx([0.1, 0.3])
    assert nodes["c"]["longest_without_light_s"] == pytest.approx(0.1)
    assert [nodes[node]["against_truth"]["wrong"] for node in "abc"] == [0, 0, 1]
    assert nodes["b"]["against_truth"]["worst_m"] == pytest.approx(0.02)
    assert nodes["c"]["against_truth"]["worst_m"] == pytest.approx(1.0)
    assert SECTION in page
    assert "<td>a (fixed)</td><td>100%</td>" in page
    assert "<td>b/c</td><td>4 of 10</td><td>40%</td>" in page


def test_where_a_node_is_the_origin_the_report_says_which(tmp_path):
    messages = [info("a"), info("b"), info("c")]
    for k in range(4):
        messages += [pose("b", k, (0.0, 0.0, 0.0), sigma_m=0.0), pose("a", k, (4.0, 0.0, 0.0))]
        messages += [pose("c", k, (3.0, 1.0, 0.0)), outcome(k, "a", "b", solved=True)]
    page = report(tmp_path, *messages)
    found = numbers_in(page)["network"]
    assert found["origin"] == "b"
    assert {node: one["against_truth"] for node, one in found["nodes"].items()} == dict.fromkeys("abc")
    assert "b (the origin)" in page
    assert "Places count from b, which moves" in page


def test_two_nodes_without_a_net_have_no_such_section(tmp_path):
    page = report(tmp_path, info("a"), info("b"), *(outcome(k, "a", "b", solved=True) for k in range(3)))
    assert numbers_in(page)["network"] is None
    assert SECTION not in page
