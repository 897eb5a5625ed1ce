"""A solver that is started again says what has not been said, and nothing twice."""

from protocol.clock import S_NS
from protocol.messages import Rejected
from solver_service.answered import Answered


def outcome(trigger, reason="ambiguous"):
    return Rejected(node_a="a", node_b="b", stamp_ns=trigger, trigger=trigger, reason=reason)


def triggers(outcomes):
    return [one.trigger for one in outcomes]


def test_the_first_solver_says_everything():
    answered = Answered()
    assert triggers(answered.unsaid([outcome(k) for k in range(5)])) == list(range(5))
    assert answered.saw_new_frame(0) == []


def test_what_was_said_is_not_said_again_and_what_was_not_is():
    answered = Answered([outcome(3), outcome(7)])
    assert triggers(answered.unsaid([outcome(k) for k in range(12)])) == [8, 9, 10, 11]
    assert answered.saw_new_frame(12) == []
    assert triggers(answered.unsaid([outcome(5, "late"), outcome(12)])) == [12]


def test_a_late_rejection_out_of_a_clock_that_is_ahead_says_nothing_of_the_others():
    answered = Answered([outcome(7), outcome(10**6, "late")])
    assert triggers(answered.unsaid([outcome(k) for k in range(10)])) == [8, 9]


def test_another_dive_is_no_answered_one():
    """Its frames came before the solver did, and those that come now have triggers that were answered."""
    answered = Answered([outcome(100)])
    assert answered.unsaid([outcome(1), outcome(2)]) == []
    assert triggers(answered.saw_new_frame(3)) == [1, 2]
    assert triggers(answered.unsaid([outcome(3)])) == [3]


def test_what_was_said_for_certain_stays_so_when_another_dive_begins():
    answered = Answered([outcome(7)])
    assert triggers(answered.unsaid([outcome(6), outcome(8)])) == [8]
    assert answered.saw_new_frame(2) == []
    assert triggers(answered.unsaid([outcome(2)])) == [2]


def test_of_a_live_dive_only_the_last_moments_are_solved_again():
    now_ns = 10**18
    said = Rejected(node_a="a", node_b="b", stamp_ns=now_ns - 20 * S_NS, trigger=7, reason="ambiguous")
    for age_s, over in ((60, True), (31, True), (29, False), (20, False), (1, False)):
        assert Answered([said]).is_over(now_ns - age_s * S_NS, now_ns) is over
        assert not Answered([said]).is_over(now_ns - age_s * S_NS, now_ns + 3600 * S_NS)
        assert not Answered().is_over(now_ns - age_s * S_NS, now_ns)
