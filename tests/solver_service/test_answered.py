"""A solver that is started again says what has not been said, and nothing twice."""

from collections import Counter
from contextlib import contextmanager
from itertools import pairwise

import pytest
from buddyline.protocol.bus import Received
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.codec import decode, encode
from buddyline.protocol.local_bus import LocalNetwork, LocalPublisher
from buddyline.protocol.messages import Candidates, NodePose, Rejected
from buddyline.protocol.topics import CANDIDATES, key_of, parse_key
from buddyline.solver_service import owed
from buddyline.solver_service.answered import Answered, AnsweredPair, answer_of
from buddyline.solver_service.config import SolverConfig
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.service import SolverService
from msgspec.structs import replace

from tests.processes import until
from tests.solver_service.conftest import PERIOD_NS, START_NS, dive_messages
from tests.tools import evaluated


def outcome(trigger, reason="ambiguous"):
    return Rejected(node_a="a", node_b="b", stamp_ns=trigger, trigger=trigger, reason=reason)


def triggers(outcomes):
    return [one.trigger for one in outcomes]


def unsaid(answered, ks):
    return [k for k in ks if answered.is_due(outcome(k))]


def test_the_first_solver_says_everything():
    answered = AnsweredPair()
    assert unsaid(answered, range(5)) == list(range(5))
    assert answered.saw_new_frame(0, 0) is None


def test_what_was_said_is_not_said_again_and_what_was_not_is():
    answered = AnsweredPair(map(answer_of, [outcome(3), outcome(7)]))
    assert unsaid(answered, range(12)) == [8, 9, 10, 11]
    assert answered.saw_new_frame(12, 12) is None
    assert unsaid(answered, [5, 12]) == [12]


def test_a_late_rejection_out_of_a_clock_that_is_ahead_says_nothing_of_the_others():
    answered = AnsweredPair(map(answer_of, [outcome(7), outcome(10**6, "late")]))
    assert unsaid(answered, range(10)) == [8, 9]


def test_another_dive_is_no_answered_one():
    """Its frames came before the solver did, and those that come now have triggers that were answered."""
    answered = AnsweredPair(map(answer_of, [outcome(100)]))
    assert unsaid(answered, [1, 2]) == []
    assert triggers(answered.saw_new_frame(3, 3)) == [1, 2]
    assert unsaid(answered, [3]) == [3]


def test_what_was_said_for_certain_stays_so_when_another_dive_begins():
    answered = AnsweredPair(map(answer_of, [outcome(7)]))
    assert unsaid(answered, [6, 8]) == [8]
    assert answered.saw_new_frame(2, 2) == []
    assert unsaid(answered, [2]) == [2]


def test_pairs_are_answered_each_for_itself():
    answered = Answered(map(answer_of, [outcome(7)]))
    other = Rejected(node_a="a", node_b="c", stamp_ns=5, trigger=5, reason="unmatched")
    status = SolverCore(Settings(), [("a", "b")]).report(0, 0, 0, [])
    assert answered.unsaid([outcome(5), other, *status, outcome(8)]) == [other, *status, outcome(8)]
    # A frame of a is over only where all of its pairs have had it.
    now_ns = 10**18
    answered = Answered(map(answer_of, [replace(outcome(7), stamp_ns=now_ns)]))
    assert answered.is_over([("a", "b")], now_ns - 60 * S_NS, now_ns)
    assert not answered.is_over([("a", "b"), ("a", "c")], now_ns - 60 * S_NS, now_ns)


def row(k, mode="filter"):
    """Return the track's row of the second of trigger k."""
    return evaluated.track(0, mode=mode, stamp_ns=k * S_NS)


def place(k):
    return NodePose(
        net="main",
        node="a",
        stamp_ns=k * S_NS,
        p_m=(0.0, 0.0, 0.0),
        q_xyzw=(0.0, 0.0, 0.0, 1.0),
        v_mps=(0.0, 0.0, 0.0),
        covariance=[0.0] * 36,
        fixed=True,
        mode="filter",
        age_s=0.0,
    )


def second(trigger, **changes):
    return replace(outcome(trigger, **changes), stamp_ns=trigger * S_NS)


def answered_to(k, *held):
    answered = Answered([answer_of(second(k))])
    answered.know_rows(held)
    return answered


def test_rows_of_tracks_and_nets_that_were_told_are_not_told_again():
    answered = answered_to(20, row(19), row(18, "lag"), place(20))
    given = [one for k in range(10, 23) for one in (row(k), row(k, "lag"), place(k))]
    due = answered.unsaid(given)
    assert [one.stamp_ns // S_NS for one in due if one.mode == "lag"] == [19, 20, 21, 22]
    assert [one.stamp_ns // S_NS for one in due if isinstance(one, NodePose)] == [21, 22]
    assert [one for one in due if one == row(20)] == [row(20)]
    assert row(19) not in due
    # A clock may be set back later on.
    assert answered.unsaid([row(3), place(3)]) == [row(3), place(3)]


def test_without_the_hub_s_word_a_track_goes_on_some_seconds_before_the_last_answer():
    assert answered_to(20).unsaid([row(14), row(15), row(16)]) == [row(16)]


def test_a_row_that_no_solver_of_the_dive_has_told_silences_no_track():
    assert answered_to(20, row(10**6), place(10**6)).unsaid([row(21), place(21)]) == [row(21), place(21)]


def test_rows_that_were_withheld_are_told_where_it_is_another_dive():
    answered = answered_to(20, row(19), place(19))
    assert answered.unsaid([row(5), second(5), place(5), row(6)]) == []
    assert answered.saw_new_frame([("a", "b")], 21, 21 * S_NS) == []
    assert answered.saw_new_frame([("a", "b")], 7, 7 * S_NS) == [second(5), row(5), row(6), place(5)]
    assert answered.unsaid([row(7)]) == [row(7)]


def test_rows_of_an_earlier_dive_with_more_triggers_a_second_are_told():
    answered, other = answered_to(20, row(19)), replace(outcome(30), stamp_ns=15 * S_NS)
    assert answered.unsaid([row(14), replace(other, trigger=29, reason="late"), other, row(15)]) == [
        replace(other, trigger=29, reason="late"),
        row(14),
        other,
        row(15),
    ]


def test_of_a_live_dive_only_the_last_moments_are_solved_again():
    now_ns = 10**18
    said = Rejected(node_a="a", node_b="b", stamp_ns=now_ns - 20 * S_NS, trigger=7, reason="ambiguous")
    for age_s, over in ((60, True), (31, True), (29, False), (20, False), (1, False)):
        assert AnsweredPair(map(answer_of, [said])).is_over(now_ns - age_s * S_NS, now_ns) is over
        assert not AnsweredPair(map(answer_of, [said])).is_over(now_ns - age_s * S_NS, now_ns + 3600 * S_NS)
        assert not AnsweredPair().is_over(now_ns - age_s * S_NS, now_ns)


OUTCOMES = "buddyline/pair/*/*/pose", "buddyline/pair/*/*/rejected"
TRACKS = "buddyline/pair/*/*/track", "buddyline/pair/*/*/track_lag"


@contextmanager
def heard(network, keys):
    """What a viewer receives on these keys."""
    received = []
    with network.connect() as viewer:
        viewer.subscribe(keys, received.append, capacity=10_000)
        yield received


@contextmanager
def solver_on(network, clock, config=None):
    """A solver on a bus of its own."""
    with network.connect() as bus:
        service = SolverService(config or SolverConfig(nodes=["a", "b"]), clock=clock)
        service.attach(bus)
        yield service


def flush(service):
    with service._lock:
        service._publish(service.core.flush())


def opened(received):
    return decode(received.payload, parse_key(received.key)[0].schema)


def triggers_of(received):
    return Counter(opened(one).trigger for one in received)


class Divers:
    """The nodes of a dive: their caches hold what they have published, also when no solver runs."""

    def __init__(self, nodes, clock, messages):
        self.clock = clock
        self.publishers = {key: nodes.publisher(parse_key(key)[0], *parse_key(key)[1]) for key in map(key_of, messages)}

    def publish(self, messages, service=None):
        """Publish messages, each at its time, which does not run ahead of the solver."""
        for message in messages:
            self.clock.set_ns(max(self.clock.now_ns() + 1, message.stamp_ns))
            self.publishers[key_of(message)].put(message)
            if service is not None and isinstance(message, Candidates):
                stream = service.core.streams[message.node]
                until(lambda stream=stream, ns=message.stamp_ns: (stream.newest_ns or 0) >= ns)


@pytest.mark.parametrize("live", [True, False], ids=["live", "stored"])
def test_two_solvers_one_after_the_other_answer_every_trigger_once(live):
    """The first is gone between two frames; the second comes some frames later, and finds them in the caches."""
    messages, _ = dive_messages(seconds=14.0, sensors=False, period_ns=2 * PERIOD_NS)
    gone_at, back_at = len(messages) * 8 // 10, len(messages) * 9 // 10
    clock = ManualClock(START_NS if live else START_NS + 86_400 * S_NS)
    network = LocalNetwork(clock)
    with network.connect() as nodes, heard(network, OUTCOMES) as outcomes:
        divers = Divers(nodes, clock, messages)
        with solver_on(network, clock) as service:
            divers.publish(messages[:gone_at], service)
        divers.publish(messages[gone_at:back_at])
        with solver_on(network, clock) as service:
            divers.publish(messages[back_at:], service)
            flush(service)
            # Of a dive of now, what was answered long ago is not even looked at.
            frames = sum(isinstance(message, Candidates) for message in messages)
            assert (sum(stream.received for stream in service.core.streams.values()) < frames) is live
        until(lambda: messages[-1].trigger in triggers_of(outcomes))
    assert triggers_of(outcomes) == {message.trigger: 1 for message in messages if isinstance(message, Candidates)}


@pytest.mark.parametrize(
    ("live", "held"), [(True, True), (False, True), (False, False)], ids=["live", "stored", "stored, new hub"]
)
def test_two_solvers_one_after_the_other_tell_every_row_of_the_tracks_once(live, held, tmp_path):
    """As above; where the hub was killed, too, the journal tells how far the tracks were, to some seconds."""
    messages, _ = dive_messages(seconds=15.0, period_ns=2 * PERIOD_NS)
    gone_at, back_at = len(messages) * 7 // 10, len(messages) * 8 // 10
    clock = ManualClock(START_NS if live else START_NS + 86_400 * S_NS)
    config = SolverConfig(nodes=["a", "b"], journal=str(tmp_path / "answered"))
    network = LocalNetwork(clock)
    with network.connect() as nodes, heard(network, TRACKS) as rows:
        divers = Divers(nodes, clock, messages)
        with solver_on(network, clock, config) as service:
            divers.publish(messages[:gone_at], service)
        until(lambda: len(rows) > 100)
        first = stamps_of(rows)
        if not held:
            network.newest.clear()
        divers.publish(messages[gone_at:back_at])
        with solver_on(network, clock, config) as service:
            divers.publish(messages[back_at:], service)
            flush(service)
        until(lambda: all(max(of) > messages[-1].stamp_ns - S_NS for of in stamps_of(rows).values()))
    for name, stamps_ns in stamps_of(rows).items():
        again = [stamp_ns for stamp_ns, count in Counter(stamps_ns).items() if count > 1]
        assert not (held and again), name
        assert all(stamp_ns > max(first[name]) - 6 * S_NS for stamp_ns in again)
        told_ns = sorted(set(stamps_ns))
        assert {after - before for before, after in pairwise(told_ns)} == {S_NS // 20}


def stamps_of(rows):
    found = {"track": [], "track_lag": []}
    for row in rows:
        found[row.key.rpartition("/")[2]].append(opened(row).stamp_ns)
    return found


@pytest.mark.parametrize("player", [False, True], ids=["held up", "played"])
def test_what_a_link_held_up_is_not_answered_again(player):
    """B's frames come after the solver that was started again: an earlier one has answered their triggers."""
    messages, _ = dive_messages(seconds=6.0, sensors=False, period_ns=2 * PERIOD_NS)
    frames = [one for one in messages if isinstance(one, Candidates)]
    last = max(frames, key=lambda frame: frame.stamp_ns)
    clock = ManualClock(last.stamp_ns + S_NS)
    network = LocalNetwork(clock)
    with heard(network, OUTCOMES) as outcomes, solver_on(network, clock) as service:
        service.watch("player", player)
        said = Rejected(node_a="a", node_b="b", stamp_ns=last.stamp_ns, trigger=last.trigger, reason="unmatched")
        service._answered = Answered(map(answer_of, [said]))
        for message in messages:
            clock.set_ns(clock.now_ns() + 1)
            service.receive(Received(key_of(message), encode(message), clock.now_ns(), ""))
        flush(service)
    assert bool(outcomes) is player


def feed(service, message):
    """Pass a message to a solver as the bus does."""
    service._note_arrival(key_of(message), encode(message))
    service.receive(Received(key_of(message), encode(message), service.clock.now_ns(), ""))


def test_what_a_killed_solver_could_not_tell_the_next_one_tells(tmp_path, monkeypatch):
    """Its last outcomes went into a hub that was dying; of one trigger it had one frame, whose node is gone too."""
    messages, _ = dive_messages(seconds=4.0, period_ns=2 * PERIOD_NS)
    frames = [one for one in messages if isinstance(one, Candidates)]
    last = max(frames, key=lambda frame: frame.stamp_ns)
    clock = ManualClock(last.stamp_ns + S_NS)
    network, deaf = LocalNetwork(clock), False
    send = LocalPublisher._send

    def send_unless_deaf(publisher, payload, **how):
        return deaf or send(publisher, payload, **how)

    monkeypatch.setattr(LocalPublisher, "_send", send_unless_deaf)
    config = SolverConfig(nodes=["a", "b"], journal=str(tmp_path / "answered"))
    with heard(network, OUTCOMES) as outcomes:
        with solver_on(network, clock, config) as service:
            for i, message in enumerate(messages):
                deaf = i > len(messages) // 2
                clock.set_ns(clock.now_ns() + 1)
                if message is not last:
                    feed(service, message)
            assert service.core.pending
            until(lambda: outcomes)
            before = len(outcomes)
        deaf = False
        monkeypatch.setattr(owed, "OWED_S", 0.0)
        for _ in range(3):
            with solver_on(network, clock, config) as service:
                service.tick(status_due=False)
                # They come after all: nothing is answered again.
                for message in messages:
                    clock.set_ns(clock.now_ns() + 1)
                    feed(service, message)
                flush(service)
        until(lambda: opened(outcomes[-1]).trigger == last.trigger)
    assert 0 < before < len(outcomes) - 5
    assert triggers_of(outcomes) == {frame.trigger: 1 for frame in frames}


def test_what_waited_when_a_solver_was_killed_has_an_outcome(tmp_path, monkeypatch):
    """Its backlog ends with it, and so do the nodes that had the frames. The next solver is killed soon, too."""
    messages, _ = dive_messages(seconds=6.0, sensors=False, period_ns=2 * PERIOD_NS)
    frames = sorted((one for one in messages if isinstance(one, Candidates)), key=lambda frame: frame.stamp_ns)
    clock = ManualClock(frames[-1].stamp_ns + S_NS)
    network = LocalNetwork(clock)
    config = SolverConfig(nodes=["a", "b"], journal=str(tmp_path / "answered"))
    third = len(frames) // 6 * 2

    def nodes_and_solver(part, *, stuck_from):
        """Nodes send these frames and end; the solver handles none from one on, and is killed."""
        with solver_on(network, clock, config) as service:
            with network.connect() as nodes:
                publishers = {node: nodes.publisher(CANDIDATES, node) for node in ("a", "b")}
                for k, frame in enumerate(part):
                    clock.set_ns(clock.now_ns() + 1)
                    if k == stuck_from:
                        until(lambda: service._handled == stuck_from)
                        service._lock.acquire()
                    publishers[frame.node].put(frame)
                if len(part) == stuck_from:
                    until(lambda: service._handled == stuck_from)
                    service._lock.acquire()
            service.stop.set()
            service._publish(service.core.flush() if len(part) == stuck_from else [])
            service._lock.release()

    with heard(network, OUTCOMES) as outcomes:
        nodes_and_solver(frames[: 2 * third], stuck_from=third)
        nodes_and_solver(frames[2 * third :], stuck_from=len(frames) - 2 * third)
        monkeypatch.setattr(owed, "OWED_S", 0.0)
        for _ in range(2):
            with solver_on(network, clock, config) as service:
                service.tick(status_due=False)
        until(lambda: len(outcomes) >= len(frames) // 2)
    assert triggers_of(outcomes) == {frame.trigger: 1 for frame in frames}
    late = {opened(one).trigger for one in outcomes if b'"late"' in one.payload}
    waited = {frame.trigger for frame in frames[third : 2 * third]}
    assert waited <= late < {frame.trigger for frame in frames}


def test_a_refused_frame_ends_no_later_solver(tmp_path, monkeypatch):
    """Its outcome could not be told: a solver that noted it ended, and each after it."""
    monkeypatch.setattr(owed, "OWED_S", 0.0)
    messages, _ = dive_messages(seconds=1.0)
    frame = next(one for one in messages if isinstance(one, Candidates))
    clock = ManualClock(frame.stamp_ns + S_NS)
    network = LocalNetwork(clock)
    config = SolverConfig(nodes=["a", "b"], journal=str(tmp_path / "answered"))
    first, second = SolverService(config, clock=clock), SolverService(config, clock=clock)
    first._journal.add([Rejected(node_a="a", node_b="b", stamp_ns=1, trigger=1, reason="ambiguous")])
    payload = encode(frame).replace(f'"trigger":{frame.trigger}'.encode(), f'"trigger":{2**63}'.encode())
    with network.connect() as bus:
        first.attach(bus)
        first._note_arrival(key_of(frame), payload)
        first.receive(Received(key_of(frame), payload, clock.now_ns(), ""))
        assert first.refusals.count == 1
        second.attach(bus)
        second.tick(status_due=True)


def test_what_has_come_again_is_not_given_up_while_it_waits(tmp_path, monkeypatch):
    """A solver on a busy machine takes longer than OWED_S to come to the frames that it has received."""
    monkeypatch.setattr(owed, "OWED_S", 0.0)
    messages, _ = dive_messages(seconds=4.0, period_ns=2 * PERIOD_NS)
    frames = [one for one in messages if isinstance(one, Candidates)]
    last_ns = max(frame.stamp_ns for frame in frames)
    clock = ManualClock(last_ns + S_NS)
    config = SolverConfig(nodes=["a", "b"], journal=str(tmp_path / "answered"))
    network, killed = LocalNetwork(clock), SolverService(config, clock=clock)
    killed._journal.add([Rejected(node_a="a", node_b="b", stamp_ns=1, trigger=1, reason="ambiguous")])
    for frame in frames:
        killed._note_arrival(key_of(frame), encode(frame))
    with heard(network, OUTCOMES) as outcomes, solver_on(network, clock, config) as service:
        # The last frames were lost with their nodes.
        come = [one for one in messages if not (isinstance(one, Candidates) and one.stamp_ns == last_ns)]
        for message in come:
            service._note_arrival(key_of(message), encode(message))
        service.tick(status_due=False)
        for message in come:
            clock.set_ns(clock.now_ns() + 1)
            service.receive(Received(key_of(message), encode(message), clock.now_ns(), ""))
        flush(service)
        until(lambda: len(outcomes) >= len(frames) // 2)
    assert triggers_of(outcomes) == {frame.trigger: 1 for frame in frames}
    assert [one.stamp_ns for one in map(opened, outcomes) if getattr(one, "reason", "") == "late"] == [last_ns]


def test_what_another_solver_may_have_answered_is_not_expected():
    noted = [answer_of(outcome(trigger)) for trigger in (5, 6, 9)] + [answer_of(outcome(2, reason="late"))]
    triggers = (1, 2, 4, 5, 7, 8, 9, 10)
    assert AnsweredPair([answer_of(outcome(9))]).expect(triggers, noted) == {7, 8, 10}
    # What the hub holds is of another: it has answered up to 9, in its order.
    assert AnsweredPair([answer_of(outcome(9))]).expect(triggers, noted[:2]) == {10}
    one = AnsweredPair([answer_of(outcome(9))])
    one.expect(triggers, noted)
    assert [one.is_due(outcome(trigger)) for trigger in (6, 7, 7, 10)] == [False, True, False, True]
