"""Puts each publisher's samples in order, each once, though the network drops, doubles and reorders them.

Pure: no bus, no clock, no threads. The bus says what arrived and what could be fetched; this says what is due.
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
    """Numbers missing before a sample that has arrived. known: the publisher was heard of before them."""

    source: Source
    key: str
    missing: range
    known: bool


@dataclass
class _Sender(Generic[S]):
    """The number that is due next, and what arrived after a gap that is still open."""

    due: int
    known: bool
    held: list[tuple[int, S]] = field(default_factory=list)


class Sequence(Generic[S]):
    """Hands samples to deliver. A gap holds up the later samples of its own publisher until it is closed.

    missed: how many numbers could not be fetched.
    """

    def __init__(self, deliver: Callable[[S], None]) -> None:
        self.missed = 0
        self._deliver = deliver
        # The one that has been silent longest comes first.
        self._publishers: dict[Source, _Sender[S]] = {}

    def begin(self, source: Source, number: int) -> None:
        """Take number as a publisher's first: earlier samples can no longer be fetched."""
        self._publishers.setdefault(source, _Sender(number, known=True))

    def accept(
        self, source: Source, number: int, key: str, sample: S, *, recover: bool = True, newest_only: bool = False
    ) -> Gap | None:
        """Deliver or hold a sample; return the gap that it opened, to be closed.

        Without recover, missing numbers are skipped and counted. newest_only: they are skipped and not counted.
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
        """Deliver what was found of a gap, count the rest, and go on; return the next gap, where there is one."""
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
