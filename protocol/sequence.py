"""Put the messages of each publisher in order, each once; the network may drop, double and reorder them.

No bus, no clock, no threads: the bus passes in what has arrived and what it could fetch, and gets the gaps to fetch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final, Generic, NamedTuple, TypeVar

# An owner is the first chunks of a key, which the hub's access rules give to one client. MAX_PUBLISHERS and
# MAX_HELD_BYTES (samples that wait for a gap to close) are for each owner: a client that invents publishers with gaps
# takes nothing from another owner. MAX_HELD: samples of one publisher.
MAX_OWNERS: Final = 256
MAX_PUBLISHERS: Final = 256
MAX_HELD: Final = 8192
MAX_HELD_BYTES: Final = 16 * 1024 * 1024
# Of a publisher: a connection that has lost a packet stands still for seconds.
MAX_COPIES: Final = 256
OWNER_CHUNKS: Final = 3

S = TypeVar("S")


def owner_of(key: str) -> str:
    """Return the first chunks of a key, such as "buddyline/node/a"; a namespace counts as one more."""
    chunks = key.split("/")
    start = chunks.index("buddyline") if "buddyline" in chunks else 0
    return "/".join(chunks[: start + OWNER_CHUNKS])


class PublisherId(NamedTuple):
    """One publisher: its key, and what it says of itself.

    A client may say any zid and eid; the key is what the hub lets it publish. So both together name a publisher, and
    what one client says on its own keys changes nothing on another's.
    """

    key: str
    zid: str
    eid: int

    @property
    def owner(self) -> str:
        """The owner of its key."""
        return owner_of(self.key)


@dataclass(frozen=True)
class Gap:
    """The missing numbers of a publisher. known: earlier samples of the publisher have arrived."""

    source: PublisherId
    missing: range
    known: bool


@dataclass
class _Sender(Generic[S]):
    """The next expected number of a publisher, and its samples that arrived after a gap that is still open.

    announced: the number in its last heartbeat. held: number, sample and size. copies: of samples that have not come,
    and are not the next; sample and size by number.
    """

    due: int
    known: bool
    open: bool = False
    announced: int = -1
    held: list[tuple[int, S, int]] = field(default_factory=list)
    copies: dict[int, tuple[S, int]] = field(default_factory=dict)


class SampleSequence(Generic[S]):
    """Passes samples to `deliver` in order. A gap holds back the later samples of its publisher until it is closed.

    missed: number of samples that could not be fetched.
    """

    def __init__(self, deliver: Callable[[S], None]) -> None:
        self.missed = 0
        self._deliver = deliver
        # By owner; sorted by last sample: the publisher that has been silent longest is first.
        self._publishers: dict[str, dict[PublisherId, _Sender[S]]] = {}
        self._held_bytes: dict[str, int] = {}

    def begin(self, source: PublisherId, number: int) -> None:
        """Take `number` as the first of a publisher: earlier samples can no longer be fetched."""
        self._sender(source, _Sender(number, known=True))

    def accept(
        self,
        source: PublisherId,
        number: int,
        sample: S,
        *,
        size_bytes: int = 0,
        recover: bool = True,
        newest_only: bool = False,
    ) -> Gap | None:
        """Deliver or hold a sample; return the gap that it opens, if any, for the caller to close.

        size_bytes: of the sample. recover=False: missing numbers are skipped and counted. newest_only: they are skipped
        and not counted.
        """
        publisher = self._sender(source, _Sender(0, known=False))
        if publisher.open:
            if number > (publisher.held[-1][0] if publisher.held else publisher.due - 1):
                self._hold(source, publisher, number, sample, size_bytes)
            return None
        if number < publisher.due:
            return None
        if newest_only:
            publisher.due = number
        missing = range(publisher.due, number)
        if missing and recover:
            publisher.open = True
            self._hold(source, publisher, number, sample, size_bytes)
            return Gap(source, missing, publisher.known)
        self._pass_copies(source, publisher, before=number)
        self._pass(publisher, number, sample)
        self._pass_copies(source, publisher)
        return None

    def skip(self, source: PublisherId, number: int) -> None:
        """Leave out a sample that the receiver does not want: it is neither delivered nor missing."""
        publisher = self._sender(source, _Sender(0, known=False))
        if not publisher.open and number >= publisher.due:
            publisher.due = number + 1

    def accept_copy(self, source: PublisherId, number: int, sample: S, *, size_bytes: int = 0) -> None:
        """Deliver a copy that has come by another way, in its order. Its original comes too, maybe much later.

        So a copy opens no gap: it waits for what is before it.
        """
        publisher = self._publishers.get(source.owner, {}).get(source)
        if publisher is None or number < publisher.due or number in publisher.copies:
            return
        if number == publisher.due and not publisher.open:
            self._pass(publisher, number, sample)
            self._pass_copies(source, publisher)
        elif len(publisher.copies) < MAX_COPIES and self._has_room(source.owner, size_bytes):
            publisher.copies[number] = sample, size_bytes
            self._add_held(source.owner, size_bytes)

    def heartbeat(self, source: PublisherId, last: int, *, newest_only: bool = False) -> Gap | None:
        """Take a heartbeat, which has the publisher's last number so far; return the gap that it shows, if any.

        A sample may still be on its way. So the gap ends at the number in the heartbeat before this one.
        """
        publisher = self._sender(source, _Sender(0, known=False))
        before, publisher.announced = publisher.announced, last
        if publisher.open or before < publisher.due:
            return None
        if newest_only:
            publisher.due = before
        publisher.open = True
        return Gap(source, range(publisher.due, before + 1), publisher.known)

    def close(self, gap: Gap, found: Iterable[tuple[int, S]]) -> Gap | None:
        """Deliver the found samples of a gap, count the others as missed, and continue; return the next gap or None."""
        publisher = self._publishers.get(gap.source.owner, {}).get(gap.source)
        if publisher is None or not publisher.open:
            return None
        held, publisher.held = publisher.held, []
        self._add_held(gap.source.owner, -sum(size for *_, size in held))
        end = gap.missing[-1]
        fetched = [(number, sample, 0) for number, sample in found if number in gap.missing]
        copied = [(number, sample, 0) for number, (sample, _) in publisher.copies.items() if number <= end]
        waiting = sorted([*fetched, *copied, *held], key=lambda one: one[0])
        for position, (number, sample, _) in enumerate(waiting):
            if number > end:
                self._skip(publisher, end + 1)
                if number > publisher.due:
                    for later in waiting[position:]:
                        self._hold(gap.source, publisher, *later)
                    return Gap(gap.source, range(publisher.due, number), known=True)
            if number >= publisher.due:
                self._pass(publisher, number, sample)
        self._skip(publisher, end + 1)
        publisher.open = False
        self._pass_copies(gap.source, publisher)
        return None

    def _sender(self, source: PublisherId, new: _Sender[S]) -> _Sender[S]:
        """Return what is known of a publisher, which has just been heard."""
        others = self._publishers.pop(source.owner, {})
        self._publishers[source.owner] = others
        if len(self._publishers) > MAX_OWNERS:
            owner = next(iter(self._publishers))
            del self._publishers[owner]
            self._held_bytes.pop(owner, None)
        sender = others.pop(source, None) or new
        others[source] = sender
        if len(others) > MAX_PUBLISHERS:
            gone = others.pop(next(iter(others)))
            sizes = [*(size for *_, size in gone.held), *(size for _, size in gone.copies.values())]
            self._add_held(source.owner, -sum(sizes))
        return sender

    def _hold(self, source: PublisherId, publisher: _Sender[S], number: int, sample: S, size_bytes: int) -> None:
        if len(publisher.held) >= MAX_HELD or (publisher.held and not self._has_room(source.owner, size_bytes)):
            return
        publisher.held.append((number, sample, size_bytes))
        self._add_held(source.owner, size_bytes)

    def _has_room(self, owner: str, size_bytes: int) -> bool:
        return self._held_bytes.get(owner, 0) + size_bytes <= MAX_HELD_BYTES

    def _add_held(self, owner: str, size_bytes: int) -> None:
        self._held_bytes[owner] = self._held_bytes.get(owner, 0) + size_bytes

    def _pass_copies(self, source: PublisherId, publisher: _Sender[S], before: int = 0) -> None:
        """Deliver the copies that are next, and all before a number; drop those whose turn is over."""
        for number in sorted(publisher.copies):
            if number > publisher.due and number >= before:
                return
            sample, size_bytes = publisher.copies.pop(number)
            self._add_held(source.owner, -size_bytes)
            if number >= publisher.due:
                self._pass(publisher, number, sample)

    def _pass(self, publisher: _Sender[S], number: int, sample: S) -> None:
        self._skip(publisher, number)
        publisher.known = True
        publisher.due = number + 1
        self._deliver(sample)

    def _skip(self, publisher: _Sender[S], due: int) -> None:
        """Give up what is missing before `due`."""
        if due > publisher.due:
            self.missed += (due - publisher.due) if publisher.known else 0
            publisher.due = due
