"""The live solver: subscribes to both nodes, feeds the core, publishes what it resolves."""

from __future__ import annotations

import logging
import math
import statistics
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from buddyline.protocol import __version__
from buddyline.protocol.clock import S_NS, Clock, SystemClock
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.errors import MessageError
from buddyline.protocol.health import CLOCKS_APART_S, HEADINGS_APART_RAD
from buddyline.protocol.messages import Candidates, Message, NodeInfo, Rejected, RelativePose, SolverStatus
from buddyline.protocol.service import Service
from buddyline.protocol.statusfile import StatusFile
from buddyline.protocol.topics import (
    ATTITUDE,
    CANDIDATES,
    DEPTH,
    INFO,
    POSE,
    REJECTED,
    SOLVER_STATUS,
)
from buddyline.solver_service.alignment import ClockAlignment, ClockOffset
from buddyline.solver_service.answered import Answered
from buddyline.solver_service.config import SolverConfig
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.health import NodeHealth
from buddyline.solver_service.streams import LIVE_WITHIN_NS
from msgspec import UNSET

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, Publisher, Received

log = logging.getLogger(__name__)

# A dive that pauses this long is taken as ended: what waits is resolved with what there is.
PAUSE_S: Final = 2.5
# The clocks' offset is reported once the dive tells it this well.
REPORTED_OFFSET_SIGMA_S: Final = 0.003
ALIGN_EVERY_S: Final = 10.0
BUFFERED_BEFORE_PAIR: Final = 4096
SOLVED_FROM: Final = (INFO, ATTITUDE, DEPTH, CANDIDATES)


class SolverService(Service):
    """Solves the configured pair, or the first two nodes that appear."""

    def __init__(self, config: SolverConfig, source: str = "defaults", clock: Clock | None = None) -> None:
        super().__init__("solver", StatusFile.of("solver", config.status_file))
        self.problems = ["no hub yet"]
        self.config = config
        self.clock = clock or SystemClock()
        self.refusals = Refusals("solver")
        self._settings = config.solve.settings(source)
        self._core: SolverCore | None = None
        self._before_pair: deque[Message] = deque(maxlen=BUFFERED_BEFORE_PAIR)
        self._seen: list[str] = []
        self._lock = threading.Lock()
        self._bus: Bus | None = None
        self._publishers: dict[str, Publisher] = {}
        self._latencies_s: deque[float] = deque(maxlen=2000)
        self._alive: set[str] = set()
        self._health: NodeHealth | None = None
        self._reported_bad = ""
        self._said: list[RelativePose | Rejected] = []
        self._answered = Answered()
        self._joined_ns: int | None = None
        self._alignment = ClockAlignment()
        self._offset: ClockOffset | None = None
        self._aligned_s = time.monotonic()
        if config.nodes:
            self._pair(*config.nodes)

    def start(self) -> None:
        """Start all threads."""
        self.spawn("bus", self._connect)

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
            bus.watch_alive(self._watch)
            bus.declare_alive(f"solver/{'_'.join(self.config.nodes) or 'any'}")
            log.info("solver: connected to %s", self.config.connect)
            self.problems = ["no two nodes yet"]
            while not self.stop.wait(1.0):
                self._report()
                self.going_on()
            self._publish(self._core.flush() if self._core else [])

    def attach(self, bus: Bus) -> None:
        """Subscribe to the nodes, and publish on this bus."""
        self._bus = bus
        self._said = _said_before(bus)
        if self._core is not None:
            self._declare(self._core)
        # In one, so that what the caches hold comes in order: a frame would not wait for an attitude a minute behind.
        bus.subscribe(tuple(topic.key_any() for topic in SOLVED_FROM), self.receive, capacity=32768)
        self._joined_ns = self.clock.now_ns()

    def receive(self, received: Received) -> None:
        """Take one message off the bus; a bad one is counted and reported, and stops nothing."""
        try:
            envelope = received.open()
        except MessageError as error:
            self.refusals.note(received.key, error)
            self._reported_bad = f"bad message on {received.key}: {error}"
            return
        message, node = envelope.message, envelope.node
        with self._lock:
            if isinstance(message, Candidates):
                new = self._joined_ns is not None and received.receive_ns > self._joined_ns
                if new:
                    # So are all after it, whatever becomes of the clock.
                    self._joined_ns = 0
                self._take_frame(message, received.receive_ns, new=new)
                return
            self._publish(self._handle(message, node, received.receive_ns))
            if self._health is not None and isinstance(message, NodeInfo):
                self._health.saw_period(node, message.trigger_period_ns)

    def _take_frame(self, frame: Candidates, came_ns: int, *, new: bool) -> None:
        """Handle a frame; new: it came after this solver had joined, and not out of a cache."""
        if self._health is not None:
            self._health.saw_frame(frame.node, frame.stamp_ns, time.monotonic())
        if not new and self._answered.is_over(frame.stamp_ns, self.clock.now_ns()):
            return
        self._publish(self._handle(frame, frame.node, came_ns))
        if new:
            self._publish(self._answered.saw_new_frame(frame.trigger))

    def _watch(self, name: str, alive: bool) -> None:
        """Say at once that a node has come or gone."""
        with self._lock:
            (self._alive.add if alive else self._alive.discard)(name)
            if self._health is not None:
                self._health.saw_process(name, alive)
        self._report()

    def _handle(self, message: Message, node: str, came_ns: int) -> list[RelativePose | Rejected]:
        if self._core is not None:
            return self._core.handle(message, came_ns)
        self._before_pair.append(message)
        if isinstance(message, NodeInfo | Candidates) and node not in self._seen:
            self._seen.append(node)
        if len(self._seen) < 2:
            return []
        core = self._pair(*sorted(self._seen[:2]))
        results = [result for waiting in self._before_pair for result in core.handle(waiting, came_ns)]
        self._before_pair.clear()
        return results

    def _pair(self, node_a: str, node_b: str) -> SolverCore:
        self._core = SolverCore(node_a, node_b, self._settings, alignment=self._alignment)
        self._health = NodeHealth(node_a, node_b)
        for name in self._alive:
            self._health.saw_process(name, True)
        log.info("solver: pair %s, %s", node_a, node_b)
        if self._bus is not None:
            self._declare(self._core)
        return self._core

    def _declare(self, core: SolverCore) -> None:
        if self._bus is None:
            return
        pair = core.node_a, core.node_b
        self._answered = Answered(one for one in self._said if (one.node_a, one.node_b) == pair)
        for topic in (POSE, REJECTED, SOLVER_STATUS):
            self._publishers[topic.name] = self._bus.publisher(topic, core.node_a, core.node_b)

    def _publish(self, results: list[RelativePose | Rejected]) -> None:
        now_ns = self.clock.now_ns()
        for result in self._answered.unsaid(results):
            topic = POSE if isinstance(result, RelativePose) else REJECTED
            self._publishers[topic.name].put(result)
            age_ns = now_ns - result.stamp_ns
            if topic is POSE and 0 <= age_ns < LIVE_WITHIN_NS:
                self._latencies_s.append(age_ns / S_NS)

    def _report(self) -> None:
        with self._lock:
            core = self._core
            if core is None:
                return
            newest_s = self._health.newest_frame_s() if self._health is not None else None
            if core.pending and (newest_s is None or time.monotonic() - newest_s > PAUSE_S):
                self._publish(core.flush())
            self.status_message = status = self.status(core)
            self.problems = [status.problem] if status.problem else []
            self._publishers[SOLVER_STATUS.name].put(status)

    def status(self, core: SolverCore) -> SolverStatus:
        """Return the solver's health."""
        now_s = time.monotonic()
        problems = self._health.problems(now_s) if self._health is not None else []
        if self._reported_bad:
            problems.append(self._reported_bad)
            self._reported_bad = ""
        if now_s - self._aligned_s > ALIGN_EVERY_S:
            found = self._alignment.estimate()
            self._offset = found if found is not None and found.sigma_s < REPORTED_OFFSET_SIGMA_S else None
            self._aligned_s = now_s
        offset = self._offset
        if offset is not None and abs(offset.offset_s) > max(CLOCKS_APART_S, 4 * offset.sigma_s):
            problems.append(f"clock of {core.node_b} is {offset.offset_s * 1e3:+.1f} ms from that of {core.node_a}")
        heading = core.heading
        if heading is not None and abs(heading.offset_rad) > HEADINGS_APART_RAD:
            apart_deg = math.degrees(abs(heading.offset_rad))
            nodes = f"{core.node_a} and {core.node_b}"
            problems.append(
                f"compasses of {nodes} disagree by {apart_deg:.0f} deg: is one near steel, or not calibrated?"
            )
        latencies_s = sorted(self._latencies_s)
        self._latencies_s.clear()
        received_a, received_b = core.received
        return SolverStatus(
            node_a=core.node_a,
            node_b=core.node_b,
            stamp_ns=self.clock.now_ns(),
            software=f"buddyline {__version__}",
            received_a=received_a,
            received_b=received_b,
            matched=core.matched,
            solved=core.counts["solved"],
            rejected={reason: count for reason, count in sorted(core.counts.items()) if reason != "solved"},
            late=core.late,
            duplicates=core.duplicates,
            bad_messages=self.refusals.count,
            pending=core.pending,
            latency_median_s=statistics.median(latencies_s) if latencies_s else UNSET,
            latency_p99_s=latencies_s[min(len(latencies_s) * 99 // 100, len(latencies_s) - 1)]
            if latencies_s
            else UNSET,
            clock_skew_s=UNSET if offset is None else offset.offset_s,
            problem="; ".join(problems),
        )


def _said_before(bus: Bus) -> list[RelativePose | Rejected]:
    """Return the last of what solvers before this one have said of each pair."""
    refusals = Refusals("solver, of what the hub holds")
    held = [refusals.open(received) for topic in (POSE, REJECTED) for received in bus.newest(topic)]
    return [one.message for one in held if one and isinstance(one.message, RelativePose | Rejected)]
