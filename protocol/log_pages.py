"""Read a node's log over the bus: questions about a stretch of it, and the answer in pages.

A page is MessagePack of `Page`, packed with zstd. Its messages are in the order in which they were written.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from itertools import count, takewhile
from pathlib import Path
from typing import IO, Final, NamedTuple

import msgspec
import zstandard
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import MessageError
from buddyline.protocol.salvage import CHANNEL_NOTE, MAGIC, ChunkAt, MalformedError, read_chunk, record_at
from mcap.exceptions import McapError
from mcap.records import Message as McapMessage
from mcap.records import Metadata

# Not packed; a single message may be larger. On a slow link urgent messages wait for a page that is under way.
PAGE_BYTES: Final = 16 * 1024
MOST_PAGE_BYTES: Final = 128 * 1024
MOST_UNPACKED_BYTES: Final = 1024 * 1024
# A question's stretch: what is beyond it is left out of the answer.
MOST_NS: Final = 60 * S_NS
_QUESTION: Final = re.compile(
    r"boot=([0-9a-z]{1,32});since=(\d{1,19});until=(\d{1,19});topics=([a-z_]{1,32}(?:\+[a-z_]{1,32}){0,31})"
)


class Logged(NamedTuple):
    """A message of a log."""

    time_ns: int
    key: str
    payload: bytes


class Page(msgspec.Struct, array_like=True, frozen=True):
    """Part of an answer. number: from 0; last: whether the answer ends with it."""

    number: int
    last: bool
    messages: list[Logged]


class Question(NamedTuple):
    """What is asked for: the messages with log times in (since_ns, until_ns] of these topics, by their keys' ends."""

    boot: str
    since_ns: int
    until_ns: int
    topics: tuple[str, ...]

    def text(self) -> str:
        """Return it as text."""
        return f"boot={self.boot};since={self.since_ns};until={self.until_ns};topics={'+'.join(self.topics)}"

    @classmethod
    def of(cls, text: str) -> Question | None:
        """Return the question of a text; None if it is none."""
        found = _QUESTION.fullmatch(text)
        if found is None:
            return None
        since_ns = int(found[2])
        return cls(found[1], since_ns, min(int(found[3]), since_ns + MOST_NS), tuple(found[4].split("+")))


class GrowingLog:
    """A log that is still being written, read by log time, and not from its beginning each time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._end = len(MAGIC)
        self._chunks: list[ChunkAt] = []
        self._keys: dict[int, str] = {}

    def messages(self, since_ns: int, until_ns: int, wanted: Callable[[str], bool]) -> Iterator[Logged]:
        """Yield the messages with log times in (since_ns, until_ns], as far as they can be read."""
        with open(self.path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            self._look(file, size)
            for chunk in self._chunks:
                if chunk.end_ns <= since_ns or chunk.start_ns > until_ns:
                    continue
                try:
                    found = read_chunk(file, chunk.offset, size)
                except (McapError, ValueError, EOFError, zstandard.ZstdError):
                    continue
                for one in found:
                    if isinstance(one, McapMessage) and since_ns < one.log_time <= until_ns:
                        key = self._keys.get(one.channel_id, "")
                        if wanted(key):
                            yield Logged(one.log_time, key, one.data)

    def _look(self, file: IO[bytes], size: int) -> None:
        """Find the chunks that were written since the last look."""
        while self._end < size:
            try:
                end, found, last = record_at(file, self._end, size)
            except MalformedError:
                return
            if isinstance(found, ChunkAt):
                self._chunks.append(found)
            elif isinstance(found, Metadata) and found.name == CHANNEL_NOTE:
                self._keys[int(found.metadata["id"])] = found.metadata["topic"]
            if last:
                return
            self._end = end


def pages_of(messages: Iterator[Logged]) -> Iterator[bytes]:
    """Yield an answer's pages; the last one says so."""
    packer = zstandard.ZstdCompressor()
    waiting: list[Logged] = []
    number = size = 0
    for one in messages:
        if waiting and size + len(one.payload) > PAGE_BYTES:
            yield packer.compress(msgspec.msgpack.encode(Page(number, False, waiting)))
            number, size, waiting = number + 1, 0, []
        waiting.append(one)
        size += len(one.payload)
    yield packer.compress(msgspec.msgpack.encode(Page(number, True, waiting)))


class LogAnswer(NamedTuple):
    """The messages of an answer, up to the first page that has not come. is_whole: all pages have."""

    messages: list[Logged]
    is_whole: bool


def answer_of(pages: list[bytes]) -> LogAnswer:
    """Unpack the pages of an answer. Raises MessageError for what is no page."""
    found: dict[int, Page] = {}
    for packed in pages:
        try:
            if zstandard.frame_content_size(packed) > MOST_UNPACKED_BYTES:
                raise MessageError("a page of a log: too big to unpack")
            unpacked = zstandard.ZstdDecompressor().decompress(packed, max_output_size=MOST_UNPACKED_BYTES)
            page = msgspec.msgpack.decode(unpacked, type=Page)
        except (zstandard.ZstdError, msgspec.DecodeError, UnicodeDecodeError) as error:
            raise MessageError(f"a page of a log: {error}") from error
        found[page.number] = page
    in_order = [found[k] for k in takewhile(found.__contains__, count())]
    messages = [one for page in in_order for one in page.messages]
    return LogAnswer(messages, bool(in_order) and in_order[-1].last)
