"""The solver's pure core: messages in, messages out, for any number of nodes; no clock, no bus, no files.

The live service, the offline solver, replay and tests all call `SolverCore.handle`. The triggers of a pair are
resolved in their own order, from the pair's own data. So the same messages give the same poses in any order of arrival
within the matching window. Other nodes change them only where there are so many that pairs rest (resting.py).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Final, TypeAlias

from buddyline.protocol.clock import LIVE_WITHIN_NS, MS_NS, S_NS
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    Depth,
    Imu,
    ImuMeans,
    Message,
    NodeInfo,
    Rejected,
    RelativePose,
    SolverStatus,
)
from buddyline.solver_service.clock_curve import ClockCurve, trigger_moved
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.health import Health
from buddyline.solver_service.networking import NetTracker
from buddyline.solver_service.pace import Pace
from buddyline.solver_service.pair_core import PairCore, PairId, newer
from buddyline.solver_service.resting import CROWD
from buddyline.solver_service.results import wrong_size
from buddyline.solver_service.sensors import KEPT_NS
from buddyline.solver_service.streams import Arrival, NodeStream
from buddyline.solver_service.track.problems import present
from buddyline.solver_service.tracking import TrackSettings, work_out_together
from msgspec import UNSET
from msgspec.structs import replace

NodeMessage: TypeAlias = NodeInfo | Candidates | Attitude | Depth | Imu | ImuMeans

# If the receive time goes back by more than this, the receiver's clock was set back.
SET_BACK_NS: Final = 1 * S_NS
# Counted as passed when the clock is set back: the service tells the time at least as often.
UNSEEN_NS: Final = 250 * MS_NS
# Limits memory: a sender that invents node ids must not get a stream for each.
MAX_NODES: Final = 16


class SolverCore:
    """Solves each trigger of each pair once.

    chosen: the pairs to solve; None for every pair of nodes that appear, A before B in the alphabet. clocks: each
    node's clock minus the common clock, where known; the node's stamps are moved to the common clock. align: estimate
    the clock offset of each pair. apart_s: B's clock minus A's of pairs, s, where an earlier pass over the whole dive
    has found it: poses count it, and stamps and triggers stay. track: the tracks to make; None for no track, and no
    network. lone: nodes of the network beside those of the chosen pairs. network: follows all nodes in one frame; None
    without `track`. unused: number of messages of each node that is not used. pace: what is left out where it cannot
    keep up. shared: other cores have some of the pairs, and perhaps the network: this one begins with none, and gets
    its own by `adopt` and `adopt_network`.
    """

    def __init__(
        self,
        settings: Settings,
        chosen: Sequence[PairId] | None = None,
        clocks: Mapping[str, ClockCurve] | None = None,
        *,
        align: bool = False,
        apart_s: Mapping[PairId, float] | None = None,
        track: TrackSettings | None = None,
        lone: Iterable[str] = (),
        shared: bool = False,
    ) -> None:
        self.settings = settings
        self.streams: dict[str, NodeStream] = {}
        self.pairs: dict[PairId, PairCore] = {}
        self.health = Health()
        self.unused: Counter[str] = Counter()
        self.pace = Pace()
        self._chosen = chosen
        self._clocks = clocks or {}
        self._align = align
        self._apart_s = apart_s or {}
        self._track = track
        self._shared = shared
        self._pairs_of: dict[str, list[PairCore]] = {}
        self._single: set[str] = set()
        self._now_ns = 0
        self._set_back_ns = 0
        self.network = NetTracker(self.streams, track) if track is not None and not shared else None
        for node in lone:
            self.streams.setdefault(node, NodeStream(node))
        for pair in chosen or ():
            if pair[0] == pair[1]:
                raise ValueError(f"the two nodes have the same id, {pair[0]!r}")
            if pair in self.pairs or pair[::-1] in self.pairs:
                raise ValueError(f"the pair {pair[0]}, {pair[1]} is named twice")
            for node in pair:
                self.streams.setdefault(node, NodeStream(node))
            if shared:
                self._pairs_of |= {node: [] for node in pair}
            else:
                self._add_pair(pair)

    @property
    def counts(self) -> Counter[str]:
        """The outcomes of all pairs: the number solved, and the number of each rejection reason."""
        return sum((pair.counts for pair in self.pairs.values()), Counter())

    @property
    def matched(self) -> int:
        """Number of triggers of all pairs with a frame and a calibration from both nodes."""
        return sum(pair.matcher.matched for pair in self.pairs.values())

    @property
    def pending(self) -> int:
        """Number of triggers of all pairs that wait for data."""
        return sum(pair.matcher.pending for pair in self.pairs.values())

    def handle(self, message: Message, receive_ns: int | None = None) -> list[Message]:
        """Take one message of a node; return the outcomes that it completes, in the order of each pair's triggers.

        receive_ns: receive time; None when read from a log.
        """
        return self.handle_many((message,), receive_ns)

    def handle_many(self, messages: Iterable[Message], receive_ns: int | None = None) -> list[Message]:
        """Take several messages; their matched triggers are solved together.

        Read from a log they are matched as if one by one, live as if they had come at one moment.
        """
        now_ns = self._steady(receive_ns)
        touched: dict[PairId, PairCore] = {}
        for message in messages:
            for pair in self._take(message, now_ns, receive_ns):
                touched[pair.nodes] = pair
                if now_ns is None:
                    pair.resolve(now_ns)
        if now_ns is not None:
            for pair in touched.values():
                pair.resolve(now_ns)
        # One may have been let go since: a later message said that a node of it has a camera or lamps alone.
        return self._settled([pair for nodes, pair in touched.items() if self.pairs.get(nodes) is pair])

    def advance(self, receive_ns: int) -> list[Message]:
        """Advance the receive time; return the outcomes whose waiting time is over."""
        now_ns = self._steady(receive_ns)
        for pair in self.pairs.values():
            pair.resolve(now_ns)
        return self._settled(self.pairs.values())

    def flush(self) -> list[Message]:
        """Resolve all pending triggers with the data at hand, at the end of the dive."""
        return list(self.finish())

    def finish(self) -> Iterator[Message]:
        """Yield what `flush` returns, as it is made: a whole dive's track takes much memory."""
        last: list[Message] = []
        for pair in self.pairs.values():
            for message in pair.finish():
                if isinstance(message, RelativePose | Rejected):
                    last.append(message)
                yield message
        if self.network is not None:
            yield from self.network.take(last)
            yield from self.network.finish()

    def report(self, stamp_ns: int, receive_ns: int, bad_messages: int, problems: list[str]) -> list[SolverStatus]:
        """Return each pair's status. bad_messages: number of refused messages. problems: added to each pair's own."""
        now_ns = self._steady(receive_ns) or 0
        problems = problems + present(self.network.problems if self.network is not None else [])
        unused = sorted(self.unused)
        return [
            pair.report(stamp_ns, now_ns, self.health.problems(pair.nodes, now_ns) + problems, bad_messages, unused)
            for pair in self.pairs.values()
        ]

    def advises_anew(self) -> bool:
        """Return whether some divers should do something else than the last report has said."""
        return any(pair.advises_anew() for pair in self.pairs.values())

    @property
    def net_poses(self) -> list[tuple[str, str]]:
        """The net and the node of each NodePose that may come."""
        return [(self.network.net, node) for node in self.network.nodes] if self.network is not None else []

    @property
    def is_crowded(self) -> bool:
        """Whether there are so many nodes that pairs rest."""
        return len(self.streams) - len(self._single) >= CROWD

    def keep_up(self, behind_ns: int, receive_ns: int) -> None:
        """Take how long frames of now have waited for this core: in a crowd, leave out what there is no time for."""
        tracks = [pair.tracker for _, pair in sorted(self.pairs.items()) if pair.tracker and pair.tracker.has_estimate]
        network = [self.network] if self.network is not None and self.network.has_estimate else []
        now_ns = self._steady(receive_ns) or 0
        self.pace.take(behind_ns if self.is_crowded else 0, now_ns, tracks or network)

    def is_single(self, node: str) -> bool:
        """Whether a node has a camera or lamps alone, and so is in no pair."""
        return node in self._single

    def pairs_of(self, node: str) -> list[PairId]:
        """Return the pairs that a node is in."""
        return [pair.nodes for pair in self._pairs_of.get(node, ())]

    # Work that is shared with other cores

    def possible_pairs(self) -> list[PairId]:
        """Return the chosen pairs, or all that the nodes so far can form."""
        if self._chosen is not None:
            return list(self._chosen)
        return list(combinations(sorted(self._pairs_of.keys() - self._single), 2))

    def adopt(self, nodes: PairId, since_ns: int, told_ns: int, receive_ns: int) -> list[Message]:
        """Take up a pair with the frames since then that are still in its nodes' windows; return what they give.

        told_ns: up to there another core has told of it; track and network begin after that.
        """
        now_ns = self._steady(receive_ns)
        pair = self._add_pair(nodes)
        frames = [
            (frame, at_ns or receive_ns) for node in nodes for frame, at_ns in self.streams[node].frames.since(since_ns)
        ]
        for frame, at_ns in sorted(frames, key=lambda one: one[0].stamp_ns):
            pair.take(frame, Arrival.FRESH, at_ns, live=abs(at_ns - frame.stamp_ns) < LIVE_WITHIN_NS)
        pair.resolve(now_ns)
        return self._settled([pair], told_ns)

    def release(self, nodes: PairId) -> None:
        """Let a pair go; what it has not answered another core will."""
        pair = self.pairs.pop(nodes)
        for node in nodes:
            self._pairs_of[node].remove(pair)

    def adopt_network(self) -> None:
        """Take up the network; it begins anew."""
        if self._track is not None:
            self.network = NetTracker(self.streams, self._track)

    def release_network(self) -> None:
        """Let the network go."""
        self.network = None

    def hear(self, outcome: RelativePose | Rejected) -> list[Message]:
        """Take an outcome of a pair that another core has; return what it gives for the network."""
        return self.network.take([outcome]) if self.network is not None else []

    def saw_published(self, messages: Iterable[Message], now_ns: int) -> None:
        """Note the latency of published poses; now_ns: wall clock."""
        for message in messages:
            if isinstance(message, RelativePose) and 0 <= now_ns - message.stamp_ns < LIVE_WITHIN_NS:
                self.pairs[message.node_a, message.node_b].latencies_s.append((now_ns - message.stamp_ns) / S_NS)

    def _settled(self, pairs: Iterable[PairCore], told_ns: int = -1) -> list[Message]:
        messages: list[Message] = []
        crowded, settled = self.is_crowded, []
        for pair in pairs:
            pair.crowd(alone=len(self.streams) == 2, crowded=crowded, one_in=self.pace.one_in)
            # Most messages are samples of sensors, which complete no trigger.
            if pair.has_news:
                settled.append((pair, pair.follow(told_ns)))
        if settled:
            work_out_together([one.track for _, one in settled])
        for pair, one in settled:
            messages += pair.tell(one)
        if self.network is None:
            return messages
        self.network.one_in = self.pace.one_in
        outcomes = [outcome for _, one in settled for outcome in one.outcomes]
        return messages + self.network.take(newer(outcomes, told_ns))

    def _steady(self, receive_ns: int | None) -> int | None:
        """Return the receive time on a clock that never goes back, so that a clock set back prolongs no waiting."""
        if receive_ns is None:
            return None
        now_ns = receive_ns + self._set_back_ns
        if now_ns < self._now_ns - SET_BACK_NS:
            self._set_back_ns += self._now_ns + UNSEEN_NS - now_ns
            now_ns = self._now_ns + UNSEEN_NS
        self._now_ns = max(self._now_ns, now_ns)
        return self._now_ns

    def _take(self, message: Message, now_ns: int | None, receive_ns: int | None) -> Sequence[PairCore]:
        """Take one message; return the pairs for which it may have completed a trigger."""
        if not isinstance(message, NodeMessage):
            return ()
        stream = self._stream(message.node)
        if stream is None:
            return ()
        if isinstance(message, NodeInfo) and not (message.has_camera and message.has_lights):
            # Only nodes that can see each other form a pair. Frames may have come before the calibration.
            self._single.add(stream.node)
            if self._chosen is None and not self._shared:
                for nodes in self.pairs_of(stream.node):
                    self.release(nodes)
                self._pairs_of.pop(stream.node, None)
        elif isinstance(message, NodeInfo):
            self._single.discard(stream.node)
        formed = self._chosen is not None or stream.node in self._pairs_of or stream.node in self._single
        if isinstance(message, NodeInfo | Candidates) and not formed:
            self._form_pairs(stream, now_ns)
        message = self._on_common_clock(message, stream)
        if isinstance(message, NodeInfo):
            stream.add_info(message)
            self.health.saw_period(stream.node, message.trigger_period_ns)
            self.health.saw_software(stream.node, message.software)
            self.health.saw_blink(stream.node, None if message.blink is UNSET else message.blink)
        elif isinstance(message, Candidates):
            live = receive_ns is not None and abs(receive_ns - message.stamp_ns) < LIVE_WITHIN_NS
            others_ns = [s.newest_ns for s in self.streams.values() if s is not stream and s.newest_ns is not None]
            arrival = stream.add_frame(message, others_ns, now_ns, live=live)
            if arrival in (Arrival.LATER, Arrival.CLOCK_SET) and self.network is not None:
                self.network.forget()
            if now_ns is not None:
                self.health.saw_frame(stream.node, message.stamp_ns, now_ns)
            calibration = stream.calibration(message.stamp_ns)
            self.health.saw_size(stream.node, wrong_size(message, calibration[0]) if calibration is not None else "")
            seen_ns = message.stamp_ns if now_ns is None else now_ns
            self.health.saw_run(message, seen_ns, is_second=arrival is Arrival.CONFLICT)
            for pair in self._pairs_of.get(stream.node, ()):
                pair.take(message, arrival, now_ns, live=live)
        else:
            for sample in message.samples() if isinstance(message, ImuMeans) else (message,):
                # One that was here in time may come again later.
                if stream.add_sample(sample) and isinstance(sample, Imu):
                    self._note_late(sample)
        if isinstance(message, Imu | ImuMeans):
            return ()  # No trigger waits for inertial samples.
        return self._pairs_of.get(stream.node, ())

    def _note_late(self, sample: Imu) -> None:
        for pair in self._pairs_of.get(sample.node, ()):
            if pair.tracker is not None:
                pair.tracker.note_late(sample)

    def _stream(self, node: str) -> NodeStream | None:
        """Return a node's stream; None if the node is not used."""
        stream = self.streams.get(node)
        if stream is None:
            if self._chosen is not None or len(self.streams) >= MAX_NODES:
                if node in self.unused or len(self.unused) < MAX_NODES:
                    self.unused[node] += 1
                return None
            stream = self.streams[node] = NodeStream(node)
        return stream

    def _form_pairs(self, stream: NodeStream, now_ns: int | None) -> None:
        """Pair a new node with all known ones. The frames in their windows count as received now."""
        others = sorted(self._pairs_of)
        self._pairs_of[stream.node] = []
        if self._shared:
            return
        for node in others:
            first, second = sorted((node, stream.node))
            pair = self._add_pair((first, second))
            for frame in self.streams[node].frames.received_since(None if now_ns is None else now_ns - KEPT_NS):
                live = now_ns is not None and abs(now_ns - self._set_back_ns - frame.stamp_ns) < LIVE_WITHIN_NS
                pair.take(frame, Arrival.FRESH, now_ns, live=live)

    def _add_pair(self, nodes: PairId) -> PairCore:
        first, second = (self.streams[node] for node in nodes)
        clock_s = self._apart_s.get(nodes, 0.0)
        pair = PairCore(first, second, self.settings, self._track, align=self._align, clock_s=clock_s)
        self.pairs[nodes] = pair
        for node in nodes:
            self._pairs_of.setdefault(node, []).append(pair)
        return pair

    def _on_common_clock(self, message: NodeMessage, stream: NodeStream) -> NodeMessage:
        curve = self._clocks.get(stream.node)
        offset_ns = curve.offset_ns(message.stamp_ns) if curve is not None else 0
        if not offset_ns:
            return message
        stamp_ns = max(message.stamp_ns - offset_ns, 0)
        if not isinstance(message, Candidates):
            return replace(message, stamp_ns=stamp_ns)
        calibration = stream.calibration(stamp_ns)
        if calibration is None:
            return replace(message, stamp_ns=stamp_ns)
        trigger = trigger_moved(message.trigger, offset_ns, calibration[0].trigger_period_ns)
        return replace(message, stamp_ns=stamp_ns, trigger=trigger)
