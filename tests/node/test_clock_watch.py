"""A clock that is set is distinguished from one that drifts or is slewed."""

import pytest
from buddyline.node.clock_watch import ClockWatch
from buddyline.protocol.clock import MS_NS, S_NS

LOOK_NS = 200 * MS_NS


class Clocks:
    """CLOCK_BOOTTIME, which is never set, and the wall clock."""

    def __init__(self):
        self.boot_ns = 5 * S_NS
        self.wall_ns = 1_764_000_000 * S_NS

    def go_on(self, ns, rate=1.0, step_ns=0):
        self.boot_ns += ns
        self.wall_ns += round(ns * rate) + step_ns


@pytest.fixture
def clocks():
    return Clocks()


@pytest.fixture
def watch(clocks):
    return ClockWatch(lambda: clocks.wall_ns, lambda: clocks.boot_ns)


@pytest.mark.parametrize("step_ns", [S_NS, -S_NS, 40 * MS_NS, -3600 * S_NS])
def test_a_step_is_named_for_a_minute(clocks, watch, step_ns):
    watch.look()
    assert watch.problem == ""
    clocks.go_on(LOOK_NS, step_ns=step_ns)
    watch.look()
    assert f"set by {step_ns / S_NS:+.3f} s" in watch.problem
    for _ in range(290):
        clocks.go_on(LOOK_NS)
        watch.look()
    assert watch.problem
    clocks.go_on(3 * S_NS)
    watch.look()
    assert watch.problem == ""
    assert watch.steps == 1


@pytest.mark.parametrize("rate", [1.0 + 100e-6, 1.0 - 0.0833, 1.0 + 0.0833])
def test_drift_and_slewing_are_no_steps(clocks, watch, rate):
    for _ in range(100):
        clocks.go_on(LOOK_NS, rate)
        watch.look()
    clocks.go_on(30 * S_NS, rate)  # a machine that was busy looks late
    watch.look()
    assert watch.steps == 0
