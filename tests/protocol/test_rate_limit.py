"""How much a receiver takes of each key, and what a client at full speed costs it."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

import pytest
import zenoh
from buddyline.protocol import rate_limit, topics
from buddyline.protocol.bus import CACHE_S, cache_depth
from buddyline.protocol.codec import payload_stamp_ns
from buddyline.protocol.rate_limit import BYTES_BURST_S, MARGIN, MOST_BYTES_PER_S, RateLimit, most_at_once, most_hz
from buddyline.protocol.security import PLAYER
from buddyline.protocol.zenoh_bus import narrowing, open_hub
from buddyline.protocol.zenoh_bus.alive import ALIVE, MAX_TOKENS
from buddyline.protocol.zenoh_bus.narrowing import Narrowing, narrowed
from buddyline.protocol.zenoh_bus.session import config_of
from buddyline.protocol.zenoh_bus.settings import client_settings

from tests.processes import free_endpoint, until
from tests.protocol.buses import run_client
from tests.protocol.inbox import Inbox


class SecondsClock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def admitted(limit: RateLimit, key: str, count: int, size_bytes: int = 100) -> int:
    return sum(limit.admits(key, size_bytes) for _ in range(count))


def test_each_topic_may_come_several_times_as_fast_as_its_table_says() -> None:
    clock = SecondsClock()
    limit = RateLimit(clock)
    for topic in topics.TOPICS:
        key = topic.key(*("abc"[: len(topic.id_fields)]))
        for _ in range(200):
            clock.now_s += 0.1
            admitted(limit, key, max(round(MARGIN * topic.rate_hz / 10), 1), topic.max_bytes // 64)
    assert limit.dropped == {}
    assert limit.problem() == ""


def test_what_is_more_is_left_out_and_its_owner_named_for_a_while() -> None:
    clock = SecondsClock()
    limit = RateLimit(clock)
    key, hz = topics.IMU.key("c"), most_hz(topics.IMU)
    assert admitted(limit, key, 100_000) == most_at_once(topics.IMU)
    clock.now_s += 1.0
    assert admitted(limit, key, 100_000) == hz
    left_out = round(200_000 - most_at_once(topics.IMU) - hz)
    assert limit.dropped == {"buddyline/node/c": left_out}
    assert limit.problem() == f"buddyline/node/c sends too much: {left_out} messages left out"
    # At once comes what a publisher of this rate holds for those that missed it.
    assert most_at_once(topics.IMU) == cache_depth(topics.IMU, CACHE_S)
    # Other keys, its own too, have what is theirs.
    assert admitted(limit, topics.CANDIDATES.key("c"), 100) == 100
    assert admitted(limit, topics.IMU.key("a"), 100) == 100
    clock.now_s += rate_limit.SAID_S
    assert limit.problem() == ""


def test_who_sends_much_at_once_is_ahead_for_a_while_and_who_keeps_its_rate_never_is() -> None:
    clock = SecondsClock()
    limit = RateLimit(clock)
    a, c = topics.IMU.key("a"), topics.IMU.key("c")
    for _ in range(100):
        clock.now_s += 0.1
        admitted(limit, a, round(MARGIN * topics.IMU.rate_hz / 10))
        assert not limit.is_ahead(a)
    admitted(limit, c, round(most_at_once(topics.IMU) * rate_limit.AHEAD) + 1)
    assert limit.is_ahead(c)
    assert limit.is_ahead(topics.CANDIDATES.key("c"))
    assert not limit.is_ahead(a)
    assert limit.dropped == {}
    clock.now_s += rate_limit.AHEAD_S
    assert not limit.is_ahead(c)
    admitted(limit, topics.CANDIDATES.key("c"), 30, 65536)
    assert limit.is_ahead(c)


def test_bytes_count_too() -> None:
    limit, key = RateLimit(SecondsClock()), topics.CANDIDATES.key("c")
    assert admitted(limit, key, 1000, 65536) == int(BYTES_BURST_S * MOST_BYTES_PER_S / 65536)


def test_keys_that_an_owner_invents_share_one_limit_and_take_nothing_from_others() -> None:
    limit = RateLimit(SecondsClock())
    for number in range(100_000):
        limit.admits(f"buddyline/node/c/x{number}", 1)
        limit.admits(f"buddyline/pair/c/x{number}/pose", 1)
    taken = most_at_once(None)
    assert limit.dropped["buddyline/node/c"] == 100_000 - taken
    assert limit.dropped["buddyline/pair/c"] == 100_000 - taken - rate_limit.MAX_KEYS
    assert admitted(limit, topics.CANDIDATES.key("a"), 100) == 100


def test_owners_that_are_invented_are_forgotten() -> None:
    limit = RateLimit(SecondsClock())
    for number in range(10 * rate_limit.MAX_OWNERS):
        limit.admits(topics.IMU.key(f"x{number}"), 1)
    assert len(limit._owners) == rate_limit.MAX_OWNERS


def test_a_flood_is_left_out_before_it_is_queued_and_a_stored_dive_is_no_flood(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rate_limit, "BURST_S", 5.0)
    monkeypatch.setattr(narrowing, "SHUT_OUT_S", 0.5)
    endpoint, inbox, count = free_endpoint(), Inbox(), 2 * round(most_at_once(topics.DEPTH))
    own = topics.DEPTH.key("c")
    with open_hub(endpoint), run_client(endpoint) as receiver, run_client(endpoint) as node:
        subscription = receiver.subscribe(topics.EVERYTHING, inbox, capacity=100_000)
        publisher = node.publisher(topics.CANDIDATES, "a")
        with zenoh.open(config_of(client_settings(endpoint, None))) as client:

            def flood() -> int:
                for _ in range(100):
                    client.put(own, b"x", congestion_control=zenoh.CongestionControl.BLOCK)
                return subscription.dropped

            began_s = time.monotonic()
            until(flood, 0.0)
            taken = len(inbox.payloads(own))
            assert taken <= most_at_once(topics.DEPTH) + (time.monotonic() - began_s) * most_hz(topics.DEPTH)
            assert "buddyline/node/c sends too much" in receiver.flood_problem()
            node.declare_alive(PLAYER)
            until(lambda: receiver._players)  # type: ignore[attr-defined]
            dropped = subscription.dropped
            for number in range(count):
                publisher.put_bytes(b'{"stamp_ns":%d}' % number)
                if number % 100 == 99:
                    # More than its cache holds must not be on the way.
                    inbox.wait_until(lambda due=number + 1: len(inbox.payloads(publisher.key)) == due)  # type: ignore[misc]
            assert [payload_stamp_ns(payload) for payload in inbox.payloads(publisher.key)] == list(range(count))
            assert subscription.dropped == dropped
            node.withdraw_alive(PLAYER)
            until(lambda: not receiver._players)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("key_expr", "left"),
    [
        ("buddyline/**", ["buddyline/node/a/**", "buddyline/pair/a/**"]),
        ("buddyline/**/@adv/pub/**", ["buddyline/node/a/**/@adv/pub/**", "buddyline/pair/a/**/@adv/pub/**"]),
        ("buddyline/node/*/imu", ["buddyline/node/a/imu"]),
        ("buddyline/pair/*/*/pose/@adv/pub/**", ["buddyline/pair/a/*/pose/@adv/pub/**"]),
        ("buddyline/net/*/*", []),
        ("buddyline/node/c/expect", ["buddyline/node/c/expect"]),
    ],
)
def test_a_subscription_without_some_owners(key_expr: str, left: list[str]) -> None:
    assert narrowed(key_expr, ["buddyline/node/a", "buddyline/pair/a", "other"]) == left


def test_who_floods_is_shut_out_for_a_time_and_the_others_lose_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(narrowing, "SHUT_OUT_S", 0.5)
    monkeypatch.setattr(narrowing, "LOOK_S", 0.05)
    # On a busy machine little comes from look to look.
    monkeypatch.setattr(rate_limit, "FLOOD_MESSAGES", 1)
    changes: list[bool] = []
    change = Narrowing._change

    def noted(of: Narrowing, owners: Sequence[str] | None) -> None:
        change(of, owners)
        changes.append(owners is None)

    monkeypatch.setattr(Narrowing, "_change", noted)
    endpoint, inbox = free_endpoint(), Inbox()
    own, numbers = topics.DEPTH.key("c"), iter(range(100_000))
    with open_hub(endpoint), run_client(endpoint) as receiver, run_client(endpoint) as node:
        receiver.subscribe(topics.EVERYTHING, inbox, capacity=100_000)
        publisher = node.publisher(topics.CANDIDATES, "a")

        def say() -> None:
            publisher.put_bytes(b'{"stamp_ns":%d}' % next(numbers))

        say()
        inbox.wait_for(1)
        with zenoh.open(config_of(client_settings(endpoint, None))) as client:

            def flood() -> list[bool]:
                say()
                for _ in range(200):
                    client.put(own, b"x", congestion_control=zenoh.CongestionControl.BLOCK)
                return changes

            until(flood, 0.0)
            assert not changes[0]
        until(lambda: say() or len(changes) > 1, 0.01)
        assert changes[1]
        say()
        said = next(numbers)
        inbox.wait_until(lambda: len(inbox.payloads(publisher.key)) == said)
        assert [payload_stamp_ns(payload) for payload in inbox.payloads(publisher.key)] == list(range(said))
        # Who was shut out, and newcomers, are heard again.
        for name in "cd":
            known = node.publisher(topics.CANDIDATES, name)
            until(lambda known=known: known.put_bytes(b"{}") and inbox.payloads(known.key), 0.05)


def test_a_node_that_comes_while_another_is_shut_out_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(narrowing, "SHUT_OUT_S", 3600.0)
    monkeypatch.setattr(narrowing, "NEWCOMERS_S", 0.05)
    monkeypatch.setattr(narrowing, "LOOK_S", 0.05)
    monkeypatch.setattr(rate_limit, "FLOOD_MESSAGES", 1)
    endpoint, inbox, narrowed_once = free_endpoint(), Inbox(), threading.Event()
    change = Narrowing._change

    def noted(of: Narrowing, owners: Sequence[str] | None) -> None:
        change(of, owners)
        narrowed_once.set()

    monkeypatch.setattr(Narrowing, "_change", noted)
    with open_hub(endpoint), run_client(endpoint) as receiver, run_client(endpoint) as node:
        receiver.subscribe(topics.EVERYTHING, inbox, capacity=100_000)
        with zenoh.open(config_of(client_settings(endpoint, None))) as client:

            def flood() -> bool:
                for _ in range(200):
                    client.put(topics.DEPTH.key("c"), b"x", congestion_control=zenoh.CongestionControl.BLOCK)
                return narrowed_once.is_set()

            until(flood, 0.0)
        late = node.publisher(topics.CANDIDATES, "d")
        node.declare_alive("node/d")
        until(lambda: late.put_bytes(b"{}") and inbox.payloads(late.key), 0.05)


def test_a_client_that_comes_and_goes_without_end_is_shut_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is named, counted, and forgotten in the end; the others are seen all the time, and after it also new ones."""
    monkeypatch.setattr(narrowing, "SHUT_OUT_S", 0.5)
    endpoint, changes = free_endpoint(), list[tuple[str, bool]]()
    with open_hub(endpoint), run_client(endpoint) as receiver, run_client(endpoint) as node:
        watch = receiver.watch_alive(lambda name, alive: changes.append((name, alive)))
        node.declare_alive("node/a")
        until(lambda: ("node/a", True) in changes)
        with zenoh.open(config_of(client_settings(endpoint, None))) as client:
            tokens = []

            def flood() -> bool:
                tokens.extend(
                    client.liveliness().declare_token(f"{ALIVE}/node/c/{len(tokens)}_{k}") for k in range(200)
                )
                return watch.dropped > 0

            until(flood, 0.0)
            assert len(tokens) >= 1000
            assert "buddyline/node/c sends too much" in receiver.flood_problem()
            node.withdraw_alive("node/a")
            until(lambda: changes[-1] == ("node/a", False))
            node.declare_alive("node/d")
            until(lambda: ("node/d", True) in changes)
            assert sum(map(len, watch._processes.values())) <= MAX_TOKENS  # type: ignore[attr-defined]
        until(lambda: "node/c" not in watch._processes and changes[-1] == ("node/c", False))  # type: ignore[attr-defined]
        assert watch._count == 1  # type: ignore[attr-defined]
    assert {name for name, _ in changes} == {"node/a", "node/c", "node/d"}
