"""Alarms while the dive goes on: the survey's own checks over the last seconds, said on the bus as marks."""

from __future__ import annotations

import argparse
import logging
import threading
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Attitude, Depth, Imu, Mark, Message, NodeInfo, RelativePose
from buddyline.protocol.security import SURVEYOR
from buddyline.protocol.topics import ATTITUDE, DEPTH, IMU, INFO, MARK, POSE
from buddyline.tools.client import client_config
from buddyline.tools.live import LiveClient, follow
from buddyline.tools.survey import alarms
from buddyline.tools.survey.derive import one_leg
from buddyline.tools.survey.magnetism import Field, field_of
from buddyline.tools.survey.readings import Readings, of_messages
from buddyline.tools.survey.rests import rests
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from buddyline.tools.survey.shots import shoot
from buddyline.tools.survey.sights import sights

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, Publisher

log = logging.getLogger(__name__)

WINDOW_NS: Final = 8 * S_NS
CHECK_NS: Final = 2 * S_NS
# The same alarm is not said again within this time.
QUIET_NS: Final = 20 * S_NS
MEMORY: Final = 300
LEARNED: Final = 5


class LiveAlarms:
    """Takes the pair's messages in any order; returns alarms as marks on the node nearest to blame."""

    def __init__(self, settings: SurveySettings, limits: AlarmSettings) -> None:
        self._settings, self._limits = settings, limits
        self._infos: dict[str, NodeInfo] = {}
        self._recent: dict[tuple[type[Message], str], deque[Message]] = {}
        self._checked_ns = 0
        self._said_ns: dict[str, int] = {}
        self._fields: dict[str, deque[Field]] = {}

    def handle(self, message: Message) -> list[Mark]:
        """Take one message."""
        if isinstance(message, NodeInfo):
            self._infos[message.node] = message
        elif isinstance(message, RelativePose):
            self._keep(message, "", message.stamp_ns)
            if abs(message.stamp_ns - self._checked_ns) >= CHECK_NS:
                self._checked_ns = message.stamp_ns
                return self._check(message)
        elif isinstance(message, Attitude | Depth | Imu):
            self._keep(message, message.node, message.stamp_ns)
        return []

    def _keep(self, message: Message, node: str, stamp_ns: int) -> None:
        recent = self._recent.setdefault((type(message), node), deque())
        recent.append(message)
        while recent and abs(stamp_ns - int(getattr(recent[0], "stamp_ns"))) > WINDOW_NS:  # noqa: B009
            recent.popleft()

    def _messages(self) -> Iterator[Message]:
        yield from self._infos.values()
        for recent in self._recent.values():
            yield from recent

    def _check(self, pose: RelativePose) -> list[Mark]:
        if pose.node_a not in self._infos or pose.node_b not in self._infos:
            return []
        readings = of_messages(self._messages())
        found = self._field_alarms(readings, pose.stamp_ns)
        seen = sights(readings, self._settings)
        resting = [one for one in rests(readings, seen, self._settings) if not one.too_short]
        if resting:
            shot = shoot(readings, seen, resting[-1].chosen, self._settings)
            leg = one_leg(shot, readings.nodes)
            usual = alarms.UsualFields(None, None)
            for text in alarms.of_leg(leg, shot, usual, self._limits, readings.nodes):
                check, _, what = text.partition(": ")
                found.append((readings.nodes[0], check, what))
        return [mark for node, check, what in found if (mark := self._mark(node, check, what, pose.stamp_ns))]

    def _field_alarms(self, readings: Readings, now_ns: int) -> list[tuple[str, str, str]]:
        found = []
        for node in (readings.a, readings.b):
            now = field_of(node, now_ns - CHECK_NS, now_ns)
            if now is None:
                continue
            known = self._fields.setdefault(node.info.node, deque(maxlen=MEMORY))
            text = alarms.field_alarm(now, alarms.median_field(list(known)), self._limits)
            if text and len(known) >= LEARNED:
                found.append((node.info.node, "field", f"the magnetic field is not the usual one ({text})"))
            known.append(now)
        return found

    def _mark(self, node: str, check: str, what: str, stamp_ns: int) -> Mark | None:
        key = f"{node} {check}"
        if abs(stamp_ns - self._said_ns.get(key, -QUIET_NS)) < QUIET_NS:
            return None
        self._said_ns[key] = stamp_ns
        return Mark(node=node, stamp_ns=stamp_ns, kind="alarm", name=check, note=what)


class Watch:
    """The alarms on a bus: attached, it listens to the pair and publishes marks."""

    def __init__(self, bus: Bus, refusals: Refusals) -> None:
        self._alarms = LiveAlarms(SurveySettings(), AlarmSettings())
        self._bus, self._refusals = bus, refusals
        self._publishers: dict[str, Publisher] = {}
        self._lock = threading.Lock()

    def attach(self) -> None:
        """Subscribe."""
        follow(self._bus, INFO.key_any(), self._refusals, self._take)
        # In one, so that no pose closes a leg ahead of the depths that came before it.
        keys = tuple(topic.key_any() for topic in (ATTITUDE, DEPTH, IMU, POSE))
        follow(self._bus, keys, self._refusals, self._take, capacity=16384, history=False)

    def _take(self, envelope: Envelope) -> None:
        try:
            with self._lock:
                marks = self._alarms.handle(envelope.message)
        except BuddylineError as error:
            log.warning("survey watch: %s: %s", envelope.key, error)
            return
        for mark in marks:
            log.warning("%s: %s: %s", mark.node, mark.name, mark.note)
            publisher = self._publishers.get(mark.node)
            if publisher is None:
                publisher = self._publishers[mark.node] = self._bus.publisher(MARK, mark.node)
            publisher.put(mark)


def run_watch(args: argparse.Namespace, seconds: float | None) -> int:
    """Watch a bus until stopped."""
    client = LiveClient("survey watch", client_config(args, SURVEYOR), seconds)

    def watch(bus: Bus) -> None:
        Watch(bus, client.refusals).attach()
        client.wait()

    return client.run(watch)
