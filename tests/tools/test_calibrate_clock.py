"""Two clocks compared by beacons: what is estimated, what is refused, and that sigmas are honest."""

import json
import math
import threading

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.messages import ClockBeacon, HeardClock, NodeStatus
from buddyline.protocol.topics import CLOCK
from buddyline.tools.calibration import clock_report
from buddyline.tools.calibration.clock import OneWayTimes, drift_between, estimate, steps, windows
from buddyline.tools.calibration.clock_report import Heard, as_json, as_text, reports
from buddyline.tools.cli import main
from buddyline.tools.client import ClientConfig

from tests.processes import free_endpoint

START_NS = 1_764_000_000_000_000_000


def beacons(
    seed=0, seconds=10.0, offset_s=0.003, drift=0.0, base_s=(2e-4, 2e-4), excess_s=2e-4, step=None, begin_s=0.0
):
    """Give both nodes' beacons as a link with these delays would have them; step: (at_s, by_s) of B's clock."""
    rng = np.random.default_rng(seed)

    def b_ns(true_s):
        by_s = step[1] if step and true_s >= step[0] else 0.0
        return START_NS + round((true_s + offset_s + drift * true_s + by_s) * S_NS)

    def a_ns(true_s):
        return START_NS + round(true_s * S_NS)

    said, newest = [], {"a": None, "b": None}
    for k in range(round(seconds * 4)):
        for node, other, now, there, base in (("a", "b", a_ns, b_ns, base_s[0]), ("b", "a", b_ns, a_ns, base_s[1])):
            true_s = begin_s + k * 0.25 + (0.11 if node == "b" else 0.0) + rng.uniform(0, 0.01)
            said.append(
                ClockBeacon(node=node, stamp_ns=now(true_s), boot="x", heard=[newest[node]] if newest[node] else [])
            )
            arrives_s = true_s + base + rng.exponential(excess_s)
            newest[other] = HeardClock(node=node, boot="x", sent_ns=now(true_s), received_ns=there(arrives_s))
    return said


def exchanges_of(said):
    legs = OneWayTimes()
    for beacon in said:
        legs.add(beacon)
    assert legs.pairs() == [("a", "b")]
    return legs.exchanges("a", "b")


def test_a_link_without_jitter_gives_the_offset_and_the_drift_exactly():
    found = estimate(exchanges_of(beacons(seconds=30, drift=8e-6, excess_s=0.0)))
    assert found.exchanges > 100
    elapsed_s = (found.stamp_ns - START_NS) / S_NS
    # A way there and one back are up to a quarter of a second apart: 2 us at this drift.
    assert found.offset_s == pytest.approx(0.003 + 8e-6 * elapsed_s, abs=2e-6)
    assert found.drift == pytest.approx(8e-6, abs=1e-7)
    assert found.bound_s == pytest.approx(2e-4, abs=3e-6)


@pytest.mark.parametrize("offset_s", [-0.04, 86400.0 * 400])
def test_swapped_nodes_give_the_opposite_however_far_apart_the_clocks_are(offset_s):
    legs = OneWayTimes()
    for beacon in beacons(offset_s=offset_s):
        legs.add(beacon)
    there, back = estimate(legs.exchanges("a", "b")), estimate(legs.exchanges("b", "a"))
    assert there.offset_s == pytest.approx(offset_s, abs=1e-4)
    assert back.offset_s == pytest.approx(-offset_s, abs=1e-4)


def test_sigmas_cover_the_errors_without_excess():
    offsets, drifts, errors_s = [], [], []
    for seed in range(40):
        ways_s = np.random.default_rng(1000 + seed).uniform(0, 4e-4)
        found = estimate(exchanges_of(beacons(seed, drift=5e-6, base_s=(ways_s, 4e-4 - ways_s))))
        error_s = found.offset_s - 0.003 - 5e-6 * (found.stamp_ns - START_NS) / S_NS
        errors_s.append(abs(error_s))
        offsets.append(error_s / found.sigma_s)
        drifts.append((found.drift - 5e-6) / found.drift_sigma)
        assert abs(error_s) < found.bound_s + 5 * found.scatter_s
    assert 0.5 < np.std(offsets) < 1.5
    # The sigma is on the safe side, because the delay of the quickest exchange is estimated.
    assert 0.3 < np.std(drifts) < 1.3
    assert max(errors_s) > 1e-4  # unequal one-way times cannot be observed, so only the bound covers them


def test_the_quickest_exchanges_count_most():
    said = beacons(excess_s=0.02)
    exchanges = exchanges_of(said)
    assert abs(estimate(exchanges).offset_s - 0.003) < 0.2 * abs(exchanges.offset_s - 0.003).mean()


@pytest.mark.parametrize("by_s", [1.0, -1.0, 0.005])
def test_a_clock_that_is_set_meanwhile_is_noticed_and_splits_the_windows(by_s):
    exchanges = exchanges_of(beacons(seconds=20, step=(10.0, by_s)))
    assert steps(exchanges)
    parts = [estimate(part) for part in windows(exchanges)]
    assert parts[0].offset_s == pytest.approx(0.003, abs=3e-4)
    assert parts[-1].offset_s == pytest.approx(0.003 + by_s, abs=3e-4)


def test_drift_and_jitter_are_no_clock_step():
    for seed in range(20):
        assert not steps(exchanges_of(beacons(seed, seconds=60, drift=40e-6, excess_s=0.01)))


def test_before_and_after_a_dive_without_a_link():
    said = beacons(seconds=70, drift=10e-6) + beacons(1, seconds=30, drift=10e-6, begin_s=3600.0)
    parts = [estimate(part) for part in windows(exchanges_of(said))]
    assert len(parts) == 3
    drift, sigma = drift_between(parts[0], parts[-1])
    assert abs(drift - 10e-6) < 4 * sigma
    assert sigma < 1e-7
    assert parts[-1].offset_s == pytest.approx(0.003 + 36e-3, abs=5e-4)


def test_one_lucky_exchange_does_not_make_the_drift_certain():
    """On a machine with far too much to do, one exchange in a window is much quicker than the rest."""
    pulls = []
    for seed in range(40):
        said = beacons(seed, seconds=15, excess_s=0.03) + beacons(1000 + seed, 15, excess_s=0.03, begin_s=60.0)
        parts = [estimate(part) for part in windows(exchanges_of(said))]
        drift, sigma = drift_between(parts[0], parts[-1])
        pulls.append(drift / sigma)
    assert 0.3 < np.std(pulls) < 1.3


def test_beacons_in_one_direction_give_no_offset():
    legs = OneWayTimes()
    for beacon in beacons():
        if beacon.node == "a":
            legs.add(beacon)
    assert legs.pairs() == []
    assert len(legs.exchanges("a", "b")) == 0
    with pytest.raises(ValueError, match="no exchanges"):
        estimate(legs.exchanges("a", "b"))


def test_too_few_exchanges_give_no_window():
    assert windows(exchanges_of(beacons(seconds=1.5))) == []
    short = estimate(exchanges_of(beacons(seconds=3)))
    assert short.drift is None
    assert math.isfinite(short.sigma_s)


def heard_of(said, *statuses):
    heard = Heard()
    for message in [*said, *statuses]:
        heard.add(message)
    return heard


def status(**clock):
    return NodeStatus(
        node="a", stamp_ns=START_NS, boot="x", software="", uptime_s=1.0, rates_hz={}, drops={}, ages_s={}, **clock
    )


def test_a_good_pair_is_reported_with_chronys_figures():
    follows = status(clock_source="192.0.2.1", clock_offset_s=1e-5, clock_rms_s=2e-5, clock_bound_s=3e-4)
    heard = heard_of(beacons(offset_s=0.0005), follows)
    found = reports(heard, None)
    assert [(one.node_a, one.node_b, one.problem()) for one in found] == [("a", "b", "")]
    text = as_text(found, heard)
    assert "b minus a: +0.5" in text
    assert "a: chrony follows 192.0.2.1: off by +0.010 ms, RMS 0.020 ms, at most 0.300 ms" in text
    said = json.loads(as_json(found, heard))
    assert said["pairs"][0]["offsets"][0]["offset_s"] == found[0].offsets[0].offset_s
    assert said["chrony"]["a"][0]["clock_source"] == "192.0.2.1"


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        ({"offset_s": 0.05}, "differ by more than 2 ms"),
        ({"offset_s": 0.0, "step": (5.0, 1.0)}, "a clock was set during the measurement"),
        ({"offset_s": 0.0, "base_s": (0.02, 0.0)}, "too slow to measure: the clocks may differ by 10.0 ms more"),
    ],
)
def test_a_pairs_clock_problem_is_named(pair, words):
    heard = heard_of(beacons(excess_s=1e-5, **pair))
    (found,) = reports(heard, None)
    assert words in found.problem()
    assert words in as_text([found], heard)


def test_a_dive_without_a_link_gives_the_offset_to_solve_with():
    said = beacons(seconds=30, drift=10e-6, offset_s=0.0) + beacons(
        1, seconds=30, drift=10e-6, offset_s=0.0, begin_s=600.0
    )
    heard = heard_of(said, status(clock_source=""), status(clock_source="local"))
    text = as_text(reports(heard, ["a", "b"]), heard)
    assert "before" in text
    assert "after" in text
    assert "`solve` goes from one to the other" in text
    assert "chrony is not synchronised" in text
    assert "serves this clock as it stands" in text


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ([], "no node's clock was heard"),
        ([m for m in beacons() if m.node == "a"], "only node a's clock"),
        (beacons(seconds=1.0), "a, b did not hear each other long enough"),
    ],
)
def test_nothing_to_compare_is_an_error_that_says_what_to_do(said, words):
    with pytest.raises(BuddylineError, match=words):
        reports(heard_of(said), None)
    # Of logs, it names them, and what else tells the offset.
    with pytest.raises(BuddylineError, match=rf"^a\.mcap, b\.mcap: .*{words}.*`buddyline align`"):
        reports(heard_of(said), None, ["a.mcap", "b.mcap"])


def test_a_node_that_was_not_heard_is_named():
    with pytest.raises(BuddylineError, match=r"--nodes a x: the clock of node x was not heard, but those of"):
        reports(heard_of(beacons()), ["a", "x"])


def test_a_node_that_becomes_silent_meanwhile_is_named(monkeypatch):
    monkeypatch.setattr(clock_report, "SILENT_S", 0.2)
    network = LocalNetwork()
    with network.connect() as node, network.connect() as tool:
        publisher, ended = node.publisher(CLOCK, "b"), threading.Event()

        def say_once():
            while not network.subscriptions and not ended.wait(0.01):
                continue
            publisher.put(ClockBeacon(node="b", stamp_ns=START_NS, boot="x", heard=[]))

        thread = threading.Thread(target=say_once)
        thread.start()
        with pytest.raises(BuddylineError, match="node b became silent"):
            clock_report.hear(tool, 2.0)
        ended.set()
        thread.join()


def test_a_missing_hub_is_reported_in_time():
    with pytest.raises(BuddylineError, match="no hub at tcp"):
        clock_report.listen(ClientConfig(connect=free_endpoint()), 3.0, connect_within_s=0.2)


def test_the_offset_is_read_from_a_dives_logs(tmp_path, capsys):
    said = beacons(seconds=12, offset_s=0.0)
    for node in "ab":
        with DiveLogWriter(tmp_path / f"{node}.mcap") as writer:
            for beacon in said:
                if beacon.node == node:
                    writer.write_message(beacon)
    assert main(["calibrate", "clock", *(str(tmp_path / f"{node}.mcap") for node in "ab")]) == 0
    assert "b minus a" in capsys.readouterr().out
    assert main(["calibrate", "clock", str(tmp_path / "a.mcap")]) == 2
    assert "only node a" in capsys.readouterr().err
