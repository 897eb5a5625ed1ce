"""Answer questions for what publishers hold, at a bounded rate, in a thread of its own.

Zenoh's own cache answers each question in one go and lets its publisher wait meanwhile: a client that asks without end
would silence it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

import zenoh
from buddyline.protocol.delivery import CLOSE_S, FailureLatch
from buddyline.protocol.held import Held, asked, pages
from buddyline.protocol.link_budget import LinkBudget

LOOK_S: Final = 0.05
# Of all answers of a process. At first a minute of two streams of samples and of frames at 30 Hz goes at once.
BYTES_PER_S: Final = 4_000_000.0
BURST_BYTES: Final = 16_000_000.0
# Questions that wait: of a publisher between two looks, and of all. A flood asks 50 times between two looks. It must
# not push out the question about a gap.
MAX_ASKED: Final = 256
MAX_WAITING: Final = 64
# Nobody waits longer for an answer. On a long way it must come before the question's end, too.
PATIENCE_S: Final = 2.0
LONG_PATIENCE_S: Final = 1.0
PAGES_A_TURN: Final = 64

RingQueryable: TypeAlias = zenoh.Queryable[zenoh.Handler[zenoh.Query]]


class _Shelf(NamedTuple):
    """What one publisher holds, and where it is asked for."""

    key: str
    declared: RingQueryable
    held: Held
    encoding: str


@dataclass(eq=False)
class _AskedFor:
    """A question that waits. Its answer is of `count` messages, the newest first.

    sent_from: the number of the last that has been sent. The answer is made when its turn comes: of many questions at
    once most get none.
    """

    query: zenoh.Query
    shelf: _Shelf
    since_s: float
    count: int = field(init=False)
    sent_from: int = field(init=False)
    page: tuple[bytes, int] | None = field(init=False, default=None)
    _pages: Iterator[tuple[bytes, int]] | None = field(init=False, default=None)
    _numbers: tuple[int, int] = field(init=False)

    def __post_init__(self) -> None:
        self._numbers = asked(str(self.query.parameters))
        self.count = self.shelf.held.count(*self._numbers, self.since_s)

    def begin(self) -> None:
        """Make the answer, if it is not made."""
        if self._pages is None:
            oldest, messages = self.shelf.held.find(*self._numbers, self.since_s)
            self.sent_from = messages[-1].number + 1 if messages else oldest
            self._pages = pages(oldest, reversed(messages))
            self.page = next(self._pages)

    def reply(self, page: bytes) -> None:
        """Send a page."""
        self.query.reply(self.shelf.key, page, encoding=self.shelf.encoding)

    def send(self) -> None:
        """Send the next page."""
        if self.page is not None and self._pages is not None:
            page, self.sent_from = self.page
            self.reply(page)
            self.page = next(self._pages, None)

    def end(self, *, is_all: bool = False) -> None:
        """Send no more. is_all: what has been sent is all that there is for the asker."""
        if is_all:
            self.begin()
        if is_all and self.page is not None:
            self.reply(next(pages(self.sent_from, []))[0])
        self.query.drop()  # type: ignore[no-untyped-call]


class HeldDesk:
    """Answers for all publishers of a session: first what is short, such as a gap of a few messages.

    budget: decides what a long way carries; None: the way is short. Of too many questions those with the longest
    answers get none; who has got none, or a part, asks again. But where a long way is slow, what has not gone within
    LONG_PATIENCE_S is told to be gone: a receiver that waits for old messages holds back the new ones.
    """

    def __init__(self, session: zenoh.Session, budget: Callable[[], LinkBudget | None], failures: FailureLatch) -> None:
        self._session = session
        self._budget = budget
        self._failures = failures
        self._shelves: dict[str, _Shelf] = {}
        self._waiting: list[_AskedFor] = []
        self._room = BURST_BYTES
        self._room_s = time.monotonic()
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def show(self, key: str, held: Held, encoding: str) -> None:
        """Answer questions on key from what is held, in the encoding of its messages."""
        ring: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(MAX_ASKED)
        declared = self._session.declare_queryable(key, ring)
        with self._lock:
            self._shelves[key] = _Shelf(key, declared, held, encoding)
            if self._thread is None and not self._stop.is_set():
                self._thread = threading.Thread(target=self._run, name="bus held", daemon=True)
                self._thread.start()

    def take_away(self, key: str) -> None:
        """Answer no more on key."""
        with self._lock:
            shelf = self._shelves.pop(key, None)
        if shelf is not None:
            shelf.declared.undeclare()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Answer no more, and end the thread."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            is_dry = True
            while not (self._stop.wait(LOOK_S) if is_dry else self._stop.is_set()):
                self._take()
                is_dry = self._answer()
        except Exception as error:
            if not self._stop.is_set():
                self._failures.report("bus held", error)
        finally:
            for question in self._waiting:
                question.end()

    def _take(self) -> None:
        """Take the questions that have come."""
        with self._lock:
            shelves = list(self._shelves.values())
        now_s = time.monotonic()
        for shelf in shelves:
            try:
                while (query := shelf.declared.handler.try_recv()) is not None:
                    self._waiting.append(_AskedFor(query, shelf, now_s))
            except zenoh.ZError:
                # Taken away meanwhile.
                continue
        self._waiting.sort(key=lambda question: question.count)
        budget = self._budget()
        is_slow = budget is not None and budget.is_slow
        patience_s = LONG_PATIENCE_S if is_slow else PATIENCE_S
        late = [question for question in self._waiting if now_s - question.since_s > patience_s]
        for question in late:
            question.end(is_all=is_slow)
        in_time = [question for question in self._waiting if question not in late]
        for question in in_time[MAX_WAITING:]:
            question.end()
        self._waiting = in_time[:MAX_WAITING]

    def _answer(self) -> bool:
        """Send some pages; return whether nothing more can be sent now."""
        now_s, budget = time.monotonic(), self._budget()
        self._room = min(self._room + (now_s - self._room_s) * BYTES_PER_S, BURST_BYTES)
        self._room_s = now_s
        for _ in range(PAGES_A_TURN):
            if not self._waiting:
                return True
            question = self._waiting[0]
            question.begin()
            if question.page is None:
                question.end()
                del self._waiting[0]
                continue
            size_bytes = len(question.page[0])
            if self._room < size_bytes or (budget is not None and not budget.admits_answer(size_bytes, now_s)):
                return True
            self._room -= size_bytes
            question.send()
        return False
