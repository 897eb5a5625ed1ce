"""The clock of a node's stamps: steps at one instant, slews told by the raw clock, and the wait for a time."""

import threading
from dataclasses import replace

import pytest
from buddyline.node.chrony import ChronyError, decode_tracking
from buddyline.node.time_base import TIME_WITHIN_NS, NodeClock, wait_for_time
from buddyline.protocol.clock import MS_NS, S_NS

from tests.node.test_chrony import FOLLOWS, LOST

LOOK_NS = 250 * MS_NS
EPOCH_NS = 1_764_000_000 * S_NS


class MachineClocks:
    """A machine's clocks: a slew moves CLOCK_BOOTTIME and the wall clock alike, a step the wall clock alone."""

    def __init__(self):
        self.boot_ns = 5 * S_NS
        self.raw_ns = 2 * S_NS
        self.wall_ns = EPOCH_NS

    def go_on(self, ns, slew=0.0, step_ns=0):
        self.raw_ns += ns
        self.boot_ns += round(ns * (1.0 + slew))
        self.wall_ns += round(ns * (1.0 + slew)) + step_ns


@pytest.fixture
def clocks():
    return MachineClocks()


@pytest.fixture
def clock(clocks):
    return NodeClock(lambda: clocks.wall_ns, lambda: clocks.boot_ns, lambda: clocks.raw_ns)


@pytest.mark.parametrize("step_ns", [S_NS, -S_NS, 40 * MS_NS, -3600 * S_NS, MS_NS])
def test_a_step_is_followed_when_asked_and_named_for_a_minute(clocks, clock, step_ns):
    assert clock.follow() == 0
    assert clock.problem == ""
    clocks.go_on(LOOK_NS, step_ns=step_ns)
    assert clock.now_ns() == EPOCH_NS + LOOK_NS  # as if nothing had happened, until the next look
    assert clock.follow() == step_ns
    assert clock.now_ns() == clocks.wall_ns
    assert f"set by {step_ns / S_NS:+.3f} s" in clock.problem
    for _ in range(230):
        clocks.go_on(LOOK_NS)
        assert clock.follow() == 0
    assert clock.problem
    clocks.go_on(3 * S_NS)
    assert clock.problem == ""
    assert clock.steps == 1


@pytest.mark.parametrize("slew", [100e-6, -0.0833, 0.0833])
def test_slewing_is_no_step_and_the_raw_clock_tells_it(clocks, clock, slew):
    begun_ns, begun_raw_ns = clock.reading()
    for _ in range(100):
        clocks.go_on(LOOK_NS, slew)
        assert clock.follow() == 0
    now_ns, now_raw_ns = clock.reading()
    assert (now_ns - begun_ns) - (now_raw_ns - begun_raw_ns) == pytest.approx(25 * S_NS * slew, abs=200)


def test_one_interrupted_comparison_is_no_step(clocks, clock):
    late = iter([4 * MS_NS])

    clock._wall = lambda: clocks.wall_ns + next(late, 0)
    assert clock.follow() == 0
    assert clock.steps == 0


def test_waiting_ends_at_the_instant_or_at_the_stop():
    stop = threading.Event()
    clock = NodeClock()
    assert not clock.wait_until_ns(clock.now_ns() - 1, stop)
    stop.set()
    assert clock.wait_until_ns(clock.now_ns() + 60 * S_NS, stop)


class Waited:
    """A stop event whose waits make time pass."""

    def __init__(self):
        self.boot_ns = 20 * S_NS

    def is_set(self):
        return False

    def wait(self, seconds):
        self.boot_ns += round(seconds * S_NS)


@pytest.mark.parametrize(
    ("answers", "chip", "waited_s", "known"),
    [
        ([FOLLOWS], None, 0, True),
        ([LOST, LOST, FOLLOWS], None, 2, True),
        ([ChronyError("chronyd does not run"), FOLLOWS], None, 1, True),
        ([LOST], ("1", "1764000000"), 0, True),
        ([LOST], ("0", "1764000000"), 26, False),
        ([LOST], ("1", "31"), 26, False),
        ([LOST], ("1", ""), 26, False),
        ([None], None, 0, True),
    ],
)
def test_a_node_waits_for_its_time_after_the_start_of_its_machine(tmp_path, answers, chip, waited_s, known):
    stop = Waited()
    if chip:
        (tmp_path / "hctosys").write_text(f"{chip[0]}\n")
        (tmp_path / "since_epoch").write_text(f"{chip[1]}\n")

    def read():
        answer = answers.pop(0) if len(answers) > 1 else answers[0]
        if isinstance(answer, Exception):
            raise answer
        return answer and decode_tracking(answer)

    assert wait_for_time(stop, read, lambda: stop.boot_ns, tmp_path) is known
    assert stop.boot_ns == 20 * S_NS + waited_s * S_NS
    assert stop.boot_ns <= TIME_WITHIN_NS + 2 * S_NS


def test_a_node_that_is_restarted_in_mid_dive_waits_for_nothing(tmp_path):
    stop = Waited()
    stop.boot_ns = 3600 * S_NS
    assert not wait_for_time(stop, lambda: replace(decode_tracking(FOLLOWS), synchronised=False),
                             lambda: stop.boot_ns, tmp_path / "none")  # fmt: skip
    assert stop.boot_ns == 3600 * S_NS
