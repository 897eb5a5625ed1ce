"""The network out of all nodes' streams: what its estimator is given, when, and the messages that it makes.

The estimator is in `network/`. A network begins with three nodes, or with any number if one is fixed. Everything here
is a function of the messages so far, as for a pair's track (tracking.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Message, NodeInfo, NodePose, Rejected, RelativePose, TrackMode
from buddyline.solver_service.geometry.rotation import matrix_to_quat, quat_to_matrix
from buddyline.solver_service.network.belief import KnownPlace
from buddyline.solver_service.network.filter import NetFilter
from buddyline.solver_service.network.rows import NetRow
from buddyline.solver_service.pace import NO_NETWORK
from buddyline.solver_service.results import NUMERIC_ERRORS, view_of, wrong_size
from buddyline.solver_service.sensors import KEPT_NS
from buddyline.solver_service.streams import STOPPED_NS, NodeStream
from buddyline.solver_service.track.inputs import DepthSeen
from buddyline.solver_service.track.problems import as_ended, merged
from buddyline.solver_service.track_messages import attitudes_of, fix_of, frame_of, same_rig, track_node_of
from buddyline.solver_service.tracking import TrackSettings
from msgspec import UNSET

NET: Final = "main"
# Rows come at the track's rate, but at no more than this: each instant has a row of every node.
MOST_HZ: Final = 20.0


class NetTracker:
    """Follows all nodes in one frame.

    streams: by node; nodes may be added to it later. one_in: of so many triggers and rows one is taken.
    """

    def __init__(self, streams: Mapping[str, NodeStream], settings: TrackSettings) -> None:
        self._streams = streams
        self._period_ns = round(S_NS / min(settings.rate_hz, MOST_HZ))
        self._mode: TrackMode = "smooth" if "smooth" in settings.modes else "filter"
        self._past: list[str] = []
        self._left: list[Message] = []
        self._filter: NetFilter | None = None
        self.one_in, self._stopped = 1, False
        self.forget()

    def forget(self) -> None:
        """Start anew: a clock was set, or a rig was changed."""
        if self._filter is not None:
            self._note(as_ended(self._filter.problems))
            # What has not been smoothed yet is told now.
            self._left += self._rest(self._filter)
        self._filter = None
        self._infos: dict[str, NodeInfo] = {}
        self._nodes: list[str] = []
        self._settled_ns: dict[tuple[str, str], int] = {}
        self._first_ns: int | None = None
        self._taken_ns = -1
        # Of each node, by its own clock: up to when all was fed, and up to when rows were asked for.
        self._fed_ns: list[int] = []
        self._asked_ns: list[int] = []
        self.net = NET
        self._zero_m = np.zeros(3)

    def stop(self) -> None:
        """End, and take nothing up to `go_on`."""
        self.forget()
        self._stopped = True

    def go_on(self) -> None:
        """Begin anew with what comes."""
        self._stopped = False

    @property
    def has_estimate(self) -> bool:
        """Whether there is an estimate."""
        return self._filter is not None

    @property
    def nodes(self) -> list[str]:
        """The nodes that the network knows, members or not."""
        return self._nodes

    def seen(self) -> set[tuple[str, str]]:
        """Return the pairs (observer, other) where the observer's pictures were searched for the other's lamps."""
        pairs = self._filter.main.detection if self._filter is not None else ()
        return {(self._nodes[observer], self._nodes[other]) for observer, other in pairs}

    def detection(self, observer: str, other: str) -> tuple[float, float]:
        """Return how likely the other's left and right lamp are found where they are lit and in the picture."""
        pair = self._nodes.index(observer), self._nodes.index(other)
        left, right = self._filter.main.detection[pair].tolist() if self._filter is not None else (1.0, 1.0)
        return left, right

    @property
    def problems(self) -> list[str]:
        """What is wrong, and what was (it says so)."""
        found = self._filter.problems if self._filter is not None else []
        found = [*found, NO_NETWORK] if self._stopped else found
        return merged([*self._past, *found])

    def take(self, outcomes: Iterable[Message]) -> list[Message]:
        """Go on to where these outcomes allow; return the poses of all nodes up to there."""
        outcomes = list(outcomes)
        fixes: list[RelativePose] = []
        if not outcomes or self._stopped:
            return self._with_left([])
        for one in outcomes:
            if not (isinstance(one, RelativePose | Rejected) and self._carries(one)):
                continue
            if self._settled_ns and one.stamp_ns > max(self._settled_ns.values()) + KEPT_NS:
                # After such a gap nothing of before helps, and a step over hours takes minutes.
                self.forget()
                fixes.clear()
            pair = one.node_a, one.node_b
            self._settled_ns[pair] = max(self._settled_ns.get(pair, 0), one.stamp_ns)
            # However many outcomes come at once, the network begins with the first of them.
            self._first_ns = one.stamp_ns if self._first_ns is None else min(self._first_ns, one.stamp_ns)
            if isinstance(one, RelativePose):
                fixes.append(one)
        with np.errstate(all="ignore"):
            try:
                return self._take(fixes, self._frontier_ns())
            except NUMERIC_ERRORS as error:
                return self._started_anew(str(error))

    def _carries(self, outcome: RelativePose | Rejected) -> bool:
        """Whether an outcome carries the network on.

        A late frame's stamp is old, or far from the dive's time. A single frame does not tell whether its node's clock
        is right: where it is ahead of all that was settled, the others' data would come too late.
        """
        is_single = isinstance(outcome, Rejected) and outcome.reason in ("unmatched", "duplicate")
        if isinstance(outcome, Rejected) and outcome.reason == "late":
            return False
        if not self._settled_ns:
            return not is_single
        ahead_ns = outcome.stamp_ns - max(self._settled_ns.values())
        return ahead_ns >= -KEPT_NS and not (is_single and ahead_ns > STOPPED_NS)

    def finish(self) -> list[Message]:
        """Take what is left, at the end of the dive."""
        if self._filter is None:
            return self._with_left([])
        with np.errstate(all="ignore"):
            try:
                messages = self._take([], max(self._settled_ns.values(), default=0) + S_NS)
                return messages + (self._rest(self._filter) if self._filter is not None else [])
            except NUMERIC_ERRORS as error:
                return self._started_anew(str(error))

    def _started_anew(self, why: str) -> list[Message]:
        """Drop a network that absurd but finite values have spoiled; return what an earlier one has left."""
        self._note([f"values were out of numeric range ({why}): the network started anew"])
        self.forget()
        return self._with_left([])

    def _rest(self, track: NetFilter) -> list[Message]:
        """Return what is still to be smoothed; nothing where absurd values have spoiled it."""
        with np.errstate(all="ignore"):
            try:
                return [self._message(row) for row in track.finish()]
            except NUMERIC_ERRORS:
                return []

    def _with_left(self, messages: list[Message]) -> list[Message]:
        """Return messages, behind those of a network that has ended."""
        left, self._left = self._left, []
        return left + messages

    def _frontier_ns(self) -> int:
        """Return up to when, by the net's clock, everything has come: outcomes, and samples of sensors that go on.

        A pair that is a second behind the newest outcome has stopped.
        """
        settled_ns = self._settled_by_net_ns
        newest_ns = max(settled_ns, default=0)
        complete_ns = [
            stream.complete_ns(newest_ns + self._off_ns(node)) - self._off_ns(node)
            for node, stream in self._streams.items()
        ]
        return min([*(ns for ns in settled_ns if ns > newest_ns - STOPPED_NS), *complete_ns], default=0)

    @property
    def _settled_by_net_ns(self) -> list[int]:
        """The newest outcome of each pair: up to when, by the net's clock, the pictures of both nodes are here."""
        return [ns - max(map(self._off_ns, pair)) for pair, ns in self._settled_ns.items()]

    def _off_ns(self, node: str) -> int:
        """Return a node's clock minus the net's, as believed."""
        known = self._filter is not None and node in self._nodes
        return self._filter.off_ns[self._nodes.index(node)] if known and self._filter is not None else 0

    def _take(self, fixes: Sequence[RelativePose], to_ns: int) -> list[Message]:
        self._meet(to_ns)
        if self._filter is None:
            return self._with_left([])
        track = self._filter
        for fix in fixes:
            if fix.node_a in self._nodes and fix.node_b in self._nodes:
                a, b = self._nodes.index(fix.node_a), self._nodes.index(fix.node_b)
                seen = ((a, fix.blobs_a), (b, fix.blobs_b))
                candidates = [(node, k) for node, blobs in seen for k in blobs if k >= 0]
                track.add_pair_fix(a, b, fix_of(fix), fix.trigger, candidates)
        if to_ns <= self._taken_ns:
            return self._with_left([])
        told_ns = min(to_ns, max(self._settled_by_net_ns, default=to_ns))
        asked: dict[int, list[int]] = {}
        for index, node in enumerate(self._nodes):
            off_ns = track.off_ns[index]
            self._feed(track, index, self._streams[node], self._fed_ns[index] + 1, to_ns + off_ns)
            due = range(-(-(self._asked_ns[index] + 1) // self._period_ns), (told_ns + off_ns) // self._period_ns + 1)
            for k in due:
                if not k % self.one_in:
                    asked.setdefault(k * self._period_ns, []).append(index)
            self._fed_ns[index] = max(self._fed_ns[index], to_ns + off_ns)
            self._asked_ns[index] = max(self._asked_ns[index], told_ns + off_ns)
        self._taken_ns = to_ns
        rows = track.advance(to_ns, asked.items())
        return self._with_left([self._message(row) for row in rows])

    def _meet(self, to_ns: int) -> None:
        """Take nodes into the network whose calibration has come; start anew where one has changed."""
        known = {node: found for node, one in self._streams.items() if (found := one.calibration(to_ns)) is not None}
        if any(node in self._infos and not same_rig(info, self._infos[node]) for node, (info, _) in known.items()):
            self.forget()
        fixed = [info for info, _ in known.values() if info.fixed is not UNSET]
        if self._first_ns is None or (self._filter is None and len(known) < 3 and not fixed):
            return
        new = sorted(known.keys() - self._infos.keys())
        if (
            self._filter is not None
            and not self._filter.main.places
            and any(known[n][0].fixed is not UNSET for n in new)
        ):
            # From the next outcome on a fixed node holds the frame.
            self.forget()
            return
        for node in new:
            info, rig = known[node]
            if self._filter is None:
                self._filter = NetFilter(smooths=self._mode == "smooth")
                self._taken_ns = self._first_ns - S_NS
            self._infos[node] = info
            self._nodes.append(node)
            blink = None if info.blink is UNSET else info.blink
            self._filter.add_node(track_node_of(info, rig), self._place(info), shines=info.has_lights, blink=blink)
            # Its messages of the last second, from before it was known here.
            self._feed(self._filter, len(self._nodes) - 1, self._streams[node], self._taken_ns - S_NS, self._taken_ns)
            self._fed_ns.append(self._taken_ns)
            self._asked_ns.append(self._taken_ns)

    def _place(self, info: NodeInfo) -> KnownPlace | None:
        if info.fixed is UNSET:
            return None
        named = {one.fixed.net for one in self._infos.values() if one.fixed is not UNSET}
        if len(named) > 1:
            self._note([f"fixed nodes name the nets {' and '.join(sorted(named))}: all are taken for one frame"])
        self.net = min(named)
        if not (self._filter is not None and self._filter.main.places):
            # Coordinates may be of a whole country: the estimator counts from the first fixed node.
            self._zero_m = np.array(info.fixed.p_m)
        R = quat_to_matrix(np.array(info.fixed.q_xyzw))
        return KnownPlace(np.array(info.fixed.p_m) - self._zero_m, R, info.fixed.sigma_m, info.fixed.sigma_rad)

    def _feed(self, track: NetFilter, index: int, stream: NodeStream, start_ns: int, end_ns: int) -> None:
        stamps_ns, values = stream.imu.between(start_ns, end_ns)
        track.add_imu(index, stamps_ns, values[:, :3], values[:, 3:])
        first, own = track.nodes[0].rig, track.nodes[index].rig
        for attitude in attitudes_of(stream.attitude.between(start_ns, end_ns), first, own):
            track.add_attitude(index, attitude)
        for depth in stream.depth.between(start_ns, end_ns):
            track.add_depth(index, DepthSeen(depth.stamp_ns, depth.depth_m, depth.sigma_m))
        info, between = self._infos[stream.node], stream.frames.between(start_ns, end_ns)
        frames = [one for one in between if not (one.trigger % self.one_in or wrong_size(one, info))]
        track.add_frames(index, [frame_of(view_of(frame)) for frame in frames])

    def _message(self, row: NetRow) -> NodePose:
        node = self._nodes[row.node]
        px, py, pz = (self._zero_m + row.p_m).tolist()
        vx, vy, vz = row.v_mps.tolist()
        qx, qy, qz, qw = matrix_to_quat(row.R).tolist()
        if not (np.isfinite(row.covariance).all() and np.isfinite(row.p_m).all()):
            raise ArithmeticError("no finite covariance")
        return NodePose(
            net=self.net,
            node=node,
            stamp_ns=row.stamp_ns,
            p_m=(px, py, pz),
            q_xyzw=(qx, qy, qz, qw),
            v_mps=(vx, vy, vz),
            covariance=row.covariance.ravel().tolist(),
            fixed=self._infos[node].fixed is not UNSET,
            mode=self._mode,
            age_s=row.age_s,
        )

    def _note(self, problems: Iterable[str]) -> None:
        self._past = merged([*self._past, *problems])
