"""Questions for what publishers hold: how often, and what is asked for again."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest
from buddyline.protocol import topics
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.sequence import Gap, PublisherId
from buddyline.protocol.zenoh_bus import questions
from buddyline.protocol.zenoh_bus.questions import Pace, Questions
from buddyline.protocol.zenoh_bus.settings import questions_hz

KEY = topics.DEPTH.key("a")
SOURCE = PublisherId(KEY, "1f", 7)


def sample(number: int) -> Any:
    return SimpleNamespace(
        key_expr=KEY,
        source_info=SimpleNamespace(source_id=SimpleNamespace(zid="1f", eid=7), source_sn=number),
    )


class FullLink(Questions):
    """Answers with what is given, question by question."""

    def __init__(self, *answers: list[int]) -> None:
        super().__init__(cast(Any, None), Pace())
        self.answers = list(answers)
        self.asked: list[str] = []

    def _ask(self, selector: str) -> Iterator[Any]:
        self.asked.append(selector)
        return iter([sample(number) for number in self.answers.pop(0)])


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions, "RETRY_S", 0.0)
    monkeypatch.setattr(questions, "SLOWER", 0.0)


def fetched(link: FullLink, first: int = 3, last: int = 6) -> list[int]:
    return sorted(number for number, _ in link.fetch(Gap(SOURCE, range(first, last + 1), known=True)))


def test_a_whole_answer_is_asked_for_once() -> None:
    link = FullLink([3, 4, 5, 6, 7])
    assert fetched(link) == [3, 4, 5, 6, 7]
    assert link.asked == [f"{KEY}/@adv/pub/1f/7/**?_sn=3..7"]


def test_what_a_full_link_left_out_of_an_answer_is_asked_for_again() -> None:
    link = FullLink([], [3], [5, 6, 7], [4, 5, 6, 7])
    assert fetched(link) == [3, 4, 5, 6, 7]
    assert [one.partition("=")[2] for one in link.asked] == ["3..7", "3..7", "4..7", "4..7"]


def test_what_the_publisher_no_longer_holds_is_asked_for_once_more() -> None:
    link = FullLink([5, 6], [5, 6])
    assert fetched(link) == [5, 6]
    assert not link.answers


def test_history_is_asked_for_again_where_its_beginning_or_middle_is_missing() -> None:
    for first_answer in ([2, 3], [0, 1, 3]):
        link = FullLink(first_answer, [0, 1, 2, 3])
        assert sorted(number for _, number in link.history(topics.DEPTH.key_any())) == [0, 1, 2, 3]


def test_a_client_asks_about_each_topic_more_slowly_than_the_hub_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    clock = ManualClock(0)
    pace = Pace(lambda: clock.now_ns() / S_NS)
    imu, depth = topics.IMU.key_any(), topics.DEPTH.key("a")
    assert [pace.wait_s(imu), pace.wait_s(depth)] == [0.0, 0.0]
    assert pace.wait_s(imu) > 1.0 / questions_hz(topics.IMU)
    # A question about everything waits for the topic that is due last.
    assert pace.wait_s(topics.EVERYTHING) == pytest.approx(2 * questions.SLOWER / questions_hz(topics.IMU))
    assert pace.wait_s(depth) > pace.wait_s(topics.POSE.key_any()) - 1.0 / questions_hz(topics.POSE) > 0.0
