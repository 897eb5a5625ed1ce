"""What a slow link carries: simulated links of a known rate."""

from __future__ import annotations

from collections import Counter, deque

import pytest
from buddyline.protocol import topics
from buddyline.protocol.connection import TcpState
from buddyline.protocol.link_budget import (
    ANSWER_SHARE,
    FIRST_BYTES_PER_S,
    OVERHEAD_BYTES,
    QUEUED_S,
    AckDelay,
    LinkBudget,
)

STEP_S = 0.01
RTT_S = 0.4
SENT = (  # topic, rate (Hz), payload (bytes)
    (topics.CANDIDATES, 5, 1000),
    (topics.CLOCK, 4, 150),
    (topics.NODE_STATUS, 1, 700),
    (topics.DEPTH, 10, 130),
    (topics.ATTITUDE, 50, 220),
    (topics.IMU, 100, 280),
)


def state(acked: float, waiting: float, min_rtt_s: float = RTT_S, sent: float | None = None) -> TcpState:
    """Return what a connection shows. sent: default: no more than is acknowledged."""
    return TcpState(int(acked), int(waiting), 0, 0, min_rtt_s, min_rtt_s, int(acked if sent is None else sent), 0)


def run(
    rate_bytes_per_s: float,
    seconds: float,
    budget: LinkBudget,
    start_s: float = 0.0,
    modem_bytes: float = 0.0,
) -> tuple[Counter[str], float]:
    """Send all topics over such a link; return what was sent in the second half, and its longest queue, s.

    modem_bytes: what a modem takes ahead of what it passes on, so that it does not wait at the sender; a long link.
    """
    waiting = in_modem = carried = longest_s = 0.0
    arrived: deque[float] = deque([0.0] * round(RTT_S / STEP_S))
    sent: Counter[str] = Counter()
    budget.forget(start_s)
    if modem_bytes:
        budget.begin_low(start_s)
    for step in range(round(seconds / STEP_S)):
        now_s = start_s + step * STEP_S
        for topic, rate_hz, size in SENT:
            due = int((step + 1) * STEP_S * rate_hz) - int(step * STEP_S * rate_hz)
            for _ in range(due):
                if budget.admits(topic, size, now_s):
                    waiting += size + OVERHEAD_BYTES
                    sent[topic.name] += step * STEP_S >= seconds / 2
        moved = min(waiting, max(modem_bytes, rate_bytes_per_s * STEP_S) - in_modem)
        waiting, in_modem = waiting - moved, in_modem + moved
        passed = min(in_modem, rate_bytes_per_s * STEP_S)
        in_modem, carried = in_modem - passed, carried + passed
        arrived.append(carried)
        acked = arrived.popleft()
        if step * STEP_S >= seconds / 2:
            longest_s = max(longest_s, (waiting + in_modem) / rate_bytes_per_s)
        if step % 10 == 9:
            budget.observe(state(acked, waiting, sent=carried + in_modem), now_s)
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


@pytest.mark.parametrize("rate_bytes_per_s", [16e3, 30e3, 60e3])
def test_the_queue_of_a_modem_stays_short_from_the_beginning(rate_bytes_per_s: float) -> None:
    """All that is sent goes into the modem at once: nothing waits at the sender, which sees only late answers."""
    budget = LinkBudget()
    for start_s, seconds, most_s in ((0.0, 10.0, 1.5), (10.0, 60.0, 0.7)):
        sent, longest_s = run(rate_bytes_per_s, seconds, budget, start_s, modem_bytes=1e6)
        assert longest_s < most_s
    # It is used.
    carried = sum(sent[topic.name] * (size + OVERHEAD_BYTES) for topic, _, size in SENT) / 30.0
    assert carried > min(0.75 * rate_bytes_per_s, 50e3)


def test_a_long_link_with_room_soon_carries_everything() -> None:
    budget = LinkBudget()
    run(1e6, 20.0, budget, modem_bytes=1e6)
    sent, _ = run(1e6, 40.0, budget, start_s=20.0, modem_bytes=1e6)
    assert sent == {topic.name: rate_hz * 20 for topic, rate_hz, _ in SENT}
    assert budget.bytes_per_s is None


def test_delays_over_losses_say_nothing_of_a_queue() -> None:
    delay = AckDelay()
    # When, and what is acknowledged, sent, and sent again: 200 bytes within half a second, 100 over a loss in one.
    steps = [(0.0, 0, 0, 0), (0.1, 0, 200, 0), (0.5, 0, 200, 0), (0.6, 200, 200, 0), (0.7, 200, 300, 0)]
    steps += [(1.7, 200, 300, 100), (1.8, 300, 300, 100)]
    found = []
    for now_s, acked, sent, again in steps:
        delay.observe(state(acked, 0, sent=sent)._replace(sent_again=again), now_s)
        found.append(delay.least_s)
    assert found == [None, None, None, pytest.approx(0.5), pytest.approx(0.5), None, None]


@pytest.mark.parametrize("look_s", [0.1, 0.25, 0.45, 1.0])
def test_seldom_looks_are_no_queue(look_s: float) -> None:
    """On a busy machine. The link has a round trip of 60 ms and room for all."""
    delay, sent, least = AckDelay(), 0, []
    for step in range(round(20.0 / look_s)):
        # All but the last 60 ms is acknowledged.
        acked, sent = round(10_000 * max(step * look_s - 0.06, 0.0)), round(10_000 * step * look_s)
        delay.observe(state(acked, 0, 0.06, sent=sent), step * look_s)
        least.append(delay.least_s or 0.0)
    assert 0.0 < max(least) < 0.06 + QUEUED_S


def test_a_quiet_beginning_is_no_proof_of_room() -> None:
    budget = LinkBudget()
    budget.begin_low(0.0)
    for step in range(400):
        now_s, acked = step / 10, 200 * max(step - 4, 0)
        if step % 2:
            assert budget.admits(topics.CANDIDATES, 400, now_s)
        budget.observe(state(acked, 0, sent=200 * step), now_s)
    assert budget.bytes_per_s is not None
    assert not budget.is_slow
    _, longest_s = run(30e3, 60.0, budget, start_s=40.0, modem_bytes=1e6)
    assert longest_s < 0.7


def test_a_long_link_that_had_room_gets_a_limit_when_it_has_none_any_more() -> None:
    budget = LinkBudget()
    run(1e6, 60.0, budget, modem_bytes=1e6)
    assert budget.bytes_per_s is None
    # Another connection on the same way does not begin anew.
    budget.forget(60.0)
    budget.begin_low(60.0)
    assert budget.bytes_per_s is None
    _, longest_s = run(30e3, 120.0, budget, start_s=60.0, modem_bytes=1e6)
    assert budget.is_slow
    assert longest_s < 0.7


def send_over_losses(budget: LinkBudget, start_s: float, seconds: float, queued_s: float, *, acks: bool = True) -> None:
    """Send 20 kB/s over a link on which each acknowledgement comes after a loss. acks: whether any come."""
    budget.forget(start_s)
    for step in range(round(seconds * 10)):
        now_s, acked = start_s + step / 10, 1000 * step * acks
        for _ in range(2):
            budget.admits(topics.CANDIDATES, 1000, now_s)
        lossy = state(acked, 0, sent=acked + 12_000)._replace(rtt_s=RTT_S + queued_s, sent_again=1000 * step)
        budget.observe(lossy, now_s)


@pytest.mark.parametrize(("queued_s", "acks", "share"), [(1.0, True, 0.5), (0.3, True, 0.8), (1.0, False, 1.0)])
def test_where_every_delay_is_over_a_loss_the_round_trip_shows_a_queue(
    queued_s: float, acks: bool, share: float
) -> None:
    """Of a link that is cut it is stale, and shows nothing."""
    budget = LinkBudget()
    run(1e6, 5.0, budget, modem_bytes=1e6)
    limit = budget.bytes_per_s or 0.0
    assert limit > 0.0
    send_over_losses(budget, 5.0, 3.0, queued_s, acks=acks)
    assert budget.bytes_per_s == pytest.approx(share * limit)


def test_a_lifted_link_that_rests_gets_no_small_limit_by_the_delays_of_others() -> None:
    budget = LinkBudget()
    run(1e6, 60.0, budget, modem_bytes=1e6)
    assert budget.bytes_per_s is None
    budget.forget(60.0)
    late = round((RTT_S + 0.4) / 0.1)
    for step in range(100):
        now_s = 60.0 + step / 10
        if step % 10 == 0:
            budget.admits(topics.NODE_STATUS, 200, now_s)
        sent, acked = 300 * (step // 10 + 1), 300 * (max(step - late, -10) // 10 + 1)
        budget.observe(state(acked, 0, sent=sent), now_s)
    assert budget.bytes_per_s is None or budget.bytes_per_s >= FIRST_BYTES_PER_S


def test_a_limit_is_not_lifted_while_a_queue_stands() -> None:
    budget = LinkBudget()
    run(1e6, 12.0, budget, modem_bytes=1e6)
    limit = budget.bytes_per_s
    assert limit is not None
    budget.forget(12.0)
    late, each = round((RTT_S + 0.3) / 0.1), round(0.065 * limit)
    for step in range(400):
        now_s = 12.0 + step / 10
        budget.admits(topics.CANDIDATES, each - OVERHEAD_BYTES, now_s)
        budget.observe(state(each * max(step - late, 0), 0, sent=each * step), now_s)
    assert budget.bytes_per_s == limit


def test_a_limit_grows_by_15_percent_a_second_at_first_and_below_what_is_always_sent() -> None:
    budget = LinkBudget()
    run(1e6, 8.0, budget, modem_bytes=1e6)
    assert FIRST_BYTES_PER_S * 1.15**5 < (budget.bytes_per_s or 0.0) < FIRST_BYTES_PER_S * 1.15**7
    send_over_losses(budget, 8.0, 20.0, 1.0)
    assert budget.bytes_per_s == 1000.0
    run(1e6, 8.0, budget, start_s=28.0, modem_bytes=1e6)
    assert (budget.bytes_per_s or 0.0) > 1000.0 * 1.15**5


def test_a_burst_does_not_raise_a_budget_at_once() -> None:
    budget = LinkBudget()
    budget.begin_low(0.0)
    for step in range(10):
        now_s = step / 10
        for _ in range(9 if step == 1 else 0):
            budget.admits(topics.CANDIDATES, 1000, now_s)
        budget.observe(state(0, 0), now_s)
    assert budget.bytes_per_s is not None
    assert budget.bytes_per_s < 10_000.0


def test_a_link_that_is_hardly_used_keeps_its_budget_when_it_is_late() -> None:
    budget = LinkBudget()
    run(30e3, 30.0, budget)
    limit = budget.bytes_per_s
    assert limit is not None
    budget.forget(30.0)
    acked: deque[int] = deque([0] * 10)
    for step in range(100):
        acked.append(100 * step)
        budget.observe(state(acked.popleft(), 0, sent=100 * step), 30.0 + step / 10)
    assert budget.bytes_per_s >= limit


def test_a_budget_is_not_lifted_while_what_was_missed_waits_for_it() -> None:
    budget = LinkBudget()
    run(30e3, 30.0, budget)
    for step in range(400):
        at_s = 30.0 + step / 10
        for _ in range(3):
            budget.admits_spare(5000, at_s)
        budget.observe(state(0, 0), at_s)
    assert budget.bytes_per_s is not None


def test_a_link_that_recovers_carries_everything_again() -> None:
    budget = LinkBudget()
    run(12e3, 20.0, budget)
    assert budget.bytes_per_s is not None
    sent, _ = run(1e6, 240.0, budget, start_s=20.0)
    assert budget.bytes_per_s is None
    assert sent["imu"] == 12000


@pytest.mark.parametrize("new_connection", [False, True], ids=["the same connection", "another connection"])
@pytest.mark.parametrize("cut_s", [1.0, 2.5, 15.0])
def test_a_cut_teaches_nothing(cut_s: float, new_connection: bool) -> None:
    """A link of 1 MB/s is cut. Once what has gathered is sent, it carries what it carried before."""
    budget, waiting, acked = LinkBudget(), 0.0, 0.0
    sent: Counter[str] = Counter()
    budget.forget(0.0)
    least = float("inf")
    for step in range(round((20.0 + cut_s) / STEP_S)):
        now_s = step * STEP_S
        for topic, rate_hz, size in SENT:
            for _ in range(int((step + 1) * STEP_S * rate_hz) - int(step * STEP_S * rate_hz)):
                if budget.admits(topic, size, now_s):
                    waiting += size + OVERHEAD_BYTES
                    sent[topic.name] += now_s >= 12.0 + cut_s
        if not 10.0 <= now_s < 10.0 + cut_s:
            carried = min(waiting, 1e6 * STEP_S)
            waiting, acked = waiting - carried, acked + carried
        elif new_connection and step == round((10.0 + cut_s) / STEP_S) - 1:
            waiting = acked = 0.0
            budget.forget(now_s)
        if step % 10 == 9:
            budget.observe(state(acked, waiting, 0.001), now_s)
        least = min(least, budget.bytes_per_s or float("inf"))
    assert sent == {topic.name: rate_hz * 8 for topic, rate_hz, _ in SENT}
    assert least > 10 * sum(rate_hz * (size + OVERHEAD_BYTES) for _, rate_hz, size in SENT)


def test_copies_go_on_a_slow_link_that_is_not_behind() -> None:
    budget = LinkBudget()
    run(1e6, 5.0, budget)
    assert not budget.admits_copy(1000, 5.0)
    run(12e3, 20.0, budget, start_s=5.0)
    for step in range(20):
        budget.observe(state(0, 0), 25.0 + step / 10)
    assert budget.admits_copy(1000, 27.0)
    for step in range(20):
        budget.observe(state(1000 * step, 4096), 27.0 + step / 10)
    assert not budget.admits_copy(1000, 29.0)
    assert "messages come 1 s late or more, since 2 s ago" in budget.words(29.0)


def test_copies_go_on_beside_a_connection_that_a_lost_packet_has_stopped() -> None:
    budget = LinkBudget()
    run(12e3, 20.0, budget)
    copied = []
    for step in range(40):
        now_s = 20.0 + step / 10
        # After a second and a half it carries four bytes at a time.
        budget.observe(state(10**6 + min(1000 * step, 15_000) + 4 * step, 4096), now_s)
        copied.append(budget.admits_copy(1000, now_s))
    assert copied[0]
    assert not any(copied[12:32])
    assert all(copied[35:])


def clear(budget: LinkBudget, seconds: float, start_s: float, waiting: int = 0) -> float:
    """Let the connection be seen with so many bytes waiting for some time; return its end."""
    for step in range(round(10 * seconds) + 1):
        budget.observe(state(0, waiting), start_s + step / 10)
    return start_s + seconds


def test_without_a_limit_all_that_was_missed_is_sent() -> None:
    budget = LinkBudget()
    assert all(budget.admits_answer(10**6, 0.0) for _ in range(100))


def test_answers_of_a_flood_of_questions_get_their_share_of_a_slow_link() -> None:
    budget = LinkBudget()
    run(20_000.0, 30.0, budget)
    sent, now_s = 0, clear(budget, 1.0, 30.0)
    limit = budget.bytes_per_s
    assert limit is not None
    for step in range(1000):
        for _ in range(10):
            sent += 1100 if budget.admits_answer(1000, now_s + step / 100) else 0
        budget.observe(state(0, 0), now_s + step / 100)
    # A second's budget at once, and the share for ten seconds; the limit rises by 3 % a second meanwhile.
    assert 10 * ANSWER_SHARE * limit < sent < 1.35 * (1 + 10 * ANSWER_SHARE) * limit + 1100


def test_candidates_and_copies_that_use_up_a_slow_link_leave_the_answers_their_share() -> None:
    budget = LinkBudget()
    run(12_000.0, 30.0, budget)
    sent, now_s = 0, clear(budget, 1.0, 30.0)
    for step in range(100):
        at_s = now_s + step / 10
        budget.observe(state(0, 0), at_s)
        assert budget.admits(topics.CANDIDATES, 4000, at_s)
        assert budget.admits_copy(8000, at_s)
        sent += budget.admits_answer(1000, at_s)
    assert budget.bytes_per_s is not None
    assert sent > 10 * ANSWER_SHARE * 0.8 * budget.bytes_per_s / 1100


def test_what_was_missed_waits_while_the_connection_is_behind() -> None:
    budget = LinkBudget()
    run(12_000.0, 30.0, budget)
    now_s = clear(budget, 1.0, 30.0)
    assert budget.admits_answer(1000, now_s)
    now_s = clear(budget, 2.0, now_s, waiting=4096)
    assert not budget.admits_answer(1000, now_s)
    now_s = clear(budget, 1.0, now_s)
    assert budget.admits_answer(1000, now_s)


def test_answers_leave_no_room_for_what_may_be_left_out() -> None:
    budget = LinkBudget()
    run(12_000.0, 30.0, budget)
    now_s = clear(budget, 2.0, 30.0)
    assert budget.admits_spare(100, now_s)
    assert budget.admits_answer(8000, now_s)
    assert not budget.admits_spare(100, now_s)
