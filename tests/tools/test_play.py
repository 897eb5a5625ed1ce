"""Playback: what is sent, when, and how a dive goes round and round."""

import math
import threading
import time

import pytest
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.codec import decode
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.messages import Candidates, Imu, NodeInfo, Rejected
from buddyline.protocol.topics import CANDIDATES, EVERYTHING, REJECTED, parse_key
from buddyline.protocol.zenoh_bus.bus import HEARTBEAT_S
from buddyline.tools import play
from buddyline.tools.dives import Dive
from buddyline.tools.play import Player, _selected, _span
from msgspec.structs import replace

from tests.processes import PATIENCE_S, until
from tests.solver_service.conftest import PERIOD_NS, START_NS, dive_messages
from tests.tools.evaluated import track


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("play") / "dive.mcap"
    with DiveLogWriter(path) as writer:
        for message in dive_messages(seconds=2.0, imu=True)[0]:
            writer.write_message(message)
        for mode in ("filter", "lag"):
            writer.write_message(track(0, stamp_ns=START_NS + PERIOD_NS, mode=mode))
        old = Rejected(node_a="a", node_b="b", stamp_ns=START_NS + PERIOD_NS, trigger=1, reason="late")
        writer.write_message(old)
    return path


class Played:
    """A dive played onto a bus of this process; what came of it, by topic."""

    def __init__(self, log, *, start_s=0.0, end_s=None, laps=1, speed=1.0):
        self.received = []
        self.clock = ManualClock(5)
        network = LocalNetwork()
        with Dive([log]) as dive, network.connect() as bus, network.connect() as listener:
            listener.subscribe(EVERYTHING, self.received.append, capacity=10_000)
            player = Player(bus, dive.nodes("candidates"), speed, self.clock, threading.Event())
            player.declare(dive.keys)
            start_ns, stop_ns = _span(dive, start_s, end_s)
            for lap in range(laps):
                for record in _selected(dive, start_ns, stop_ns):
                    player.send(record, lap * 30, PERIOD_NS)
        self.sent = player.sent

    def messages(self, kind):
        parsed = [(parse_key(r.key)[0].schema, r.payload) for r in self.received]
        return [decode(payload, kind) for schema, payload in parsed if schema is kind]


def test_everything_but_what_a_solver_made_is_sent(log):
    played = Played(log)
    assert played.sent == len(played.received) == len(dive_messages(seconds=2.0, imu=True)[0])
    assert not any("/pair/" in received.key for received in played.received)
    assert len(played.messages(Candidates)) == 2 * 18
    assert len(played.messages(Imu)) == 2 * 200


def test_what_stands_in_two_logs_is_sent_once(log, tmp_path):
    twin = tmp_path / "twin.mcap"
    twin.write_bytes(log.read_bytes())
    with Dive([log]) as alone, Dive([log, twin]) as both:
        once, twice = (list(_selected(dive, *_span(dive, 0.0, None))) for dive in (alone, both))
    assert sorted((one.key, one.payload) for one in twice) == sorted((one.key, one.payload) for one in once)


def test_what_stands_twice_in_one_log_is_sent_twice(log, tmp_path):
    doubled = tmp_path / "doubled.mcap"
    with Dive([log]) as dive, DiveLogWriter(doubled) as writer:
        once = list(_selected(dive, *_span(dive, 0.0, None)))
        for one in once:
            for _ in range(2):
                writer.write_message(one.message, one.time_ns)
    with Dive([doubled]) as dive:
        assert len(list(_selected(dive, *_span(dive, 0.0, None)))) == 2 * len(once)


def test_the_playback_rate_follows_speed(log):
    assert Played(log).clock.now_ns() - 5 == pytest.approx(1.98e9, abs=1e8)
    assert Played(log, speed=4.0).clock.now_ns() - 5 == pytest.approx(1.98e9 / 4, abs=3e7)


def test_a_part_of_a_dive_is_sent_with_its_calibration(log):
    played = Played(log, start_s=0.5, end_s=1.0)
    stamps = [message.stamp_ns for message in played.messages(Candidates)]
    assert len(stamps) == 10
    assert min(stamps) >= START_NS + 500_000_000 - 20_000_000
    assert len(played.messages(NodeInfo)) == 2


def test_laps_continue_times_and_triggers(log):
    frames = Played(log, laps=2).messages(Candidates)
    first, second = frames[: len(frames) // 2], frames[len(frames) // 2 :]
    for one, other in zip(first, second, strict=True):
        assert other.stamp_ns - one.stamp_ns == 30 * PERIOD_NS
        assert other.trigger - one.trigger == 30
        assert other.blobs == one.blobs


class LateSolver:
    """Answers every trigger once both nodes' frames have come, and in its own time."""

    def __init__(self, bus, wait_s):
        self.wait_s = wait_s
        self.answered_ns = None
        self.ahead_ns = []
        self._seen = set()
        self._publisher = bus.publisher(REJECTED, "a", "b")
        bus.subscribe(CANDIDATES.key_any(), self.hear, capacity=1000)
        bus.subscribe(CANDIDATES.key_any(), self.measure, capacity=1000)
        bus.declare_alive("solver/a_b")

    def measure(self, received):
        stamp_ns = decode(received.payload, Candidates).stamp_ns
        self.answered_ns = self.answered_ns or stamp_ns
        self.ahead_ns.append(stamp_ns - self.answered_ns)

    def hear(self, received):
        frame = decode(received.payload, Candidates)
        if frame.trigger not in self._seen:
            self._seen.add(frame.trigger)
            return
        if self.wait_s:
            # The messages that the link held back come now, all at once.
            time.sleep(self.wait_s)
            self.wait_s = 0.0
        self.answered_ns = frame.stamp_ns
        stamp_ns, trigger = frame.stamp_ns, frame.trigger
        self._publisher.put(Rejected(node_a="a", node_b="b", stamp_ns=stamp_ns, trigger=trigger, reason="late"))


def test_fast_playback_never_outruns_what_a_solver_waits_for(tmp_path):
    path = tmp_path / "long.mcap"
    with DiveLogWriter(path) as writer:
        for message in dive_messages(seconds=8.0)[0]:
            if isinstance(message, NodeInfo | Candidates):
                writer.write_message(message)
    network = LocalNetwork()
    with Dive([path]) as dive, network.connect() as bus, network.connect() as listener:
        solver = LateSolver(listener, wait_s=1.5)
        player = Player(bus, dive.nodes("candidates"), 0.0, ManualClock(5), threading.Event())
        player.declare(dive.keys)
        # Playback does not wait before it knows that a solver is alive.
        while not player._follower._solvers:
            time.sleep(0.01)
        for envelope in dive.messages():
            player.send(envelope)
    assert len(solver.ahead_ns) > 140
    # A solver gives up a silent node after two seconds of the dive.
    assert max(solver.ahead_ns) < 1_950_000_000


def test_fast_playback_without_a_solver_does_not_wait(log, monkeypatch):
    monkeypatch.setattr(play, "SOLVER_SILENT_S", math.inf)
    network, stop = LocalNetwork(), threading.Event()
    with Dive([log]) as dive, network.connect() as bus:
        player = Player(bus, dive.nodes("candidates"), 0.0, ManualClock(5), stop)
        player.declare(dive.keys)
        frames = list(dive.messages(CANDIDATES.name))
        # Far beyond what a solver would have resolved.
        late = [replace(frame, time_ns=frame.time_ns + k * S_NS) for k, frame in enumerate(frames)]
        playing = threading.Thread(target=lambda: [player.send(frame) for frame in late])
        playing.start()
        playing.join(PATIENCE_S)
        stop.set()
        playing.join()
    assert player.sent == len(frames)


@pytest.mark.parametrize(("start_s", "end_s"), [(-1.0, None), (99.0, None), (1.0, 0.5)])
def test_a_part_outside_the_dive_is_refused(log, start_s, end_s):
    with Dive([log]) as dive, pytest.raises(BuddylineError, match="the dive goes from 0 to") as refused:
        _span(dive, start_s, end_s)
    assert "None" not in str(refused.value)


def test_playback_stays_until_the_solver_has_answered_the_last_frames(log, monkeypatch):
    monkeypatch.setattr(play, "SOLVER_SILENT_S", math.inf)
    monkeypatch.setattr(play, "LINGER_S", 0.0)
    network, stop = LocalNetwork(), threading.Event()
    with Dive([log]) as dive, network.connect() as bus, network.connect() as solver:
        player = Player(bus, dive.nodes("candidates"), math.inf, ManualClock(5), stop)
        player.declare(dive.keys)
        solver.declare_alive("solver/test")
        until(lambda: player._follower._solvers)
        frames = list(dive.messages(CANDIDATES.name))
        for frame in frames:
            player.send(frame)
        staying = threading.Thread(target=player.finish)
        staying.start()
        staying.join(1.2)
        assert staying.is_alive()
        last = frames[-1].message
        solver.publisher(REJECTED, "a", "b").put(
            Rejected(node_a="a", node_b="b", stamp_ns=last.stamp_ns, trigger=last.trigger, reason="unmatched")
        )
        staying.join(PATIENCE_S)
        assert not staying.is_alive()


def test_playback_stays_longer_than_until_the_next_heartbeat():
    assert play.LINGER_S > HEARTBEAT_S


def test_a_running_node_of_the_dives_own_id_is_named(log, caplog):
    network = LocalNetwork()
    with Dive([log]) as dive, network.connect() as bus, network.connect() as node, network.connect() as other:
        Player(bus, dive.nodes("candidates"), 1.0, ManualClock(5), threading.Event())
        other.declare_alive("node/elsewhere")
        node.declare_alive("node/b")
        until(lambda: caplog.messages)
    assert len(caplog.messages) == 1
    assert "node b runs on this bus" in caplog.messages[0]
