"""What publishers hold, and how they answer: whole, in small pages, and no more than a bound a second."""

from __future__ import annotations

import time

import pytest
import zenoh
from buddyline.protocol import topics
from buddyline.protocol.delivery import FailureLatch
from buddyline.protocol.held import (
    MAX_HELD_BYTES,
    OVERHEAD_BYTES,
    PAGE_BYTES,
    Held,
    HeldMessage,
    asked,
    open_page,
    pages,
)
from buddyline.protocol.link_budget import LinkBudget
from buddyline.protocol.zenoh_bus import held_desk, open_hub
from buddyline.protocol.zenoh_bus.held_desk import BURST_BYTES, BYTES_PER_S, HeldDesk
from buddyline.protocol.zenoh_bus.session import config_of
from buddyline.protocol.zenoh_bus.settings import client_settings
from hypothesis import given
from hypothesis import strategies as st

from tests.processes import free_endpoint, until
from tests.protocol.inbox import Inbox
from tests.protocol.test_bus_zenoh import run_client
from tests.protocol.test_link_budget import run

MESSAGES = st.lists(
    st.builds(HeldMessage, st.integers(0, 2**32 - 1), st.binary(max_size=2 * PAGE_BYTES), st.booleans()), max_size=20
)


@given(st.integers(0, 2**32 - 1), MESSAGES)
def test_pages_hold_all_messages_in_order(oldest: int, messages: list[HeldMessage]) -> None:
    found: list[HeldMessage] = []
    for page, last in pages(oldest, messages):
        told, part = open_page(page)
        assert told == oldest
        assert last == (part[-1].number if part else oldest)
        assert len(page) <= PAGE_BYTES or (len(part) == 1 and len(page) == OVERHEAD_BYTES + len(part[0].payload))
        found += part
    assert found == messages


@given(st.binary(max_size=200))
def test_a_page_of_nonsense_is_refused_or_has_no_more_than_it_says(page: bytes) -> None:
    try:
        _, found = open_page(page)
    except ValueError:
        return
    assert sum(OVERHEAD_BYTES - 4 + len(message.payload) for message in found) <= len(page)


def test_the_newest_are_held_up_to_the_depth_and_to_a_size() -> None:
    held = Held(3)
    for number in range(10):
        held.add(HeldMessage(number, b"x", again=False))
    oldest, found = held.find(0, 2**32 - 1)
    assert (oldest, [message.number for message in found]) == (7, [7, 8, 9])
    assert [message.number for message in held.find(8, 8)[1]] == [8]
    assert held.find(20, 30) == (7, [])
    for first, last in [(0, 2**32 - 1), (8, 8), (20, 30), (0, 6), (9, 8), (6, 9)]:
        assert held.count(first, last) == len(held.find(first, last)[1])
    large = Held(1000)
    for number in range(100):
        large.add(HeldMessage(number, bytes(MAX_HELD_BYTES // 10), again=False))
    assert [message.number for message in large.find(0, 100)[1]] == list(range(90, 100))


def test_who_comes_new_gets_a_minute_and_who_missed_something_all_that_is_held() -> None:
    """At 5 Hz there are six minutes. A solver that joined got the older part of them first, for seconds."""
    held = Held(1800, history_s=60.0)
    for number in range(2000):
        held.add(HeldMessage(number, b"x", again=False), number / 5.0)
    oldest, found = held.find(*asked(""), 400.0)
    assert (oldest, [message.number for message in found]) == (1700, list(range(1700, 2000)))
    assert held.find(0, 1749, 400.0) == (1700, found[:50])
    assert held.find(0, 1000, 400.0) == (1700, [])
    oldest, found = held.find(300, 1999, 400.0)
    assert (oldest, [message.number for message in found]) == (200, list(range(300, 2000)))


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("_sn=3..7", (3, 7)),
        ("", (0, 2**32 - 1)),
        ("_sn=3", (0, 2**32 - 1)),
        ("_sn=-1..x", (0, 2**32 - 1)),
        (f"_sn=5..{10**30}", (5, 2**32 - 1)),
    ],
)
def test_what_a_question_asks_for(text: str, numbers: tuple[int, int]) -> None:
    assert asked(text) == numbers


def test_a_flood_of_questions_is_answered_up_to_a_bound_and_a_gap_before_it() -> None:
    """Zenoh's own cache answers each in one go; its publisher and the hub do nothing else meanwhile."""
    endpoint = free_endpoint()
    with open_hub(endpoint), run_client(endpoint) as node, run_client(endpoint) as viewer:
        inbox, publisher = Inbox(), node.publisher(topics.CANDIDATES, "a")
        viewer.subscribe(topics.CANDIDATES.key_any(), inbox)
        payload = bytes(60_000)
        for _ in range(100):
            publisher.put_bytes(payload)
        inbox.wait_for(100)
        came: list[int] = []
        with zenoh.open(config_of(client_settings(endpoint, None))) as session:
            selector = "buddyline/node/a/candidates/@adv/pub/**"
            begin_s = time.monotonic()

            def take(reply: zenoh.Reply) -> None:
                if reply.ok is not None:
                    came.append(len(reply.ok.payload))

            # 1.2 GB are asked for.
            for _ in range(200):
                session.get(selector, take, target=zenoh.QueryTarget.ALL, timeout=30.0)

            def answered() -> bool:
                replies = session.get(f"{selector}?_sn=99..99", target=zenoh.QueryTarget.ALL, timeout=1.0)
                return any(reply.ok is not None and reply.ok.payload.to_bytes()[4] == 99 for reply in replies)

            # What a full link leaves out of an answer is asked for again.
            until(answered, 0.0)
            publisher.put_bytes(b"last")
            inbox.wait_for(101)
            until(lambda: sum(came) > BYTES_PER_S or time.monotonic() - begin_s > 3.0, 0.05)
            assert sum(came) <= BURST_BYTES + BYTES_PER_S * (time.monotonic() - begin_s)


def test_a_question_for_a_gap_is_not_pushed_out_by_those_that_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flood has 50 between two looks of its owner. The gap's question came again and again, for up to 1.5 s."""
    monkeypatch.setattr(held_desk, "LOOK_S", 0.5)
    endpoint = free_endpoint()
    with open_hub(endpoint), zenoh.open(config_of(client_settings(endpoint, None))) as session:
        held = Held(1000)
        for number in range(20):
            held.add(HeldMessage(number, b"x", again=False))
        desk = HeldDesk(session, lambda: None, FailureLatch())
        source = f"buddyline/node/a/candidates/@adv/pub/{session.zid()}/1/_"
        desk.show(source, held, topics.CANDIDATES.encoding)
        try:
            gap = session.get(f"{source}?_sn=7..7", timeout=60.0)
            for _ in range(200):
                session.get(source, lambda _: None, timeout=60.0)
            pages = [open_page(reply.ok.payload.to_bytes()) for reply in gap if reply.ok is not None]
        finally:
            desk.close()
    assert [message.number for _, messages in pages for message in messages] == [7]


def test_what_a_slow_link_cannot_carry_is_told_to_be_gone_and_holds_back_nothing() -> None:
    """Of what was missed the newest is sent; a receiver that asked for the rest again and again would hold the new."""
    endpoint, budget = free_endpoint(), LinkBudget()
    with open_hub(endpoint), zenoh.open(config_of(client_settings(endpoint, None))) as session:
        run(12_000.0, 30.0, budget, start_s=time.monotonic() - 30.0)
        budget.forget(time.monotonic())
        limit = budget.bytes_per_s
        assert limit is not None
        held = Held(1000)
        for number in range(400):
            held.add(HeldMessage(number, bytes(1000), again=False))
        desk = HeldDesk(session, lambda: budget, FailureLatch())
        source = f"buddyline/node/a/candidates/@adv/pub/{session.zid()}/1/_"
        desk.show(source, held, topics.CANDIDATES.encoding)
        try:
            replies = list(session.get(source, consolidation=zenoh.ConsolidationMode.NONE, timeout=60.0))
        finally:
            desk.close()
    opened = [open_page(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]
    numbers = sorted(message.number for _, messages in opened for message in messages)
    assert numbers == list(range(400 - len(numbers), 400))
    assert 0 < len(numbers) * 1000 < 3 * limit
    assert opened[-1] == (400 - len(numbers), [])
