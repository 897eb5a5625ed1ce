"""Dive logs: self-describing MCAP files that survive a power cut and stay readable when damaged."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from pathlib import Path
from stat import S_ISREG
from typing import IO, Final, cast

import msgspec
from buddyline.protocol import topics
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import encode, payload_stamp_ns
from buddyline.protocol.envelope import Envelope, open_envelope
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Message
from buddyline.protocol.parity import ParityWriter
from buddyline.protocol.salvage import (
    CHANNEL_NOTE,
    MAGIC,
    MAX_RECORD_BYTES,
    ChunkAt,
    joined_at,
    read_chunk,
    summary_is_sound,
    walk,
)
from buddyline.protocol.schemas import json_schema
from buddyline.protocol.spool import Spool
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.writer import CompressionType, Writer
from zstandard import ZstdError

CHUNK_BYTES: Final = 1024 * 1024
# One flipped bit loses a whole chunk, so chunks are short.
CHUNK_NS: Final = S_NS
LOG_NOTE: Final = "buddyline.log"
MAX_NOTES: Final = 100
_DAMAGE = (McapError, ValueError, struct.error, EOFError, OSError, MemoryError, RuntimeError, ZstdError)


class Record(msgspec.Struct, frozen=True, gc=False):
    """One message of a log: its key, its times in ns, and its payload as on the bus.

    sequence: number of the message in its log, from 0, modulo 2**32, where DiveLogWriter wrote the log.
    """

    key: str
    schema_name: str
    log_time_ns: int
    publish_time_ns: int
    payload: bytes
    sequence: int = 0

    def open(self) -> Envelope:
        """Decode and check the message; raise MessageError."""
        return open_envelope(self.key, self.payload, self.log_time_ns)


class _WithParity:
    """The stream that the MCAP writer writes to: a file, and the parity of what goes into it."""

    def __init__(self, file: Spool, parity: ParityWriter) -> None:
        self._file = file
        self._parity = parity
        self.tell, self.flush = file.tell, file.flush

    def write(self, data: bytes) -> int:
        """Write to both."""
        self._parity.add(data)
        return self._file.write(data)


class DiveLogWriter:
    """Writes one MCAP file, which must not exist yet, in chunks of at most a second of log time.

    parity: add what `buddyline repair` needs to restore damaged bytes (protocol.parity), a tenth of the file.
    """

    def __init__(self, path: Path | str, *, metadata: dict[str, str] | None = None, parity: bool = True) -> None:
        self.path = Path(path)
        try:
            self._file = Spool(self.path)
        except FileExistsError:
            raise BuddylineError(
                f"{self.path}: exists; a log is never overwritten, name another or remove it first"
            ) from None
        except OSError as error:
            raise BuddylineError(f"{self.path}: cannot be written: {error.strerror}") from error
        self._parity = ParityWriter() if parity else None
        stream = self._file if self._parity is None else _WithParity(self._file, self._parity)
        self._writer = Writer(cast(IO[bytes], stream), chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="buddyline", library="buddyline")
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._cut_ns: int | None = None
        self.count = 0
        if metadata:
            # A file's name need not be UTF-8.
            notes = {name: note.encode(errors="replace").decode() for name, note in metadata.items()}
            self._writer.add_metadata(LOG_NOTE, notes)
        # With the head on the disk, a power cut in the first second leaves a readable log. A full disk is reported by
        # the next flush.
        with suppress(OSError):
            self.flush(sync=True)

    @property
    def size_bytes(self) -> int:
        """Length of the file, without the unfinished chunk."""
        return self._file.tell()

    @property
    def removed(self) -> bool:
        """Whether the file was deleted while it was written."""
        return self._file.removed

    def write(
        self, key: str, payload: bytes, log_time_ns: int, publish_time_ns: int | None = None, schema: str = ""
    ) -> None:
        """Add one payload. publish_time_ns: its stamp, by default read from it. schema: for keys of other programs.

        Raises OSError if the disk refuses to write; then this payload is not in the log, and earlier ones stay
        queued.
        """
        if self._file.stuck:
            self._file.flush()
        self._cut(log_time_ns)
        if publish_time_ns is None:
            publish_time_ns = payload_stamp_ns(payload)
        if publish_time_ns is None:
            publish_time_ns = log_time_ns
        channel = self._channels.get((key, schema))
        if channel is None:
            channel = self._channels[key, schema] = self._register(key, schema)
        self._writer.add_message(channel, log_time_ns, payload, publish_time_ns, self.count & 0xFFFFFFFF)
        self.count += 1

    def _cut(self, log_time_ns: int) -> None:
        """Finish the chunk if it spans a second of log time. Messages with earlier times stay in it."""
        if self._cut_ns is None:
            self._cut_ns = log_time_ns
        elif log_time_ns - self._cut_ns >= CHUNK_NS:
            self._writer.flush()
            self._add_parity()
            self._cut_ns = log_time_ns

    def write_message(self, message: Message, log_time_ns: int | None = None, key: str | None = None) -> None:
        """Add one message; log_time_ns: by default its own stamp; key: by default its topic's."""
        stamp_ns: int = getattr(message, "stamp_ns", 0)
        time_ns = stamp_ns if log_time_ns is None else log_time_ns
        self.write(key or topics.key_of(message), encode(message), time_ns, stamp_ns)

    def _register(self, key: str, schema: str) -> int:
        parsed = topics.parse_key(key)
        name = parsed[0].schema_name if parsed else (schema or "object")
        schema_id = self._schemas.get(name)
        if schema_id is None:
            described = json_schema(parsed[0].schema) if parsed else b'{"type":"object"}'
            schema_id = self._schemas[name] = self._writer.register_schema(name, "jsonschema", described)
        channel = self._writer.register_channel(key, "json", schema_id)
        # The channel's note is outside the chunks: later chunks stay readable if the declaring chunk is damaged.
        self._writer.add_metadata(CHANNEL_NOTE, {"id": str(channel), "topic": key, "schema": name})
        return channel

    def flush(self, *, sync: bool = False) -> None:
        """Finish and write the chunk; sync: also fsync. Raises OSError; the next call tries again."""
        self._writer.flush()
        self._add_parity()
        self._cut_ns = None
        if sync:
            self._file.sync()

    def _add_parity(self, *, last: bool = False) -> None:
        """Write the parity that is due; all records before are complete."""
        record = b"" if self._parity is None else self._parity.record(last=last)
        if record and self._parity is not None:
            self._parity.add(record)
            self._file.write(record)

    def close(self) -> None:
        """Write the index and the end, and close the file; raise OSError."""
        if self._file.closed:
            return
        try:
            self._writer.flush()
            self._add_parity(last=True)
            self._writer.finish()
            self._file.flush()
            self._file.sync()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file without its end, and without what the disk refused to write."""
        self._file.close()

    def __enter__(self) -> DiveLogWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass
class _Contents:
    """The places and log times of a log's chunks, its channels, its messages outside chunks, and its metadata."""

    # start, end (ns), offset in the file, and the channels in it (None: not known before it is read)
    chunks: list[tuple[int, int, int, frozenset[int] | None]] = field(default_factory=list)
    channels: dict[int, tuple[str, str]] = field(default_factory=dict)  # id: topic, schema name
    loose: list[McapMessage] = field(default_factory=list)
    metadata: dict[str, str] = field(default_factory=dict)


class DiveLogReader:
    """Reads one MCAP file, whole or damaged. damage: a line for each part that could not be read.

    trust_index: use the index at the file's end if there is one; False: always read through the whole file.
    """

    def __init__(self, path: Path | str, *, trust_index: bool = True) -> None:
        self.path = Path(path)
        self.damage: list[str] = []
        if self.path.is_dir():
            raise BuddylineError(f"{self.path}: is a folder; name the logs in it: {self.path / '*.mcap'}")
        try:
            about = self.path.stat()
            if not S_ISREG(about.st_mode):
                once = "is a pipe or a device, and a log is read more than once; copy it into a file, and name that"
                raise BuddylineError(f"{self.path}: {once}")
            self._size = about.st_size
            self._file = open(self.path, "rb")
        except OSError as error:
            raise BuddylineError(f"{self.path}: cannot be read: {error.strerror}") from error
        try:
            if self._size == 0:
                raise BuddylineError(f"{self.path}: is empty; nothing was recorded in it")
            if self._file.read(len(MAGIC)) != MAGIC:
                raise BuddylineError(f"{self.path}: is not a dive log (an MCAP file begins with other bytes)")
            self._contents = (self._index() if trust_index else None) or self._scan()
        except BaseException:
            self._file.close()
            raise

    @property
    def keys(self) -> list[str]:
        """The keys that the log declares, sorted."""
        return sorted({topic for topic, _ in self._contents.channels.values()})

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message, ns; None for a log without messages."""
        starts = [start for start, *_ in self._contents.chunks] + [m.log_time for m in self._contents.loose]
        return min(starts, default=None)

    @property
    def end_ns(self) -> int | None:
        """Log time of the last message, ns; None for a log without messages."""
        ends = [end for _, end, *_ in self._contents.chunks] + [m.log_time for m in self._contents.loose]
        return max(ends, default=None)

    def metadata(self) -> dict[str, str]:
        """Return the writer's notes about the log."""
        return dict(self._contents.metadata)

    def records(self, wanted: Callable[[str], bool] | None = None, since_ns: int | None = None) -> Iterator[Record]:
        """Yield the records by log time, and in the file's order where times are equal.

        Only chunks that overlap in time are in memory at once. wanted: returns whether to read a key. since_ns: the
        least log time. If the log has an index, chunks without wanted records are not read.
        """
        wanted = cache(wanted) if wanted else None
        heap: list[tuple[int, int, Record]] = []
        order = 0
        for message in self._contents.loose:
            record = self._record(message, wanted, since_ns)
            if record is not None:
                heap.append((record.log_time_ns, order, record))
                order += 1
        heapq.heapify(heap)
        for start_ns, end_ns, offset, channels in sorted(self._contents.chunks, key=lambda chunk: chunk[:3]):
            if (since_ns is not None and end_ns < since_ns) or not self._holds_any(channels, wanted):
                continue
            while heap and heap[0][0] < start_ns:
                yield heapq.heappop(heap)[2]
            for message in self._chunk_messages(offset, start_ns, end_ns):
                record = self._record(message, wanted, since_ns)
                if record is not None:
                    heapq.heappush(heap, (record.log_time_ns, order, record))
                    order += 1
        while heap:
            yield heapq.heappop(heap)[2]

    def stored(self, wanted: Callable[[str], bool] | None = None) -> Iterator[Record]:
        """Yield the records in the order in which they were written. wanted: returns whether to read a key."""
        wanted = cache(wanted) if wanted else None
        chunks = sorted(self._contents.chunks, key=lambda chunk: chunk[2])
        messages = (one for start, end, at, _ in chunks for one in self._chunk_messages(at, start, end))
        for message in chain(self._contents.loose, messages):
            record = self._record(message, wanted, None)
            if record is not None:
                yield record

    def _holds_any(self, channels: frozenset[int] | None, wanted: Callable[[str], bool] | None) -> bool:
        if channels is None or wanted is None:
            return True
        declared = self._contents.channels
        return any(channel not in declared or wanted(declared[channel][0]) for channel in channels)

    def _record(
        self, message: McapMessage, wanted: Callable[[str], bool] | None, since_ns: int | None
    ) -> Record | None:
        if since_ns is not None and message.log_time < since_ns:
            return None
        channel = self._contents.channels.get(message.channel_id)
        if channel is None:
            self._note(f"channel {message.channel_id} is not declared: its messages are left out")
            return None
        topic, schema = channel
        if wanted is not None and not wanted(topic):
            return None
        return Record(topic, schema, message.log_time, message.publish_time, message.data, message.sequence)

    def _note(self, text: str) -> None:
        if len(self.damage) < MAX_NOTES and text not in self.damage:
            self.damage.append(text if len(self.damage) < MAX_NOTES - 1 else "and more")

    def _chunk_messages(self, offset: int, start_ns: int, end_ns: int) -> list[McapMessage]:
        try:
            contents = read_chunk(self._file, offset, self._size)
        except _DAMAGE as error:
            lost_s = (end_ns - start_ns) / S_NS
            from_s = (start_ns - min(chunk[0] for chunk in self._contents.chunks)) / S_NS
            self._note(
                f"chunk at byte {offset}: {error or type(error).__name__}; "
                f"{lost_s:.2f} s of messages are lost, from {from_s:.2f} s on"
            )
            return []
        self._declare(contents)
        return [record for record in contents if isinstance(record, McapMessage)]

    def _declare(self, records: Iterable[object]) -> None:
        schemas: dict[int, str] = {}
        for record in records:
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel) and record.id not in self._contents.channels:
                self._contents.channels[record.id] = (record.topic, schemas.get(record.schema_id, ""))

    def _index(self) -> _Contents | None:
        """Read the index at the end of a closed log; None if there is no usable index."""
        self._file.seek(0)
        try:
            reader = SeekingReader(self._file, record_size_limit=MAX_RECORD_BYTES)
            summary = reader.get_summary()
        except _DAMAGE:
            return None
        if summary is None or not summary.chunk_indexes or not summary.channels:
            return None
        if not summary_is_sound(self._file, self._size):
            self._note(f"the index before byte {self._size} is damaged; the log is read without it")
            return None
        contents = _Contents()
        for index in summary.chunk_indexes:
            # A chunk without a message index may hold messages of any channel.
            channels = frozenset(index.message_index_offsets) or None
            contents.chunks.append(
                (index.message_start_time, index.message_end_time, index.chunk_start_offset, channels)
            )
        for channel in summary.channels.values():
            schema = summary.schemas.get(channel.schema_id)
            contents.channels[channel.id] = (channel.topic, schema.name if schema else "")
        try:
            noted = next((note for note in reader.iter_metadata() if note.name == LOG_NOTE), None)
        except _DAMAGE as error:
            self._note(f"the writer's notes about the log are lost ({error or type(error).__name__})")
        else:
            contents.metadata = dict(noted.metadata) if noted else {}
        return contents

    def _scan(self) -> _Contents:
        """Find the chunks of a log by reading through it; damaged parts are skipped."""
        contents = self._contents = _Contents()
        joined = joined_at(self._file, self._size)
        if joined is not None:
            self._note(
                f"another log begins at byte {joined}: its {self._size - joined} bytes are not read; "
                "give the command the files that were joined"
            )
            self._size = joined
        declared: list[object] = []
        for found in walk(self._file, self._size, self._note):
            if isinstance(found, ChunkAt):
                contents.chunks.append(self._span(found))
            elif isinstance(found, McapMessage):
                contents.loose.append(found)
            elif isinstance(found, Metadata):
                self._take_note(found)
            else:
                declared.append(found)
        self._declare(declared)
        return contents

    def _span(self, chunk: ChunkAt) -> tuple[int, int, int, frozenset[int] | None]:
        """Return a chunk's entry by its messages: its head has no checksum, and damaged times would mix the order."""
        try:
            records = read_chunk(self._file, chunk.offset, self._size)
        except _DAMAGE:
            return chunk.start_ns, chunk.end_ns, chunk.offset, None
        self._declare(records)
        messages = [record for record in records if isinstance(record, McapMessage)]
        if not messages:
            return chunk.start_ns, chunk.end_ns, chunk.offset, None
        times_ns = [message.log_time for message in messages]
        return min(times_ns), max(times_ns), chunk.offset, frozenset(message.channel_id for message in messages)

    def _take_note(self, note: Metadata) -> None:
        if note.name == LOG_NOTE:
            self._contents.metadata = dict(note.metadata)
        elif note.name == CHANNEL_NOTE:
            try:
                channel = int(note.metadata["id"])
                self._contents.channels[channel] = (note.metadata["topic"], note.metadata["schema"])
            except (KeyError, ValueError):
                self._note("the note of a channel is malformed")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> DiveLogReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_logs(readers: Iterable[DiveLogReader], wanted: Callable[[str], bool] | None = None) -> Iterator[Record]:
    """Yield the records of several logs, merged by log time."""
    return heapq.merge(*(reader.records(wanted) for reader in readers), key=lambda record: record.log_time_ns)
