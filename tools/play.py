"""`buddyline play`: send stored dives over the bus at the speed at which they were recorded, or another."""

from __future__ import annotations

import argparse
import logging
import math
import threading
import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Final

from buddyline.protocol.clock import S_NS, Clock, SystemClock
from buddyline.protocol.codec import payload_stamp_ns
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CompressedImage, FoxgloveTime, Message, NodeInfo
from buddyline.protocol.security import PLAYER
from buddyline.protocol.topics import (
    CANDIDATES,
    CLOCK,
    CLOCK_SET,
    DIGEST,
    IMAGE,
    IMU_MEANS,
    INFO,
    POSE,
    REJECTED,
    TOPICS,
    parse_key,
)
from buddyline.tools.client import client_config
from buddyline.tools.dives import Dive
from buddyline.tools.live import LiveClient
from buddyline.tools.progress import Progress
from msgspec import UNSET
from msgspec.structs import replace

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, Publisher, Received

log = logging.getLogger(__name__)

# Results are not sent, because a solver on the bus computes them again. Clock beacons are not sent, because they say
# nothing about the clocks of the nodes that are on the bus now. Digests are not sent, because not all is sent. The log
# has the samples themselves that a slow link had means of.
SENT: Final = tuple(
    topic.name for topic in TOPICS if not topic.solved and topic not in (CLOCK, CLOCK_SET, DIGEST, IMU_MEANS)
)
# Pictures are sent as previews only, to leave the bus to the solver's data.
IMAGES_HZ: Final = 2.0
# At --speed 0, the dive may run ahead of the solver's outcomes by this much of the dive's time. It is less than the
# solver's wait for a silent node (2 s), so that a sample which is fetched late does not count as lost ...
AHEAD_NS: Final = 1_500_000_000
# ... and more where a node is silent in the dive itself, because there the solver does wait.
AHEAD_OF_SILENT_NS: Final = 2_200_000_000
# A solver that waits for a lost sample gets one more trigger's messages after RELEASE_S, up to so far ahead: they show
# what is missing sooner than a publisher's heartbeats, for which the solver does not wait.
RELEASE_S: Final = 0.25
AHEAD_AT_MOST_NS: Final = 1_800_000_000
# A solver without outcomes for this time waits for something that the dive does not have.
SOLVER_SILENT_S: Final = 5.0
# After the last message: longer than a publisher's heartbeat (2 s), which tells subscribers that they have missed it.
LINGER_S: Final = 4.0
# The calibration is sent this long before the frames, which have a higher priority on the bus.
INFO_AHEAD_S: Final = 0.3


class SolverFollower:
    """Follows a solver's outcomes on the bus, so that playback neither outruns it nor leaves before it is done."""

    def __init__(self, bus: Bus, nodes: Iterable[str]) -> None:
        self._changed = threading.Condition()
        self._resolved_ns = -1
        self._heard_s = time.monotonic()
        self._solvers: set[str] = set()
        self._sent_ns = dict.fromkeys(nodes, -1)
        for topic in (POSE, REJECTED):
            bus.subscribe(topic.key_any(), self._hear, capacity=4096, history=False)
        bus.watch_alive(self._watch)

    def _hear(self, received: Received) -> None:
        with self._changed:
            self._resolved_ns = max(self._resolved_ns, payload_stamp_ns(received.payload) or -1)
            self._heard_s = time.monotonic()
            self._changed.notify_all()

    def _watch(self, name: str, alive: bool) -> None:
        node = name.removeprefix("node/")
        if alive and node != name and node in self._sent_ns:
            log.warning(
                "play: node %s runs on this bus, and its messages mix with the dive's: poses of both may be wrong; "
                "stop one of them, or play to a hub of its own (--connect)",
                node,
            )
        with self._changed:
            if name.startswith("solver/"):
                (self._solvers.add if alive else self._solvers.discard)(name)
                self._heard_s = time.monotonic()
            self._changed.notify_all()

    def wait_to_send(self, stamp_ns: int, stop: threading.Event) -> None:
        """Wait until the solver's outcomes are close to stamp_ns, of the next frame; no wait without a solver."""
        with self._changed:
            if self._resolved_ns < 0:
                # Everything before the first frame counts as resolved.
                self._resolved_ns = stamp_ns
            silent = min(self._sent_ns.values(), default=-1) < stamp_ns - AHEAD_NS
            if not silent:
                self._wait_for(stamp_ns - AHEAD_NS, stop, RELEASE_S)
            self._wait_for(stamp_ns - (AHEAD_OF_SILENT_NS if silent else AHEAD_AT_MOST_NS), stop)

    def take_sent(self, node: str, stamp_ns: int) -> None:
        """Take the stamp of a frame that was sent."""
        with self._changed:
            self._sent_ns[node] = stamp_ns

    def wait_for_last(self, stop: threading.Event) -> None:
        """Wait until the solver has given the outcome of all nodes' last frames; no wait without a solver."""
        with self._changed:
            self._wait_for(min(self._sent_ns.values(), default=-1), stop)

    def _wait_for(self, stamp_ns: int, stop: threading.Event, longest_s: float = math.inf) -> None:
        end_s = time.monotonic() + longest_s
        while (
            self._solvers
            and self._resolved_ns < stamp_ns
            and time.monotonic() < min(self._heard_s + SOLVER_SILENT_S, end_s)
            and not stop.is_set()
        ):
            self._changed.wait(0.1)


class Player:
    """Sends a dive's messages in order, each at its time."""

    def __init__(self, bus: Bus, nodes: Iterable[str], speed: float, clock: Clock, stop: threading.Event) -> None:
        self.sent = 0
        self._bus = bus
        self._speed = speed
        self._clock = clock
        self._stop = stop
        self._publishers: dict[str, Publisher] = {}
        self._follower = SolverFollower(bus, nodes)
        self._image_due_ns: dict[str, int] = {}
        self._first_ns: int | None = None
        self._began_ns = 0

    def declare(self, keys: list[str]) -> None:
        """Declare the publishers of a dive, so that subscribers find them before the first message."""
        for key in keys:
            parsed = parse_key(key)
            if parsed and parsed[0].name in SENT and key not in self._publishers:
                self._publishers[key] = self._bus.publisher(parsed[0], *parsed[1])

    def send_infos(self, infos: Iterable[NodeInfo]) -> None:
        """Send the first calibration of each node, ahead of everything else."""
        for info in infos:
            self._publishers[INFO.key(info.node)].put(info)
        self._stop.wait(INFO_AHEAD_S)

    def send(self, envelope: Envelope, shift_triggers: int = 0, period_ns: int = S_NS) -> None:
        """Wait for a message's time, and send it with its stamp moved on by shift_triggers triggers."""
        time_ns = envelope.time_ns + shift_triggers * period_ns
        if self._first_ns is None:
            self._first_ns, self._began_ns = time_ns, self._clock.now_ns()
        if self._speed > 0:
            self._clock.wait_until_ns(self._began_ns + round((time_ns - self._first_ns) / self._speed), self._stop)
        if self._stop.is_set():
            return
        if envelope.topic is IMAGE and not self._image_is_due(envelope.key):
            return
        if envelope.topic is CANDIDATES:
            if self._speed == 0:
                self._follower.wait_to_send(time_ns, self._stop)
            self._follower.take_sent(envelope.node, time_ns)
        publisher = self._publishers[envelope.key]
        if shift_triggers:
            publisher.put(_shifted(envelope.message, shift_triggers, period_ns))
        else:
            publisher.put_bytes(envelope.payload)
        self.sent += 1

    def finish(self) -> None:
        """Stay until a solver is done with the dive: subscribers may still fetch lost samples from this process."""
        self._follower.wait_for_last(self._stop)
        self._stop.wait(LINGER_S)

    def _image_is_due(self, key: str) -> bool:
        if self._clock.now_ns() < self._image_due_ns.get(key, 0):
            return False
        self._image_due_ns[key] = self._clock.now_ns() + round(S_NS / IMAGES_HZ)
        return True


def _shifted(message: Message, triggers: int, period_ns: int) -> Message:
    """Return a message with its stamp and trigger moved on by `triggers`."""
    shift_ns = triggers * period_ns
    if isinstance(message, CompressedImage):
        stamp_ns = message.stamp_ns + shift_ns
        return replace(message, timestamp=FoxgloveTime(sec=stamp_ns // S_NS, nsec=stamp_ns % S_NS))
    changes = {"stamp_ns": getattr(message, "stamp_ns") + shift_ns}  # noqa: B009
    trigger = getattr(message, "trigger", UNSET)
    if trigger is not UNSET:
        changes["trigger"] = trigger + triggers
    return replace(message, **changes)


def run(args: argparse.Namespace) -> int:
    """Play until the dive's end, or until stopped."""
    if not (math.isfinite(args.speed) and args.speed >= 0):
        raise BuddylineError(f"--speed {args.speed}: 0 or more")
    client = LiveClient("play", client_config(args, PLAYER))
    with Dive(args.dives) as dive:
        start_ns, stop_ns = _span(dive, args.start, args.end)
        if not dive.nodes("candidates"):
            log.warning("play: %s holds no candidates: a solver finds nothing; run `buddyline detect` first", dive.name)

        def play(bus: Bus) -> None:
            bus.declare_alive("player")
            player = Player(bus, dive.nodes("candidates"), args.speed, SystemClock(), client.stop)
            player.declare(dive.keys)
            player.send_infos(dive.infos().values())
            period_ns = max((info.trigger_period_ns for info in dive.infos().values()), default=S_NS)
            laps_triggers = (stop_ns - start_ns) // period_ns + 2
            lap = 0
            while not client.stop.is_set() and (lap == 0 or args.loop):
                with Progress("play", (stop_ns - start_ns) / S_NS) as progress:
                    for envelope in _selected(dive, start_ns, stop_ns):
                        if client.stop.is_set():
                            break
                        player.send(envelope, lap * laps_triggers, period_ns)
                        progress.show((envelope.time_ns - start_ns) / S_NS)
                lap += 1
            player.finish()
            log.info("play: %d messages sent, %d bad", player.sent, dive.refused)

        return client.run(play)


def _span(dive: Dive, start_s: float, end_s: float | None) -> tuple[int, int]:
    first_ns, last_ns = dive.start_ns, dive.end_ns
    start_ns = first_ns + round(start_s * S_NS)
    stop_ns = last_ns + 1 if end_s is None else first_ns + round(end_s * S_NS)
    if not first_ns <= start_ns <= last_ns or stop_ns <= start_ns:
        given = f"--start {start_s:g}" + ("" if end_s is None else f" --end {end_s:g}")
        raise BuddylineError(f"{given}: the dive goes from 0 to {(last_ns - first_ns) / S_NS:.1f} s")
    return start_ns, stop_ns


def _selected(dive: Dive, start_ns: int, stop_ns: int) -> Iterator[Envelope]:
    """Yield the messages to send, between start_ns and stop_ns, and calibrations from before start_ns.

    What stands in two logs, as in a dive and the solved dive, is sent once. What stands twice in one log is sent twice.
    """
    sent, at_ns = set[tuple[str, bytes]](), -1
    for envelope in dive.messages(*SENT):
        if envelope.time_ns >= stop_ns:
            return
        if len(dive.readers) > 1:
            if envelope.time_ns != at_ns:
                sent, at_ns = set(), envelope.time_ns
            if (envelope.key, envelope.payload) in sent:
                continue
            sent.add((envelope.key, envelope.payload))
        if envelope.time_ns >= start_ns or envelope.topic is INFO:
            yield envelope
