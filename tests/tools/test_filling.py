"""What a recording lacks comes from the node's own log, over the bus, while the node still writes it."""

from __future__ import annotations

import math
import random
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from buddyline.node.log_desk import LogDesk
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import encode
from buddyline.protocol.digest_check import Discrepancy
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.errors import MessageError
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.log_pages import MOST_NS, PAGE_BYTES, LogAnswer, Logged, Question, answer_of, pages_of
from buddyline.protocol.messages import Depth
from buddyline.protocol.recorder import Recorder
from buddyline.protocol.topics import LOG, key_of
from buddyline.tools.authenticity import check_logs
from buddyline.tools.filling import MAX_GAPS, MOST_MISSING_NS, WRITTEN_NS, Filler
from buddyline.tools.record import Recording

from tests.processes import PATIENCE_S, until
from tests.protocol.test_digest import BEGAN_NS, Line, written

LATER_NS = 50_000
EVERYTHING = Question("x", BEGAN_NS - 1, BEGAN_NS + 60_000_000_000, ("depth", "attitude", "digest", "info"))


def own_log(folder: Path, boot: str = "x") -> tuple[DiveLogWriter, list[Line]]:
    writer = DiveLogWriter(folder / f"a-20260101T000000Z-{boot}.mcap", metadata={"node": "a", "boot": boot})
    # A digest is written a moment after its stamp.
    lines = [
        (key, payload, time_ns + (LATER_NS if key.endswith("/digest") else 0))
        for key, payload, time_ns in written("a", None, boot, ended=False)
    ]
    for key, payload, time_ns in lines:
        writer.write(key, payload, time_ns)
    writer.flush(sync=True)
    return writer, lines


def test_a_log_that_is_being_written_is_handed_out(tmp_path: Path) -> None:
    writer, lines = own_log(tmp_path)
    desk = LogDesk(tmp_path, "a")
    found = answer_of(list(desk.answer(EVERYTHING.text())))
    assert found.is_whole
    assert [(one.key, one.payload, one.time_ns) for one in found.messages] == lines
    writer.write(lines[-1][0], lines[-1][1], lines[-1][2] + 1)
    writer.close()
    again = answer_of(list(desk.answer(EVERYTHING.text())))
    assert len(again.messages) == len(lines) + 1
    second = Question("x", lines[10][2], lines[20][2], ("depth",))
    of_second = answer_of(list(desk.answer(second.text())))
    assert {one.key for one in of_second.messages} == {"buddyline/node/a/depth"}


@pytest.mark.parametrize(
    "text", ["", "boot=../../etc;since=1;until=2;topics=depth", "boot=*;since=1;until=2;topics=depth", "boot=y", "\0"]
)
def test_other_questions_have_no_answer(tmp_path: Path, text: str) -> None:
    own_log(tmp_path)[0].close()
    assert list(LogDesk(tmp_path, "a").answer(text)) == []
    assert answer_of([]) == LogAnswer([], is_whole=False)


def test_an_answer_that_lacks_a_page_is_read_up_to_it() -> None:
    rng = random.Random(1)
    messages = [Logged(k, "buddyline/node/a/depth", rng.randbytes(1000)) for k in range(100)]
    pages = list(pages_of(iter(messages)))
    assert len(pages) >= 100 * 1000 // PAGE_BYTES
    assert answer_of(pages) == LogAnswer(messages, is_whole=True)
    for k in range(len(pages)):
        begun = answer_of(pages[:k] + pages[k + 1 :])
        assert not begun.is_whole
        assert begun.messages == messages[: len(begun.messages)]
        assert bool(begun.messages) == bool(k)
    for broken in (b"", b"x" * 100, pages[0][:-1], pages[0].replace(pages[0][8:12], b"abcd")):
        with pytest.raises(MessageError):
            answer_of([broken])


@pytest.mark.parametrize("lost", ["some messages", "whole seconds", "all but the ends", "the first digests"])
def test_a_recording_is_filled(tmp_path: Path, lost: str) -> None:
    writer, lines = own_log(tmp_path)
    rng = random.Random(3)
    gone = {
        "some messages": {i for i in range(1, len(lines)) if rng.random() < 0.3 and "digest" not in lines[i][0]},
        "whole seconds": set(range(10, 28)),
        "all but the ends": set(range(10, len(lines) - 1)),
        "the first digests": {2, 3, 9, 11, 18, 27},
    }[lost]
    network = LocalNetwork()
    node, topside = network.connect(), network.connect()
    node.answer(LOG.format(node="a"), LogDesk(tmp_path, "a").answer)
    stop = threading.Event()
    # By the clock topside, which is off.
    ahead_ns = 123_456_789
    with Recorder(tmp_path / "top.mcap", metadata={"command": "record"}) as recorder:
        recording = Recording(recorder, None)
        recording.filler = filler = Filler(topside, recording.fill, BEGAN_NS, stop)
        worker = threading.Thread(target=filler.run)
        worker.start()
        for i, (key, payload, time_ns) in enumerate(lines):
            if i not in gone:
                recording.write(key, payload, time_ns + ahead_ns)
        went_on = 0

        def is_filled() -> bool:
            nonlocal went_on
            went_on += 1  # the node goes on, ten messages a second
            at_ns = lines[-1][2] + went_on * 10**8
            more = Depth(node="a", stamp_ns=at_ns, depth_m=1.0, sigma_m=0.1)
            recording.write(key_of(more), encode(more), at_ns + ahead_ns)
            return sum(filler.filled.values()) == len(gone)

        until(is_filled)
        stop.set()
        worker.join()
        assert not filler.open
    writer.close()
    with DiveLogReader(tmp_path / "top.mcap") as reader:
        recorded = [(one.key, one.payload) for one in reader.records()]
        assert set(recorded) >= {(key, payload) for key, payload, _ in lines}
        assert len(recorded) == len(lines) + went_on
        told = check_logs([reader], None)
    assert told[0].startswith(f"{tmp_path}/top.mcap: node a: 6 s are as the node wrote them")


def test_a_node_that_does_not_answer_holds_up_no_other() -> None:
    network = LocalNetwork()
    node, topside = network.connect(), network.connect()
    stop, a_asked, b_asked, may_answer = (threading.Event() for _ in range(4))

    def late(_: str) -> Iterator[bytes]:
        a_asked.set()
        may_answer.wait(PATIENCE_S)
        yield from ()

    def none(_: str) -> Iterator[bytes]:
        b_asked.set()
        yield from ()

    node.answer(LOG.format(node="a"), late)
    node.answer(LOG.format(node="b"), none)
    filler = Filler(topside, lambda *_: None, BEGAN_NS, stop)
    worker = threading.Thread(target=filler.run)
    worker.start()
    filler.want(Discrepancy("a", "missing", BEGAN_NS, BEGAN_NS + S_NS, "1 digests are missing", "x"))
    assert a_asked.wait(PATIENCE_S)
    filler.want(Discrepancy("b", "missing", BEGAN_NS, BEGAN_NS + S_NS, "1 digests are missing", "x"))
    try:
        assert b_asked.wait(PATIENCE_S)
        assert not may_answer.is_set()
    finally:
        stop.set()
        may_answer.set()
        worker.join()


def test_what_goes_wrong_while_one_node_is_asked_is_told() -> None:
    topside = LocalNetwork().connect()
    filler = Filler(topside, lambda *_: None, BEGAN_NS, threading.Event())
    for node in "ab":
        filler.want(Discrepancy(node, "missing", BEGAN_NS, BEGAN_NS + S_NS, "1 digests are missing", "x"))

    def broken(key: str, *_: object) -> list[bytes]:
        if key == LOG.format(node="b"):
            return []
        raise RuntimeError("broken")

    topside.ask = broken  # type: ignore[method-assign]
    with pytest.raises(RuntimeError, match="broken"):
        filler.run()


def test_absurd_digests_of_many_nodes_cost_their_own_gaps() -> None:
    filler = Filler(LocalNetwork().connect(), lambda *_: None, BEGAN_NS, threading.Event())
    filler.want(Discrepancy("own", "missing", BEGAN_NS, BEGAN_NS + S_NS, "1 digests are missing", "x"))
    each = math.ceil(MOST_MISSING_NS / (MOST_NS - WRITTEN_NS))
    for k in range(math.ceil(MAX_GAPS / each) + 2):
        filler.want(Discrepancy(f"n{k}", "missing", BEGAN_NS, 2**63 - 1, "1 digests are missing", "x"))
    nodes = [one.node for one in filler.open]
    assert len(nodes) == MAX_GAPS
    assert nodes.count("own") == 1


def test_a_digest_of_centuries_ahead_asks_for_a_day() -> None:
    filler = Filler(LocalNetwork().connect(), lambda *_: None, BEGAN_NS, threading.Event())
    filler.want(Discrepancy("a", "missing", BEGAN_NS, 2**63 - 1, "1 digests are missing", "x"))
    assert len(filler.open) == math.ceil(MOST_MISSING_NS / (MOST_NS - WRITTEN_NS))
    filler.want(Discrepancy("b", "missing", BEGAN_NS, BEGAN_NS + 90 * S_NS, "9 digests are missing", "x"))
    assert [one.node for one in filler.open].count("b") == 2
