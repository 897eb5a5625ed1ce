"""What a slow link carries: simulated links of a known rate."""

from __future__ import annotations

from collections import Counter

import pytest
from buddyline.protocol import topics
from buddyline.protocol.connection import TcpState
from buddyline.protocol.link_budget import OVERHEAD_BYTES, LinkBudget

STEP_S = 0.01
SENT = (  # topic, rate (Hz), payload (bytes)
    (topics.CANDIDATES, 5, 1000),
    (topics.CLOCK, 4, 150),
    (topics.NODE_STATUS, 1, 700),
    (topics.DEPTH, 10, 130),
    (topics.ATTITUDE, 50, 220),
    (topics.IMU, 100, 280),
)


def run(
    rate_bytes_per_s: float, seconds: float, budget: LinkBudget, start_s: float = 0.0
) -> tuple[Counter[str], float]:
    """Send all topics over such a link; return what was sent in the second half, and its longest queue, s."""
    waiting = acked = longest_s = 0.0
    sent: Counter[str] = Counter()
    budget.forget(start_s)
    for step in range(round(seconds / STEP_S)):
        now_s = start_s + step * STEP_S
        for topic, rate_hz, size in SENT:
            due = int((step + 1) * STEP_S * rate_hz) - int(step * STEP_S * rate_hz)
            for _ in range(due):
                if budget.admits(topic, size, now_s):
                    waiting += size + OVERHEAD_BYTES
                    sent[topic.name] += step * STEP_S >= seconds / 2
        carried = min(waiting, rate_bytes_per_s * STEP_S)
        waiting, acked = waiting - carried, acked + carried
        if step * STEP_S >= seconds / 2:
            longest_s = max(longest_s, waiting / rate_bytes_per_s)
        if step % 10 == 9:
            budget.observe(TcpState(int(acked), int(waiting), 0, 0, 0.4), now_s)
    return sent, longest_s


def test_a_link_with_room_carries_everything() -> None:
    budget = LinkBudget()
    sent, _ = run(1e6, 20.0, budget)
    assert sent == {topic.name: rate_hz * 10 for topic, rate_hz, _ in SENT}
    assert not budget.shed
    assert budget.bytes_per_s is None
    assert budget.words(20.0) == ""


@pytest.mark.parametrize("rate_bytes_per_s", [12e3, 16e3, 30e3])
def test_a_slow_link_keeps_what_is_needed_and_its_queue_short(rate_bytes_per_s: float) -> None:
    budget = LinkBudget()
    sent, longest_s = run(rate_bytes_per_s, 60.0, budget)
    assert sent["candidates"] == 150
    assert sent["clock"] == 120
    assert sent["node_status"] >= 14
    assert sent["attitude"] >= 140
    assert sent["depth"] >= 50
    assert budget.shed["imu"] > 0
    # Shed in the order of the table: of the inertial samples more than of the attitudes.
    assert sent["imu"] / 100 <= sent["attitude"] / 50
    assert longest_s < 1.0
    assert "slow link" in budget.words(60.0)
    assert "imu" in budget.words(60.0)


def test_a_link_that_recovers_carries_everything_again() -> None:
    budget = LinkBudget()
    run(12e3, 20.0, budget)
    assert budget.bytes_per_s is not None
    sent, _ = run(1e6, 240.0, budget, start_s=20.0)
    assert budget.bytes_per_s is None
    assert sent["imu"] == 12000


def test_copies_go_on_a_slow_link_that_is_not_behind() -> None:
    budget = LinkBudget()
    run(1e6, 5.0, budget)
    assert not budget.admits_copy(1000, 5.0)
    run(12e3, 20.0, budget, start_s=5.0)
    for step in range(20):
        budget.observe(TcpState(0, 0, 0, 0, 0.4), 25.0 + step / 10)
    assert budget.admits_copy(1000, 27.0)
    for step in range(20):
        budget.observe(TcpState(0, 4096, 0, 0, 0.4), 27.0 + step / 10)
    assert not budget.admits_copy(1000, 29.0)
    assert "messages wait for more than 1 s, for 2 s now" in budget.words(29.0)
