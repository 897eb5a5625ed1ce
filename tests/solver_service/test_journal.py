"""What a live solver has received and answered outlives a kill of solver and hub."""

import os
import time

import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import encode
from buddyline.protocol.messages import Candidates, Rejected
from buddyline.protocol.topics import key_of
from buddyline.solver_service import journal
from buddyline.solver_service.answered import Answered, answer_of, said_of
from buddyline.solver_service.journal import Journal

NOW_NS = 10**18


def outcome(trigger, pair=("a", "b"), reason="ambiguous", ago_s=100):
    return Rejected(
        node_a=pair[0], node_b=pair[1], stamp_ns=NOW_NS - ago_s * S_NS + trigger, trigger=trigger, reason=reason
    )


def frame(trigger, ago_s=1):
    stamp_ns = NOW_NS - ago_s * S_NS
    return Candidates(
        node="a", stamp_ns=stamp_ns, trigger=trigger, seq=trigger, boot="x", width_px=640, height_px=480, blobs=[]
    )


def kept(path):
    return {(one.node_a, one.node_b): one.trigger for one in said_of([], Journal(path).read(NOW_NS).said)}


def test_the_last_outcome_of_each_pair_is_read_back(tmp_path):
    path = tmp_path / "deep" / "solver.answered"
    first = Journal(path)
    assert first.read(NOW_NS).said == []
    first.add([outcome(3), outcome(4), outcome(9, ("a", "c"))])
    assert kept(path) == {("a", "b"): 4, ("a", "c"): 9}
    # The next solver has read it, and goes on for one pair alone.
    second = Journal(path)
    second.read(NOW_NS)
    second.add([outcome(5)])
    assert kept(path) == {("a", "b"): 5, ("a", "c"): 9}


def test_outcomes_of_the_last_minute_and_frames_of_this_dive_are_read_back_as_they_were(tmp_path):
    path = tmp_path / "solver.answered"
    one = Journal(path)
    said = [outcome(1, ago_s=70), outcome(2, ago_s=50), outcome(3, reason="late", ago_s=1)]
    one.add(said[:2])
    for each in (frame(2), frame(1, ago_s=601), frame(3)):
        one.add_frame(each.node, each.trigger, each.stamp_ns)
    one.add(said[2:])
    past = Journal(path).read(NOW_NS)
    assert past.said == [answer_of(one) for one in said]
    assert past.recent == [(key_of(one), encode(one)) for one in said[1:]]
    assert past.frames == [("a", k, frame(k).stamp_ns) for k in (2, 3)]


@pytest.mark.parametrize("lately", [True, False])
def test_what_a_solver_that_was_behind_noted_last_is_read_back_too(tmp_path, lately):
    """It may not have been sent, unless it was noted long ago."""
    now_ns, path = time.time_ns(), tmp_path / "solver.answered"
    said = [
        Rejected(node_a="a", node_b="b", stamp_ns=now_ns - ago_s * S_NS, trigger=300 - ago_s, reason="ambiguous")
        for ago_s in (160, 95, 90)
    ]
    Journal(path).add(said)
    if not lately:
        os.utime(path, (0, now_ns / S_NS - 70))
    assert Journal(path).read(now_ns).recent == [(key_of(one), encode(one)) for one in said[1:] if lately]


def test_one_that_takes_over_a_pair_reads_of_no_other(tmp_path):
    path = tmp_path / "solver.answered"
    one = Journal(path)
    one.add([outcome(3), outcome(4, ("a", "c"))])
    one.add_frame("a", 3, frame(3).stamp_ns)
    past = Journal(path).read(NOW_NS, [("a", "c")])
    assert past.said == [answer_of(outcome(4, ("a", "c")))]
    assert past.frames == []


def test_a_line_that_was_cut_off_is_left_out(tmp_path):
    path = tmp_path / "solver.answered"
    one = Journal(path)
    one.add([outcome(3)])
    one.add([outcome(4)])
    path.write_bytes(path.read_bytes()[:-9])
    assert kept(path) == {("a", "b"): 3}


def test_a_frame_that_no_message_can_name_is_left_out(tmp_path):
    """As a solver had noted it that did not look at a refused message's numbers."""
    one = Journal(tmp_path / "solver.answered")
    one.add_frame("a", 3, frame(3).stamp_ns)
    one.add_frame("a", 2**63, frame(4).stamp_ns)
    assert [trigger for _, trigger, _ in Journal(one.path).read(NOW_NS).frames] == [3]


def test_it_stays_small(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "MOST_BYTES", 2000)
    path = tmp_path / "solver.answered"
    one = Journal(path)
    one.add([outcome(7, ("a", "c"))])
    for trigger in range(100):
        one.add([outcome(trigger)])
        one.add_frame("a", trigger, frame(trigger).stamp_ns)
        assert path.stat().st_size <= 2000
    assert kept(path) == {("a", "b"): 99, ("a", "c"): 7}
    assert sorted(file.name for file in tmp_path.iterdir()) == ["solver.answered", "solver.answered~"]
    # What was noted last is still there.
    assert [trigger for _, trigger, _ in Journal(path).read(NOW_NS).frames][-5:] == [95, 96, 97, 98, 99]


def test_what_it_says_is_not_answered_again(tmp_path):
    path = tmp_path / "solver.answered"
    Journal(path).add([outcome(7), outcome(9, reason="late")])
    answered = Answered(said_of([], Journal(path).read(NOW_NS).said))
    said = [outcome(6), outcome(7), outcome(8), outcome(9, reason="late"), outcome(9)]
    assert answered.unsaid(said) == [said[2]]


def test_the_journal_goes_on_from_what_the_hub_holds_unless_that_is_another_solvers():
    def answer(trigger, pair=("a", "b")):
        return answer_of(outcome(trigger, pair))

    noted = [answer(5), answer(6), answer(7)]
    assert said_of([answer(6), answer(4)], noted) == [answer(7)]
    assert said_of([answer(9), answer(8)], noted) == [answer(9), answer(8)]
    assert said_of([answer(9, ("a", "c"))], noted) == [answer(7), answer(9, ("a", "c"))]


def test_a_place_that_cannot_be_written_is_said_once(tmp_path, caplog):
    (tmp_path / "file").write_text("")
    one = Journal(tmp_path / "file" / "solver.answered")
    one.add([outcome(1)])
    one.add([outcome(2)])
    assert len([record for record in caplog.records if "journal" in record.message]) == 1
