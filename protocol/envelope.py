"""The one door for messages: a key and a payload in, a sound message with its topic and node ids out.

Nothing else in the project decodes a payload. What is not sound is refused, counted and named.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from buddyline.protocol.codec import M, decode, encode
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import CompressedImage, Message
from buddyline.protocol.topics import Topic, key_of, parse_key

log = logging.getLogger(__name__)

MAX_NAMED_KEYS: Final = 32
CAMERA_FRAME: Final = "_camera"


@dataclass(frozen=True, slots=True)
class Envelope:
    """A sound message, and what its key says of it.

    ids: the node's id, or the pair's two. payload: the message as it came, to be passed on unchanged.
    time_ns: receive time on the bus, log time in a log; 0 where neither is known.
    """

    key: str
    topic: Topic
    ids: tuple[str, ...]
    message: Message
    payload: bytes
    time_ns: int = 0

    @property
    def node(self) -> str:
        """The node that it is of; A of a pair."""
        fields = self.topic.id_fields
        return self.ids[fields.index("node") if "node" in fields else 0]


def open_envelope(key: str, payload: bytes, time_ns: int = 0) -> Envelope:
    """Decode and check one message.

    Raises MessageError, naming the field, where the key is none of ours, the payload is not sound, or the message
    says that it is of another node or pair than its key.
    """
    parsed = parse_key(key)
    if parsed is None:
        raise MessageError(f"{key}: no topic of ours")
    topic, ids = parsed
    message = decode(payload, topic.schema)
    _check_sender(key, topic, ids, message)
    return Envelope(key, topic, ids, message, payload, time_ns)


def envelope_of(message: Message, time_ns: int) -> Envelope:
    """Return a message of our own making as if it had come; raise MessageError where it is not sound."""
    key = key_of(message)
    parsed = parse_key(key)
    assert parsed is not None
    return Envelope(key, *parsed, message, encode(message), time_ns)


def _check_sender(key: str, topic: Topic, ids: tuple[str, ...], message: Message) -> None:
    fields = topic.id_fields
    if isinstance(message, CompressedImage):
        # Other programs name frames as they like; `<node>_camera` is ours.
        named = message.frame_id.endswith(CAMERA_FRAME)
        said = (message.frame_id.removesuffix(CAMERA_FRAME),) if named else ids
        fields = ("frame_id",)
    else:
        said = tuple(getattr(message, field, own) for field, own in zip(fields, ids, strict=True))
    if said != ids:
        words = ", ".join(f"{field} {value!r}" for field, value in zip(fields, said, strict=True))
        raise MessageError(f"{topic.schema_name}: {words} on key {key}")


class Sealed(Protocol):
    """What can be opened: a `Received` of the bus, a `Record` of a log."""

    @property
    def key(self) -> str:
        """Its Zenoh key and MCAP topic."""
        ...

    def open(self) -> Envelope:
        """Return its sound message; raise MessageError."""
        ...


@dataclass
class Refused:
    """What was refused of one key: how many messages, and why the first."""

    count: int
    first: str


class Refusals:
    """Counts what is refused, by key, and says so: the 1st, 2nd, 4th ... of each key. Safe in several threads.

    who: begins each line of the log, "" for a reader that says everything at its end. by_key: of the first keys;
    more than MAX_NAMED_KEYS are counted together under "other keys".
    """

    def __init__(self, who: str = "") -> None:
        self.by_key: dict[str, Refused] = {}
        self._who = who
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """How many messages were refused."""
        with self._lock:
            return sum(refused.count for refused in self.by_key.values())

    def open(self, sealed: Sealed) -> Envelope | None:
        """Open one; None where it is refused."""
        try:
            return sealed.open()
        except MessageError as error:
            self.note(sealed.key, error)
            return None

    def note(self, key: str, error: MessageError) -> None:
        """Count a refusal."""
        with self._lock:
            if key not in self.by_key and len(self.by_key) >= MAX_NAMED_KEYS:
                key = "other keys"
            refused = self.by_key.setdefault(key, Refused(0, str(error)))
            refused.count += 1
            count = refused.count
        if self._who and count.bit_count() == 1:
            log.warning("%s: bad message on %s: %s (%d so far)", self._who, key, error, count)

    def lines(self) -> list[str]:
        """Return a line for each key: how many of its messages were refused, and why the first."""
        with self._lock:
            return [
                f"{key}: {refused.count} refused, the first: {refused.first}" for key, refused in self.by_key.items()
            ]


def read_message(path: Path, schema: type[M]) -> M:
    """Read a file that holds one message's payload; raise MessageError naming the file."""
    try:
        return decode(path.read_bytes(), schema)
    except OSError as error:
        raise MessageError(f"{path}: cannot be read: {error.strerror}") from error
    except MessageError as error:
        raise MessageError(f"{path}: {error}") from error
