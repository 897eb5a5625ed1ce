"""Put the messages of each publisher in order, each once; the network may drop, double and reorder them.

No bus, no clock, no threads: the bus passes in what has arrived and what it could fetch, and gets the gaps to fetch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

MAX_PUBLISHERS: Final = 4096
MAX_HELD: Final = 8192

S = TypeVar("S")
Source = tuple[str, int]


@dataclass(frozen=True)
class Gap:
    """The missing numbers before a sample that has arrived. known: earlier samples of the publisher have arrived."""

    source: Source
    key: str
    missing: range
    known: bool


@dataclass
class _Sender(Generic[S]):
    """The next expected number of a publisher, and its samples that arrived after a gap that is still open."""

    due: int
    known: bool
    held: list[tuple[int, S]] = field(default_factory=list)


class Sequence(Generic[S]):
    """Passes samples to `deliver` in order. A gap holds back the later samples of its publisher until it is closed.

    missed: number of samples that could not be fetched.
    """

    def __init__(self, deliver: Callable[[S], None]) -> None:
        self.missed = 0
        self._deliver = deliver
        # Sorted by last sample: the publisher that has been silent longest is first.
        self._publishers: dict[Source, _Sender[S]] = {}

    def begin(self, source: Source, number: int) -> None:
        """Take `number` as the first of a publisher: earlier samples can no longer be fetched."""
        self._publishers.setdefault(source, _Sender(number, known=True))

    def accept(
        self, source: Source, number: int, key: str, sample: S, *, recover: bool = True, newest_only: bool = False
    ) -> Gap | None:
        """Deliver or hold a sample; return the gap that it opens, if any, for the caller to close.

        recover=False: missing numbers are skipped and counted. newest_only: they are skipped and not counted.
        """
        publisher = self._publishers.pop(source, None) or _Sender[S](0, known=False)
        self._publishers[source] = publisher
        if len(self._publishers) > MAX_PUBLISHERS:
            del self._publishers[next(iter(self._publishers))]
        if publisher.held:
            if number > publisher.held[-1][0] and len(publisher.held) < MAX_HELD:
                publisher.held.append((number, sample))
            return None
        if number < publisher.due:
            return None
        if newest_only:
            publisher.due = number
        missing = range(publisher.due, number)
        if missing and recover:
            publisher.held.append((number, sample))
            return Gap(source, key, missing, publisher.known)
        self._pass(publisher, number, sample)
        return None

    def close(self, gap: Gap, found: Iterable[tuple[int, S]]) -> Gap | None:
        """Deliver the found samples of a gap, count the others as missed, and continue; return the next gap or None."""
        publisher = self._publishers.get(gap.source)
        if publisher is None or not publisher.held:
            return None
        for number, sample in sorted(found, key=lambda item: item[0]):
            if number in gap.missing and number >= publisher.due:
                self._pass(publisher, number, sample)
        held, publisher.held = publisher.held, []
        for position, (number, sample) in enumerate(held):
            if position and number > publisher.due:
                publisher.held = held[position:]
                return Gap(gap.source, gap.key, range(publisher.due, number), known=True)
            self._pass(publisher, number, sample)
        return None

    def _pass(self, publisher: _Sender[S], number: int, sample: S) -> None:
        if publisher.known:
            self.missed += number - publisher.due
        publisher.known = True
        publisher.due = number + 1
        self._deliver(sample)
