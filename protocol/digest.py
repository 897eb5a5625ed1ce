"""Sum up and sign what a node has said in each second, and read such digests; `digest_check` compares logs with them.

No bus, no clock, no files, no keys: the function that signs is passed in.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Final

from buddyline.protocol.codec import encode
from buddyline.protocol.envelope import open_envelope
from buddyline.protocol.messages import MAX_SAID, Digest, Said
from buddyline.protocol.topics import DIGEST, IMAGE, MARK, Topic
from msgspec import UNSET

_SIGNATURE: Final = b',"signature":"'


def is_covered(topic: Topic) -> bool:
    """Return whether digests cover a topic: what only the node itself says. Surveyors set marks for a node, too."""
    return topic.id_fields == ("node",) and not topic.solved and topic is not DIGEST and topic is not MARK


def end_of(topic: Topic) -> str:
    """Return the last chunk of a topic's keys."""
    return topic.template.rpartition("/")[2]


class DigestBook:
    """Sums up what a node says, for its digests. Not safe in several threads."""

    def __init__(self, node: str, boot: str, began_ns: int) -> None:
        self._node = node
        self._boot = boot
        self._seq = 0
        self._since_ns = began_ns
        self._open: dict[str, tuple[int, int, int, hashlib._Hash]] = {}
        self._said: list[Said] = []

    def add(self, topic: Topic, stamp_ns: int, payload: bytes) -> None:
        """Take a message that the node says."""
        if not is_covered(topic):
            return
        name = end_of(topic)
        count, first_ns, last_ns, hashed = self._open.get(name) or (0, stamp_ns, -1, hashlib.sha256())
        # Pictures are recorded and shown each at its own rate: each is a stretch of its own.
        if count and (stamp_ns <= last_ns or topic is IMAGE):
            self._end(name)
            count, first_ns, hashed = 0, stamp_ns, hashlib.sha256()
        hashed.update(hashlib.sha256(payload).digest())
        self._open[name] = count + 1, first_ns, stamp_ns, hashed

    @property
    def is_full(self) -> bool:
        """Whether a digest is due before its second is over."""
        return len(self._said) + len(self._open) >= MAX_SAID - 1

    def digest(self, stamp_ns: int, *, last: bool = False) -> Digest:
        """Return the digest of all since the last one."""
        for topic in list(self._open):
            self._end(topic)
        said, self._said = self._said, []
        made = Digest(
            node=self._node,
            stamp_ns=stamp_ns,
            boot=self._boot,
            seq=self._seq,
            since_ns=self._since_ns,
            said=said,
            last=last or UNSET,
        )
        self._seq += 1
        self._since_ns = stamp_ns
        return made

    def _end(self, topic: str) -> None:
        count, first_ns, last_ns, hashed = self._open.pop(topic)
        short = hashed.hexdigest()[:32]
        self._said.append(Said(topic=topic, count=count, first_ns=first_ns, last_ns=last_ns, sha256=short))


def sealed(digest: Digest, sign: Callable[[bytes], str] | None) -> bytes:
    """Return the payload of a digest, with its signature."""
    payload = encode(digest)
    return payload if sign is None else payload[:-1] + _SIGNATURE + sign(payload).encode() + b'"}'


def unsealed(key: str, payload: bytes) -> tuple[Digest, bytes, str]:
    """Return the digest of a payload, what is signed of it, and the signature ("" without one); raise MessageError."""
    head, mark, tail = payload.rpartition(_SIGNATURE)
    # What comes after the signed part counts for nothing.
    signed, signature = (head + b"}", tail[:-2].decode("ascii", "replace")) if mark else (payload, "")
    digest = open_envelope(key, signed).message
    assert isinstance(digest, Digest)
    return digest, signed, signature


def sum_of(leaves: list[bytes]) -> str:
    """Return a stretch's checksum of its messages' checksums."""
    return hashlib.sha256(b"".join(leaves)).hexdigest()[:32]
