"""Complete a recording from the nodes' own logs, over the bus, while it is being made.

What the recording lacks shows by the nodes' digests. It is asked for, some seconds at a time, and written when its
checksum is right.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

from buddyline.protocol.bus import CACHE_S
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import payload_stamp_ns
from buddyline.protocol.digest import end_of, sum_of
from buddyline.protocol.digest_check import MAX_NODES, Discrepancy
from buddyline.protocol.errors import MessageError
from buddyline.protocol.log_pages import MOST_NS, LogAnswer, Logged, Question, answer_of
from buddyline.protocol.topics import DIGEST, LOG

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus

log = logging.getLogger(__name__)

ANSWER_S: Final = 10.0
PAUSE_S: Final = 0.1
AGAIN_S: Final = 2.0
# Of all nodes. Each may be a second. The oldest are given up, of the node that has most.
MAX_GAPS: Final = 20_000
# Of one gap in the digests, which may state any time; what is older is not asked for.
MOST_MISSING_NS: Final = 24 * 3600 * S_NS
# Seconds that one question is about, at most: less is packed, and on a long link waited, than for each on its own.
MOST_JOINED: Final = 8
# Gaps among which those that follow on the oldest one are looked for.
MAX_LOOK: Final = 100
# A digest is written this long after its stamp, at most.
WRITTEN_NS: Final = S_NS // 2

# Key, payload, log time.
Write = Callable[[str, bytes, int], None]


class _Second(NamedTuple):
    """Where messages are missing: (since_ns, until_ns] by the node's clock, of a boot."""

    node: str
    boot: str
    since_ns: int
    until_ns: int

    def follows(self, other: _Second) -> bool:
        """Return whether it begins where the other ends."""
        return (self.node, self.boot, self.since_ns) == (other.node, other.boot, other.until_ns)


class Filler:
    """Asks for what is missing, each node in a thread of its own: a node that is slow or silent holds up no other.

    began_ns: what is older is not asked for. write: takes what was missing, in several threads. open: what has not come
    so far. filled: how many messages have come, by node.
    """

    def __init__(self, bus: Bus, write: Write, began_ns: int, stop: threading.Event) -> None:
        self.filled: Counter[str] = Counter()
        self._bus = bus
        self._write = write
        self._began_ns = began_ns - round(CACHE_S * S_NS)
        self._stop = stop
        self._open: dict[str, OrderedDict[_Second, list[Discrepancy]]] = {}
        self._changed = threading.Condition()

    @property
    def open(self) -> list[Discrepancy]:
        """What is missing still."""
        with self._changed:
            return [one for of_node in self._open.values() for found in of_node.values() for one in found]

    def want(self, one: Discrepancy) -> None:
        """Ask for what is missing, when its turn has come."""
        if one.stretch is not None and one.since_ns < self._began_ns:
            return
        # Missing digests may be of hours, and begin before the recording.
        end_ns = one.until_ns
        since_ns = max(one.since_ns, self._began_ns, end_ns - MOST_MISSING_NS)
        with self._changed:
            of_node = self._open.setdefault(one.node, OrderedDict())
            while since_ns < end_ns:
                until_ns = min(since_ns + MOST_NS - WRITTEN_NS, end_ns)
                of_node.setdefault(_Second(one.node, one.boot, since_ns, until_ns), []).append(one)
                since_ns = until_ns
            for _ in range(sum(map(len, self._open.values())) - MAX_GAPS):
                max(self._open.values(), key=len).popitem(last=False)
            self._changed.notify_all()

    def run(self) -> None:
        """Ask until stopped. Raises what a node's thread has raised; all others are then stopped."""
        asking: dict[str, Future[None]] = {}
        with ThreadPoolExecutor(MAX_NODES) as threads:
            try:
                while not self._stop.is_set():
                    with self._changed:
                        for node in self._open.keys() - asking.keys():
                            asking[node] = threads.submit(self._run, self._open[node])
                        self._changed.wait(AGAIN_S)
                    for one in asking.values():
                        if one.done():
                            one.result()
            finally:
                self._stop.set()

    def _run(self, of_node: OrderedDict[_Second, list[Discrepancy]]) -> None:
        """Ask a node until stopped, the oldest first; what is not answered goes to the end."""
        failed, most = 0, 1
        while not self._stop.is_set():
            with self._changed:
                if not of_node:
                    self._changed.wait(AGAIN_S)
                    continue
                asked = _next(of_node, most)
            left = self._fill(asked)
            with self._changed:
                for second, missing in left.items():
                    of_node.setdefault(second, []).extend(missing)
                failed = failed + 1 if left else 0
                waiting = len(of_node)
            # A shorter answer may come where a long one does not.
            most = max(most // 2, 1) if left else min(2 * most, MOST_JOINED)
            # With nothing but failures, all gaps are tried again in turn, slowly.
            self._stop.wait(AGAIN_S if failed >= max(min(waiting, 10), 1) else PAUSE_S)

    def _fill(self, asked: dict[_Second, list[Discrepancy]]) -> dict[_Second, list[Discrepancy]]:
        """Return what is missing after an attempt."""
        first, last = next(iter(asked)), next(reversed(asked))
        every = [one for missing in asked.values() for one in missing]
        topics = {end_of(DIGEST) if one.stretch is None else one.stretch.topic for one in every}
        late_ns = WRITTEN_NS if end_of(DIGEST) in topics else 0
        question = Question(first.boot, first.since_ns, last.until_ns + late_ns, tuple(sorted(topics)))
        try:
            answer = answer_of(self._bus.ask(LOG.format(node=first.node), question.text(), ANSWER_S))
        except MessageError as error:
            log.warning("node %s: %s", first.node, error)
            return asked
        left: dict[_Second, list[Discrepancy]] = {}
        for second, missing in asked.items():
            for one in missing:
                chosen = _digests(second, answer) if one.stretch is None else _missing_of(one, answer.messages)
                for logged in chosen or ():
                    self._write(logged.key, logged.payload, logged.time_ns)
                    self.filled[second.node] += 1
                if chosen is None:
                    left.setdefault(second, []).append(one)
        return left


def _next(of_node: OrderedDict[_Second, list[Discrepancy]], most: int) -> dict[_Second, list[Discrepancy]]:
    """Take the oldest second, and those that follow on it, so many at most."""
    taken = [next(iter(of_node))]
    for one in islice(of_node, 1, MAX_LOOK):
        # Where digests are missing, nothing else is asked for.
        alone = any(missing.stretch is None for missing in (*of_node[one], *of_node[taken[0]]))
        if one.follows(taken[-1]) and not alone and len(taken) < most:
            taken.append(one)
    return {one: of_node.pop(one) for one in taken}


def _digests(second: _Second, answer: LogAnswer) -> list[Logged] | None:
    """Return the digests that were made then, and written a moment later; None: not all have come."""
    if not answer.is_whole:
        return None
    return [
        one
        for one in answer.messages
        if one.key == DIGEST.key(second.node)
        and second.since_ns < (payload_stamp_ns(one.payload) or 0) <= second.until_ns
    ]


def _missing_of(one: Discrepancy, found: list[Logged]) -> list[Logged] | None:
    """Return the messages of a stretch that are missing, with log times between their neighbours'; None: not found."""
    stretch = one.stretch
    assert stretch is not None
    key = f"buddyline/node/{one.node}/{stretch.topic}"
    of_key = [logged for logged in found if logged.key == key]
    sums = [hashlib.sha256(logged.payload).digest() for logged in of_key]
    for begin in range(len(of_key) - stretch.count + 1):
        end = begin + stretch.count
        if sum_of(sums[begin:end]) == stretch.sha256:
            return _between(of_key[begin:end], sums[begin:end], one.have)
    return None


def _between(stretch: list[Logged], sums: list[bytes], have: Mapping[bytes, int]) -> list[Logged]:
    """Return the new ones, with log times that keep the order: before that of the next one that is there."""
    new: list[Logged] = []
    before_ns = 0
    for at, (logged, checksum) in enumerate(zip(stretch, sums, strict=True)):
        if checksum in have:
            before_ns = max(before_ns, have[checksum])
            continue
        next_ns = min((have[later] for later in sums[at:] if later in have), default=2**63)
        before_ns = max(min(logged.time_ns, next_ns - 1), before_ns + 1)
        new.append(logged._replace(time_ns=before_ns))
    return new
