"""What a publisher holds for those that missed it, and the pages in which it answers. No bus, no clock."""

from __future__ import annotations

import bisect
import math
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Final, NamedTuple

# Of a page, unless a single message is larger: a page on its way delays what is more urgent.
PAGE_BYTES: Final = 4096
# Of a publisher: a minute of candidates at 30 Hz with as many lights as there may be.
MAX_HELD_BYTES: Final = 16 * 1024 * 1024
_NUMBER_BYTES: Final = 4
_HEAD_BYTES: Final = 2 * _NUMBER_BYTES + 1
# Of a page with one message, besides its payload.
OVERHEAD_BYTES: Final = _NUMBER_BYTES + _HEAD_BYTES
_MOST_NUMBER: Final = 2**32 - 1


class HeldMessage(NamedTuple):
    """A message that is held. number: which of its publisher's it is; again: it is one that an earlier one has sent."""

    number: int
    payload: bytes
    again: bool


class Held:
    """The newest messages of a publisher, numbered one by one. Safe to use from several threads.

    history_s: who has heard nothing of the publisher yet gets what was added in this time; who has missed something
    gets all that is held, which is of more time where messages are rare.
    """

    def __init__(self, depth: int, history_s: float = math.inf) -> None:
        self._depth = depth
        self._history_s = history_s
        self._messages: deque[HeldMessage] = deque()
        self._added_s: deque[float] = deque()
        self._bytes = 0
        self._lock = threading.Lock()

    def add(self, message: HeldMessage, now_s: float = 0.0) -> None:
        """Hold a message; let go of the oldest beyond the depth or MAX_HELD_BYTES. now_s: monotonic."""
        with self._lock:
            self._messages.append(message)
            self._added_s.append(now_s)
            self._bytes += len(message.payload)
            while len(self._messages) > self._depth or self._bytes > MAX_HELD_BYTES:
                self._bytes -= len(self._messages.popleft().payload)
                self._added_s.popleft()

    def count(self, first: int, last: int, now_s: float = 0.0) -> int:
        """Return how many messages `find` returns now."""
        with self._lock:
            _, begin, end = self._places(first, last, now_s)
            return max(end - begin, 0)

    def find(self, first: int, last: int, now_s: float = 0.0) -> tuple[int, list[HeldMessage]]:
        """Return the number of the oldest message that there is, and those from `first` to `last`.

        Who asks from 0 on knows nothing of this publisher.
        """
        with self._lock:
            oldest, begin, end = self._places(first, last, now_s)
            return oldest, list(islice(self._messages, begin, max(end, begin)))

    def _places(self, first: int, last: int, now_s: float) -> tuple[int, int, int]:
        """Return the number of the oldest message that there is for who asks so, and the answer's begin and end."""
        oldest = self._messages[0].number if self._messages else 0
        end = min(max(last + 1 - oldest, 0), len(self._messages))
        if first == 0:
            passed = bisect.bisect_left(self._added_s, now_s - self._history_s)
            return oldest + passed, passed, end
        return oldest, max(first - oldest, 0), end


def asked(text: str) -> tuple[int, int]:
    """Return the first and the last number that a question asks for: "_sn=3..7"; of any other text all."""
    first, dots, last = text.removeprefix("_sn=").partition("..")
    if text.startswith("_sn=") and dots and first.isdecimal() and last.isdecimal():
        return min(int(first), _MOST_NUMBER), min(int(last), _MOST_NUMBER)
    return 0, _MOST_NUMBER


def pages(oldest: int, messages: Iterable[HeldMessage]) -> Iterator[tuple[bytes, int]]:
    """Return the pages of an answer, each with the number of its last message.

    A page has the number of the oldest message that is held, and some messages. Without messages there is one page.
    """
    page, last = bytearray(oldest.to_bytes(_NUMBER_BYTES, "little")), oldest
    for message in messages:
        size_bytes = _HEAD_BYTES + len(message.payload)
        if len(page) > _NUMBER_BYTES and len(page) + size_bytes > PAGE_BYTES:
            yield bytes(page), last
            del page[_NUMBER_BYTES:]
        page += message.number.to_bytes(_NUMBER_BYTES, "little")
        page += (len(message.payload) << 1 | message.again).to_bytes(_NUMBER_BYTES + 1, "little")
        page += message.payload
        last = message.number
    yield bytes(page), last


def open_page(page: bytes) -> tuple[int, list[HeldMessage]]:
    """Return the number of the oldest message that its publisher holds, and the messages of a page.

    Raises ValueError where it is not a page: anybody may answer on keys of his own.
    """
    oldest, at = int.from_bytes(page[:_NUMBER_BYTES], "little"), _NUMBER_BYTES
    found: list[HeldMessage] = []
    while at + _HEAD_BYTES <= len(page):
        number = int.from_bytes(page[at : at + _NUMBER_BYTES], "little")
        size = int.from_bytes(page[at + _NUMBER_BYTES : at + _HEAD_BYTES], "little")
        at += _HEAD_BYTES
        found.append(HeldMessage(number, page[at : at + (size >> 1)], again=bool(size & 1)))
        at += size >> 1
    if at != len(page):
        raise ValueError(f"a page of {len(page)} bytes ends at {at}")
    return oldest, found
