"""Ask publishers for what they hold: seldom enough for the hub, and again where a part of the answer was lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Final, TypeAlias

import zenoh
from buddyline.protocol.bus import CACHE_S, cache_depth
from buddyline.protocol.sequence import Gap, PublisherId
from buddyline.protocol.topics import TOPICS, parse_key
from buddyline.protocol.zenoh_bus.session import RETRY_S
from buddyline.protocol.zenoh_bus.settings import questions_hz

QUERY_S: Final = 2.0
# Slower than the hub allows: on the way two questions may come nearer to each other.
SLOWER: Final = 1.3
# Questions for one gap, and for what is held when a subscription begins.
FETCHES: Final = 16
HISTORIES: Final = 4
# Of one answer; with less room than it needs the hub would leave out a part of it.
ANSWERS: Final = 16384

Held: TypeAlias = dict[tuple[PublisherId, int], zenoh.Sample]


class Pace:
    """When a client may ask its next question about each topic."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._lock = threading.Lock()
        self._next_s: dict[str, float] = {}

    def wait_s(self, key_expr: str) -> float:
        """Take the next turn for a question on key_expr; return how long to wait for it, s."""
        asked = zenoh.KeyExpr(key_expr)
        topics = [topic for topic in TOPICS if asked.intersects(zenoh.KeyExpr(topic.key_any()))]
        with self._lock:
            now_s = self._now_s()
            at_s = max(now_s, now_s, *(self._next_s.get(topic.name, now_s) for topic in topics))
            self._next_s |= {topic.name: at_s + SLOWER / questions_hz(topic) for topic in topics}
        return at_s - now_s


class Questions:
    """Asks in a session, at its pace. Answers come with DROP: what a full link has left out is asked for again."""

    def __init__(self, session: zenoh.Session, pace: Pace) -> None:
        self._session = session
        self._pace = pace
        self._stop = threading.Event()

    def stop(self) -> None:
        """Ask no more."""
        self._stop.set()

    def history(self, key_expr: str) -> Held:
        """Return all that publishers hold of these keys."""
        return self._gather(lambda _: (key_expr, "@adv/pub/**"), _is_whole, HISTORIES, {})

    def fetch(self, gap: Gap) -> list[tuple[int, zenoh.Sample]]:
        """Return the samples of a gap that its publisher still holds; ask again for some time if it does not answer."""
        # The gap's last sample, or the one after it, has been heard of: an answer that contains one has its end.
        source, last = gap.source, gap.missing[-1]

        def due(found: Mapping[tuple[PublisherId, int], zenoh.Sample]) -> tuple[str, str]:
            first = next((number for number in gap.missing if (source, number) not in found), last)
            return source.key, f"@adv/pub/{source.zid}/{source.eid}/**?_sn={first}..{last + 1}"

        def is_whole(found: Collection[tuple[PublisherId, int]]) -> bool | None:
            if (source, last) not in found and (source, last + 1) not in found:
                return None
            return all((source, number) in found for number in gap.missing)

        found = self._gather(due, is_whole, FETCHES, {})
        # An answer may come from anybody who may answer on this key, and say any source.
        return [(number, sample) for (of, number), sample in found.items() if of == source]

    def _gather(
        self,
        selector: Callable[[Held], tuple[str, str]],
        is_whole: Callable[[Held], bool | None],
        times: int,
        found: Held,
    ) -> Held:
        """Ask until all has come, or nothing more does. is_whole: None where more must come."""
        for _ in range(times):
            before = len(found)
            key, rest = selector(found)
            if self._stop.wait(self._pace.wait_s(key)):
                break
            found.update(((source_of(sample), number_of(sample)), sample) for sample in self._ask(f"{key}/{rest}"))
            whole = is_whole(found)
            if whole or (whole is False and len(found) == before) or self._stop.wait(RETRY_S):
                break
        return found

    def _ask(self, selector: str) -> Iterator[zenoh.Sample]:
        for reply in self._session.get(
            selector,
            zenoh.handlers.FifoChannel(ANSWERS),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=QUERY_S,
        ):
            if reply.ok is not None and reply.ok.source_info is not None:
                yield reply.ok


def _is_whole(found: Held) -> bool:
    """Tell whether of each publisher all is there that it should hold."""
    numbers: dict[PublisherId, list[int]] = {}
    for source, number in found:
        numbers.setdefault(source, []).append(number)
    return all(len(of_one) >= min(max(of_one) + 1, _depth(source.key)) for source, of_one in numbers.items())


def _depth(key: str) -> int:
    parsed = parse_key(key)
    return 1 if parsed is None else cache_depth(parsed[0], CACHE_S)


def source_of(sample: zenoh.Sample) -> PublisherId:
    """Return which publisher a sample says that it is of."""
    key, info = str(sample.key_expr), sample.source_info
    return PublisherId(key, "", 0) if info is None else PublisherId(key, str(info.source_id.zid), info.source_id.eid)


def number_of(sample: zenoh.Sample) -> int:
    """Return the number that a sample says it has; -1 for none."""
    info = sample.source_info
    return -1 if info is None else info.source_sn
