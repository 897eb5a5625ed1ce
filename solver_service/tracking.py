"""One pair's track out of both nodes' streams: what the estimator is given, when, and the messages that it makes.

The estimator is in `track/`. Everything here is a function of the messages so far: a live dive and its log give the
same track.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import (
    Expect,
    Imu,
    Message,
    NodeInfo,
    Rejected,
    RelativePose,
    TrackMode,
)
from buddyline.solver_service.pace import NO_TRACK
from buddyline.solver_service.resting import LOOK_APART, LOOKS, REST_NS
from buddyline.solver_service.results import NUMERIC_ERRORS, view_of, wrong_size
from buddyline.solver_service.sensors import KEPT_NS
from buddyline.solver_service.streams import NodeStream
from buddyline.solver_service.track.clocks import Clocks, clock_now, clocks_of
from buddyline.solver_service.track.dive import smooth
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.forecasts import DueRow, Forecast, make_rows, work_out
from buddyline.solver_service.track.foresight import Foresight, foresee
from buddyline.solver_service.track.inputs import DepthSeen, FixSeen, TrackNode
from buddyline.solver_service.track.lag import EVERY_S, KEPT_S, TrackLag
from buddyline.solver_service.track.lamps import UNSEEN_PICTURES, UNSEEN_S
from buddyline.solver_service.track.moving import HOLD_S
from buddyline.solver_service.track.output import TrackRow
from buddyline.solver_service.track.problems import ENDED_S, as_ended, merged, present
from buddyline.solver_service.track.records import NodeRecord, Records, feed, joined
from buddyline.solver_service.track_messages import (
    attitudes_of,
    expected_light,
    fix_of,
    frame_of,
    same_rig,
    track_message,
    track_node_of,
)

# For how long after its stamp an expectation serves: its sigma has grown to a large part of the picture by then.
EXPECT_VALID_NS: Final = S_NS // 2
# A start takes about as many triggers before it is sure of itself.
FEW: Final = 5


@dataclass(frozen=True)
class TrackSettings:
    """modes: the tracks to make, at rate_hz rows a second. expect: tell both nodes where to look for the lights."""

    modes: frozenset[TrackMode]
    rate_hz: float = 20.0
    expect: bool = False


@dataclass(frozen=True, eq=False)
class Coming:
    """What a pair is about to tell: messages, then its tracks' rows, then where its nodes should look for lights.

    stamps_ns: by node, of its next picture. oriented: whether an attitude says where north is.
    """

    messages: Sequence[Message] = ()
    rows: Sequence[tuple[DueRow | TrackRow, TrackMode]] = ()
    foresight: Foresight | None = None
    stamps_ns: Mapping[int, int] = field(default_factory=dict)
    oriented: bool = False

    @property
    def due(self) -> list[DueRow]:
        """The rows that are to be made."""
        return [row for row, _ in self.rows if isinstance(row, DueRow)]

    @property
    def forecasts(self) -> list[Forecast]:
        """What is to be worked out."""
        beside = [] if self.foresight is None else [self.foresight.present]
        return [row.forecast for row in self.due] + beside


def work_out_together(of_pairs: Sequence[Coming]) -> None:
    """Work out what some pairs are about to tell, in one set of arrays."""
    with np.errstate(all="ignore"):
        try:
            work_out(each for one in of_pairs for each in one.forecasts)
            make_rows(each for one in of_pairs for each in one.due)
        except NUMERIC_ERRORS:
            # Whose values are out of range shows where each pair's are worked out by themselves.
            return


class PairTracker:
    """Follows a pair. Messages up to a trigger's time enter the estimator once the trigger's outcome is known.

    crowded: whether it is one of many pairs: its live track then starts from poses alone, for in pictures of many bars
    too many starts without a fix are possible. So nothing is fed to it while there is neither a pose nor a track.
    one_in: of so many triggers and rows one is taken, if not of all without what would come too late (pace.py).
    clock_s: B's clock minus A's as the whole dive has told it, for the whole dive's track; the poses count it.
    """

    def __init__(
        self, stream_a: NodeStream, stream_b: NodeStream, settings: TrackSettings, clock_s: float = 0.0
    ) -> None:
        self._filter: TrackFilter | None = None
        self.crowded, self.one_in, self._stopped = False, 1, False
        self._past: list[str] = []
        self.late_imu = 0  # inertial samples that came too late
        self._made = False
        self._clock_ns = round(clock_s * S_NS)
        self._streams = stream_a, stream_b
        self._settings = settings
        self._period_ns = round(S_NS / settings.rate_hz)
        self.forget()

    def forget(self) -> None:
        """Start anew: a clock was set."""
        if self._filter is not None:
            self._note(as_ended(self._filter.problems))
        self._infos: tuple[NodeInfo, NodeInfo] | None = None
        self._nodes: tuple[TrackNode, TrackNode] | None = None
        self._filter = None
        self._lag: TrackLag | None = None
        self._pieces: tuple[list[NodeRecord], list[NodeRecord]] = ([], [])
        self._fixes: list[FixSeen] = []
        self._asked_ns: list[int] = []
        self._first_ns: int | None = None
        self._taken_ns = -1
        self._told_ns = -1
        self._settled_ns = -1
        # Of nodes with such samples, the newest outcome when the last one came.
        self._late_ns: dict[str, int] = {}
        self._oriented = self._idle = False
        self._fixed_ns = -REST_NS
        self._clock: tuple[float, float] | None = None
        # How many poses there were; whether both nodes had a picture of a trigger; whether the nodes look apart and
        # never had a pose; the triggers of then, with stamps.
        self._posed, self._met, self._rests = 0, False, False
        self._unseen: dict[int, int] = {}

    @property
    def makes_whole(self) -> bool:
        """Whether it makes a whole dive's track."""
        return "smooth" in self._settings.modes

    @property
    def has_estimate(self) -> bool:
        """Whether there is an estimate."""
        return self._filter is not None and (self._filter.main is not None or bool(self._filter.challengers))

    def stop(self) -> None:
        """End the track, and take nothing up to `go_on`."""
        self.forget()
        self._stopped = True

    def go_on(self) -> None:
        """Begin anew with what comes."""
        self._stopped = False

    @property
    def problems(self) -> list[str]:
        """What is wrong, what was (it says so), and the lamps that are dark now."""
        if self._stopped:
            return [*self._past, NO_TRACK]
        if self._filter is None:
            return self._past + self._late()
        found = merged([*self._past, *self._late(), *self._filter.problems])
        return found + self._dark_lamps(self._filter.lamps.dark())

    def note_late(self, sample: Imu) -> None:
        """Count an inertial sample that comes after the track has passed its time; it has no effect any more."""
        if self._first_ns is not None and self._first_ns <= sample.stamp_ns <= self._taken_ns:
            self.late_imu += 1
            self._late_ns[sample.node] = self._settled_ns

    def _late(self) -> list[str]:
        return [
            f"inertial samples of node {node} come too late: the track does without them"
            for node, late_ns in sorted(self._late_ns.items())
            if self._settled_ns - late_ns <= ENDED_S * S_NS
        ]

    def dark_lamps(self) -> list[tuple[int, int]]:
        """Return the lamps that are dark now, as node (0: A) and light (0: left)."""
        return [] if self._filter is None else [(node, light) for node, light, _ in self._filter.lamps.dark()]

    def unseen_lamps(self) -> list[tuple[int, int]]:
        """Return the lamps that may be dark."""
        found = [] if self._filter is None else self._filter.lamps.dark(UNSEEN_S, UNSEEN_PICTURES)
        return [(node, light) for node, light, _ in found]

    def _dark_lamps(self, dark: Iterable[tuple[int, int, float]]) -> list[str]:
        sides = ("left", "right")
        return [
            f"{sides[light]} lamp of {self._streams[node].node} has not been seen for {seconds:.0f} s "
            f"while the {sides[1 - light]} one was"
            for node, light, seconds in dark
        ]

    def clock_now(self) -> tuple[float, float] | None:
        """Return B's clock minus A's and its sigma, s, as the whole dive's track told, or the live one believes."""
        if self._clock is not None or self._filter is None:
            return self._clock
        return clock_now(self._filter)

    def clocks(self) -> Clocks | None:
        """Return what a dive that is over tells of the clocks; of a tracker that makes the whole dive's track."""
        if self._nodes is None or self._settled_ns < 0:
            return None
        with np.errstate(all="ignore"):
            try:
                self._advance(self._settled_ns + S_NS)
                if not all(self._pieces):
                    return None
                a, b = map(joined, self._pieces)
                return clocks_of((a, b), self._fixes)
            except NUMERIC_ERRORS as error:
                self._start_anew(str(error))
                return None

    def take(self, outcomes: Sequence[Message]) -> list[Message]:
        """Go on to the newest of these outcomes; return the live tracks' messages up to there."""
        return self.tell(self.follow(outcomes))

    def follow(self, outcomes: Sequence[Message]) -> Coming:
        """Go on as `take` does; return what there is to tell, which may be worked out together with other pairs'."""
        with np.errstate(all="ignore"):
            try:
                return self._take(outcomes)
            except NUMERIC_ERRORS as error:
                self._start_anew(str(error))
                return Coming()

    def tell(self, coming: Coming) -> list[Message]:
        """Return the messages of what there is to tell."""
        with np.errstate(all="ignore"):
            try:
                return self._tell(coming)
            except NUMERIC_ERRORS as error:
                self._start_anew(str(error))
                return list(coming.messages)

    def _start_anew(self, why: str) -> None:
        """Drop a track that absurd but finite values have spoiled, such as a depth of 1e308 m."""
        node_a, node_b = (stream.node for stream in self._streams)
        self._note([f"values from {node_a} or {node_b} were out of numeric range ({why}): the track started anew"])
        self.forget()

    def _take(self, outcomes: Sequence[Message]) -> Coming:
        if self._stopped:
            return Coming()
        # A late frame's stamp is old, or far from the dive's time: it does not carry the track on.
        stamps_ns = [
            one.stamp_ns
            for one in outcomes
            if isinstance(one, RelativePose) or (isinstance(one, Rejected) and one.reason != "late")
        ]
        known = [stream.calibration(max(stamps_ns)) for stream in self._streams] if stamps_ns else [None, None]
        if known[0] is None or known[1] is None:
            return Coming()
        infos = known[0][0], known[1][0]
        fixes = [fix_of(one) for one in outcomes if isinstance(one, RelativePose)]
        if fixes:
            self._fixed_ns = max(fix.stamp_ns for fix in fixes)
        elif self.crowded and min(stamps_ns) - self._fixed_ns > REST_NS and not (self.has_estimate or self.makes_whole):
            self._idle = True
            return Coming()
        messages: list[Message] = []
        if self._infos is not None and not all(map(same_rig, infos, self._infos)):
            # The track of the old rigs ends here.
            messages = list(self._end(self._settled_ns))
            self.forget()
        if self._infos is None:
            self._infos, self._nodes = infos, (track_node_of(*known[0]), track_node_of(*known[1]))
            self._make_filter(self._nodes)
        if self._first_ns is None:
            # However many outcomes come at once, the track begins with the first of them.
            self._first_ns = self._told_ns = min(stamps_ns)
            self._taken_ns = self._first_ns - S_NS
        if self._idle:
            # What came since has nothing to be told of.
            self._taken_ns = max(self._taken_ns, min(stamps_ns) - S_NS)
            self._told_ns = max(self._told_ns, min(stamps_ns))
            self._idle = False
        self._settled_ns = max(self._settled_ns, *stamps_ns)
        for one in outcomes:
            self._posed += isinstance(one, RelativePose)
            self._met |= not (isinstance(one, Rejected) and one.reason == "unmatched")
            if isinstance(one, Rejected) and not self._posed:
                apart = one.detail == LOOK_APART
                # One in LOOKS triggers is solved also of nodes that look apart; one of a single frame tells nothing.
                untold = one.trigger % LOOKS == 0 or one.reason == "unmatched"
                self._rests = apart or (self._rests and untold)
                if self._rests:
                    self._unseen[one.trigger] = one.stamp_ns
        if self._filter is not None:
            self._filter.searches = not self.crowded
            for fix in fixes:
                self._filter.add_fix(fix)
        if self.makes_whole:
            self._fixes += fixes
        return replace(self._advance(self._frontier_ns()), messages=messages)

    def finish(self) -> Iterable[Message]:
        """Take what is left, and return what the end of the dive tells: the rest of the live tracks, the smooth one.

        The smooth track's messages are made as they are read, for they take more memory than all they are made from.
        The smooth track is told once: a later call tells only what came since.
        """
        # Later rows would only be guessed. The filter holds back what is within HOLD_S of the end.
        heard_ns = max(stream.heard_ns for stream in self._streams) + round(2.0 * HOLD_S * S_NS)
        posed, met = self._posed, self._met
        told = self._end(min(self._settled_ns + S_NS, heard_ns))
        if not (self._made or self._stopped or present(self.problems)):
            self._note([self._why_none(posed, met=met)])
        return told

    def _why_none(self, posed: int, *, met: bool) -> str:
        """Say why a dive has no track, where nothing is wrong with its messages.

        posed: how many poses it has. met: whether a trigger has pictures of both nodes.
        """
        a, b = self._streams
        if not met:
            return f"no track: no trigger has pictures of both {a.node} and {b.node}"
        if posed and a.attitude.newest_ns is None and a.imu.newest_ns is None:
            return f"no track: node {a.node} told neither attitudes nor inertial samples, so a pose starts none"
        if 0 < posed < FEW:
            what = "one pose is" if posed == 1 else f"{posed} poses are"
            return f"no track: {what} too few to start one; name logs of more seconds in which both saw each other"
        if posed:
            return "no track: the lights after each pose do not agree with a start from it"
        without = [stream.node for stream in (a, b) if stream.attitude.newest_ns is None]
        if without:
            return f"no track: no pose starts one, nor do lights without attitudes of {' and '.join(without)}"
        return "no track: no pose starts one, and lights with both attitudes fit no start"

    def _end(self, end_ns: int) -> Iterable[Message]:
        """Take what is left up to end_ns, and tell what the end of a track tells."""
        if self._nodes is None or self._settled_ns < 0:
            return []
        with np.errstate(all="ignore"):
            try:
                messages = self._tell(self._advance(end_ns))
                if self._lag is not None:
                    messages += self._messages(self._lag.finish(), "lag")
                if not all(self._pieces):
                    return messages
                asked_ns, self._asked_ns = self._asked_ns, []
                found = smooth(self._recorded(), self._fixes, asked_ns, self._clock_ns)
            except NUMERIC_ERRORS as error:
                self._start_anew(str(error))
                return []
        self._note(found.problems)
        if self._filter is None:
            self._note(self._dark_lamps(found.dark))
        told = math.isfinite(found.clock_sigma_s)
        self._clock = (found.clock_offset_s, found.clock_sigma_s) if told else None
        # Rows are made as they are read; where there is no track they are an empty list.
        self._made |= found.rows != []
        return chain(messages, self._messages(found.rows, "smooth"))

    def _make_filter(self, nodes: tuple[TrackNode, TrackNode]) -> None:
        live = self._settings.modes & {"filter", "lag"}
        if live:
            self._filter = TrackFilter(*nodes, keep_s=KEPT_S if "lag" in live else 0.0)
            self._lag = TrackLag(self._filter) if "lag" in live else None

    def _recorded(self) -> Records:
        """Give what both nodes recorded, once: the pieces, which take as much memory again, are let go of."""
        pieces, self._pieces = self._pieces, ([], [])
        return joined(pieces[0]), joined(pieces[1])

    def _frontier_ns(self) -> int:
        """Return up to when everything has come: outcomes, and the samples of the sensors that have not stopped."""
        return min(stream.complete_ns(self._settled_ns) for stream in self._streams)

    def _advance(self, to_ns: int) -> Coming:
        if to_ns <= self._taken_ns or self._idle:
            return Coming()
        for node, stream in enumerate(self._streams):
            piece = self._piece(stream, node, self._taken_ns + 1, to_ns)
            self._oriented |= bool(piece.attitudes)
            if self.makes_whole:
                self._pieces[node].append(piece)
            if self._filter is not None:
                feed(self._filter, node, piece)
        if self.makes_whole:
            self._asked_ns += self._due(max(self._taken_ns + 1, self._first_ns or 0), to_ns)
        self._taken_ns = to_ns
        self._unseen = {trigger: ns for trigger, ns in self._unseen.items() if ns > to_ns - S_NS}
        return self._live(to_ns)

    def _live(self, to_ns: int) -> Coming:
        if self._filter is None:
            return Coming()
        told: list[tuple[DueRow | TrackRow, TrackMode]] = []
        while self._told_ns < to_ns:
            # After a wait for late samples there is much to take at once; the lag looks at every part of it.
            part_ns = min(to_ns, max(self._told_ns, to_ns - KEPT_NS) + round(EVERY_S * S_NS))
            due = self._due(self._told_ns + 1, part_ns)
            self._told_ns = part_ns
            rows = list(self._filter.coming(part_ns, due))
            if self._filter.main is not None and not np.isfinite(self._filter.main.covariance).all():
                raise ArithmeticError("no finite covariance")
            if "filter" in self._settings.modes:
                told += [(row, "filter") for row in rows]
            if self._lag is not None and self.one_in == 1:
                self._lag.ask(due)
                told += [(row, "lag") for row in self._lag.rows()]
        stamps_ns = self._next_ns() if self._settings.expect and self.one_in == 1 else {}
        foresight = foresee(self._filter, to_ns, stamps_ns)
        return Coming(rows=told, foresight=foresight, stamps_ns=stamps_ns, oriented=self._oriented)

    def _next_ns(self) -> dict[int, int]:
        """Return when each node's next picture is due."""
        if self._infos is None:
            return {}
        return {
            node: stream.newest_ns + self._infos[node].trigger_period_ns
            for node, stream in enumerate(self._streams)
            if stream.newest_ns is not None
        }

    def _tell(self, coming: Coming) -> list[Message]:
        node_a, node_b = (stream.node for stream in self._streams)
        make_rows(coming.due)
        made = [(one.row if isinstance(one, DueRow) else one, mode) for one, mode in coming.rows]
        tracks = [
            track_message(row, node_a, node_b, mode, oriented=coming.oriented) for row, mode in made if row is not None
        ]
        self._made |= bool(tracks)
        return [*coming.messages, *tracks, *self._expected(coming)]

    def _expected(self, coming: Coming) -> list[Message]:
        """Return where each node's next picture should show the other's lights."""
        if self._infos is None or coming.foresight is None:
            return []
        return [
            Expect(
                node=self._streams[node].node,
                seen=self._streams[1 - node].node,
                stamp_ns=coming.stamps_ns[node],
                valid_ns=EXPECT_VALID_NS,
                lights=[expected_light(light) for light in lights],
                blink=self._infos[1 - node].blink,
            )
            for node, lights in coming.foresight.lights().items()
            if lights
        ]

    def _due(self, start_ns: int, end_ns: int) -> list[int]:
        """Return the instants of the rows from start_ns to end_ns; of a long span only those near both ends.

        Nothing is known in between. Where clocks are weeks apart, all instants would fill the memory.
        """
        ends = [(start_ns, end_ns)]
        if end_ns - start_ns > 2 * KEPT_NS:
            ends = [(start_ns, start_ns + KEPT_NS), (end_ns - KEPT_NS, end_ns)]
        rows = chain.from_iterable(range(-(-a // self._period_ns), b // self._period_ns + 1) for a, b in ends)
        return [k * self._period_ns for k in rows if not k % self.one_in]

    def _piece(self, stream: NodeStream, node: int, start_ns: int, end_ns: int) -> NodeRecord:
        if self._nodes is None or self._infos is None:
            raise RuntimeError("no calibration yet")
        stamps_ns, values = stream.imu.between(start_ns, end_ns)
        first, own = self._nodes[0].rig, self._nodes[node].rig
        return NodeRecord(
            node=self._nodes[node],
            # In pictures of nodes that look apart the track would only find wrong starts.
            frames=[
                frame_of(view_of(frame))
                for frame in stream.frames.between(start_ns, end_ns)
                if frame.trigger not in self._unseen
                and not frame.trigger % self.one_in
                and not wrong_size(frame, self._infos[node])
            ],
            imu_stamps_ns=stamps_ns,
            accel_mps2=values[:, :3],
            gyro_radps=values[:, 3:],
            attitudes=attitudes_of(stream.attitude.between(start_ns, end_ns), first, own),
            depths=[
                DepthSeen(each.stamp_ns, each.depth_m, each.sigma_m) for each in stream.depth.between(start_ns, end_ns)
            ],
        )

    def _note(self, problems: Iterable[str]) -> None:
        self._past = merged([*self._past, *problems])

    def _messages(self, rows: Iterable[TrackRow], mode: TrackMode) -> Iterator[Message]:
        node_a, node_b = (stream.node for stream in self._streams)
        oriented = self._oriented
        return (track_message(row, node_a, node_b, mode, oriented=oriented) for row in rows)
