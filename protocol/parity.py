"""Parity for a file that grows: what is damaged of it can be computed from the rest (Reed-Solomon over its bytes).

The file is covered in groups of up to 180 blocks; after each group goes a record with 10 % of parity blocks and the
checksums of all blocks, which say where the damage is. As many damaged blocks of a group, whichever, can be restored as
there are sound parity blocks. Bytes that were inserted or removed are not found.

A systematic code with a Cauchy matrix over GF(256): J. Bloemer et al., "An XOR-based erasure-resilient coding scheme",
1995.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

BLOCK_BYTES: Final = 4096
MOST_BLOCKS: Final = 180
GROUP_BYTES: Final = BLOCK_BYTES * MOST_BLOCKS
PARITY_SHARE: Final = 0.1
# A hole of 64 kB touches 17 blocks.
LEAST: Final = 18
# A private MCAP record, which other readers skip.
PARITY_OPCODE: Final = 0x90

_MARK: Final = b"\x89BLPARITY"
_HEAD: Final = struct.Struct("<9sQQIHHQ")  # mark, begin, length, block size, blocks, parity blocks, where these begin
_RECORD: Final = struct.Struct("<BQ")

Bytes = NDArray[np.uint8]


def _tables() -> tuple[Bytes, Bytes]:
    """Return GF(256)'s products (256, 256), by the polynomial 0x11d, and inverses (256,)."""
    powers, logs = np.zeros(510, np.int64), np.zeros(256, np.int64)
    value = 1
    for i in range(255):
        powers[i] = powers[i + 255] = value
        logs[value] = i
        value = value << 1 ^ (0x11D if value & 0x80 else 0)
    products = powers[logs[:, None] + logs[None, :]].astype(np.uint8)
    products[0, :] = products[:, 0] = 0
    inverses = powers[255 - logs].astype(np.uint8)
    return products, inverses


_PRODUCT, _INVERSE = _tables()


def _coefficients(parity: int, blocks: int) -> Bytes:
    """Return the Cauchy matrix (parity, blocks): each of its square parts can be inverted.

    No coefficient is 1: the parity of a single block would be a copy, and a search for chunks would find it.
    """
    coefficients: Bytes = _INVERSE[np.arange(parity)[:, None] ^ (255 - np.arange(blocks))[None, :]]
    return coefficients


@dataclass(frozen=True)
class Group:
    """What a parity record says. sums: CRC-32 of the blocks, then of the parity blocks, which begin at parity_at."""

    begin: int
    length: int
    block_bytes: int
    parity_at: int
    blocks: int
    parity: int
    sums: tuple[int, ...]

    def description(self) -> bytes:
        """Return it as bytes, with a checksum."""
        head = _HEAD.pack(
            _MARK, self.begin, self.length, self.block_bytes, self.blocks, self.parity, self.parity_at
        ) + struct.pack(f"<{len(self.sums)}I", *self.sums)
        return head + struct.pack("<I", zlib.crc32(head))


class ParityWriter:
    """Collects what is written to a file, and makes the records of parity for it."""

    def __init__(self) -> None:
        self._tail = bytearray()
        self._uncovered = 0
        self._written = 0

    def add(self, data: bytes) -> None:
        """Take bytes that were appended to the file."""
        self._tail += data
        self._uncovered += len(data)
        self._written += len(data)
        surplus = len(self._tail) - max(self._uncovered, GROUP_BYTES)
        if surplus > GROUP_BYTES:
            del self._tail[:surplus]

    def record(self, *, last: bool = False) -> bytes:
        """Return the record to append now; empty if the group is not complete.

        last: end the file's last group, which also covers the bytes before it, so that it is not a short one.
        """
        if not self._uncovered or (self._uncovered < GROUP_BYTES and not last):
            return b""
        length = max(self._uncovered, min(len(self._tail), GROUP_BYTES))
        self._uncovered = 0
        return parity_record(bytes(self._tail[-length:]), self._written)


def parity_record(data: bytes, end: int) -> bytes:
    """Return the record with the parity of the last bytes of a file, which ends at byte `end`."""
    block_bytes = max(BLOCK_BYTES, -(-len(data) // MOST_BLOCKS))
    blocks = _blocks(data, block_bytes)
    count = max(round(len(blocks) * PARITY_SHARE), min(len(blocks), LEAST))
    parity = _combine(_coefficients(count, len(blocks)), blocks)
    sums = tuple(zlib.crc32(block.tobytes()) for block in (*blocks, *parity))
    described_bytes = _HEAD.size + 4 * len(sums) + 4
    at = end + _RECORD.size + described_bytes
    group = Group(end - len(data), len(data), block_bytes, at, len(blocks), count, sums)
    # The description is there twice, far from each other.
    content = group.description() + parity.tobytes() + group.description()
    return _RECORD.pack(PARITY_OPCODE, len(content)) + content


def _blocks(data: bytes, block_bytes: int) -> Bytes:
    """Return the blocks (n, block_bytes); the last is filled up with zeros."""
    count = -(-len(data) // block_bytes)
    return np.frombuffer(data.ljust(count * block_bytes, b"\0"), np.uint8).reshape(count, block_bytes)


def _combine(coefficients: Bytes, blocks: Bytes) -> Bytes:
    """Return the product of a matrix (m, n) with blocks (n, block size)."""
    out = np.zeros((len(coefficients), blocks.shape[1]), np.uint8)
    for column, block in zip(coefficients.T, blocks, strict=True):
        content = block.tobytes()
        for row, factor in enumerate(column):
            # A table look-up of bytes: four times as fast as numpy's.
            out[row] ^= np.frombuffer(content.translate(_PRODUCT[factor].data), np.uint8)
    return out


def groups_of(path: Path) -> list[Group]:
    """Return what the parity records of a file say, damaged ones too if one of their two descriptions is sound."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return sorted(set(_described(data)), key=lambda group: group.begin)


def _described(data: mmap.mmap) -> Iterator[Group]:
    at = data.find(_MARK)
    while at >= 0:
        if at + _HEAD.size <= len(data):
            _, begin, length, block_bytes, blocks, parity, parity_at = _HEAD.unpack_from(data, at)
            end = at + _HEAD.size + 4 * (blocks + parity)
            if blocks + parity <= 256 and block_bytes and -(-length // block_bytes) == blocks and end + 4 <= len(data):
                sums = struct.unpack_from(f"<{blocks + parity}I", data, at + _HEAD.size)
                if zlib.crc32(data[at:end]) == struct.unpack_from("<I", data, end)[0]:
                    yield Group(begin, length, block_bytes, parity_at, blocks, parity, sums)
        at = data.find(_MARK, at + 1)


def restore(path: Path) -> tuple[dict[int, bytes], int]:
    """Return what a file's damaged blocks should be, by offset, and the number of those that cannot be restored."""
    patches: dict[int, bytes] = {}
    lost = 0
    with open(path, "rb") as file:
        for group in groups_of(path):
            file.seek(group.begin)
            blocks = _blocks(file.read(group.length).ljust(group.length, b"\0"), group.block_bytes).copy()
            bad = [i for i in range(group.blocks) if zlib.crc32(blocks[i].tobytes()) != group.sums[i]]
            if not bad:
                continue
            file.seek(group.parity_at)
            size = group.parity * group.block_bytes
            parity = _blocks(file.read(size).ljust(size, b"\0"), group.block_bytes)
            sums = group.sums[group.blocks :]
            sound = [j for j in range(group.parity) if zlib.crc32(parity[j].tobytes()) == sums[j]]
            if len(sound) < len(bad):
                lost += len(bad)
                continue
            rows = sound[: len(bad)]
            blocks[bad] = 0
            matrix = _coefficients(group.parity, group.blocks)[rows]
            found = _solve(matrix[:, bad], parity[rows] ^ _combine(matrix, blocks))
            for i, block in zip(bad, found, strict=True):
                begin = i * group.block_bytes
                patches[group.begin + begin] = block.tobytes()[: group.length - begin]
    return patches, lost


def _solve(matrix: Bytes, right: Bytes) -> Bytes:
    """Solve matrix (n, n) @ x = right (n, block size) by elimination."""
    matrix, right = matrix.copy(), right.copy()
    for i in range(len(matrix)):
        pivot = i + int(np.argmax(matrix[i:, i] != 0))
        matrix[[i, pivot]], right[[i, pivot]] = matrix[[pivot, i]], right[[pivot, i]]
        inverse = _INVERSE[matrix[i, i]]
        matrix[i], right[i] = _PRODUCT[inverse][matrix[i]], _PRODUCT[inverse][right[i]]
        for j in range(len(matrix)):
            factor = matrix[j, i]
            if j != i and factor:
                matrix[j] ^= _PRODUCT[factor][matrix[i]]
                right[j] ^= _PRODUCT[factor][right[i]]
    return right
