"""Damaged bytes of a file are restored from its parity."""

from __future__ import annotations

import random
from pathlib import Path

import mcap.reader
import pytest
from buddyline.protocol import topics
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.parity import BLOCK_BYTES, GROUP_BYTES, ParityWriter, groups_of, restore

from tests.processes import buddyline

NOW_NS = 1_700_000_000_000_000_000
HOLE_BYTES = 64 * 1024
MESSAGES = 2500


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of two groups, of payloads that cannot be compressed."""
    path, rng = tmp_path_factory.mktemp("log") / "a.mcap", random.Random(3)
    with DiveLogWriter(path, metadata={"node": "a"}) as writer:
        for k in range(MESSAGES):
            stamp_ns = NOW_NS + k * S_NS // 50
            payload = b'{"stamp_ns":%d,"x":"%s"}' % (stamp_ns, rng.randbytes(250).hex().encode())
            writer.write(topics.DEPTH.key("a"), payload, stamp_ns)
    return path


def damaged(log: Path, path: Path, seed: int) -> Path:
    """Return a copy with a hole, or, for odd seeds, 15 flipped bits: more for its length than 100 in ten minutes."""
    data, rng = bytearray(log.read_bytes()), random.Random(seed)
    if seed % 2:
        for bit in rng.sample(range(8 * len(data)), 15):
            data[bit // 8] ^= 1 << bit % 8
    else:
        begin = rng.randrange(len(data) - HOLE_BYTES)
        data[begin : begin + HOLE_BYTES] = bytes(HOLE_BYTES)
    path.write_bytes(data)
    return path


def messages(path: Path) -> list[tuple[int, bytes]]:
    with DiveLogReader(path) as reader:
        return [(record.sequence, record.payload) for record in reader.records()]


@pytest.mark.parametrize("seed", range(12))
def test_a_hole_or_flipped_bits_cost_no_message(log: Path, tmp_path: Path, seed: int) -> None:
    path = damaged(log, tmp_path / "x.mcap", seed)
    patches, lost = restore(path)
    assert lost == 0
    data = bytearray(path.read_bytes())
    for offset, block in patches.items():
        data[offset : offset + len(block)] = block
    path.write_bytes(data)
    with DiveLogReader(path, trust_index=False) as reader:
        assert [record.payload for record in reader.records()] == [payload for _, payload in messages(log)]


def test_repair_restores_even_the_first_bytes(log: Path, tmp_path: Path) -> None:
    data = bytearray(log.read_bytes())
    data[:HOLE_BYTES] = bytes(HOLE_BYTES)
    (tmp_path / "x.mcap").write_bytes(data)
    done = buddyline("repair", str(tmp_path / "x.mcap"), "-o", str(tmp_path / "y.mcap"))
    assert done.returncode == 0, done.stderr
    assert "16 damaged blocks" in done.stderr
    assert "nothing of it is lost" in done.stderr
    assert messages(tmp_path / "y.mcap") == messages(log)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.mcap", "y.mcap"]


def test_more_damage_than_parity_is_counted_and_the_rest_is_read(log: Path, tmp_path: Path) -> None:
    data = bytearray(log.read_bytes())
    data[100_000 : 100_000 + 3 * HOLE_BYTES] = bytes(3 * HOLE_BYTES)
    path = tmp_path / "x.mcap"
    path.write_bytes(data)
    patches, lost = restore(path)
    assert not patches
    assert 47 <= lost <= 49
    done = buddyline("repair", str(path), "-o", str(tmp_path / "y.mcap"))
    assert done.returncode == 1
    assert f"{lost} damaged blocks are more than" in done.stderr
    assert len(messages(tmp_path / "y.mcap")) > MESSAGES / 2


def test_other_programs_read_a_log_with_parity(log: Path) -> None:
    with open(log, "rb") as file:
        assert sum(1 for _ in mcap.reader.make_reader(file).iter_messages()) == MESSAGES
    with open(log, "rb") as file:
        assert sum(1 for _ in mcap.reader.NonSeekingReader(file, validate_crcs=True).iter_messages()) == MESSAGES


def test_a_log_without_parity_or_end_is_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = DiveLogWriter(path, parity=False)
    writer.write(topics.DEPTH.key("a"), b"{}", NOW_NS)
    writer.flush()
    writer.abandon()
    assert restore(path) == ({}, 0)
    assert len(messages(path)) == 1


@pytest.mark.parametrize("length", [BLOCK_BYTES + 1, GROUP_BYTES, 3 * GROUP_BYTES + 17])
def test_every_byte_of_a_file_is_covered(tmp_path: Path, length: int) -> None:
    data, writer, out = random.Random(1).randbytes(length), ParityWriter(), bytearray()
    for begin in range(0, length, 100_000):
        writer.add(data[begin : begin + 100_000])
        out += data[begin : begin + 100_000]
        record = writer.record(last=begin + 100_000 >= length)
        writer.add(record)
        out += record
    path = tmp_path / "x"
    path.write_bytes(out)
    groups = groups_of(path)
    assert all(any(g.begin <= at < g.begin + g.length for g in groups) for at in range(0, len(data), 500))
    whole = bytes(out)
    out[len(data) // 3] ^= 1
    path.write_bytes(out)
    patches, lost = restore(path)
    assert (len(patches), lost) == (1, 0)
    for offset, block in patches.items():
        out[offset : offset + len(block)] = block
    assert bytes(out) == whole
