"""One pair from frames to messages: outcomes, track and status."""

from __future__ import annotations

import math
import statistics
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np
from buddyline.protocol import __version__
from buddyline.protocol.clock import S_NS
from buddyline.protocol.health import CLOCKS_APART_S, HEADINGS_APART_RAD, NO_POSE_S, REPORTED_OFFSET_SIGMA_S
from buddyline.protocol.messages import Candidates, Message, NodeInfo, Rejected, RelativePose, SolverStatus, Track
from buddyline.protocol.topics import EXPECT, POSE, REJECTED, SOLVER_STATUS, TRACK, TRACK_LAG
from buddyline.solver_service.alignment import ClockAlignment, ClockOffset
from buddyline.solver_service.coach import LastPlace, advise
from buddyline.solver_service.first_fix import look_of
from buddyline.solver_service.geometry.rotation import Floats, quat_to_matrix
from buddyline.solver_service.geometry.trigger import NoFix, Settings
from buddyline.solver_service.matcher import PairMatcher, Unmatched
from buddyline.solver_service.pair import Matched, PairSolver
from buddyline.solver_service.results import relative_pose
from buddyline.solver_service.sensors import attitude_at
from buddyline.solver_service.streams import Arrival, NodeStream
from buddyline.solver_service.track.clocks import Clocks
from buddyline.solver_service.track.problems import present
from buddyline.solver_service.tracking import Coming, PairTracker, TrackSettings
from msgspec import UNSET

PairId: TypeAlias = tuple[str, str]

# The topics that a pair publishes, and those that it publishes for each of its nodes.
PUBLISHED: Final = (POSE, REJECTED, TRACK, TRACK_LAG, SOLVER_STATUS)
PUBLISHED_FOR_NODES: Final = (EXPECT,)
ALIGN_EVERY_NS: Final = 10 * S_NS


def newer(messages: list[Message], told_ns: int) -> list[Message]:
    """Return the outcomes among messages that are later than told_ns; all if that is -1."""
    if told_ns < 0:
        return messages
    return [one for one in messages if isinstance(one, RelativePose | Rejected) and one.stamp_ns > told_ns]


@dataclass(frozen=True, eq=False)
class Settled:
    """Outcomes of a pair, in the order of its triggers, and what its track is about to tell.

    past: outcomes of before a clock was set: they are told, and carry neither track nor network on.
    """

    past: list[Message] = field(default_factory=list)
    outcomes: list[Message] = field(default_factory=list)
    track: Coming = field(default_factory=Coming)


class PairCore:
    """One pair: its matcher, its solver, its track, and the counts of its outcomes.

    counts: number of "solved", and of each rejection reason. latencies_s: from the middle of exposure to publication,
    since the last report. tracker: makes the pair's track; None for no track. clock_s: B's clock minus A's, as an
    earlier pass over the dive has found it.
    """

    def __init__(
        self,
        stream_a: NodeStream,
        stream_b: NodeStream,
        settings: Settings,
        track: TrackSettings | None,
        *,
        align: bool,
        clock_s: float = 0.0,
    ) -> None:
        self.nodes: PairId = (stream_a.node, stream_b.node)
        self.streams = stream_a, stream_b
        self.matcher = PairMatcher(stream_a, stream_b)
        self.alignment = ClockAlignment() if align else None
        self.solver = PairSolver(settings, self.alignment, clock_s)
        self.tracker = PairTracker(stream_a, stream_b, track, clock_s) if track is not None else None
        self.counts: Counter[str] = Counter()
        self.latencies_s: deque[float] = deque(maxlen=2000)
        self._posed_ns: int | None = None
        self._why: Counter[str] = Counter()
        self._last: RelativePose | Track | None = None
        self._offset: ClockOffset | None = None
        self._aligned_ns: int | None = None
        self._alone = True
        self._unsettled: list[Matched | Unmatched] = []
        self._settled: list[Message] = []
        self._past: list[Message] = []
        self._advised: list[str] = []

    def crowd(self, *, alone: bool, crowded: bool, one_in: int) -> None:
        """Note whether this pair is the only one, or one of many; one_in: of so many triggers one is taken."""
        self._alone = alone
        self.solver.crowded, self.solver.one_in = crowded, one_in
        if self.tracker is not None:
            self.tracker.crowded, self.tracker.one_in = crowded, self.solver.one_in

    def take(self, frame: Candidates, arrival: Arrival, receive_ns: int | None, *, live: bool) -> None:
        """Take a frame of one of the two nodes; see PairMatcher.take."""
        if arrival is Arrival.CLOCK_SET:
            self._unsettled += self.matcher.restart(frame.node)
            self._solve()
            self._past += self._settled
            self._settled = []
            self.solver.forget()
            self._posed_ns = self._last = None
            self._why.clear()
            if self.tracker is not None:
                self.tracker.forget()
        self._unsettled += self.matcher.take(frame, arrival, receive_ns, live=live)

    def resolve(self, receive_ns: int | None, *, everything: bool = False) -> None:
        """Match or reject the triggers whose waiting is over; everything: all of them."""
        self._unsettled += self.matcher.resolve(receive_ns, everything=everything)

    @property
    def has_news(self) -> bool:
        """Whether there are triggers to settle."""
        return bool(self._unsettled or self._settled or self._past)

    def settle(self, told_ns: int = -1) -> list[Message]:
        """Solve all matched triggers at once; return the outcomes in the order of the triggers, then the track.

        told_ns: the track gets only later outcomes.
        """
        return self.tell(self.follow(told_ns))

    def follow(self, told_ns: int = -1) -> Settled:
        """Settle, but for the track's messages, which may be worked out together with those of other pairs."""
        if not self.has_news:
            return Settled()
        self._solve()
        settled, self._settled = self._settled, []
        past, self._past = self._past, []
        track = self.tracker.follow(newer(settled, told_ns)) if self.tracker is not None else Coming()
        return Settled(past, settled, track)

    def tell(self, settled: Settled) -> list[Message]:
        """Return the outcomes, then the track's messages."""
        told = settled.past + settled.outcomes + (self.tracker.tell(settled.track) if self.tracker is not None else [])
        for message in told:
            if isinstance(message, RelativePose):
                self._posed_ns = message.stamp_ns
                self._why.clear()
            elif isinstance(message, Rejected):
                self._why[message.reason] += 1
            if isinstance(message, RelativePose | Track) and (
                self._last is None or message.stamp_ns >= self._last.stamp_ns
            ):
                self._last = message
        return told

    def finish(self) -> Iterator[Message]:
        """Yield the last outcomes and the rest of the track, at the end of the dive."""
        self.resolve(None, everything=True)
        yield from self.settle()
        if self.tracker is not None:
            yield from self.tracker.finish()

    def _solve(self) -> None:
        if not self._unsettled:
            return
        found = iter(self.solver.solve([one for one in self._unsettled if isinstance(one, Matched)]))
        for one in self._unsettled:
            if isinstance(one, Unmatched):
                self._reject(one)
                continue
            fix = next(found)
            if isinstance(fix, NoFix):
                self._reject(Unmatched(one.trigger, one.stamp_ns, fix.reason, fix.detail))
            else:
                self.counts["solved"] += 1
                self._settled.append(
                    relative_pose(one.frame_a, one.frame_b, one.rig_a, (one.sensed_a, one.sensed_b), fix)
                )
        self._unsettled.clear()

    def _reject(self, one: Unmatched) -> None:
        self.counts[one.reason] += 1
        node_a, node_b = self.nodes
        self._settled.append(
            Rejected(
                node_a=node_a,
                node_b=node_b,
                stamp_ns=one.stamp_ns,
                trigger=one.trigger,
                reason=one.reason,
                detail=one.detail,
            )
        )

    def report(
        self,
        stamp_ns: int,
        now_ns: int,
        problems: list[str],
        bad_messages: int,
        unused: list[str],
        *,
        over: bool = False,
    ) -> SolverStatus:
        """Return the pair's status at stamp_ns. now_ns: steady receive time. problems: known from outside the pair.

        over: of a whole dive, whose status also names the track's problems that ended before the dive did.
        """
        (node_a, node_b), (stream_a, stream_b) = self.nodes, self.streams
        latencies_s = sorted(self.latencies_s)
        self.latencies_s.clear()
        p99 = len(latencies_s) * 99 // 100
        offset = self._estimate_offset(now_ns)
        self._advised = self.advice()
        of_track = self.tracker.problems if self.tracker is not None else []
        return SolverStatus(
            node_a=node_a,
            node_b=node_b,
            stamp_ns=stamp_ns,
            software=f"buddyline {__version__}",
            received_a=stream_a.received,
            received_b=stream_b.received,
            matched=self.matcher.matched,
            solved=self.counts["solved"],
            rejected={reason: count for reason, count in sorted(self.counts.items()) if reason != "solved"},
            late=self.matcher.late,
            duplicates=self.matcher.duplicates,
            bad_messages=bad_messages,
            pending=self.matcher.pending,
            latency_median_s=statistics.median(latencies_s) if latencies_s else UNSET,
            latency_p99_s=latencies_s[p99] if latencies_s else UNSET,
            clock_skew_s=UNSET if offset is None else offset.offset_s,
            problem="; ".join(problems + self._disagreements(offset) + (of_track if over else present(of_track))),
            unused=unused or UNSET,
            advice=self._advised or UNSET,
            late_imu=(self.tracker.late_imu if self.tracker else 0) or UNSET,
        )

    def advises_anew(self) -> bool:
        """Return whether the divers should do something else than the last report has said."""
        return self.advice() != self._advised

    def advice(self) -> list[str]:
        """Return what the divers should do for a fix or a better one, by the newest data of both nodes."""
        now_ns = max((stream.newest_ns or 0 for stream in self.streams), default=0)
        known = [stream.calibration(now_ns) for stream in self.streams]
        rigs = [each for each in known if each is not None]
        infos = [info for info, _ in rigs]
        if len(infos) < 2:
            return []
        last, place = self._last, None
        has_fix = self._posed_ns is not None and now_ns - self._posed_ns < NO_POSE_S * S_NS
        if last is not None:
            turned = [
                self._turned(stream, info, last.stamp_ns) for stream, info in zip(self.streams, infos, strict=True)
            ]
            both = (turned[0], turned[1]) if turned[0] is not None and turned[1] is not None else None
            why = "" if has_fix else next((reason for reason, _ in self._why.most_common(1)), "unmatched")
            place = LastPlace.of(last, max(now_ns - last.stamp_ns, 0) / S_NS, why, both)
        dark = self.tracker.dark_lamps() if self.tracker is not None else ()
        unseen = self.tracker.unseen_lamps() if self.tracker is not None and not has_fix else ()
        # Where there are more nodes, a light that is seen may be a third one's.
        needed = self._alone and (place is None or not place.tells) and all(s.newest_ns for s in self.streams)
        looks = [look_of(stream, *rig) for stream, rig in zip(self.streams, rigs, strict=True)] if needed else ()
        return advise(infos, place, dark, looks, unseen)

    def _turned(self, stream: NodeStream, info: NodeInfo, since_ns: int) -> Floats | None:
        """Return R_then_now of a node's camera by its attitude sensor, whose slow error cancels; None without one."""
        now_ns = stream.attitude.newest_ns
        then = attitude_at(stream.attitude, since_ns)
        now = attitude_at(stream.attitude, now_ns) if now_ns is not None else None
        if then is None or now is None:
            return None
        R_body_camera = quat_to_matrix(np.array(info.q_body_camera_xyzw))
        R_camera: Floats = R_body_camera.T @ quat_to_matrix(then[0]).T @ quat_to_matrix(now[0]) @ R_body_camera
        return R_camera

    def clocks(self) -> Clocks | ClockOffset | None:
        """Return what the dive, which is over, tells of the clocks: by the track, or else by the fixes' gaps."""
        self.resolve(None, everything=True)
        self.settle()
        told = self.tracker.clocks() if self.tracker is not None else None
        return told or (self.alignment.estimate() if self.alignment is not None else None)

    def _estimate_offset(self, now_ns: int) -> ClockOffset | None:
        """Return the clocks' offset where it is told well enough: by the track, or else by the fixes' gaps."""
        now = self.tracker.clock_now() if self.tracker is not None else None
        if now is not None:
            return ClockOffset(*now, self.counts["solved"]) if now[1] < REPORTED_OFFSET_SIGMA_S else None
        if self.alignment is not None and (self._aligned_ns is None or now_ns - self._aligned_ns > ALIGN_EVERY_NS):
            found = self.alignment.estimate()
            self._offset = found if found is not None and found.sigma_s < REPORTED_OFFSET_SIGMA_S else None
            self._aligned_ns = now_ns
        return self._offset

    def _disagreements(self, offset: ClockOffset | None) -> list[str]:
        """Return problems that the poses show: the two nodes' clocks or compasses disagree."""
        found = []
        node_a, node_b = self.nodes
        if offset is not None and abs(offset.offset_s) > max(CLOCKS_APART_S, 4 * offset.sigma_s):
            found.append(f"clock of {node_b} is {offset.offset_s * 1e3:+.1f} ms from that of {node_a}")
        heading = self.solver.heading(max(stream.newest_ns or 0 for stream in self.streams))
        if heading is not None and abs(heading.offset_rad) > HEADINGS_APART_RAD:
            apart_deg = math.degrees(abs(heading.offset_rad))
            found.append(
                f"compasses of {node_a} and {node_b} disagree by {apart_deg:.0f} deg: "
                "is one near steel, or not calibrated?"
            )
        return found
