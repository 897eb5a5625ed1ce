"""Decode and check messages: a key and a payload in, a valid message with its topic and node ids out.

This is the only place in the project that decodes payloads. Invalid messages are refused, counted and reported.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import msgspec
from buddyline.protocol.codec import M, decode, encode
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import CompressedImage, Message
from buddyline.protocol.topics import Topic, key_of, parse_key

log = logging.getLogger(__name__)

MAX_NAMED_KEYS: Final = 32
# Characters of a key, or of a reason, that are logged.
MAX_SHOWN: Final = 400
CAMERA_FRAME: Final = "_camera"


class Envelope(msgspec.Struct, frozen=True, gc=False):
    """A valid message, with the topic and the ids of its key.

    ids: the node's id, or the pair's two. payload: the message as received, to be passed on unchanged.
    time_ns: receive time on the bus, log time in a log, 0 where unknown.
    """

    key: str
    topic: Topic
    ids: tuple[str, ...]
    message: Message
    payload: bytes
    time_ns: int = 0

    @property
    def node(self) -> str:
        """The id of the message's node; of a pair, A's."""
        fields = self.topic.id_fields
        return self.ids[fields.index("node") if "node" in fields else 0]

    @property
    def stamp_ns(self) -> int:
        """The message's measurement time."""
        stamp_ns: int = getattr(self.message, "stamp_ns", self.time_ns)
        return stamp_ns


def open_envelope(key: str, payload: bytes, time_ns: int = 0) -> Envelope:
    """Decode and check one message.

    Raises MessageError, naming the field, for a key that is no Buddyline topic, an invalid payload, or a message of
    another node or pair than its key's.
    """
    parsed = parse_key(key)
    if parsed is None:
        raise MessageError(f"{key}: not a Buddyline topic")
    topic, ids = parsed
    message = decode(payload, topic.schema)
    _check_sender(key, topic, ids, message)
    return Envelope(key, topic, ids, message, payload, time_ns)


def envelope_of(message: Message, time_ns: int) -> Envelope:
    """Return the envelope of a message made by this process; raise MessageError if it is not valid."""
    key = key_of(message)
    parsed = parse_key(key)
    assert parsed is not None
    return Envelope(key, *parsed, message, encode(message), time_ns)


def _check_sender(key: str, topic: Topic, ids: tuple[str, ...], message: Message) -> None:
    fields = topic.id_fields
    if isinstance(message, CompressedImage):
        # Other programs choose their own frame names; only `<node>_camera` is checked.
        named = message.frame_id.endswith(CAMERA_FRAME)
        said = (message.frame_id.removesuffix(CAMERA_FRAME),) if named else ids
        fields = ("frame_id",)
    else:
        said = tuple([getattr(message, field, own) for field, own in zip(fields, ids, strict=True)])
    if said != ids:
        words = ", ".join(f"{field} {value!r}" for field, value in zip(fields, said, strict=True))
        raise MessageError(f"{topic.schema_name}: {words} on key {key}")


class Sealed(Protocol):
    """A message that is not decoded yet: a `Received` of the bus, or a `Record` of a log."""

    @property
    def key(self) -> str:
        """Its Zenoh key, which is also its MCAP topic."""
        ...

    def open(self) -> Envelope:
        """Decode and check the message; raise MessageError."""
        ...


@dataclass
class Refused:
    """The refused messages of one key: their number, and the reason of the first."""

    count: int
    first: str


class Refusals:
    """Counts refused messages by key, and logs the 1st, 2nd, 4th, 8th ... of each key. Safe in several threads.

    who: begins each logged line; "" logs nothing, for a reader that reports at its end. by_key: the counts of the
    first MAX_NAMED_KEYS keys; all others are counted together under "other keys".
    """

    def __init__(self, who: str = "") -> None:
        self.by_key: dict[str, Refused] = {}
        self._who = who
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """Number of messages refused."""
        with self._lock:
            return sum(refused.count for refused in self.by_key.values())

    def open(self, sealed: Sealed) -> Envelope | None:
        """Decode and check one message; None if it is refused."""
        try:
            return sealed.open()
        except MessageError as error:
            self.note(sealed.key, error)
            return None

    def note(self, key: str, error: MessageError) -> None:
        """Count a refused message."""
        with self._lock:
            if key not in self.by_key and len(self.by_key) >= MAX_NAMED_KEYS:
                key = "other keys"
            refused = self.by_key.setdefault(key, Refused(0, str(error)))
            refused.count += 1
            count = refused.count
        if self._who and count.bit_count() == 1:
            log.warning("%s: bad message on %s: %s (%d so far)", self._who, _shown(key), _shown(str(error)), count)

    def lines(self) -> list[str]:
        """Return a line for each key: the number of refused messages, and the reason of the first."""
        with self._lock:
            return [
                f"{_shown(key)}: {refused.count} refused, the first: {_shown(refused.first)}"
                for key, refused in self.by_key.items()
            ]


def _shown(text: str) -> str:
    """Return a stranger's text as a terminal may show it: without control characters, and cut where it is long."""
    short = text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."
    return "".join(letter if letter.isprintable() else "?" for letter in short)


def read_message(path: Path, schema: type[M]) -> M:
    """Read a file that holds one message's payload; raise MessageError naming the file."""
    try:
        return decode(path.read_bytes(), schema)
    except OSError as error:
        raise MessageError(f"{path}: cannot be read: {error.strerror}") from error
    except MessageError as error:
        raise MessageError(f"{path}: {error}") from error
