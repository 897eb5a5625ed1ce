"""Samples in order, each once: laws over random losses, and single cases."""

from __future__ import annotations

from typing import Any

import pytest
from buddyline.protocol import sequence
from buddyline.protocol.sequence import Gap, PublisherId, SampleSequence
from hypothesis import given
from hypothesis import strategies as st

A, B = PublisherId("buddyline/node/a/depth", "z", 1), PublisherId("buddyline/node/b/depth", "z", 1)


def name_of(source: PublisherId) -> str:
    return source.key.split("/")[2]


class Listener:
    """A sequence and what it has handed on."""

    def __init__(self) -> None:
        self.got: list[tuple[str, int]] = []
        self.sequence = SampleSequence(self.got.append)

    def accept(self, source: PublisherId, number: int, **more: Any) -> Gap | None:
        return self.sequence.accept(source, number, (name_of(source), number), **more)

    def close(self, gap: Gap, found: list[int]) -> Gap | None:
        return self.sequence.close(gap, [(number, (name_of(gap.source), number)) for number in found])

    def numbers(self, source: PublisherId = A) -> list[int]:
        return [number for name, number in self.got if name == name_of(source)]


@given(
    st.lists(st.tuples(st.sampled_from([A, B]), st.booleans(), st.booleans()), max_size=60),
    st.lists(st.integers(0, 5), max_size=60),
)
def test_all_available_samples_come_in_order_and_once(
    samples: list[tuple[PublisherId, bool, bool]], delays: list[int]
) -> None:
    """Some samples are lost on their way, some of those are still held; fetching takes a while."""
    listener, sent, held_by, open_gaps = Listener(), {A: 0, B: 0}, {A: [], B: []}, []
    expected: dict[PublisherId, list[int]] = {A: [], B: []}
    delay = iter(delays)

    def fetch(gap: Gap) -> Gap | None:
        return listener.close(gap, [n for n in held_by[gap.source] if n in gap.missing])

    for source, lost, kept in [*samples, (A, False, True), (B, False, True)]:
        number = sent[source]
        sent[source] += 1
        if kept:
            held_by[source].append(number)
        if kept or not lost:
            expected[source].append(number)
        if not lost:
            gap = listener.accept(source, number)
            if gap is not None:
                open_gaps.append([gap, next(delay, 0)])
        for entry in list(open_gaps):
            entry[1] -= 1
            if entry[1] < 0:
                entry[0] = fetch(entry[0])
                if entry[0] is None:
                    open_gaps.remove(entry)
    for gap, _ in open_gaps:
        due = gap
        while due is not None:
            due = fetch(due)
    assert {source: listener.numbers(source) for source in (A, B)} == expected
    counted = sum(sent.values()) - len(listener.got)
    # What a publisher sent before it was heard of, and holds no more, is no loss.
    assert listener.sequence.missed <= counted


def test_samples_after_a_gap_wait_and_other_publishers_do_not() -> None:
    listener = Listener()
    listener.accept(A, 0)
    gap = listener.accept(A, 3)
    assert gap == Gap(A, range(1, 3), known=True)
    assert listener.accept(A, 4) is None
    listener.accept(B, 0)
    assert listener.got == [("a", 0), ("b", 0)]
    assert listener.close(gap, [2]) is None
    assert listener.numbers() == [0, 2, 3, 4]
    assert listener.sequence.missed == 1


def test_a_second_gap_is_closed_after_the_first() -> None:
    listener = Listener()
    listener.accept(A, 0)
    first = listener.accept(A, 2)
    assert listener.accept(A, 5) is None
    second = listener.close(first, [1])
    assert second == Gap(A, range(3, 5), known=True)
    assert listener.numbers() == [0, 1, 2]
    assert listener.close(second, []) is None
    assert listener.numbers() == [0, 1, 2, 5]
    assert listener.sequence.missed == 2


def test_samples_before_a_publishers_first_are_fetched_and_not_counted_as_missed() -> None:
    listener = Listener()
    gap = listener.accept(A, 5)
    assert gap == Gap(A, range(5), known=False)
    assert listener.close(gap, [3, 4]) is None
    assert listener.numbers() == [3, 4, 5]
    assert listener.sequence.missed == 0
    listener.sequence.begin(B, 7)
    assert listener.accept(B, 7) is None


def test_duplicates_and_latecomers_are_dropped() -> None:
    listener = Listener()
    for number in (0, 1, 1, 0, 2):
        listener.accept(A, number)
    gap = listener.accept(A, 4)
    listener.accept(A, 4)
    listener.accept(A, 1)
    listener.close(gap, [1, 3, 3, 4, 9])
    assert listener.numbers() == [0, 1, 2, 3, 4]


def test_without_recovery_losses_are_counted_and_skipped() -> None:
    listener = Listener()
    for number in (10, 11, 14):
        assert listener.accept(A, number, recover=False) is None
    assert listener.numbers() == [10, 11, 14]
    assert listener.sequence.missed == 2


def test_replaced_states_do_not_count_as_lost() -> None:
    listener = Listener()
    for number in (3, 9, 8, 12):
        assert listener.accept(A, number, newest_only=True) is None
    assert listener.numbers() == [3, 9, 12]
    assert listener.sequence.missed == 0


def test_memory_for_publishers_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sequence, "MAX_HELD", 3)
    monkeypatch.setattr(sequence, "MAX_PUBLISHERS", 2)
    listener = Listener()
    listener.accept(A, 0)
    gap = listener.accept(A, 2)
    for number in range(3, 10):
        listener.accept(A, number)
    assert listener.close(gap, [1]) is None
    assert listener.numbers() == [0, 1, 2, 3, 4]
    assert listener.accept(A, 10) == Gap(A, range(5, 10), known=True)
    for eid in (2, 3):
        listener.accept(A._replace(eid=eid), 0)
    # It was silent longest, so it is forgotten.
    assert listener.close(Gap(A, range(5, 10), known=True), []) is None
    assert listener.numbers() == [0, 1, 2, 3, 4, 0, 0]


def test_samples_that_wait_are_bounded_in_bytes_by_owner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sequence, "MAX_HELD_BYTES", 100)
    listener = Listener()
    for source in (A, B):
        listener.accept(source, 0)
        gap = listener.accept(source, 2, size_bytes=60)
        for number in range(3, 10):
            listener.accept(source, number, size_bytes=20)
        # One more publisher of this owner finds no more room than for a single sample.
        other = source._replace(eid=2)
        listener.accept(other, 1, size_bytes=20)
        listener.accept(other, 2, size_bytes=20)
        assert listener.close(gap, [1]) is None
        assert listener.numbers(source) == [0, 1, 2, 3, 4]


def test_a_publisher_is_known_by_its_key_and_not_by_what_it_says_of_itself_alone() -> None:
    listener = Listener()
    for number in range(3):
        listener.accept(B, number)
    forged = PublisherId(A.key, B.zid, B.eid)
    assert listener.accept(forged, 10**6) == Gap(forged, range(10**6), known=False)
    assert listener.accept(B, 3) is None
    assert listener.numbers(B) == [0, 1, 2, 3]


def test_whoever_invents_publishers_makes_others_forget_nothing() -> None:
    listener = Listener()
    listener.accept(B, 0)
    for eid in range(2 * sequence.MAX_PUBLISHERS):
        listener.accept(A._replace(eid=eid), 5)
    assert listener.accept(B, 1) is None
    assert listener.numbers(B) == [0, 1]


def test_a_heartbeat_tells_of_the_last_sample_and_the_next_one_that_it_is_lost() -> None:
    listener = Listener()
    listener.accept(A, 0)
    assert listener.sequence.heartbeat(A, 0) is None
    assert listener.sequence.heartbeat(A, 2) is None
    gap = listener.sequence.heartbeat(A, 3)
    assert gap == Gap(A, range(1, 3), known=True)
    assert listener.sequence.heartbeat(A, 3) is None
    # What comes meanwhile waits; what was late and is fetched as well comes once.
    assert listener.accept(A, 2) is None
    assert listener.accept(A, 3) is None
    assert listener.close(gap, [1, 2]) is None
    assert listener.numbers() == [0, 1, 2, 3]
    assert listener.sequence.missed == 0


def test_what_a_heartbeat_tells_of_and_nobody_has_is_missed_once() -> None:
    listener = Listener()
    listener.accept(A, 0)
    listener.sequence.heartbeat(A, 4)
    gap = listener.sequence.heartbeat(A, 4)
    assert listener.close(gap, [2]) is None
    assert listener.sequence.heartbeat(A, 4) is None
    assert listener.accept(A, 5) is None
    assert listener.numbers() == [0, 2, 5]
    assert listener.sequence.missed == 3


def test_of_a_state_the_newest_alone_is_fetched() -> None:
    listener = Listener()
    listener.sequence.heartbeat(A, 7, newest_only=True)
    gap = listener.sequence.heartbeat(A, 7, newest_only=True)
    assert gap == Gap(A, range(7, 8), known=False)
    assert listener.close(gap, [7]) is None
    assert listener.numbers() == [7]
    assert listener.sequence.missed == 0


def test_copies_wait_for_what_is_before_them_and_for_no_originals_of_their_own() -> None:
    """The connection stands still: what it lacks of the copies comes by it, late, and then all is there."""
    listener = Listener()
    copy = listener.sequence.accept_copy
    listener.accept(A, 0)
    for number in (1, 3, 4, 6):
        copy(A, number, ("a", number))
    assert listener.numbers() == [0, 1]
    assert listener.accept(A, 1) is None
    assert listener.accept(A, 2) is None
    assert listener.numbers() == [0, 1, 2, 3, 4]
    copy(A, 5, ("a", 5))
    assert listener.numbers() == [0, 1, 2, 3, 4, 5, 6]
    assert listener.sequence.missed == 0


def test_copies_fill_a_gap_that_nobody_else_can_fill() -> None:
    listener = Listener()
    listener.accept(A, 0)
    gap = listener.accept(A, 4)
    for number in (2, 3, 5):
        listener.sequence.accept_copy(A, number, ("a", number))
    assert listener.numbers() == [0]
    assert listener.close(gap, []) is None
    assert listener.numbers() == [0, 2, 3, 4, 5]
    assert listener.sequence.missed == 1


def test_who_fetches_nothing_gets_the_copies_of_what_is_lost() -> None:
    listener = Listener()
    listener.accept(A, 0)
    listener.sequence.accept_copy(A, 2, ("a", 2))
    assert listener.accept(A, 4, recover=False) is None
    assert listener.numbers() == [0, 2, 4]
    assert listener.sequence.missed == 2


def test_copies_that_wait_are_bounded_by_number_and_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sequence, "MAX_COPIES", 3)
    monkeypatch.setattr(sequence, "MAX_HELD_BYTES", 100)
    listener = Listener()
    listener.accept(A, 0)
    for number in range(2, 9):
        listener.sequence.accept_copy(A, number, ("a", number), size_bytes=40)
    assert listener.accept(A, 1) is None
    # Two have room, and give it back.
    assert listener.numbers() == [0, 1, 2, 3]
    for number in range(5, 12):
        listener.sequence.accept_copy(A, number, ("a", number), size_bytes=10)
    assert listener.accept(A, 4) is None
    assert listener.numbers() == [0, 1, 2, 3, 4, 5, 6, 7]


def test_a_copy_is_delivered_only_in_its_turn_and_its_original_then_is_not() -> None:
    listener = Listener()
    copy = listener.sequence.accept_copy
    copy(A, 0, ("a", 0))
    assert listener.numbers() == []
    listener.accept(A, 0)
    copy(A, 1, ("a", 1))
    copy(A, 3, ("a", 3))
    assert listener.numbers() == [0, 1]
    for number in (1, 2, 3):
        assert listener.accept(A, number) is None
    copy(A, 3, ("a", 3))
    assert listener.numbers() == [0, 1, 2, 3]
