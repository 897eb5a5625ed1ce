"""Dive logs: written messages are read back in order of time, also from damaged logs."""

import os
import random
import signal
import struct
import subprocess
import sys
import textwrap

import pytest
import zstandard
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter, read_logs
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CompressedImage, Depth, FoxgloveTime
from buddyline.protocol.recorder import Recorder
from mcap.reader import make_reader

TICK_NS = 100_000_000


def depth(tick: int, node: str = "a") -> Depth:
    return Depth(node=node, stamp_ns=tick * TICK_NS, depth_m=float(tick), sigma_m=0.02)


def write(path, ticks, flush_every=10, node="a"):
    with DiveLogWriter(path, metadata={"software": "test"}) as writer:
        for i, tick in enumerate(ticks):
            writer.write_message(depth(tick, node))
            if i % flush_every == flush_every - 1:
                writer.flush()


def ticks_of(reader):
    return [record.open().message.stamp_ns // TICK_NS for record in reader.records()]


def test_a_log_is_readable_here_and_by_the_mcap_library(tmp_path):
    write(tmp_path / "a.mcap", range(100))
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        assert ticks_of(reader) == list(range(100))
        assert (reader.start_ns, reader.end_ns, reader.damage) == (0, 99 * TICK_NS, [])
        assert reader.metadata() == {"software": "test"}
        assert reader.keys == ["buddyline/node/a/depth"]
    with open(tmp_path / "a.mcap", "rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert (schema.name, schema.encoding) == ("buddyline.Depth", "jsonschema")
            assert (channel.message_encoding, message.publish_time) == ("json", message.log_time)


def test_an_existing_log_is_never_overwritten(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"precious")
    with pytest.raises(BuddylineError, match="exists"):
        DiveLogWriter(tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == b"precious"


def test_out_of_order_messages_come_in_order(tmp_path):
    ticks = list(range(200))
    random.Random(1).shuffle(ticks)
    write(tmp_path / "a.mcap", ticks)
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        assert ticks_of(reader) == list(range(200))


def test_several_logs_are_merged_by_time(tmp_path):
    write(tmp_path / "a.mcap", range(0, 100, 2))
    write(tmp_path / "b.mcap", range(1, 100, 2), node="b")
    with DiveLogReader(tmp_path / "a.mcap") as a, DiveLogReader(tmp_path / "b.mcap") as b:
        assert [r.log_time_ns // TICK_NS for r in read_logs([a, b])] == list(range(100))
        assert [r.key for r in read_logs([a, b], lambda key: "/b/" in key)] == ["buddyline/node/b/depth"] * 50


def test_a_log_cut_at_any_byte_loses_only_its_last_chunk(tmp_path):
    write(tmp_path / "a.mcap", range(50), flush_every=5)
    whole = (tmp_path / "a.mcap").read_bytes()
    kept = 0
    for cut in range(1, len(whole), 17):
        (tmp_path / "cut.mcap").write_bytes(whole[:cut])
        try:
            with DiveLogReader(tmp_path / "cut.mcap") as reader:
                found = ticks_of(reader)
                assert reader.damage or cut == len(whole)
        except BuddylineError:
            assert cut < 8
            continue
        assert found == list(range(len(found)))
        assert len(found) % 5 == 0
        assert len(found) >= kept
        kept = len(found)
    assert kept == 50


def test_a_damaged_chunk_is_left_out_and_reported(tmp_path):
    write(tmp_path / "a.mcap", range(50), flush_every=10)
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        offset = sorted(reader._contents.chunks)[1][2]
    data[offset + 60 : offset + 80] = bytes(20)
    (tmp_path / "a.mcap").write_bytes(data)
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        assert ticks_of(reader) == [*range(10), *range(20, 50)]
        assert len(reader.damage) == 1
        assert f"chunk at byte {offset}: " in reader.damage[0]
        assert "; 0.90 s of messages are lost, from 1.00 s on" in reader.damage[0]


def test_a_chunk_whose_head_has_wrong_times_comes_in_order(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, range(50))
    content = bytearray(path.read_bytes())
    with DiveLogReader(path) as reader:
        second = sorted(chunk[2] for chunk in reader._contents.chunks)[1]
    head = slice(second + 9, second + 25)
    assert struct.unpack("<QQ", content[head]) == (10 * TICK_NS, 19 * TICK_NS)
    content[head] = struct.pack("<QQ", 35 * TICK_NS, 2**63)
    path.write_bytes(content)
    with DiveLogReader(path, trust_index=False) as reader:
        assert (reader.start_ns, reader.end_ns) == (0, 49 * TICK_NS)
        assert ticks_of(reader) == list(range(50))
        assert [record.log_time_ns // TICK_NS for record in reader.records(since_ns=15 * TICK_NS)] == list(
            range(15, 50)
        )


@pytest.mark.parametrize("megabytes", [60, 200])
def test_a_chunk_that_unpacks_to_nothing_but_zeros_is_refused_at_once(tmp_path, megabytes):
    """A zstd bomb: some kilobytes that would unpack to millions of records."""
    write(tmp_path / "a.mcap", range(50), flush_every=10)
    zeros = bytes(megabytes * 1024 * 1024)
    packed = zstandard.compress(zeros)
    content = struct.pack("<QQQII", 0, 10**9, len(zeros), 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    data = (tmp_path / "a.mcap").read_bytes()
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        offset = sorted(reader._contents.chunks)[1][2]
    bomb = struct.pack("<BQ", 6, len(content)) + content
    (tmp_path / "b.mcap").write_bytes(data[:offset] + bomb + data[offset:])
    with DiveLogReader(tmp_path / "b.mcap", trust_index=False) as reader:
        assert ticks_of(reader) == [*range(50)]
        assert str(offset) in reader.damage[0]


def test_chunks_are_cut_by_the_second_of_log_time(tmp_path):
    ticks = [*range(150), 40, *range(150, 200)]  # and one that comes late
    write(tmp_path / "a.mcap", ticks, flush_every=10_000)
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        chunks = sorted(reader._contents.chunks)
        assert len(chunks) == 20
        whole = (tmp_path / "a.mcap").read_bytes()
        # Any flipped bit in a chunk loses that second, and the loss is reported.
        for _, _, offset, _ in chunks:
            data = bytearray(whole)
            data[offset + 80] ^= 1
            (tmp_path / "b.mcap").write_bytes(data)
            with DiveLogReader(tmp_path / "b.mcap") as damaged:
                assert len(ticks) - len(ticks_of(damaged)) in (10, 11)
                assert damaged.damage


def test_a_log_is_readable_before_its_first_message(tmp_path):
    writer = DiveLogWriter(tmp_path / "a.mcap", metadata={"node": "a"})
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "a.mcap").read_bytes())
    writer.close()
    with DiveLogReader(tmp_path / "cut.mcap") as reader:
        assert (reader.metadata(), reader.start_ns, reader.keys) == ({"node": "a"}, None, [])
        assert "without having been closed" in reader.damage[0]


def test_a_damaged_index_hides_no_chunk(tmp_path):
    write(tmp_path / "a.mcap", range(50))
    whole = (tmp_path / "a.mcap").read_bytes()
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        after = max(offset for _, _, offset, _ in reader._contents.chunks) + 400
    for at in range(after, len(whole) - 8, 11):
        data = bytearray(whole)
        data[at] ^= 0xFF
        (tmp_path / "b.mcap").write_bytes(data)
        with DiveLogReader(tmp_path / "b.mcap") as damaged:
            assert ticks_of(damaged) == list(range(50))


@pytest.mark.parametrize("cut", ["nowhere", "in its end", "in its index", "in a chunk"])
def test_of_two_logs_in_one_file_the_first_is_read_and_the_second_named(tmp_path, cut):
    write(tmp_path / "a.mcap", range(50))
    write(tmp_path / "b.mcap", range(100, 300), node="b")
    first, second = (tmp_path / "a.mcap").read_bytes(), (tmp_path / "b.mcap").read_bytes()
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        last_chunk = max(offset for _, _, offset, _ in reader._contents.chunks)
    size = {
        "nowhere": len(first),
        "in its end": len(first) - 3,
        "in its index": len(first) - 200,
        "in a chunk": last_chunk + 90,
    }[cut]
    (tmp_path / "both.mcap").write_bytes(first[:size] + second)
    for trust_index in (True, False):
        with DiveLogReader(tmp_path / "both.mcap", trust_index=trust_index) as reader:
            found = [record.open().message for record in reader.records()]
            assert found == [depth(tick) for tick in range(40 if cut == "in a chunk" else 50)]
            (said,) = [line for line in reader.damage if "another log" in line]
            assert f"begins at byte {size}: its {len(second)} bytes are not read" in said
            assert len(reader.damage) == (1 if cut == "nowhere" else 2)


def test_bytes_after_the_end_of_a_log_are_named(tmp_path):
    write(tmp_path / "a.mcap", range(50))
    size = (tmp_path / "a.mcap").stat().st_size
    with open(tmp_path / "a.mcap", "ab") as file:
        file.write(random.Random(4).randbytes(1000))
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        assert ticks_of(reader) == list(range(50))
        assert reader.damage == [f"the 1000 bytes after the log's end at byte {size} are not read"]


def test_a_chunk_whose_kind_became_that_of_the_end_costs_only_itself(tmp_path):
    write(tmp_path / "a.mcap", range(50))
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        offset = sorted(reader._contents.chunks)[1][2]
    # The kind of a log's last record.
    data[offset] = 2
    (tmp_path / "a.mcap").write_bytes(data)
    with DiveLogReader(tmp_path / "a.mcap", trust_index=False) as reader:
        assert ticks_of(reader) == [*range(10), *range(20, 50)]
        assert reader.damage


@pytest.mark.parametrize(
    ("content", "says"), [(b"", "is empty"), (b"just some text\n", "not a dive log"), (None, "cannot be read")]
)
def test_a_file_that_is_no_log_is_refused(tmp_path, content, says):
    if content is not None:
        (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(BuddylineError, match=says) as refused:
        DiveLogReader(tmp_path / "x.mcap")
    assert "x.mcap" in str(refused.value)


def test_a_killed_recorder_loses_at_most_two_seconds(tmp_path):
    program = textwrap.dedent(
        """
        import sys, time
        from buddyline.protocol.recorder import Recorder
        recorder = Recorder(sys.argv[1])
        for i in range(10_000):
            stamp = time.time_ns()
            payload = b'{"node":"a","stamp_ns":%d,"depth_m":1.0,"sigma_m":0.02}' % stamp
            recorder.write("buddyline/node/a/depth", payload, stamp)
            print(stamp, flush=True)
            time.sleep(0.02)
        """
    )
    path = tmp_path / "killed.mcap"
    child = subprocess.Popen([sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, text=True)
    stamps = [int(child.stdout.readline()) for _ in range(150)]
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    child.stdout.close()
    with DiveLogReader(path) as reader:
        found = [record.publish_time_ns for record in reader.records()]
    assert found == stamps[: len(found)]
    assert stamps[-1] - found[-1] <= 2_000_000_000


def test_the_recorder_writes_everything_and_names_the_file_that_failed(tmp_path):
    with Recorder(tmp_path / "a.mcap") as recorder:
        for second in range(1000):
            message = depth(second)
            recorder.write("buddyline/node/a/depth", b'{"stamp_ns":%d}' % message.stamp_ns, message.stamp_ns)
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        assert len(list(reader.records())) == 1000
    assert (recorder.written, recorder.dropped) == (1000, 0)


def test_the_recorder_drops_pictures_before_candidates(tmp_path, monkeypatch):
    monkeypatch.setattr("buddyline.protocol.recorder.MAX_QUEUED_BYTES", 1000)
    # The writing thread cannot take anything meanwhile.
    with Recorder(tmp_path / "a.mcap") as recorder, recorder._ready:
        for i in range(8):
            recorder.write("buddyline/node/a/image", bytes(200), i)
            recorder.write("buddyline/node/a/depth", b'{"stamp_ns":%d}' % i, i)
        assert len(recorder._messages) == 8
        assert len(recorder._pictures) == 4
    assert recorder.dropped == 4


def test_an_image_stamp_is_its_publish_time(tmp_path):
    image = CompressedImage(timestamp=FoxgloveTime(sec=3, nsec=4), frame_id="a_camera", data=b"x", format="jpeg")
    with DiveLogWriter(tmp_path / "a.mcap") as writer:
        writer.write_message(image)
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        (record,) = reader.records()
        assert record.publish_time_ns == 3_000_000_004
        assert record.open().message == image


def test_a_folder_in_place_of_a_log_says_what_to_name(tmp_path):
    with pytest.raises(BuddylineError, match=r"is a folder; name the logs in it: .*\*\.mcap"):
        DiveLogReader(tmp_path)


def test_a_pipe_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(BuddylineError, match=r"pipe: is a pipe or a device, .* copy it into a file"):
        DiveLogReader(tmp_path / "pipe")
