"""Alarms during a dive: the survey's checks over the last seconds, published as marks."""

from __future__ import annotations

import argparse
import logging
import threading
from collections import deque
from typing import TYPE_CHECKING, Final, TypeAlias

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
from buddyline.tools.survey.magnetism import Field, field_alarm, field_of, usual_field
from buddyline.tools.survey.readings import NodeReadings, of_messages
from buddyline.tools.survey.rests import rests
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from buddyline.tools.survey.shots import shoot
from buddyline.tools.survey.sights import sights

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, Publisher

log = logging.getLogger(__name__)

WINDOW_NS: Final = 8 * S_NS
CHECK_NS: Final = 2 * S_NS
# The same alarm is not repeated within this time.
QUIET_NS: Final = 20 * S_NS
MEMORY: Final = 300
LEARNED: Final = 5

_Stamped: TypeAlias = RelativePose | Attitude | Depth | Imu


class LiveAlarms:
    """Takes messages of any number of nodes, in any order; returns alarms as marks of the node most likely at fault."""

    def __init__(self, settings: SurveySettings, limits: AlarmSettings) -> None:
        self._settings, self._limits = settings, limits
        self._infos: dict[str, NodeInfo] = {}
        # By kind and by the ids of its node or pair.
        self._recent: dict[tuple[type[Message], tuple[str, ...]], deque[_Stamped]] = {}
        self._checked_ns: dict[tuple[str, str], int] = {}
        self._said_ns: dict[str, int] = {}
        self._fields: dict[str, deque[Field]] = {}

    def handle(self, message: Message) -> list[Mark]:
        """Take one message."""
        if isinstance(message, NodeInfo):
            self._infos[message.node] = message
        elif isinstance(message, RelativePose):
            pair = message.node_a, message.node_b
            self._keep(message, pair)
            if abs(message.stamp_ns - self._checked_ns.get(pair, 0)) >= CHECK_NS:
                self._checked_ns[pair] = message.stamp_ns
                return self._check(pair, message.stamp_ns)
        elif isinstance(message, Attitude | Depth | Imu):
            self._keep(message, (message.node,))
        return []

    def _keep(self, message: _Stamped, ids: tuple[str, ...]) -> None:
        recent = self._recent.setdefault((type(message), ids), deque())
        recent.append(message)
        while abs(message.stamp_ns - recent[0].stamp_ns) > WINDOW_NS:
            recent.popleft()

    def _check(self, pair: tuple[str, str], now_ns: int) -> list[Mark]:
        if not set(pair) <= set(self._infos):
            return []
        sensed = (message for (_, ids), recent in self._recent.items() if {*ids} <= {*pair} for message in recent)
        (readings,) = of_messages([*(self._infos[node] for node in pair), *sensed])
        found = [(node.info.node, f"field: {text}") for node in readings.pair if (text := self._field(node, now_ns))]
        seen = sights(readings, self._settings)
        resting = [rest for rest in rests(readings, seen, self._settings) if not rest.too_short]
        if resting:
            shot = shoot(readings, seen, resting[-1].chosen, self._settings)
            leg = one_leg(shot, {node: node for node in pair}, pair[0])
            # The usual fields are learned here over minutes, not from one rest.
            found += [(pair[0], text) for text in alarms.of_leg(leg, shot, {}, self._limits)]
        return [mark for node, text in found if (mark := self._mark(node, text, now_ns))]

    def _field(self, node: NodeReadings, now_ns: int) -> str:
        """Return what is wrong with a node's present field, and learn the usual field from it; empty if nothing."""
        now = field_of(node, now_ns - CHECK_NS, now_ns)
        if now is None:
            return ""
        known = self._fields.setdefault(node.info.node, deque(maxlen=MEMORY))
        text = field_alarm(now, usual_field(known), self._limits) if len(known) >= LEARNED else ""
        known.append(now)
        return text

    def _mark(self, node: str, text: str, stamp_ns: int) -> Mark | None:
        """Return an alarm (`check: what`) as a mark; None if it was published a moment ago."""
        check, _, what = text.partition(": ")
        key = f"{node} {check}"
        if abs(stamp_ns - self._said_ns.get(key, -QUIET_NS)) < QUIET_NS:
            return None
        self._said_ns[key] = stamp_ns
        return Mark(node=node, stamp_ns=stamp_ns, kind="alarm", name=check, note=what)


class Watch:
    """The alarms on a bus: attached, it listens to all nodes and pairs, and publishes marks."""

    def __init__(self, bus: Bus, refusals: Refusals) -> None:
        self._alarms = LiveAlarms(SurveySettings(), AlarmSettings())
        self._bus, self._refusals = bus, refusals
        self._publishers: dict[str, Publisher] = {}
        self._lock = threading.Lock()

    def attach(self) -> None:
        """Subscribe."""
        follow(self._bus, INFO.key_any(), self._refusals, self._take)
        # One subscription keeps the order: no pose may close a leg before the depths that were sent before it.
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
            if mark.node not in self._publishers:
                self._publishers[mark.node] = self._bus.publisher(MARK, mark.node)
            self._publishers[mark.node].put(mark)


def run_watch(args: argparse.Namespace, seconds: float | None) -> int:
    """Watch a bus until stopped."""
    client = LiveClient("survey watch", client_config(args, SURVEYOR), seconds)

    def watch(bus: Bus) -> None:
        Watch(bus, client.refusals).attach()
        client.wait()

    return client.run(watch)
