"""`buddyline backfill`: the union of a topside recording and the nodes' logs, each message once, by time."""

import pytest
from buddyline.protocol.codec import encode
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.messages import CompressedImage, FoxgloveTime, Mark
from buddyline.protocol.topics import key_of
from buddyline.tools.cli import main
from msgspec.structs import replace

from tests.solver_service.conftest import dive_messages
from tests.tools.evaluated import track

S_NS = 1_000_000_000
LATENCY_NS = 40_000_000


# Of the live solver: on the bus, and in no node's log.
TRACKS = [track(0, stamp_ns=50_000_000 * k, mode=mode) for k in range(20) for mode in ("filter", "lag")]


def image(stamp_ns, data):
    time = FoxgloveTime(sec=stamp_ns // S_NS, nsec=stamp_ns % S_NS)
    return CompressedImage(timestamp=time, frame_id="a_camera", data=data, format="jpeg")


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    """Two nodes' logs, and a topside recording without 2 s of node b, with some of a late, twice, and its own."""
    directory = tmp_path_factory.mktemp("dive")
    messages, _ = dive_messages(seconds=5.0, seed=7, imu=True)
    begin_ns = min(message.stamp_ns for message in messages)
    for node in ("a", "b"):
        with DiveLogWriter(directory / f"{node}.mcap") as writer:
            for message in messages:
                if message.node == node:
                    writer.write_message(message)
            if node == "a":
                writer.write_message(image(begin_ns + S_NS, b"whole picture"))
    with DiveLogWriter(directory / "topside.mcap", metadata={"command": "record"}) as writer:
        for i, message in enumerate(messages):
            passed_ns = message.stamp_ns - begin_ns
            if message.node == "b" and S_NS <= passed_ns < 3 * S_NS:
                continue
            late_ns = 20 * S_NS if message.node == "a" and passed_ns < S_NS // 2 else LATENCY_NS
            for _ in range(2 if i % 50 == 0 else 1):
                writer.write(key_of(message), encode(message), message.stamp_ns + late_ns, message.stamp_ns)
        writer.write_message(image(begin_ns + S_NS, b"preview"), begin_ns + S_NS + LATENCY_NS)
        for row in TRACKS:
            stamp_ns = begin_ns + S_NS + row.stamp_ns
            writer.write_message(replace(row, stamp_ns=stamp_ns), stamp_ns + LATENCY_NS)
        mark = Mark(node="a", stamp_ns=begin_ns + S_NS, name="1")
        writer.write_message(mark, mark.stamp_ns + LATENCY_NS)
    out = directory / "out.mcap"
    words = [str(directory / name) for name in ("topside.mcap", "a.mcap", "b.mcap")]
    assert main(["backfill", *words, "-o", str(out)]) == 0
    return directory, messages, mark


def read(path):
    with DiveLogReader(path) as reader:
        return list(reader.records())


def test_everything_is_there_once_and_in_order(dive):
    directory, messages, mark = dive
    records = read(directory / "out.mcap")
    found = sorted((record.key, record.publish_time_ns) for record in records)
    others = [("buddyline/node/a/image", mark.stamp_ns), (key_of(mark), mark.stamp_ns)]
    others += [(key_of(row), mark.stamp_ns + row.stamp_ns) for row in TRACKS]
    assert found == sorted([*((key_of(m), m.stamp_ns) for m in messages), *others])
    assert {key.rpartition("/")[2] for key, _ in found} >= {"imu", "track", "track_lag"}
    times = [record.log_time_ns for record in records]
    assert times == sorted(times)


def test_the_nodes_own_copy_is_kept_and_differences_are_reported(dive, tmp_path, capsys):
    directory, _, _ = dive
    (picture,) = [record for record in read(directory / "out.mcap") if record.key.endswith("/image")]
    assert picture.open().message.data == b"whole picture"
    again = [str(directory / name) for name in ("out.mcap", "b.mcap", "a.mcap")]
    assert main(["backfill", *again, "-o", str(tmp_path / "again.mcap")]) == 0
    assert len(read(tmp_path / "again.mcap")) == len(read(directory / "out.mcap"))
    assert "differ" not in capsys.readouterr().err
    words = [str(directory / name) for name in ("topside.mcap", "a.mcap")]
    assert main(["backfill", *words, "-o", str(tmp_path / "one.mcap")]) == 0
    assert "image: 1 topside, 1 now, 1 differ" in capsys.readouterr().err


def test_a_backfilled_log_solves_like_the_nodes_own_logs(dive, tmp_path):
    directory, _, _ = dive
    own = [str(directory / name) for name in ("a.mcap", "b.mcap")]
    assert main(["solve", *own, "-o", str(tmp_path / "own.mcap")]) == 0
    assert main(["solve", str(directory / "out.mcap"), "-o", str(tmp_path / "filled.mcap")]) == 0

    def results(path):
        # The live solver's outcomes are only in the topside recording, and are not solved again.
        return [record.payload for record in read(path) if record.key.startswith("buddyline/pair/")]

    assert results(tmp_path / "own.mcap")
    assert results(tmp_path / "filled.mcap") == results(tmp_path / "own.mcap")
