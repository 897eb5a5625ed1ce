"""Two clocks compared by beacons: what is estimated, what is refused, and that sigmas are honest."""

import math

import numpy as np
import pytest

from protocol.clock import S_NS
from protocol.messages import ClockBeacon, HeardClock
from tools.calibration.clock import Legs, drift_between, estimate, steps, windows

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
    legs = Legs()
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
    legs = Legs()
    for beacon in beacons(offset_s=offset_s):
        legs.add(beacon)
    there, back = estimate(legs.exchanges("a", "b")), estimate(legs.exchanges("b", "a"))
    assert there.offset_s == pytest.approx(offset_s, abs=1e-4)
    assert back.offset_s == pytest.approx(-offset_s, abs=1e-4)


def test_sigmas_cover_the_errors_and_not_by_far():
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
    assert 0.5 < np.std(drifts) < 1.6
    assert max(errors_s) > 1e-4  # ways that differ cannot be seen: the bound is what says so


def test_the_quickest_exchanges_count_most():
    said = beacons(excess_s=0.02)
    exchanges = exchanges_of(said)
    assert abs(estimate(exchanges).offset_s - 0.003) < 0.2 * abs(exchanges.offset_s - 0.003).mean()


@pytest.mark.parametrize("by_s", [1.0, -1.0, 0.005])
def test_a_clock_that_is_set_meanwhile_is_noticed_and_cuts(by_s):
    exchanges = exchanges_of(beacons(seconds=20, step=(10.0, by_s)))
    assert steps(exchanges)
    parts = [estimate(part) for part in windows(exchanges)]
    assert parts[0].offset_s == pytest.approx(0.003, abs=3e-4)
    assert parts[-1].offset_s == pytest.approx(0.003 + by_s, abs=3e-4)


def test_no_step_where_there_was_none():
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


def test_one_way_alone_tells_nothing():
    legs = Legs()
    for beacon in beacons():
        if beacon.node == "a":
            legs.add(beacon)
    assert legs.pairs() == []
    assert len(legs.exchanges("a", "b")) == 0
    with pytest.raises(ValueError, match="no exchanges"):
        estimate(legs.exchanges("a", "b"))


def test_too_few_are_no_window():
    assert windows(exchanges_of(beacons(seconds=1.5))) == []
    short = estimate(exchanges_of(beacons(seconds=3)))
    assert short.drift is None
    assert math.isfinite(short.sigma_s)
