"""Good or again: each rest is judged while the divers are still there, and the verdict is published as marks."""

from __future__ import annotations

import argparse
import logging
import threading
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    Depth,
    Imu,
    Mark,
    Message,
    NodeInfo,
    Rejected,
    RelativePose,
)
from buddyline.protocol.security import SURVEYOR
from buddyline.protocol.topics import ATTITUDE, CANDIDATES, DEPTH, IMU, INFO, MARK, POSE, REJECTED
from buddyline.tools.client import client_config
from buddyline.tools.live import LiveClient, follow
from buddyline.tools.survey import alarms
from buddyline.tools.survey.blinks import new_blinks
from buddyline.tools.survey.chain import Standing, find_standings
from buddyline.tools.survey.derive import doubt_of, note_name, one_leg, rest_of, stop_of, time_text
from buddyline.tools.survey.magnetism import Field, off_usual, usual_field
from buddyline.tools.survey.project import STATION_NAME, Leg
from buddyline.tools.survey.readings import of_messages
from buddyline.tools.survey.recognition import recognized
from buddyline.tools.survey.rests import PAUSE_NS, Rest, rests
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from buddyline.tools.survey.shots import Shot, shoot
from buddyline.tools.survey.sights import sights
from msgspec import UNSET

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, Publisher

log = logging.getLogger(__name__)

# A rest is judged after this time; a shorter one once it is over.
JUDGED_NS: Final = 10 * S_NS
CHECK_NS: Final = S_NS
OVER_NS: Final = 6 * S_NS
# Messages are kept for this time; in a longer rest from BEFORE_NS before its start, but at most for LONGEST_NS.
WINDOW_NS: Final = 25 * S_NS
BEFORE_NS: Final = 8 * S_NS
LONGEST_NS: Final = 120 * S_NS
MARKS: Final = 2048
# A node's usual field is known when so many more rests have it than have another one.
WITNESSES: Final = 3

_Stamped: TypeAlias = RelativePose | Rejected | Attitude | Candidates | Depth | Imu


@dataclass(eq=False)
class _JudgedRest:
    """A rest, what it gives, and the checks that were said to fail. start_ns: as first judged."""

    rest: Rest
    shot: Shot | None
    start_ns: int
    said: set[str] | None = None


@dataclass(eq=False)
class _Pair:
    """A pair's rests of this dive, all that it has seen of the present one, and when it was looked at last."""

    nodes: tuple[str, str]
    judged: list[_JudgedRest] = field(default_factory=list)
    checked_ns: int = 0


class LiveLegs:
    """Takes messages of any number of nodes, in any order; returns marks: verdicts on rests, points by blinks.

    A verdict is a mark of both nodes; where there are more than two, its note begins with the pair. Three blinks are
    one mark of the node that blinked, however many nodes see them.
    Mark of kind `leg` and name `good`: the leg carries no alarm. Of kind `alarm`: measure again; its name is the check.
    A rest is judged by what `survey legs` would say of it. Later rests may show more of an earlier one, by the usual
    magnetic field: then the mark is of an earlier leg, and its note begins with that leg's name and time (after the
    pair).
    """

    def __init__(self, settings: SurveySettings, limits: AlarmSettings) -> None:
        self._settings, self._limits = settings, limits
        self._infos: dict[str, NodeInfo] = {}
        # By kind and by the ids of its node or pair.
        self._recent: dict[tuple[type[Message], tuple[str, ...]], deque[_Stamped]] = {}
        self._pairs: dict[tuple[str, str], _Pair] = {}
        self._blinks: deque[Mark] = deque(maxlen=MARKS)
        self._marks: deque[Mark] = deque(maxlen=MARKS)

    def handle(self, message: Message) -> list[Mark]:
        """Take one message."""
        if isinstance(message, NodeInfo):
            self._infos[message.node] = message
        elif isinstance(message, Mark) and message.kind == "station" and STATION_NAME.match(message.name):
            self._marks.append(message)
        elif isinstance(message, RelativePose | Rejected):
            nodes = message.node_a, message.node_b
            pair = self._pairs.setdefault(nodes, _Pair(nodes))
            self._keep(message, nodes)
            if abs(message.stamp_ns - pair.checked_ns) >= CHECK_NS and set(nodes) <= set(self._infos):
                pair.checked_ns = message.stamp_ns
                return self._check(pair, message.stamp_ns)
        elif isinstance(message, Attitude | Candidates | Depth | Imu):
            self._keep(message, (message.node,))
        return []

    def _keep(self, message: _Stamped, ids: tuple[str, ...]) -> None:
        recent = self._recent.setdefault((type(message), ids), deque())
        recent.append(message)
        begins = [
            pair.judged[-1].rest.start_ns - BEFORE_NS
            for pair in self._pairs.values()
            if pair.judged and set(ids) & set(pair.nodes)
        ]
        reach_ns = max([WINDOW_NS, *(message.stamp_ns - begin_ns for begin_ns in begins)])
        while abs(message.stamp_ns - recent[0].stamp_ns) > min(reach_ns, LONGEST_NS):
            recent.popleft()

    def _check(self, pair: _Pair, now_ns: int) -> list[Mark]:
        nodes = set(pair.nodes)
        if (RelativePose, pair.nodes) not in self._recent:
            return []
        sensed = (message for (_, ids), recent in self._recent.items() if {*ids} <= nodes for message in recent)
        (readings,) = of_messages([*(self._infos[node] for node in pair.nodes), *sensed])
        seen = sights(readings, self._settings)
        # No marks went in: these are what the pictures show.
        said = new_blinks(readings.marks, self._blinks)
        self._blinks += said
        for rest in rests(readings, seen, self._settings):
            known = next((one for one in pair.judged if _same(one.rest, rest)), None)
            if known is not None and (known is not pair.judged[-1] or rest.too_short):
                continue
            over = now_ns - rest.end_ns > OVER_NS
            if not over and (rest.too_short or now_ns - rest.start_ns < JUDGED_NS):
                continue
            shot = None if rest.too_short else shoot(readings, seen, rest.chosen, self._settings, rest.unused)
            if known is None:
                known = _JudgedRest(rest, shot, rest.start_ns)
                pair.judged.append(known)
            elif rest.end_ns > known.rest.end_ns:
                known.rest, known.shot = rest, shot
            said += self._judge(pair, now_ns)
        return said

    def _judge(self, pair: _Pair, now_ns: int) -> list[Mark]:
        """Return what is new to be said of all rests, the present one's verdict among it."""
        legs = [one for one in pair.judged if one.shot is not None]
        usual = {
            node: self._usual([one.shot.ends[i].field for one in legs if one.shot is not None])
            for i, node in enumerate(pair.nodes)
        }
        standings = self._standings(pair, legs)
        said = []
        measured: list[Leg] = []
        for one in pair.judged:
            if one.shot is None:
                which = "rest"
                text = f"{one.rest.too_short}; a leg takes {self._settings.rest_s:g} s"
                found, words = {"rest": text}, ""
            else:
                standing, doubts = standings[id(one)]
                leg = one_leg(one.shot, standing.station, standing.rear, usual)
                measured.append(leg)
                which = f"leg {leg.name}"
                texts = [*alarms.of_leg(leg, one.shot, usual, self._limits), *doubts]
                found = {check: what for check, _, what in (text.partition(": ") for text in texts)}
                words = _words(leg) if one.said is None and not found else ""
                words += _question(measured) if words and one is pair.judged[-1] else ""
            fresh = {check: what for check, what in found.items() if check not in (one.said or set())}
            earlier = one is not pair.judged[-1]
            late = f"{which} of {time_text(one.start_ns)}: " if earlier else ""
            new: list[tuple[Literal["alarm", "leg"], str, str]]
            new = [("alarm", check, late + what) for check, what in fresh.items()]
            new += [("leg", "good", words)] if one.said is None and not found else []
            said += [
                Mark(
                    node=node,
                    stamp_ns=now_ns,
                    kind=kind,
                    name=name,
                    note=note if len(self._infos) < 3 else f"{'/'.join(pair.nodes)}: {note}",
                    leg_ns=one.start_ns,
                    earlier=earlier,
                )
                for node in pair.nodes
                for kind, name, note in new
            ]
            one.said = (one.said or set()) | set(found)
        return said

    def _usual(self, fields: list[Field | None]) -> Field | None:
        """Return a node's usual field; None until enough more rests have it than another one."""
        usual = usual_field(fields)
        others = sum(off_usual(one, usual, self._limits) > 1 for one in fields)
        known = sum(one is not None for one in fields)
        return usual if known - 2 * others >= WITNESSES else None

    def _standings(self, pair: _Pair, legs: list[_JudgedRest]) -> dict[int, tuple[Standing, list[str]]]:
        """Return each leg's stations, and what is doubtful about them, by the id of its rest."""
        named: list[dict[str, str]] = [{} for _ in legs]
        tagged: list[set[str]] = [set() for _ in legs]
        for mark in sorted(self._marks, key=lambda one: one.tag is UNSET):
            at = rest_of(mark, [one.rest for one in legs])
            if at is not None and mark.node in pair.nodes:
                note_name(mark, named[at], tagged[at])
        stops = [
            stop_of(one.rest, one.shot, stations, read)
            for one, stations, read in zip(legs, named, tagged, strict=True)
            if one.shot is not None
        ]
        standings = find_standings(stops, self._settings.procedure, self._settings.first)
        lost = {id(pair.judged[i]) for i in range(1, len(pair.judged)) if pair.judged[i - 1].shot is None}
        return {
            id(one): (standing, doubt_of(standing.problem, stations, after_lost=id(one) in lost))
            for one, standing, stations in zip(legs, standings, named, strict=True)
        }


def _same(one: Rest, other: Rest) -> bool:
    """Tell whether two rests have time in common; refused poses beside a rest are of it."""
    beside_ns = PAUSE_NS if other.too_short and one.too_short == "" else 0
    return one.start_ns - beside_ns <= other.end_ns and other.start_ns <= one.end_ns + beside_ns


def _words(leg: Leg) -> str:
    seconds = (leg.end_ns - leg.start_ns) / S_NS
    return f"{leg.distance_m:.2f} m, {seconds:.0f} s with {leg.fixes} fixes"


def _question(legs: list[Leg]) -> str:
    """Return which earlier station an end of the last leg may be, in words, or ""."""
    try:
        found = recognized(legs)
    except BuddylineError:
        return ""
    return f"; {found[0].question}: if it is, mark it" if found else ""


class Watch:
    """The verdicts on a bus: attached, it listens to all nodes and pairs, and publishes marks."""

    def __init__(self, bus: Bus, refusals: Refusals) -> None:
        self._legs = LiveLegs(SurveySettings(), AlarmSettings())
        self._bus, self._refusals = bus, refusals
        self._publishers: dict[str, Publisher] = {}
        self._lock = threading.Lock()

    def attach(self) -> None:
        """Subscribe."""
        follow(self._bus, INFO.key_any(), self._refusals, self._take)
        # One subscription keeps the order: no pose may close a leg before the depths that were sent before it.
        keys = tuple(topic.key_any() for topic in (ATTITUDE, CANDIDATES, DEPTH, IMU, POSE, REJECTED, MARK))
        follow(self._bus, keys, self._refusals, self._take, capacity=16384, history=False)

    def _take(self, envelope: Envelope) -> None:
        try:
            with self._lock:
                marks = self._legs.handle(envelope.message)
        except BuddylineError as error:
            log.warning("survey watch: %s: %s", envelope.key, error)
            return
        for mark in marks:
            level = logging.WARNING if mark.kind == "alarm" else logging.INFO
            log.log(level, "%s: %s: %s", mark.node, mark.name or mark.kind, mark.note)
            if mark.node not in self._publishers:
                self._publishers[mark.node] = self._bus.publisher(MARK, mark.node)
            self._publishers[mark.node].put(mark)


def run_watch(args: argparse.Namespace, seconds: float | None) -> int:
    """Watch a bus until stopped."""
    client = LiveClient("survey watch", client_config(args, SURVEYOR), seconds)

    def watch(bus: Bus) -> None:
        Watch(bus, client.refusals).attach()
        log.info("survey watch: %s: each rest is judged at its tenth second; Ctrl-C ends", client.config.connect)
        client.wait()

    return client.run(watch)
