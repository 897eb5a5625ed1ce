"""The node's benchmark runs, and prints what it claims to measure."""

import json

import pytest
from buddyline.tools.bench import node
from buddyline.tools.bench.__main__ import main

pytest.importorskip("vqf", reason="vqf is not installed: make install EXTRAS=pi")


@pytest.mark.slow
def test_a_whole_node_is_measured(capsys, monkeypatch):
    monkeypatch.setattr(node, "WARM_UP_S", 0.2)
    monkeypatch.setattr(node, "PICTURES", 2)
    assert main(["node", "--seconds", "2", "--width", "164", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["frames"] > 5
    assert 0 < figures["median_ms"] <= figures["p99_ms"] <= figures["most_ms"]
    assert figures["cpu"] > 0
    assert {"detect", "camera", "imu", "others"} <= set(figures["cpu_by_thread"])
    assert sum(figures["cpu_by_thread"].values()) == pytest.approx(figures["cpu"], rel=0.3, abs=0.05)
    assert figures["rss_mib"][-1][1] > 20
    assert {"candidates", "imu", "depth"} <= set(figures["rates_hz"])
    assert "p99" in node.table(figures)


@pytest.mark.parametrize("argv", [["--seconds", "0"], ["--rate", "0"], ["--width", "1"]])
def test_bad_arguments_give_a_one_line_error(argv, capsys):
    assert main(["node", *argv]) == 2
    assert capsys.readouterr().err.startswith("bench: ")
