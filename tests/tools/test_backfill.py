"""`buddyline backfill`: the union of a topside recording and the nodes' logs, each message once, by time."""

from contextlib import ExitStack

import pytest
from buddyline.node.sim.dive import messages as simulated
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.codec import encode
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    CompressedImage,
    Depth,
    Expect,
    ExpectedLight,
    FoxgloveTime,
    Mark,
    NodeInfo,
)
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


def test_a_team_is_completed_from_as_many_logs_as_there_are_nodes(tmp_path, capsys):
    """The link of c was out for a second, that of d from a second on; d's log is missing at first."""
    begin_ns = 1_764_000_000 * S_NS
    world = World(Scenario(seed=7, start_ns=begin_ns, more_nodes=("c", "d")))
    told = [message for _, _, message in simulated(world, DivePlan(seconds=3.0))]
    messages = [message for message in told if isinstance(message, NodeInfo | Candidates | Attitude | Depth)]
    out_s = {"c": (1.0, 2.0), "d": (1.0, 9.0)}
    logs = {name: str(tmp_path / f"{name}.mcap") for name in ("topside", "a", "b", "c", "d")}
    with ExitStack() as stack:
        writers = {name: stack.enter_context(DiveLogWriter(path)) for name, path in logs.items()}
        for message in messages:
            writers[message.node].write_message(message)
            from_s, to_s = out_s.get(message.node, (0.0, 0.0))
            if not from_s <= (message.stamp_ns - begin_ns) / S_NS < to_s:
                writers["topside"].write_message(message, message.stamp_ns + LATENCY_NS)
    expected = sorted((key_of(message), message.stamp_ns) for message in messages)
    for brought in (("a", "b", "c"), ("d", "b", "a", "c")):
        out = tmp_path / f"{len(brought)}.mcap"
        assert main(["backfill", logs["topside"], *(logs[node] for node in brought), "-o", str(out)]) == 0
        found = sorted((record.key, record.publish_time_ns) for record in read(out))
        assert found == [
            one for one in expected if len(brought) == 4 or "/d/" not in one[0] or one[1] < begin_ns + S_NS
        ]
    said = capsys.readouterr().err
    frames = sum(isinstance(message, Candidates) and message.node == "d" for message in messages)
    early = sum(isinstance(one, Candidates) and one.node == "d" and one.stamp_ns < begin_ns + S_NS for one in messages)
    assert f"buddyline/node/d/candidates: {early} topside, {frames} now" in said


def test_what_is_expected_of_two_nodes_in_one_picture_is_kept(tmp_path):
    """A sees b and c: the solver says for each where its lamps will be in a's next picture."""
    light = ExpectedLight(
        side="left", u_px=9.0, v_px=9.0, covariance_px2=(1.0, 0.0, 1.0), rate_pxps=(0.0, 0.0), sigma_rate_pxps=1.0
    )
    messages = [
        Expect(node="a", seen=seen, stamp_ns=(10 + k) * S_NS, valid_ns=S_NS, lights=[light])
        for k in range(3)
        for seen in ("b", "c")
    ]
    paths = [tmp_path / f"{name}.mcap" for name in ("topside", "a", "out")]
    for path, kept in zip(paths, (messages, messages[:3]), strict=False):
        with DiveLogWriter(path) as writer:
            for message in kept:
                writer.write_message(message)
    topside, own, out = map(str, paths)
    assert main(["backfill", topside, own, "-o", out]) == 0
    assert [record.open().message for record in read(out)] == messages
