"""`buddyline repair`: what can be read is whole and indexed afterwards, and what is lost is said in numbers."""

import random

import numpy as np
import pytest
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.messages import Depth
from buddyline.tools.cli import main
from buddyline.tools.repair import missing
from mcap.reader import make_reader

TICK_NS = 100_000_000
COUNT, EVERY = 100, 10


@pytest.fixture
def log(tmp_path):
    """A closed log of 100 messages in chunks of ten, and where its chunks begin."""
    path = tmp_path / "in.mcap"
    with DiveLogWriter(path, metadata={"software": "test"}, parity=False) as writer:
        for i in range(COUNT):
            message = Depth(node="ab"[i % 2], stamp_ns=i * TICK_NS, depth_m=float(i), sigma_m=0.02)
            writer.write_message(message)
            if i % EVERY == EVERY - 1:
                writer.flush()
    with DiveLogReader(path) as reader:
        return path, sorted(chunk[2] for chunk in reader._contents.chunks)


def repaired(path, capsys, status=1):
    """Repair it, with this exit status; return the numbers of the messages in the result, and what was said."""
    out = path.with_name("out.mcap")
    assert main(["repair", str(path), "-o", str(out)]) == status
    with open(out, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        found = [message.log_time // TICK_NS for _, _, message in reader.iter_messages()]
        assert summary.statistics.message_count == len(found)
        assert summary.chunk_indexes or not found
    with DiveLogReader(out) as reader:
        assert reader.damage == []
        assert reader.metadata()["repaired_from"] == path.name
        assert [record.open().message.stamp_ns // TICK_NS for record in reader.records()] == found
    return found, capsys.readouterr().err


def test_an_unclosed_log_is_repaired(log, capsys):
    path, chunks = log
    path.write_bytes(path.read_bytes()[: chunks[7] + 40])
    found, said = repaired(path, capsys)
    assert found == list(range(70))
    assert "breaks off" in said


@pytest.mark.parametrize("shift", [0, 13, -13], ids=["overwritten", "bytes added", "bytes missing"])
def test_garbage_in_the_middle_is_skipped(log, capsys, shift):
    path, chunks = log
    data = path.read_bytes()
    begin, end = chunks[3] - 20, chunks[5] + 30
    garbage = random.Random(3).randbytes(end - begin + shift)
    path.write_bytes(data[:begin] + garbage + data[end:])
    found, said = repaired(path, capsys)
    assert found == [*range(30), *range(60, 100)]
    assert "30 messages are lost between 1970-01-01 00:00:02.900 UTC and 1970-01-01 00:00:06.000 UTC" in said
    assert "skipped" in said


def test_a_wrong_length_costs_only_its_own_chunk(log, capsys):
    path, chunks = log
    data = bytearray(path.read_bytes())
    # Far enough to skip two whole chunks, and end in the middle of a third.
    data[chunks[2] + 1 : chunks[2] + 9] = (chunks[5] - chunks[2] + 5).to_bytes(8, "little")
    path.write_bytes(data)
    found, said = repaired(path, capsys)
    assert found == [*range(20), *range(30, 100)]
    assert "10 messages are lost" in said


def test_a_chunk_with_a_wrong_checksum_is_left_out(log, capsys):
    path, chunks = log
    data = bytearray(path.read_bytes())
    data[chunks[4] + 70] ^= 0xFF
    path.write_bytes(data)
    found, said = repaired(path, capsys)
    assert found == [*range(40), *range(50, 100)]
    assert f"chunk at byte {chunks[4]}" in said


def test_a_log_with_a_destroyed_beginning_is_repaired(log, capsys):
    path, chunks = log
    data = bytearray(path.read_bytes())
    data[8 : chunks[1]] = bytes(chunks[1] - 8)
    path.write_bytes(data)
    found, said = repaired(path, capsys)
    # The second chunk is found; its channels are named by the index at the end.
    assert found == list(range(10, 100))
    assert "10 messages are lost before" in said


def test_a_complete_log_loses_nothing_and_is_reported_as_complete(log, capsys):
    path, _ = log
    found, said = repaired(path, capsys, status=0)
    assert found == list(range(COUNT))
    assert "it was whole" in said


def test_nothing_is_overwritten(log, capsys):
    path, _ = log
    path.with_name("out.mcap").write_bytes(b"precious")
    assert main(["repair", str(path), "-o", str(path.with_name("out.mcap"))]) == 2
    assert main(["repair", str(path), "-o", str(path)]) == 2
    assert path.with_name("out.mcap").read_bytes() == b"precious"


def test_what_can_be_read_of_a_log_cut_at_any_byte_can_be_repaired(log, tmp_path):
    path, _ = log
    whole = path.read_bytes()
    kept = 0
    for cut in range(8, len(whole), 101):
        cut_path = tmp_path / f"{cut}.mcap"
        cut_path.write_bytes(whole[:cut])
        with DiveLogReader(cut_path, trust_index=False) as reader:
            found = [record.log_time_ns // TICK_NS for record in reader.records()]
            assert reader.damage
        assert found == list(range(len(found)))
        assert kept <= len(found) <= kept + EVERY
        kept = len(found)
    assert kept == COUNT


def test_missing_sequence_numbers_are_not_interpreted():
    assert missing(np.zeros(5, np.int64), np.arange(5)) == []
    assert missing(np.empty(0, np.int64), np.empty(0, np.int64)) == []
    assert missing(np.arange(5)[::-1].copy(), np.arange(5)) == []


def test_files_that_cannot_be_read_or_written_are_one_line(tmp_path, capsys, monkeypatch):
    path = tmp_path / "in.mcap"
    with DiveLogWriter(path) as writer:
        for i in range(COUNT):
            writer.write_message(Depth(node="a", stamp_ns=i * TICK_NS, depth_m=float(i), sigma_m=0.02))
    data = bytearray(path.read_bytes())
    data[len(data) // 4] ^= 255
    path.write_bytes(data)
    assert main(["repair", str(path), "-o", str(tmp_path / "none" / "out.mcap")]) == 2
    assert capsys.readouterr().err.endswith("out.mcap: cannot be written: No such file or directory\n")

    def refuse(path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("buddyline.tools.repair.restore", refuse)
    assert main(["repair", str(path), "-o", str(tmp_path / "out.mcap")]) == 2
    assert capsys.readouterr().err == f"buddyline repair: {path}: cannot be read: Permission denied\n"
