"""The parts that both buses share."""

from __future__ import annotations

import threading

import pytest
from buddyline.protocol import delivery, topics
from buddyline.protocol.bus import cache_depth
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.delivery import Delivery, FailureLatch, RateCap

from tests.processes import PATIENCE_S


def test_a_queue_is_bounded_in_bytes_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delivery, "MAX_QUEUED_BYTES", 100)
    begun, go_on, handled = threading.Event(), threading.Event(), []

    def handle(item: str) -> None:
        begun.set()
        assert go_on.wait(PATIENCE_S)
        handled.append(item)

    queue = Delivery("test", handle, capacity=1000, failures=FailureLatch())
    queue.offer("first", 60)
    assert begun.wait(PATIENCE_S)
    for item in ("a", "b", "c"):
        queue.offer(item, 60)
    # A single item may exceed the bound, or it could never be delivered.
    queue.offer("huge", 1000)
    assert queue.dropped == 3
    go_on.set()
    queue.close()
    assert handled == ["first", "huge"]


def test_one_queue_delays_and_drops_only_its_own_items() -> None:
    begun, go_on, handled = threading.Event(), threading.Event(), []

    def handle(item: str) -> None:
        begun.set()
        assert go_on.wait(PATIENCE_S)
        handled.append(item)

    queue = Delivery("test", handle, capacity=100, failures=FailureLatch())
    queue.offer("first", queue="flood")
    assert begun.wait(PATIENCE_S)
    for number in range(1000):
        queue.offer(f"flood {number}", queue="flood")
    for number in range(3):
        queue.offer(f"a {number}", queue="a")
    queue.offer("held before")
    assert queue.dropped == 900
    assert queue.waiting == 104
    go_on.set()
    queue.close(PATIENCE_S)
    assert queue.waiting == 0
    assert handled[:2] == ["first", "held before"]
    assert [item for item in handled if item.startswith("a")] == ["a 0", "a 1", "a 2"]
    assert max(handled.index(f"a {number}") for number in range(3)) < 10
    assert [item for item in handled if item.startswith("flood")] == [f"flood {number}" for number in range(900, 1000)]


def test_a_queue_that_is_last_comes_after_all_others() -> None:
    begun, go_on, handled = threading.Event(), threading.Event(), []

    def handle(item: str) -> None:
        begun.set()
        assert go_on.wait(PATIENCE_S)
        handled.append(item)

    queue = Delivery("test", handle, capacity=100, failures=FailureLatch())
    queue.offer("first", queue="flood", is_last=True)
    assert begun.wait(PATIENCE_S)
    for number in range(3):
        queue.offer(f"flood {number}", queue="flood", is_last=True)
        queue.offer(f"a {number}", queue="a")
        queue.offer(f"b {number}", queue="b")
    go_on.set()
    queue.close(PATIENCE_S)
    assert handled == ["first", "a 0", "b 0", "a 1", "b 1", "a 2", "b 2", "flood 0", "flood 1", "flood 2"]


def test_a_handler_that_never_ends_does_not_delay_closing(caplog: pytest.LogCaptureFixture) -> None:
    go_on, handled = threading.Event(), []

    def handle(item: int) -> None:
        handled.append(item)
        go_on.wait(PATIENCE_S)

    queue = Delivery("stuck", handle, capacity=10, failures=FailureLatch())
    for item in range(5):
        queue.offer(item)
    queue.close(timeout_s=0.05)
    assert "stuck" in caplog.text
    go_on.set()
    queue.close()
    assert handled == [0]


def test_a_handler_may_close_its_own_queue() -> None:
    closed = threading.Event()

    def handle(item: int) -> None:
        queue.close()
        closed.set()

    queue = Delivery("own", handle, capacity=10, failures=FailureLatch())
    queue.offer(1)
    assert closed.wait(PATIENCE_S)


def test_the_first_failure_is_kept() -> None:
    failures = FailureLatch()
    failures.report("one", KeyError("x"))
    failures.report("two", KeyError("y"))
    assert str(failures.failure) == "thread 'one' died: KeyError: 'x'"


@pytest.mark.parametrize("rate_hz", [7.0, 10.0, 29.0, 30.0])
def test_a_rate_cap_passes_its_rate(rate_hz: float) -> None:
    clock = ManualClock()
    cap = RateCap(rate_hz, clock)
    passed = 0
    for i in range(300):
        clock.set_ns(i * S_NS // 30)
        passed += cap.passes()
    assert passed == pytest.approx(10 * rate_hz, abs=1)


def test_a_rate_cap_works_after_pauses_and_a_clock_set_back() -> None:
    clock = ManualClock(1000 * S_NS)
    cap = RateCap(1.0, clock)
    assert cap.passes()
    assert not cap.passes()
    clock.set_ns(1100 * S_NS)
    assert [cap.passes(), cap.passes()] == [True, False]
    clock.set_ns(0)
    assert [cap.passes(), cap.passes()] == [True, False]


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan")])
def test_a_rate_cap_of_zero_or_less_is_refused(rate_hz: float) -> None:
    with pytest.raises(ValueError, match="max_rate_hz"):
        RateCap(rate_hz, ManualClock())


def test_caches_hold_a_minute_of_streams_and_the_latest_state() -> None:
    assert cache_depth(topics.INFO, 60.0) == 1
    assert cache_depth(topics.IMAGE, 60.0) == 0
    assert cache_depth(topics.ATTITUDE, 60.0) == 6000
    assert cache_depth(topics.CANDIDATES, 60.0) == 1800
    assert cache_depth(topics.CANDIDATES, 0.001) == 1
