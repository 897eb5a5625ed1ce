"""Tell whether a log is what its node wrote, by the node's digests.

No bus, no clock, no files, no keys: the function that checks signatures is passed in.
"""

from __future__ import annotations

import hashlib
from bisect import bisect_left, bisect_right
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import payload_stamp_ns
from buddyline.protocol.digest import end_of, is_covered, sum_of, unsealed
from buddyline.protocol.envelope import open_envelope
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import Digest, NodeInfo, Said
from buddyline.protocol.topics import DIGEST, IMAGE, INFO, TOPICS, parse_key
from msgspec import UNSET
from msgspec.structs import replace

# A digest is judged when the log is this far ahead of it: messages of other keys may arrive after it.
LATE_NS: Final = 10 * S_NS
# Messages that wait for their digest, of one topic of one node: minutes.
MAX_WAITING: Final = 20_000
# Of all together, 250 bytes each; topics that many messages wait of have equal shares.
MAX_WAITING_TOGETHER: Final = 200_000
# Digests of a node that wait to be judged, of at most 64 kB each.
MAX_DUE: Final = 128
# From one digest of a node to the next.
MOST_DIGEST_NS: Final = 3 * S_NS // 2
MAX_NODES: Final = 256
# Runs of a node in one log; one that ends every few seconds has hundreds in an hour.
MAX_BOOTS: Final = 1024
# Times of a node that its digests cover, each without a gap. What is forgotten is nobody's word, and no forgery.
MAX_COVERED: Final = 1024
# What a node says was measured at most this long before.
SAID_NS: Final = S_NS
# These are said again when the bus connects, however old.
SAID_AGAIN: Final = {end_of(topic) for topic in TOPICS if topic.latest_only and is_covered(topic)}
# These are said once each, in the order of their stamps.
SAMPLED: Final = {end_of(topic) for topic in TOPICS if not topic.latest_only and is_covered(topic)}
# Digests of a node that may come late: a day's.
MAX_ABSENT: Final = 86_400

# A node's certificate, the signature and what is signed -> why it is not valid; "" if it is.
Refuses = Callable[[str, str, str, bytes], str]
Kind = Literal["altered", "missing", "unsigned"]


class Undigested(NamedTuple):
    """A message that no digest has named so far. time_ns: its log time."""

    stamp_ns: int
    time_ns: int
    sha256: bytes


@dataclass(frozen=True)
class Discrepancy:
    """What is wrong with a log, from a second on.

    kind: altered: it is not what the node wrote. missing: not all of it is there, so the rest is not verified.
    unsigned: nobody vouches for it. since_ns, until_ns: the digest's second, by the node's clock; of messages without
    one, the second of their log times.
    stretch: the one that is wrong; None: a digest is. have: the log times of what is there of it, by checksum.
    """

    node: str
    kind: Kind
    since_ns: int
    until_ns: int
    words: str
    boot: str = ""
    stretch: Said | None = None
    have: Mapping[bytes, int] = field(default_factory=dict)


class _Due(NamedTuple):
    """A digest that is to be judged. time_ns: its log time."""

    time_ns: int
    digest: Digest
    signed: bytes
    signature: str


@dataclass
class Checked:
    """What is known of a node. seconds: how many digests were right, signed: those of them with a sound signature."""

    seconds: int = 0
    signed: int = 0
    certificates: list[str] = field(default_factory=list)
    waiting: dict[str, list[Undigested]] = field(default_factory=lambda: defaultdict(list))
    # By boot: the newest judged digest, without its sums.
    newest: dict[str, Digest] = field(default_factory=dict)
    # By boot: the last stamp of each topic of SAMPLED in that digest.
    last_ns: dict[str, dict[str, int]] = field(default_factory=dict)
    # By boot: the numbers of the digests that are missing before that.
    absent: dict[str, set[int]] = field(default_factory=lambda: defaultdict(set))
    # Of what the node said then, by its clock, a digest is there: begins and ends, apart and in order.
    covered: list[tuple[int, int]] = field(default_factory=list)
    due: list[_Due] = field(default_factory=list)
    # By topic: first and last stamps of stretches that were incomplete when they were judged.
    incomplete: dict[str, deque[tuple[int, int]]] = field(
        default_factory=lambda: defaultdict(lambda: deque(maxlen=MAX_COVERED))
    )
    # By topic: the checksum of the newest stretch that was right.
    right: dict[str, str] = field(default_factory=dict)


class DigestCheck:
    """Compares messages, in the order in which they were written, with their nodes' digests.

    refuses: checks signatures; None: they are not looked at. must_sign: digests without a signature are named, too.
    own: it is a node's own log, of one run: digests come in the order in which they were written, or are named, and
    what none of them has is forged, however it is stamped. A recording may have messages of runs without a digest.
    """

    def __init__(self, refuses: Refuses | None = None, *, must_sign: bool = False, own: bool = True) -> None:
        self.nodes: dict[str, Checked] = {}
        self._refuses = refuses
        self._must_sign = must_sign
        self._own = own
        self._lists = 0

    def add(self, key: str, payload: bytes, time_ns: int) -> Iterator[Discrepancy]:
        """Take a message; yield what is wrong with those of some seconds ago. time_ns: log time."""
        parsed = parse_key(key)
        if parsed is None or not (is_covered(parsed[0]) or parsed[0] is DIGEST):
            return
        topic, (node,) = parsed
        if node not in self.nodes and len(self.nodes) >= MAX_NODES:
            return
        of = self.nodes.setdefault(node, Checked())
        if topic is DIGEST:
            try:
                due = _Due(time_ns, *unsealed(key, payload))
                absent = of.absent.get(due.digest.boot, ())
                if _insert(of.due, due) and self._own and due.digest.seq not in absent:
                    yield Discrepancy(node, "altered", time_ns - S_NS, time_ns, "digests in another order")
            except MessageError as error:
                words = f"a digest cannot be read: {error}"
                yield Discrepancy(node, "altered", time_ns - S_NS, time_ns, words)
        else:
            if topic is INFO:
                _take_certificate(of, key, payload)
            one = Undigested(payload_stamp_ns(payload) or 0, time_ns, hashlib.sha256(payload).digest())
            name = end_of(topic)
            self._lists += name not in of.waiting
            waiting = of.waiting[name]
            waiting.append(one)
            if len(waiting) > min(MAX_WAITING, MAX_WAITING_TOGETHER // self._lists):
                yield from self._leftover(node, of, name, [waiting.pop(0)])
        while of.due and (of.due[0].time_ns + LATE_NS < time_ns or len(of.due) > MAX_DUE):
            yield from self._judge(node, of, of.due.pop(0))

    def finish(self) -> Iterator[Discrepancy]:
        """Yield what is wrong with the rest, at the log's end."""
        for node, of in self.nodes.items():
            for due in of.due:
                yield from self._judge(node, of, due)
            of.due.clear()
            for topic, waiting in of.waiting.items():
                yield from self._leftover(node, of, topic, waiting)
            of.waiting.clear()
            for boot, digest in of.newest.items():
                if digest.last is UNSET:
                    words = "the log ends without the node's last digest: what came after is not known"
                    yield Discrepancy(node, "unsigned", digest.stamp_ns, digest.stamp_ns, words, boot)

    def _judge(self, node: str, of: Checked, due: _Due) -> Iterator[Discrepancy]:
        time_ns, digest, signed, signature = due
        # What is not the node's says nothing of time.
        second = time_ns - S_NS, time_ns
        why = self._why_refused(node, of, signature, signed)
        if why:
            yield Discrepancy(node, "altered", *second, f"a digest is not the node's: {why}")
            return
        if not signature and self._must_sign:
            yield Discrepancy(node, "unsigned", digest.since_ns, digest.stamp_ns, "is not signed", digest.boot)
        newest = of.newest.get(digest.boot)
        if newest is None and len(of.newest) >= MAX_BOOTS:
            yield Discrepancy(node, "altered", *second, f"digests of more than {MAX_BOOTS} runs of the node")
            return
        if self._own and newest is None and of.newest:
            yield Discrepancy(node, "altered", *second, "a digest of another run of the node")
        absent = of.absent[digest.boot]
        if newest is not None and digest.seq <= newest.seq and digest.seq not in absent:
            yield Discrepancy(node, "altered", *second, "a digest comes again, or late")
            return
        if newest is None and of.newest:
            # The end of its run before may be in its log alone.
            before = max(of.newest.values(), key=lambda one: one.stamp_ns)
            if before.last is UNSET and before.stamp_ns < digest.since_ns:
                words = "the end of the node's run before is missing"
                yield Discrepancy(node, "missing", before.stamp_ns, digest.since_ns, words, before.boot)
        if newest is None and digest.seq:
            words = f"nothing is there of the node's first {digest.seq} s"
            began_ns = max(digest.since_ns - digest.seq * MOST_DIGEST_NS, 0)
            yield Discrepancy(node, "missing", began_ns, digest.since_ns, words, digest.boot)
            _expect_late(of, digest, 0)
        elif newest is not None and digest.seq > newest.seq + 1:
            words = f"{digest.seq - newest.seq - 1} digests are missing"
            yield Discrepancy(node, "missing", newest.stamp_ns, digest.since_ns, words, digest.boot)
            _expect_late(of, digest, newest.seq + 1)
        absent.discard(digest.seq)
        # Where the clock was set ahead, the time between was none. After its last digest a node says nothing.
        begin_ns = max(digest.since_ns, digest.stamp_ns - LATE_NS)
        _cover(of.covered, begin_ns, digest.stamp_ns + (0 if digest.last is UNSET else SAID_NS))
        if newest is None or digest.seq > newest.seq:
            of.newest[digest.boot] = replace(digest, said=[])
            lasts_ns = {one.topic: one.last_ns for one in digest.said if one.topic in SAMPLED}
            of.last_ns[digest.boot] = {name: max(ns, digest.stamp_ns - LATE_NS) for name, ns in lasts_ns.items()}
        found = [one for stretch in digest.said for one in _compare(node, of, digest, stretch)]
        yield from found
        if not found:
            of.seconds += 1
            of.signed += bool(signature and self._refuses is not None)

    def _leftover(self, node: str, of: Checked, topic: str, left: list[Undigested]) -> Iterator[Discrepancy]:
        """Name the messages that no digest has named, by second."""
        if not of.newest:
            return  # the whole node is not signed
        # What a run said after the last digest that is there, also where the clock was set back before the next run. On
        # a busy machine it may be older than SAID_NS then: its stamp comes after those of its topic in that digest.
        rests_ns = [
            (min(digest.stamp_ns - SAID_NS, of.last_ns[boot].get(topic, digest.stamp_ns)), digest.stamp_ns)
            for boot, digest in of.newest.items()
            if digest.last is UNSET
        ]
        # All digests are there, and no other run is.
        is_whole = self._own and not rests_ns and not any(of.absent.values())
        seconds: dict[tuple[int, Kind], int] = defaultdict(int)
        for one in left:
            # A forgery is only what would have to be in a digest that is there.
            altered = _in_digests(of, one.stamp_ns, one.stamp_ns + SAID_NS)
            if topic in SAID_AGAIN:
                altered = altered and _in_digests(of, max(one.stamp_ns, one.time_ns - SAID_NS), one.time_ns)
            # What came after its digest was judged belongs to what was missing then, and is as little verified.
            altered = altered and not any(first <= one.stamp_ns <= last for first, last in of.incomplete[topic])
            altered = altered and not any(after < one.stamp_ns <= end + MOST_DIGEST_NS for after, end in rests_ns)
            seconds[one.time_ns // S_NS, "altered" if altered or is_whole else "unsigned"] += 1
        for (second, kind), count in sorted(seconds.items()):
            at_ns = second * S_NS
            yield Discrepancy(node, kind, at_ns, at_ns + S_NS, f"{topic}: {count} that are in no digest")

    def _why_refused(self, node: str, of: Checked, signature: str, signed: bytes) -> str:
        if not signature or self._refuses is None:
            return ""
        if not of.certificates:
            return "no calibration of the node has its certificate"
        why = ""
        for certificate in of.certificates:
            why = self._refuses(node, certificate, signature, signed)
            if not why:
                break
        return why


def _expect_late(of: Checked, digest: Digest, first: int) -> None:
    """Note the digests from number `first` up to this one as absent; the newest ones, if they are too many."""
    room = MAX_ABSENT - sum(map(len, of.absent.values()))
    of.absent[digest.boot].update(range(max(first, digest.seq - room), digest.seq))


def _cover(covered: list[tuple[int, int]], begin_ns: int, end_ns: int) -> None:
    """Add a time, joined with those that it touches; nothing where the clock was set back meanwhile."""
    if begin_ns > end_ns:
        return
    first = bisect_left(covered, begin_ns, key=lambda one: one[1])
    after = bisect_right(covered, end_ns, key=lambda one: one[0])
    if first < after:
        begin_ns, end_ns = min(begin_ns, covered[first][0]), max(end_ns, covered[after - 1][1])
    covered[first:after] = [(begin_ns, end_ns)]
    del covered[:-MAX_COVERED]


def _in_digests(of: Checked, begin_ns: int, end_ns: int) -> bool:
    at = bisect_right(of.covered, begin_ns, key=lambda one: one[0]) - 1
    return at >= 0 and end_ns <= of.covered[at][1]


def _insert(due: list[_Due], new: _Due) -> bool:
    """Put a digest in its place, and return whether others wait behind it.

    One that came late goes before the later ones of its boot.
    """
    at = len(due)
    while at and due[at - 1].digest.boot == new.digest.boot and due[at - 1].digest.seq > new.digest.seq:
        at -= 1
    due.insert(at, new)
    return at < len(due) - 1


def _take_certificate(of: Checked, key: str, payload: bytes) -> None:
    try:
        info = open_envelope(key, payload).message
    except MessageError:
        return
    certificate = info.certificate if isinstance(info, NodeInfo) else UNSET
    if certificate is not UNSET and certificate not in of.certificates:
        # Those of a node's last starts; an invented one takes the place of none that is in use.
        of.certificates = [*of.certificates, certificate][:8]


def _compare(node: str, of: Checked, digest: Digest, stretch: Said) -> Iterator[Discrepancy]:
    """Compare the messages of a stretch, which then no longer wait."""
    # Not entered for a topic that has none: any text may stand in a digest.
    waiting = of.waiting.get(stretch.topic, [])
    inside = [one for one in waiting if stretch.first_ns <= one.stamp_ns <= stretch.last_ns]
    # Where a clock was set back, or a message was said again, there are others among them.
    for begin in range(len(inside) - stretch.count + 1):
        found = inside[begin : begin + stretch.count]
        if sum_of([one.sha256 for one in found]) == stretch.sha256:
            _remove(waiting, found)
            of.right[stretch.topic] = stretch.sha256
            return
    if not inside and of.right.get(stretch.topic) == stretch.sha256:
        return  # the same message said again, which logs that were put together have once
    if stretch.topic == end_of(IMAGE):
        return  # pictures are not all recorded, and not all kept; what is there without a digest is named
    distinct = list({one.sha256: one for one in inside}.values())
    _remove(waiting, inside)
    by_stamp = sorted(distinct, key=lambda one: one.stamp_ns)
    kind: Kind = "altered"
    if sum_of([one.sha256 for one in by_stamp]) == stretch.sha256:
        words = f"{stretch.topic}: {'in another order' if len(inside) == len(distinct) else 'some stand twice'}"
    elif len(distinct) < stretch.count:
        of.incomplete[stretch.topic].append((stretch.first_ns, stretch.last_ns))
        kind, words = "missing", f"{stretch.topic}: {stretch.count - len(distinct)} of {stretch.count} are missing"
    else:
        words = f"{stretch.topic}: other messages than the node's"
    have = {one.sha256: one.time_ns for one in distinct}
    yield Discrepancy(node, kind, digest.since_ns, digest.stamp_ns, words, digest.boot, stretch, have)


def _remove(waiting: list[Undigested], gone: list[Undigested]) -> None:
    known = set(map(id, gone))
    waiting[:] = [one for one in waiting if id(one) not in known]
