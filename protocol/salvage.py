"""Read an MCAP file record by record; skip damaged parts, and stop at its end or where it is cut off.

After a malformed record, the next chunk (or channel note) is searched byte by byte. It is recognized by its first bytes
and by consistent lengths, which other data has only by rare chance. Checksums of chunks are checked when chunks are
read.
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import IO, Final, TypeAlias

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import get_chunk_data_stream

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES: Final = 256 * 1024 * 1024
# Unpacked. Writers cut chunks at one to four megabytes, which a picture may exceed. 60 kB of zeros, packed, may unpack
# to any size: without a limit they cost minutes and gigabytes.
MAX_CHUNK_BYTES: Final = 64 * 1024 * 1024
CHANNEL_NOTE: Final = "buddyline.channel"

# Records of kinds from here on are for anybody's own use (MCAP specification, Opcodes).
PRIVATE_OPCODE: Final = 0x80

_HEAD_BYTES: Final = 9
_CHUNK_HEAD: Final = struct.Struct("<QQQII")  # start, end, uncompressed size, its checksum, length of the compression
_FOOTER: Final = struct.Struct("<BQQQI")  # kind, length, where the summary and its offsets begin, its checksum
_COMPRESSIONS: Final = (b"zstd", b"lz4", b"")
_RESUME: Final = re.compile(
    rb"\x06.{8}.{28}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0)"
    rb"|\x0c.{8}" + struct.pack("<I", len(CHANNEL_NOTE)) + re.escape(CHANNEL_NOTE.encode()),
    re.DOTALL,
)
_RECORD_HEAD: Final = struct.Struct("<BQ")  # kind, length
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")  # channel, sequence, log and publish time
_KNOWN: Final = frozenset(Opcode)
_MALFORMED: Final = (McapError, struct.error, ValueError, EOFError, MemoryError, RuntimeError)


@dataclass(frozen=True, slots=True)
class ChunkAt:
    """A chunk that begins at byte `offset`. start_ns, end_ns: first and last log time of its messages."""

    offset: int
    start_ns: int
    end_ns: int


Found: TypeAlias = ChunkAt | McapMessage | Schema | Channel | Metadata


class MalformedError(ValueError):
    """Bytes that are not a valid record."""


def walk(file: IO[bytes], size: int, note: Callable[[str], None]) -> Iterator[Found]:
    """Yield the records of an MCAP file of `size` bytes. note: is called with a line for each skipped part."""
    offset = suspect = len(MAGIC)
    while offset < size:
        try:
            end, found, last = record_at(file, offset, size)
        except MalformedError as error:
            resumed = _resume(file, suspect, offset, size)
            if resumed is None:
                note(f"breaks off at byte {offset} of {size} ({error})")
                return
            note(f"bytes {offset} to {resumed} are damaged and skipped ({error})")
            offset = suspect = resumed
            continue
        if found is not None:
            yield found
        # A damaged length may have skipped valid chunks: the search begins after the last valid chunk.
        if isinstance(found, ChunkAt):
            suspect = end
        offset = end
        if last:
            file.seek(offset)
            if file.read(len(MAGIC)) != MAGIC:
                note(f"ends at byte {size} without having been closed")
            elif file.tell() < size:
                note(f"the {size - file.tell()} bytes after the log's end at byte {file.tell()} are not read")
            return
    note(f"ends at byte {size} without having been closed")


def joined_at(file: IO[bytes], size: int) -> int | None:
    """Return the byte at which another log begins that was joined to the first one; None if there is none.

    No record of ours has a log's first bytes in it (see protocol.parity for those that are nearly copies).
    """
    with mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) as data:
        found = data.find(MAGIC + bytes([Opcode.HEADER]), len(MAGIC))
    return None if found < 0 else found


def record_at(file: IO[bytes], offset: int, size: int) -> tuple[int, Found | None, bool]:
    """Return the record's end, its content (None for kinds that no reader uses), and whether it is the last one."""
    file.seek(offset)
    head = file.read(_HEAD_BYTES)
    if len(head) < _HEAD_BYTES:
        raise MalformedError("ends within a record's head")
    opcode, length = head[0], int.from_bytes(head[1:], "little")
    end = offset + _HEAD_BYTES + length
    if opcode not in _KNOWN and opcode < PRIVATE_OPCODE:
        raise MalformedError(f"no record is of kind {opcode}")
    if end > size:
        raise MalformedError("ends within a record")
    if length > MAX_RECORD_BYTES:
        raise MalformedError(f"a record of {length} bytes")
    if opcode == Opcode.FOOTER and length != _FOOTER.size - _HEAD_BYTES:
        raise MalformedError(f"a footer of {length} bytes")
    if opcode == Opcode.CHUNK:
        return end, _chunk_at(file, offset, length), False
    if opcode not in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
        return end, None, opcode == Opcode.FOOTER
    content = ReadDataStream(BytesIO(file.read(length)))
    try:
        if opcode == Opcode.MESSAGE:
            found: Found = McapMessage.read(content, length)
        elif opcode == Opcode.SCHEMA:
            found = Schema.read(content)
        elif opcode == Opcode.CHANNEL:
            found = Channel.read(content)
        else:
            found = Metadata.read(content)
    except _MALFORMED as error:
        raise MalformedError(f"a malformed record: {error or type(error).__name__}") from error
    return end, found, False


def read_chunk(file: IO[bytes], offset: int, size: int) -> list[McapMessage | Schema | Channel]:
    """Return the records of the chunk at offset; raise MalformedError, or its compression's or checksum's error."""
    end, found, _ = record_at(file, offset, size)
    if not isinstance(found, ChunkAt):
        raise MalformedError("no chunk where the index says")
    file.seek(offset + _HEAD_BYTES)
    chunk = Chunk.read(ReadDataStream(BytesIO(file.read(end - offset - _HEAD_BYTES))))
    # The decompressor allocates the size that the frame claims.
    if chunk.compression == "zstd" and zstandard.frame_content_size(chunk.data) > MAX_CHUNK_BYTES:
        raise MalformedError("a chunk too big to unpack")
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    return list(_records_in(stream.read(length)))


def _records_in(content: bytes) -> Iterator[McapMessage | Schema | Channel]:
    """Yield the records of an unpacked chunk. A message's head is unpacked in one call, because there are thousands."""
    at = 0
    while at < len(content):
        opcode, length = _RECORD_HEAD.unpack_from(content, at)
        at += _RECORD_HEAD.size
        if at + length > len(content):
            raise MalformedError("a record that ends after its chunk's end")
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_ns, publish_ns = _MESSAGE_HEAD.unpack_from(content, at)
            payload = content[at + _MESSAGE_HEAD.size : at + length]
            yield McapMessage(channel, log_ns, payload, publish_ns, sequence)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(BytesIO(content[at : at + length])))
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(ReadDataStream(BytesIO(content[at : at + length])))
        elif opcode < PRIVATE_OPCODE:
            raise MalformedError(f"a record of kind {opcode} in a chunk")
        at += length


def summary_is_sound(file: IO[bytes], size: int) -> bool:
    """Return whether the index at the end of a closed log matches its checksum; True if there is no checksum."""
    file.seek(size - len(MAGIC) - _FOOTER.size)
    _, _, start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
    if checksum == 0:
        return True
    file.seek(start)
    return bool(zlib.crc32(file.read(size - len(MAGIC) - 4 - start)) == checksum)


def _chunk_at(file: IO[bytes], offset: int, length: int) -> ChunkAt:
    head = file.read(_CHUNK_HEAD.size)
    if len(head) < _CHUNK_HEAD.size:
        raise MalformedError("ends within a chunk's head")
    start_ns, end_ns, uncompressed, _, name_bytes = _CHUNK_HEAD.unpack(head)
    name = file.read(name_bytes) if name_bytes <= max(map(len, _COMPRESSIONS)) else None
    data_bytes = int.from_bytes(file.read(8), "little")
    if name not in _COMPRESSIONS or _CHUNK_HEAD.size + name_bytes + 8 + data_bytes != length:
        raise MalformedError("a chunk whose lengths do not agree")
    if uncompressed > MAX_CHUNK_BYTES:
        raise MalformedError(f"a chunk of {uncompressed} bytes unpacked, at most {MAX_CHUNK_BYTES} are read")
    return ChunkAt(offset, start_ns, end_ns)


def _resume(file: IO[bytes], begin: int, damaged: int, size: int) -> int | None:
    """Return the offset of the next valid chunk or channel note, from `begin` on and not at `damaged`; None if none."""
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = begin
        while (match := _RESUME.search(data, at)) is not None:
            offset = match.start()
            del match
            try:
                _, found, _ = record_at(file, offset, size)
            except MalformedError:
                pass
            else:
                if offset > damaged or not isinstance(found, Metadata):
                    return offset
            at = offset + 1
    return None
