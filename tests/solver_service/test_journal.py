"""What a live solver has answered outlives a kill of solver and hub."""

from buddyline.protocol.messages import Rejected
from buddyline.solver_service import journal
from buddyline.solver_service.answered import Answered
from buddyline.solver_service.journal import Journal


def outcome(trigger, pair=("a", "b"), reason="ambiguous"):
    return Rejected(node_a=pair[0], node_b=pair[1], stamp_ns=trigger * 10**8, trigger=trigger, reason=reason)


def kept(path):
    return {(one.node_a, one.node_b): one.trigger for one in Journal(path).read()}


def test_the_last_outcome_of_each_pair_is_read_back(tmp_path):
    path = tmp_path / "deep" / "solver.answered"
    first = Journal(path)
    assert first.read() == []
    first.add([outcome(3), outcome(4), outcome(9, ("a", "c"))])
    first.add([outcome(2, reason="late")])
    assert kept(path) == {("a", "b"): 4, ("a", "c"): 9}
    # The next solver has read it, and goes on for one pair alone.
    second = Journal(path)
    second.read()
    second.add([outcome(5)])
    assert kept(path) == {("a", "b"): 5, ("a", "c"): 9}


def test_a_line_that_was_cut_off_is_left_out(tmp_path):
    path = tmp_path / "solver.answered"
    one = Journal(path)
    one.add([outcome(3)])
    one.add([outcome(4)])
    path.write_bytes(path.read_bytes()[:-9])
    assert kept(path) == {("a", "b"): 3}


def test_it_stays_small(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "MOST_BYTES", 1000)
    path = tmp_path / "solver.answered"
    one = Journal(path)
    for trigger in range(100):
        one.add([outcome(trigger)])
        assert path.stat().st_size <= 1000
    assert kept(path) == {("a", "b"): 99}
    assert [file.name for file in tmp_path.iterdir()] == ["solver.answered"]


def test_what_it_says_is_not_answered_again(tmp_path):
    path = tmp_path / "solver.answered"
    Journal(path).add([outcome(7)])
    answered = Answered(Journal(path).read())
    assert [one.trigger for one in answered.unsaid([outcome(6), outcome(7), outcome(8)])] == [8]


def test_a_place_that_cannot_be_written_is_said_once(tmp_path, caplog):
    (tmp_path / "file").write_text("")
    one = Journal(tmp_path / "file" / "solver.answered")
    one.add([outcome(1)])
    one.add([outcome(2)])
    assert len([record for record in caplog.records if "journal" in record.message]) == 1
