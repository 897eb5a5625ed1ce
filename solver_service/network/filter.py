"""The causal filter of a network: messages in the order of time, who joins, which estimate is followed, rows.

A fixed node is a member from the start; any other joins when a few poses in a row place it beside a member. Several
poses in a row that contradict the network open challengers, in which the node in question stands where these poses say.
The estimate that explains the pictures best is followed. Without fixed nodes the frame moves with the first member.
"""

from __future__ import annotations

import copy
import heapq
import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from buddyline.protocol.health import HEADINGS_APART_RAD
from buddyline.protocol.messages import Blink
from buddyline.solver_service.geometry.rotation import rotation_log, skew
from buddyline.solver_service.network.belief import KnownPlace
from buddyline.solver_service.network.estimate import CONTRADICTS, Candidate, NetEstimate, PairFix
from buddyline.solver_service.network.fixed import FixedWatch
from buddyline.solver_service.network.intake import NetIntake
from buddyline.solver_service.network.rows import DueNetRow, NetRow, make_rows
from buddyline.solver_service.network.trail import NetTrail
from buddyline.solver_service.track.inputs import FixSeen, TrackNode
from buddyline.solver_service.track.intake import CHECK_EVERY_S, newest_before
from buddyline.solver_service.track.lights import Sight
from buddyline.solver_service.track.moving import HOLD_S, TOGETHER_S
from buddyline.solver_service.track.problems import Problems
from buddyline.solver_service.track.samples import Samples

# FIXES_TO_JOIN poses of one pair in a row, no further apart in time than JOIN_WITHIN_S, and each in reach of the one
# before, place a node: a single one may be wrong.
FIXES_TO_JOIN: Final = 3
JOIN_WITHIN_S: Final = 1.5
REACH_MPS: Final = 1.5
REACH_RADPS: Final = 1.5
# Of so many poses of one trigger that take each other's candidates at most it is worked out which are right.
MOST_DISPUTED: Final = 10
# A challenger replaces the estimate once it explains the pictures since its start better by this, after TRIED_S at
# least; it is dropped after CHALLENGE_S, or when it is worse by REFUTED. No more are followed at a time.
REPLACED: Final = 20.0
TRIED_S: Final = 0.5
CHALLENGE_S: Final = 3.0
REFUTED: Final = 40.0
MOST_CHALLENGERS: Final = 3
# A pair opens a challenger no more often than this.
AGAIN_S: Final = 1.0
# A pair is reported after so many poses in a row that contradict the network.
CONTRADICTIONS: Final = 10
MEMORY_S: Final = 30.0
# Rows are smoothed by what comes in this time after them at least, and in twice this time at most.
LATER_S: Final = 10.0
# How the units are shaken, and how far their biases walk, is learned from so much of a dive's beginning before what is
# smoothed begins.
REHEARSED_S: Final = 20.0
# How far biases may walk, over what Noise has: as those of poor units, as those of good ones, and between. What
# explains the dive's beginning better counts more.
WALKS: Final = np.array((2.0, 0.8, 0.32))
# The dive's beginning is passed over again, by clocks that the pass before has put right, so often at most.
CLOCK_TRIALS: Final = 3
# Rows come after all else of their time.
ROW: Final = 1 << 20


class NetFilter(NetIntake):
    """The network of nodes. Samples and events may be added in any order before `advance` passes them.

    smooths: rows come later, by all that was seen in the LATER_S after each, or up to the end.
    """

    def __init__(self, *, smooths: bool = False) -> None:
        super().__init__()
        self.smooths = smooths
        self._rehearses, self._learns_clocks = smooths, True
        # Up to when all has been added.
        self._end_s = -np.inf
        if smooths:
            self.main.trail = NetTrail()
        # Up to when rows have been smoothed.
        self._smoothed_s = -np.inf
        # By trigger: the poses that are taken into account, or will be.
        self._together: dict[int, list[PairFix]] = {}
        self._challenged_s: dict[tuple[int, int], float] = {}
        self._contradicted: dict[tuple[int, int], int] = {}
        self._watches: dict[int, FixedWatch] = {}
        self._watched_s = -np.inf

    def add_node(
        self, node: TrackNode, place: KnownPlace | None = None, *, shines: bool = True, blink: Blink | None = None
    ) -> int:
        """Take a node into the network, and return its index.

        place: of a fixed node. shines: whether it has lamps. blink: how they blink.
        """
        self.nodes.append(node)
        self.samples.append(Samples())
        self.attitudes.append([])
        self.depths.append([])
        self._rejected.append(0)
        self.off_ns.append(0)
        index = len(self.nodes) - 1
        self.turning.append(self._turning_of(index))
        if place is not None:
            self._watches[index] = FixedWatch(node.name, place.R)
            self.main.places[index] = place
            if self.main.state is not None:
                self.main.settle(index, self.main.t_s)
                self.challengers = []
        if not shines:
            self.main.dark.add(index)
        if blink is not None:
            self.main.blinks[index] = blink
        return index

    def advance(self, to_ns: int, asked: Iterable[tuple[int, Sequence[int]]] = ()) -> list[NetRow]:
        """Go on to to_ns, by the net's clock, up to which all has been added; return the rows asked for in between.

        asked: stamps, by the nodes' own clocks, and the nodes.

        Events within HOLD_S of to_ns wait for the next call, so that the result does not depend on how often it is
        called.
        """
        self._end_s = self.since_epoch(to_ns) - HOLD_S
        for stamp_ns, nodes in asked:
            self.ask_rows(stamp_ns, nodes, ROW)
        if self._rehearses and (not self._events or self._end_s < self._events[0][0] + REHEARSED_S):
            return []
        return self._go_on(self._end_s)

    def _go_on(self, end_s: float) -> list[NetRow]:
        if self._rehearses:
            self._rehearse()
        rows: list[NetRow] = []
        due: list[DueNetRow] = []
        while self._events and self._events[0][0] <= end_s:
            t_s, _, _, what = heapq.heappop(self._events)
            if isinstance(what, tuple) and self.smooths:
                rows += self._ask(t_s, what)
            elif isinstance(what, tuple):
                row = self.main.due_row(t_s, what[0], what[1:])
                due += [row] if row is not None else []
            elif isinstance(what, PairFix):
                self._take_fix(t_s, what)
            elif isinstance(what, Sight):
                self._take_sights(t_s, [what, *self._beside(t_s)])
                if self._learns_clocks and self._put_clocks_right():
                    # What came by a clock that is ahead, since, comes with the next call.
                    break
        self._forget_before(end_s - MEMORY_S)
        return rows + make_rows(due)

    def _forget_before(self, t_s: float) -> None:
        super()._forget_before(t_s)
        while self._together:
            trigger = next(iter(self._together))
            if self.pair_seconds(self._together[trigger][0].stamp_ns) >= t_s:
                break
            del self._together[trigger]

    def finish(self) -> list[NetRow]:
        """Return the rows that are left, at the end of the dive."""
        rows = self._go_on(self._end_s)
        # It stops where a clock is put right.
        while self._events and self._events[0][0] <= self._end_s:
            rows += self._go_on(self._end_s)
        return rows + (self._smooth(np.inf) if self.smooths else [])

    def _rehearse(self) -> None:
        """Learn how the units are shaken and biases walk from the dive's beginning, whose own rows need it already."""
        self._rehearses = False
        if not self._events:
            return
        first = self._trial(float(WALKS[0]))
        for _ in range(CLOCK_TRIALS):
            if not self._put_right_by(first):
                break
            first = self._trial(float(WALKS[0]))
        trials = [first, *(self._trial(float(walked)) for walked in WALKS[1:])]
        evidence = np.array([trial.evidence for trial in trials])
        weights = np.exp(evidence - evidence.max())
        best = trials[evidence.argmax()]
        learned = zip(best.members, best.shaking.logs, strict=True)
        self.main.shaken = {member.node: logs for member, logs in learned}
        self.main.walked = float(np.exp(weights @ np.log(WALKS) / weights.sum()))

    def _trial(self, walked: float) -> NetEstimate:
        """Return where the dive's beginning leads if biases walk so far."""
        trial = copy.copy(self)
        trial.smooths, trial._learns_clocks, trial.main = False, False, self.main.copied()
        trial.main.trail, trial.main.walked = None, walked
        trial.challengers, trial._watches, trial._problems = [], {}, Problems()
        trial._fixes, trial._challenged_s, trial._contradicted = {}, {}, {}
        trial._together = self._together.copy()
        trial._rejected = self._rejected.copy()
        trial._events = sorted(event for event in self._events if event[1] != ROW)
        trial._go_on(self._events[0][0] + REHEARSED_S)
        # The trial has shared it, and its pictures come again.
        self._pictured_s.clear()
        return trial.main

    def _ask(self, t_s: float, what: tuple[int, ...]) -> list[NetRow]:
        """Note that a row is to be smoothed; return those that can be by now."""
        for estimate in [self.main, *self.challengers]:
            estimate.ask(t_s, what[0], what[1:])
        if self._smoothed_s == -np.inf:
            self._smoothed_s = t_s - TOGETHER_S
        return self._smooth(t_s - LATER_S) if t_s - self._smoothed_s >= 2.0 * LATER_S else []

    def _smooth(self, until_s: float) -> list[NetRow]:
        """Return the rows until then that have not been smoothed yet."""
        rows = self.main.smoothed(self._smoothed_s, until_s)
        self._smoothed_s = until_s
        for estimate in [self.main, *self.challengers]:
            if estimate.trail is not None:
                estimate.trail.forget_before(until_s)
        return rows

    def add_pair_fix(self, node: int, other: int, fix: FixSeen, trigger: int, candidates: Iterable[Candidate]) -> None:
        """Take a pose that one trigger's lights gave by themselves: of the node `other` from the node `node`.

        candidates: what it takes for lamps.
        """
        found = PairFix(
            fix.stamp_ns, fix.t_a_b_m, fix.R_a_b, fix.covariance, node, other, trigger, frozenset(candidates)
        )
        self._together.setdefault(trigger, []).append(found)
        self.add_fix(found)

    def _beside(self, t_s: float) -> list[Sight]:
        """Take the other pictures of a trigger, less than TOGETHER_S after the first of t_s, out of the events.

        Fixes and rows in between come after all of them.
        """
        found, passed = [], []
        while self._events and self._events[0][0] < t_s + TOGETHER_S:
            event = heapq.heappop(self._events)
            if isinstance(event[3], Sight):
                found.append(event[3])
            else:
                passed.append(event)
        for event in passed:
            heapq.heappush(self._events, event)
        return found

    def _take_sights(self, t_s: float, sights: Sequence[Sight]) -> None:
        self._check_units(t_s)
        if t_s - self._watched_s >= CHECK_EVERY_S:
            self._watched_s = t_s
            self._check_fixed(t_s)
            self._check_compasses(t_s)
            self._check_clocks(t_s)
        for sight in sights:
            self._hear(sight.node, t_s)
        if self.main.state is None and self.main.places:
            self.main.begin(t_s)
        for estimate in [self.main, *self.challengers]:
            estimate.take_sights(t_s, sights)
        self._judge(t_s)

    def _check_fixed(self, t_s: float) -> None:
        """Say which fixed nodes seem to have moved."""
        for node, watch in self._watches.items():
            seen, sunk = newest_before(self.attitudes[node], t_s), newest_before(self.depths[node], t_s)
            R = self.level_camera(node, seen[1]) if seen is not None and t_s - seen[0] < 1.0 else None
            depth_m = sunk[1].depth_m if sunk is not None and t_s - sunk[0] < 1.0 else None
            for problem in watch.judge(t_s, R, depth_m):
                self._problems.report(problem, t_s)

    def _check_compasses(self, t_s: float) -> None:
        """Say which compass is the wrong one, where that is known."""
        wrong = self.main.wrong_compass()
        if wrong is not None and abs(wrong[1]) > HEADINGS_APART_RAD:
            name, off_deg = self.nodes[wrong[0]].name, math.degrees(abs(wrong[1]))
            said = f"its compass is {off_deg:.0f} deg off those of the others: is it near steel, or not calibrated?"
            self._problems.report(f"{name}: {said}", t_s)

    def _judge(self, t_s: float) -> None:
        """Follow the estimate that explains the pictures best."""
        kept = []
        for challenger in self.challengers:
            # Both began with the same evidence.
            lead = challenger.evidence - self.main.evidence
            if lead > REPLACED and t_s - challenger.start_s > TRIED_S:
                self.main, self.challengers = challenger, []
                return
            if t_s - challenger.start_s < CHALLENGE_S and lead > -REFUTED:
                kept.append(challenger)
        self.challengers = kept

    def _take_fix(self, t_s: float, fix: PairFix) -> None:
        main = self.main
        if main.state is None and main.places:
            main.begin(t_s)
        if t_s < main.t_s - TOGETHER_S:
            return
        recent = self._fixes.setdefault((fix.node, fix.other), [])
        recent.append((t_s, fix))
        del recent[:-FIXES_TO_JOIN]
        one, two = main.member_of(fix.node), main.member_of(fix.other)
        if one is not None and two is not None:
            self._compare(t_s, fix, one, two)
        elif _settled(recent) and not any(disputed(one, self._together.get(one.trigger, ())) for _, one in recent):
            _enter(main, t_s, fix)
            for challenger in self.challengers:
                _enter(challenger, t_s, fix)

    def _compare(self, t_s: float, fix: PairFix, one: int, two: int) -> None:
        """Open challengers where poses on end contradict the estimate: either node may be the one that is off."""
        _, chi2 = self.main.gap(t_s, fix, one, two)
        pair = fix.node, fix.other
        if chi2 < CONTRADICTS:
            self._contradicted[pair] = 0
            return
        self._contradicted[pair] = self._contradicted.get(pair, 0) + 1
        free = [node for node in pair if node not in self.main.places]
        if self._contradicted[pair] >= CONTRADICTIONS:
            self._say_contradiction(t_s, pair)
        if not _settled(self._fixes[pair]) or t_s - self._challenged_s.get(pair, -np.inf) < AGAIN_S:
            return
        self._challenged_s[pair] = t_s
        for node in free:
            challenger = self.main.copied()
            index = challenger.member_of(node)
            if index is None or len(self.challengers) >= MOST_CHALLENGERS:
                continue
            challenger.start_s = t_s
            challenger.remove(index)
            challenger.clocks.pop(node, None)
            _enter(challenger, t_s, fix)
            if challenger.member_of(node) is not None:
                self.challengers.append(challenger)

    def _say_contradiction(self, t_s: float, pair: tuple[int, int]) -> None:
        fixed = [self.nodes[node].name for node in pair if node in self.main.places]
        one, two = (self.nodes[node].name for node in pair)
        if len(fixed) == 2:
            said = f"fixed nodes {one} and {two}: what they see of each other contradicts their places"
        elif fixed:
            contradict = f"poses of {one} and {two} contradict the network"
            said = f"{contradict}: has fixed node {fixed[0]} moved, or is it another's bar?"
        else:
            said = f"poses of {one} and {two} contradict the network: another's bar?"
        self._problems.report(said, t_s)


def _enter(estimate: NetEstimate, t_s: float, fix: PairFix) -> None:
    """Make the one of a pose's two nodes a member that is none; both, where there are no members yet."""
    one, two = estimate.member_of(fix.node), estimate.member_of(fix.other)
    if one is None and two is None:
        if estimate.state is not None or not estimate.open(t_s, fix):
            return
        one = 0
    if one is not None and two is None:
        estimate.join(t_s, fix, one, fix.other)
    elif one is None and two is not None:
        estimate.join(t_s, inverted(fix), two, fix.node)


def _settled(recent: Sequence[tuple[float, PairFix]]) -> bool:
    """Whether there are poses enough in a row, each in reach of the one before."""
    return len(recent) == FIXES_TO_JOIN and all(_in_reach(*both) for both in pairwise(recent))


def _in_reach(before: tuple[float, PairFix], now: tuple[float, PairFix]) -> bool:
    """Whether a node can have moved from one pose to the next, seen from a node that turns as well."""
    (before_s, one), (now_s, two) = before, now
    span_s = now_s - before_s
    if span_s > JOIN_WITHIN_S:
        return False
    sigma_m = float(np.sqrt(np.trace(one.covariance[:3, :3] + two.covariance[:3, :3])))
    range_m = float(np.linalg.norm(two.t_a_b_m))
    reach_m = (REACH_MPS + REACH_RADPS * range_m) * span_s + 4.0 * sigma_m
    sigma_rad = float(np.sqrt(np.trace(one.covariance[3:, 3:] + two.covariance[3:, 3:])))
    turned = float(np.linalg.norm(rotation_log(two.R_a_b @ one.R_a_b.T)))
    moved_m = float(np.linalg.norm(two.t_a_b_m - one.t_a_b_m))
    return moved_m < reach_m and turned < 2.0 * REACH_RADPS * span_s + 4.0 * sigma_rad


def disputed(fix: PairFix, others: Sequence[PairFix]) -> bool:
    """Whether a pose shares a candidate with another pose of its trigger, and may be the one that is wrong.

    Of such poses those that together explain most candidates are right. Where two choices explain as many, what is not
    in both is disputed.
    """
    about, rest = [fix], list(others)
    while more := [one for one in rest if any(one.candidates & of.candidates for of in about)]:
        about += [one for one in more if one is not fix]
        rest = [one for one in rest if one not in more]
    if len(about) > MOST_DISPUTED:
        return True
    choices = _without_contradiction(about)
    explained = [sum(len(one.candidates) for one in choice) for choice in choices]
    return any(fix not in of for of, n in zip(choices, explained, strict=True) if n == max(explained))


def _without_contradiction(poses: Sequence[PairFix]) -> list[list[PairFix]]:
    """Give all choices of poses in which no candidate is used twice."""
    if not poses:
        return [[]]
    first, *rest = poses
    beside = [one for one in rest if not one.candidates & first.candidates]
    return [[first, *choice] for choice in _without_contradiction(beside)] + _without_contradiction(rest)


def inverted(fix: PairFix) -> PairFix:
    """Give T_b_a of a pose T_a_b: t' = -R^T t, e_t' = -R^T (e_t + [t]x e_w), e_w' = -R^T e_w."""
    back = fix.R_a_b.T
    J = np.zeros((6, 6))
    J[:3, :3], J[:3, 3:], J[3:, 3:] = -back, -back @ skew(fix.t_a_b_m), -back
    P = J @ fix.covariance @ J.T
    return PairFix(fix.stamp_ns, -back @ fix.t_a_b_m, back, P, fix.other, fix.node, fix.trigger, fix.candidates)
