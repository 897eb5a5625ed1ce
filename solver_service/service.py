"""The live solver: subscribes to all nodes, passes their messages to the core, publishes its results."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
from buddyline.protocol.clock import S_NS, Clock, SystemClock
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import Candidates, Message
from buddyline.protocol.messages.fields import Count, StampNs
from buddyline.protocol.security import PLAYER
from buddyline.protocol.service import Service
from buddyline.protocol.statusfile import StatusFile
from buddyline.protocol.topics import (
    ATTITUDE,
    CANDIDATES,
    DEPTH,
    IMU,
    IMU_MEANS,
    INFO,
    NET_POSE,
    POSE,
    REJECTED,
    TRACK,
    TRACK_LAG,
    Topic,
    key_of,
    parse_key,
)
from buddyline.solver_service.answered import THIS_DIVE_NS, Answer, Answered, Outcome, Row, answer_of, said_of
from buddyline.solver_service.config import SolverConfig
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.journal import Journal, Noted
from buddyline.solver_service.owed import Owed
from buddyline.solver_service.pace import BEHIND_NS, ONE_IN_FIVE
from buddyline.solver_service.pair_core import PUBLISHED, PUBLISHED_FOR_NODES, PairId
from buddyline.solver_service.shared_work import CLAIM_S, SharedWork

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, Publisher, Received, Subscription

log = logging.getLogger(__name__)

# Live also from IMU_MEANS: a stored dive has the samples themselves.
SOLVED_FROM: Final = (INFO, IMU, ATTITUDE, DEPTH, CANDIDATES)
# The core gets the time, and the status is published, at these intervals.
TICK_S: Final = 0.25
STATUS_S: Final = 1.0
# Between two statuses it is looked whether the divers' words have changed.
WORDS_S: Final = 0.5
MAX_ALIVE_NAME: Final = 64
WAIT_S: Final = 1.0
# So many messages that wait are solved together at most, which costs half.
TOGETHER: Final = 256


class _FrameHead(msgspec.Struct):
    trigger: Count
    stamp_ns: StampNs


_FRAME_HEAD: Final = msgspec.json.Decoder(_FrameHead)


class SolverService(Service):
    """Solves the configured pairs, or every pair of nodes that appears."""

    def __init__(self, config: SolverConfig, source: str = "defaults", clock: Clock | None = None) -> None:
        super().__init__("solver", StatusFile.of("solver", config.status_file))
        self.problems = ["no hub yet"]
        self.config = config
        self.clock = clock or SystemClock()
        self.refusals = Refusals("solver")
        lamps_alone = config.lamps_alone()
        self.core = SolverCore(
            config.solve.settings(source),
            config.chosen,
            align=True,
            track=config.track.settings,
            lone=[info.node for info in lamps_alone],
            shared=config.share,
        )
        for info in lamps_alone:
            self.core.handle(info)
        self._lock = threading.Lock()
        self._bus: Bus | None = None
        self._subscription: Subscription | None = None
        # Messages that are solved together with those that wait behind them, with their receive times.
        self._came: list[tuple[Message, int]] = []
        # How long the frames of the last such set had waited in this process for their turn, at least.
        self._behind_ns = 0
        self._publishers: dict[str, Publisher] = {}
        self._declared: set[PairId] = set()
        self._refused = ""
        self._news = False
        # Set where the work may have to be shared anew.
        self._wake = threading.Event()
        self._handled = 0
        self._answered = Answered()
        self._work = SharedWork(self.core, self._answered) if config.share else None
        self._shown: set[str] = set()
        instance = self._work.sharing.instance if self._work is not None else ""
        self._journal = (
            Journal(Path(config.journal), instance)
            if config.journal
            else Journal.of(config.connect, config.namespace, instance)
        )
        self._joined_ns: int | None = None
        self._attached_ns = 0
        self._player = False
        self._owed = Owed(self._answered)
        # Up to this stamp the frames of a node had come, and were noted or answered, before this solver came.
        self._answered_to_ns: dict[str, int] = {}
        self._words_s = 0.0

    def start(self) -> None:
        """Start all threads."""
        self.spawn("bus", self._connect)
        if self._work is not None:
            work = self._work
            self.spawn("pulse", lambda: _pulse(work, self.stop))

    def _connect(self) -> None:
        from buddyline.protocol.zenoh_bus import connect

        bus = connect(
            self.config.connect,
            namespace=self.config.namespace or None,
            stop=self.stop,
            on_wait=lambda text: log.info("solver: %s", text),
            tls=self.config.tls,
        )
        if bus is None:
            return
        with bus:
            bus.on_failure(lambda error: self.fail("bus", error))
            self.attach(bus)
            bus.watch_alive(self.watch)
            if self._work is None:
                nodes = [node for pair in self.config.chosen or () for node in pair]
                bus.declare_alive(f"solver/{'_'.join(dict.fromkeys(nodes))[:MAX_ALIVE_NAME] or 'any'}")
            log.info("solver: connected to %s", self.config.connect)
            told_s = time.monotonic()
            while not self.stop.is_set():
                self._wake.wait(CLAIM_S if self._work is not None and self._work.sharing.waits else TICK_S)
                self._wake.clear()
                status_due = time.monotonic() - told_s >= STATUS_S
                if status_due:
                    told_s = time.monotonic()
                    self.heartbeat()
                self.tick(status_due)
            if self._work is None or self._work.sharing.alone:
                self.finish()

    def finish(self) -> None:
        """Handle what still waits, and resolve all pending triggers."""
        with self._lock:
            self._take_all()
            self._publish(self.core.flush())

    def tick(self, status_due: bool) -> None:
        """Resolve triggers whose time has come; report where a status is due, or the words of one have changed.

        Words change where a node has started or ended, and where divers should do something else.
        """
        if self._work is not None and self._bus is not None:
            self._share(self._work, self._bus)
        with self._turn():
            self._take_all()
            if not self._more_waits:
                self._behind_ns = 0
                self.core.keep_up(0, self.clock.now_ns())
            results = self.core.advance(self.clock.now_ns())
            self._declare()
            self._publish(results)
            self._give_up_owed()
            if status_due or time.monotonic() - self._words_s >= WORDS_S:
                self._words_s = time.monotonic()
                self._news |= not status_due and self.core.advises_anew()
        if self._news or status_due:
            self.report()

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """Hold the lock; a wait for it counts as a heartbeat while the bus's thread gets on with a backlog.

        That thread may take the lock again before this one has it, for as long as there is a backlog.
        """
        handled = -1
        while not self._lock.acquire(timeout=WAIT_S):
            if self._handled != handled:
                handled = self._handled
                self.heartbeat()
        try:
            yield
        finally:
            self._lock.release()

    def _share(self, work: SharedWork, bus: Bus) -> None:
        """Go on with the tasks that are this solver's now."""
        if self._joined_ns != 0 and self._more_waits:
            # What the nodes have held comes first: until all of it is in, the others can do more with the pairs.
            return
        hub = bus.hub
        with self._turn():
            begin = work.tick(hub)
            self._shown = work.declare(bus, self._shown)
        if not begin:
            return
        alive = bus.others_alive()
        if bus.hub != hub:
            work.sharing.cut_off = True
            return
        begin = work.sharing.unheld(begin, alive)
        past, said = self._read_past(bus, [(task[0], task[1]) for task in begin if task])
        for task in begin:
            with self._turn():
                found = work.begin(task, said, self.clock.now_ns())
                self._declare()
                self._publish(found)
        # Last, because it takes longer than all else, and helps only those who had lost the hub.
        with self._turn():
            self._repeat(past.recent)
        log.info("solver: takes up %s", ", ".join("/".join(task) or "the network" for task in begin))

    def _hear(self, received: Received) -> None:
        """Take an outcome that some solver has published."""
        work = self._work
        if work is None:
            return
        with self._lock:
            try:
                if work.hear(received.payload):
                    message = received.open().message
                    if isinstance(message, Outcome):
                        results = self.core.hear(message)
                        self._declare()
                        self._publish(results)
            except MessageError as error:
                self.refusals.note(received.key, error)

    def attach(self, bus: Bus) -> None:
        """Subscribe to the nodes on this bus, and publish on it from now on."""
        self._bus = bus
        self.problems = ["no two nodes yet"]
        past = Noted()
        if self._work is None:
            past, said = self._read_past(bus)
            self._answered.know(said)
            self._answered.know_rows(_rows_held_by(bus))
            self._owed.expect(past)
            for one in said:
                up_to_ns = self._answered.pair((one.node_a, one.node_b)).up_to_ns
                for node in (one.node_a, one.node_b):
                    self._answered_to_ns[node] = min(up_to_ns, self._answered_to_ns.get(node, up_to_ns))
        else:
            bus.subscribe((POSE.key_any(), REJECTED.key_any()), self._hear, history=False)
            log.info("solver: shares the work of this hub as %s", self._work.sharing.instance)
        self._declare()
        self._repeat(past.recent)
        # One subscription for all topics, so that cached messages come in the order of their stamps. A frame would
        # not wait for an attitude that comes a minute later.
        self._subscription = bus.subscribe(
            tuple(topic.key_any() for topic in (*SOLVED_FROM, IMU_MEANS)),
            self.receive,
            capacity=32768,
            on_arrival=self._note_arrival if self._journal is not None and self._work is None else None,
        )
        self._joined_ns = self._attached_ns = self.clock.now_ns()

    def _note_arrival(self, key: str, payload: bytes) -> None:
        """Note a frame as soon as it has come: while there is a backlog, this solver may be killed before its turn."""
        parsed = parse_key(key)
        if self._journal is not None and parsed is not None and parsed[0] is CANDIDATES:
            (node,) = parsed[1]
            with suppress(msgspec.DecodeError, UnicodeDecodeError):
                frame = _FRAME_HEAD.decode(payload)
                self._owed.saw_frame(node, frame.trigger)
                if frame.stamp_ns > self._answered_to_ns.get(node, -1):
                    self._journal.add_frame(node, frame.trigger, frame.stamp_ns)

    def receive(self, received: Received) -> None:
        """Take one message from the bus; a bad one is counted and reported. If more wait, they are solved together.

        Once this solver is told to stop, a backlog is left to the next one: the end would wait for the lock for as long
        as the backlog lasts.
        """
        if self.stop.is_set():
            return
        message: Message | None = None
        try:
            message = received.open().message
        except MessageError as error:
            self.refusals.note(received.key, error)
            self._refused = f"bad message on {received.key}: {error}"
        with self._lock:
            if message is not None:
                self._came.append((message, received.receive_ns))
            if not self._more_waits or len(self._came) >= TOGETHER:
                self._take_all()

    def watch(self, name: str, alive: bool) -> None:
        """Note that a node has started or ended; the next tick reports all of them at once."""
        with self._lock:
            if name == PLAYER:
                self._player = alive
            self._news |= self.core.health.saw_process(name, alive)
            if self._work is not None:
                self._work.sharing.saw(name, alive)
                self._wake.set()

    def report(self) -> None:
        """Publish each pair's status."""
        with self._turn():
            now_ns = self.clock.now_ns()
            refused, self._refused = self._refused, ""
            self._news = False
            flood = self._bus.flood_problem() if self._bus is not None else ""
            problems = [one for one in (refused, flood) if one]
            if self._behind_ns > BEHIND_NS:
                problems.append(
                    f"the solver is {self._behind_ns / S_NS:.0f} s behind: this machine is too slow; lower the nodes' "
                    "rate, or start further solvers, all with --share"
                    + (f"; {ONE_IN_FIVE}" if self.core.is_crowded else "")
                )
            problems += self._work.problems if self._work is not None else []
            statuses = self.core.report(now_ns, now_ns, self.refusals.count, problems)
            if not statuses:
                if self._work is not None:
                    self.problems = problems
                return
            named = [(f"{one.node_a}/{one.node_b}: ", one) for one in statuses if one.problem]
            self.problems = [f"{pair if len(statuses) > 1 else ''}{one.problem}" for pair, one in named]
            self.status_message = named[0][1] if named else statuses[0]
            self._publish(statuses)

    @property
    def _more_waits(self) -> bool:
        return self._subscription is not None and self._subscription.waiting > 0

    def _take_all(self) -> None:
        """Handle what has come, except frames from a cache that an earlier solver has answered."""
        came, self._came = self._came, []
        together: list[Message] = []
        waited_ns: list[int] = []
        for message, receive_ns in came:
            if not isinstance(message, Candidates):
                together.append(message)
                continue
            new = self._joined_ns is not None and receive_ns > self._joined_ns
            # What a link or a cache has held for long says nothing of this solver's speed.
            if abs(receive_ns - message.stamp_ns) < BEHIND_NS:
                waited_ns.append(max(self.clock.now_ns() - receive_ns, 0))
            pairs = self.core.pairs_of(message.node)
            if new:
                # All later frames are new too, even if the clock is set.
                self._joined_ns = 0
            elif self._answered.is_over(pairs, message.stamp_ns, self.clock.now_ns()):
                self._owed.saw_unused(message.node, message.trigger)
                continue
            together.append(message)
            if new and self._is_of_now(message):
                if not pairs:
                    # It may be the node's first, by which its pairs form.
                    self._handle(together)
                    together, pairs = [], self.core.pairs_of(message.node)
                self._publish(self._answered.saw_new_frame(pairs, message.trigger, message.stamp_ns))
        if waited_ns:
            # A sender of too much is served last: what waits least shows how far behind the solver is.
            self._behind_ns = min(waited_ns)
            self.core.keep_up(self._behind_ns, self.clock.now_ns())
        self._handle(together)
        self._handled += len(came)

    def _is_of_now(self, frame: Candidates) -> bool:
        """Return whether a new frame may be of another dive than what was answered before.

        A frame of this dive that was exposed before this solver came was held up by its link.
        """
        in_this_dive = abs(self.clock.now_ns() - frame.stamp_ns) < THIS_DIVE_NS
        return self._player or not in_this_dive or frame.stamp_ns >= self._attached_ns

    def _handle(self, messages: list[Message]) -> None:
        if not messages:
            return
        # The time is now, not the receive time: a message that waited in the queue has not yet waited for other nodes.
        results = self.core.handle_many(messages, self.clock.now_ns())
        self._declare()
        self._publish(results)

    def _declare(self) -> None:
        """Declare the publishers of new pairs, so that subscribers find them before the first message."""
        if self._bus is None:
            return
        for of_net in self.core.net_poses:
            self._publisher_of(NET_POSE, *of_net)
        for pair in self.core.pairs.keys() - self._declared:
            log.info("solver: pair %s, %s", *pair)
            self._declared.add(pair)
            named: list[tuple[Topic, tuple[str, ...]]] = [(topic, pair) for topic in PUBLISHED]
            named += [(topic, (node,)) for topic in PUBLISHED_FOR_NODES for node in pair]
            for topic, ids in named:
                self._publisher_of(topic, *ids)

    def _publisher_of(self, topic: Topic, *ids: str) -> None:
        """Declare a publisher, unless there is one."""
        if self._bus is not None and topic.key(*ids) not in self._publishers:
            self._publishers[topic.key(*ids)] = self._bus.publisher(topic, *ids)

    def _publish(self, messages: Iterable[Message]) -> None:
        if self._work is not None and not self._work.may_speak:
            return
        unsaid = self._answered.unsaid(messages)
        # Noted first: if this solver is killed in between, the next one publishes what is noted.
        if self._journal is not None:
            self._journal.add(unsaid)
        for message in unsaid:
            self._publishers[key_of(message)].put(message)
            if isinstance(message, Outcome):
                self._owed.saw_outcome(message)
        self.core.saw_published(unsaid, self.clock.now_ns())

    def _repeat(self, published: Iterable[tuple[str, bytes]]) -> None:
        """Publish an earlier solver's last outcomes again, for those who have missed them: it answers nobody now."""
        for key, payload in published:
            if key not in self._publishers and (parsed := parse_key(key)) is not None:
                self._publisher_of(parsed[0], *parsed[1])
            self._publishers[key].repeat(payload)

    def _give_up_owed(self) -> None:
        """Answer the triggers whose frames have not come again."""
        outcomes = self._owed.lost(self.core.is_single)
        for outcome in outcomes:
            self._publisher_of(REJECTED, outcome.node_a, outcome.node_b)
        self._publish(outcomes)
        self._owed.give_up(outcomes)

    def _read_past(self, bus: Bus, pairs: Iterable[PairId] | None = None) -> tuple[Noted, list[Answer]]:
        """Return what the journals know, of these pairs if given, and the last answers of all solvers so far."""
        past = self._journal.read(self.clock.now_ns(), pairs) if self._journal is not None else Noted()
        return past, said_of(_held_by(bus), past.said)


def _pulse(work: SharedWork, stop: threading.Event) -> None:
    while not stop.wait(TICK_S):
        work.pulse()


def _held_by(bus: Bus) -> list[Answer]:
    """Return the last outcome of each pair that earlier solvers have published, as kept by the hub."""
    return [answer_of(message) for message in _held(bus, POSE, REJECTED) if isinstance(message, Outcome)]


def _rows_held_by(bus: Bus) -> list[Row]:
    """Return the last row of each track, and of each node in a net, that earlier solvers have published."""
    return [message for message in _held(bus, TRACK, TRACK_LAG, NET_POSE) if isinstance(message, Row)]


def _held(bus: Bus, *topics: Topic) -> list[Message]:
    refusals = Refusals("solver, of what the hub holds")
    held = [refusals.open(received) for topic in topics for received in bus.newest(topic)]
    return [one.message for one in held if one]
