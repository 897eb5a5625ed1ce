"""The causal filter: messages in the order of time, starts, confirmation, restarts, rows."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from itertools import islice
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track import anchors
from buddyline.solver_service.track.estimate import Estimate, lead, same_pose
from buddyline.solver_service.track.forecasts import TOGETHER, DueRow, Forecast, Way, make_rows, of_state
from buddyline.solver_service.track.inputs import AttitudeSeen, FixSeen, TrackNode
from buddyline.solver_service.track.intake import newest_before
from buddyline.solver_service.track.lights import BLOCK, COLUMNS, Sight
from buddyline.solver_service.track.moving import HOLD_S, TOGETHER_S, excerpt, to_other_clocks
from buddyline.solver_service.track.output import CONTRADICTS, TrackRow, fix_chi2, fix_residual
from buddyline.solver_service.track.pool import MAX_TENTATIVE, TrackPool
from buddyline.solver_service.track.scale import MOST_GAP, gap_words, with_gap
from buddyline.solver_service.track.seeing import ONE_TRIGGER_S
from buddyline.solver_service.track.start import CLOCK_S, state_from_fix
from buddyline.solver_service.track.state import CLOCK, SIZE, State, place_covariance
from buddyline.solver_service.track.stepping import TICK_S
from buddyline.solver_service.track.strapdown import kept_shares

# Log odds by which an estimate must explain its pictures better than clutter to be confirmed, and a challenger better
# than the track to replace it. Each node's pictures alone must give at least MUTUAL.
CONFIRMED: Final = 25.0
REPLACED: Final = 20.0
MUTUAL: Final = 7.0
# An estimate is dropped where another leads it by more than REFUTED, or its own log odds fall below GIVEN_UP.
REFUTED: Final = 40.0
GIVEN_UP: Final = -15.0
# A start without a fix is confirmed after so many pictures with both lights, and so many of each node with a light: for
# a second another's lamp fits in place of a hidden one, until the motion contradicts.
BARS: Final = 4
TOLD: Final = 12
# A start from single lamps, when its place is known to this share of the range, 1 sd.
LONE_SHARE: Final = 0.1
# So many fixes must agree with a start from one of them, to confirm it, and to replace a confirmed track by it.
FIXES_TO_CONFIRM: Final = 2
FIXES_TO_REPLACE: Final = 3
# So many fixes on end that contradict a track, and so many of those that agreed, are enough for it not to be told live.
# The status says so from FIXES_TO_SAY on: a start is often put right within half a second.
FIXES_TO_DOUBT: Final = 2
FIXES_TO_SAY: Final = 5
SHARE_TO_DOUBT: Final = 0.2
# A start without a fix may follow a lamp and its reflection for up to REFLECTED_S, or drift in range by single lights,
# with too small a covariance. Live, it is not told until LATE_BARS pictures have shown both lights after that, nor
# after LONE_S of single lights until BARS_TO_FOLLOW have in all, unless a fix has agreed.
LATE_BARS: Final = 8
LONE_S: Final = 1.0
BARS_TO_FOLLOW: Final = 25
# A start is wide where the sigma of its place is so many times that of a fix that agrees with it. A wide start cannot
# be sure which candidates are lights. If it began without a fix, it is dropped, and the fix makes a new start: a wide
# one can agree with every fix, and then nothing else would start. It stays if its evidence is above CONFIRMED and it
# has used a light of the last two pictures. If it began from a fix and used no such light, it takes the new fix as a
# measurement.
WIDER: Final = 3.0
# A rival that began so much later than the best is younger.
LATE_S: Final = 0.1
# A confirmed track ends when no light was used for so long, and its position's sigma exceeds this share of the range,
# a range above LOST_RANGE_M counted as that.
LOST_S: Final = 3.0
LOST_SHARE: Final = 0.3
LOST_RANGE_M: Final = 10.0
# What iron near a compass, or haste, adds to an attitude's sigmas (roll, pitch, yaw) when a start is checked.
IRON_RAD: Final = np.radians((1.0, 1.0, 8.0))
# So do fixes on end whose chi^2 has a running mean above this (the newest counts 0.3). A sound track has 1 to 2, for
# a fix is made of lights that the track has used; one with wrong first updates can stay below 33 for long. Fixes that
# contradict by themselves do not count: a sound one after them must agree.
MEAN_CONTRADICTS: Final = 10.0
MEAN_KEPT: Final = 0.7
REFUSED_TO_SAY: Final = 10
# With clocks further apart than this, and by so many sigmas, the live filter is far from linear and its covariance too
# small: it gives no rows until APART_S later.
FAR_CLOCK_S: Final = 0.1
APART_S: Final = 20.0
FAR_SIGMAS: Final = 6.0
# Longest step, without a picture, over which a track tells its present state.
BRIDGED_S: Final = 1.0
# The last row stands for the present where it is at most this much before it.
LITTLE_S: Final = 0.01
# A step over a longer gap leaves nothing that is known, and one over hours takes minutes.
LONGEST_GAP_S: Final = 60.0
# Of one time, a row comes after the fixes (0) and the pictures of both nodes (1 and 2).
ROW_RANK: Final = 3
# Messages older than this are dropped. The noise of slow sensors is learned from so much.
MEMORY_S: Final = 30.0


class TrackFilter(TrackPool):
    """The track of nodes a (0) and b (1). Samples and events may be added in any order before `advance` passes them.

    keep_s: for how long steps are kept to smooth over; inf: all. clock_sigma_s: how far B's clock may be off, 1 sd.
    """

    def __init__(
        self, node_a: TrackNode, node_b: TrackNode, *, keep_s: float = 0.0, clock_sigma_s: float = CLOCK_S
    ) -> None:
        super().__init__((node_a, node_b), keep_s, clock_sigma_s)
        self.finished: list[Estimate] = []
        self._refused = 0
        self._apart_s = -np.inf
        self._last_row: tuple[Estimate, Forecast] | None = None

    def advance(self, to_ns: int, outputs_ns: list[int] | None = None) -> list[TrackRow]:
        """Go on to to_ns, up to which all has been added; return the track at the asked stamps in between.

        Events within HOLD_S of to_ns wait for the next call, so that the result does not depend on how often it is
        called.
        """
        rows: list[TrackRow] = []
        coming = self.coming(to_ns, outputs_ns)
        while some := list(islice(coming, TOGETHER)):
            make_rows(some)
            rows += [one.row for one in some if one.row is not None]
        return rows

    def coming(self, to_ns: int, outputs_ns: list[int] | None = None) -> Iterator[DueRow]:
        """Go on as `advance` does while rows are taken; give those that are still to be made."""
        end_s = self.seconds(0, to_ns) - HOLD_S
        for stamp_ns in outputs_ns or ():
            self._push(self.pair_seconds(stamp_ns), ROW_RANK, stamp_ns)
        while self._events and self._events[0][0] <= end_s:
            t_s, _, _, what = heapq.heappop(self._events)
            self._end_behind(t_s - LONGEST_GAP_S)
            if isinstance(what, int):
                row = self._row(t_s, what)
                if row is not None:
                    yield row
            elif isinstance(what, FixSeen):
                self._take_fix(t_s, what)
            elif isinstance(what, Sight):
                self._take_sight(t_s, what)
        if math.isinf(self._keep_s):
            # Without rows in between, an estimate stays where the last picture was.
            end_s = min([end_s, *(estimate.t_s for estimate in self._estimates())])
        self._forget_before(end_s - MEMORY_S)

    def present(self, t_s: float) -> Forecast | None:
        """Return the confirmed track at t_s, or its last row where that is at most LITTLE_S before.

        All events up to t_s must have been added. None where there is no such track, or it ends before.
        """
        main = self.main
        if main is None or not main.confirmed or self.withheld() or not 0.0 <= t_s - main.t_s < BRIDGED_S:
            return None
        row = self._last_row
        if row is not None and row[0] is main and max(main.t_s, t_s - LITTLE_S) <= row[1].t_s <= t_s:
            return row[1]
        return self._present(main, t_s)

    def _present(self, estimate: Estimate, t_s: float) -> Forecast:
        state, from_s, P = estimate.state, estimate.t_s, estimate.covariance
        if estimate.scale.found:
            P = with_gap(P, estimate.scale.share, estimate.by_scale, state)
        if t_s <= from_s:
            return of_state(from_s, state, P, estimate.rates_radps)
        a, b = (
            excerpt(samples, delay_s, from_s, t_s, carried_s)
            for samples, delay_s, carried_s in zip(
                self.samples, state.delay_s.tolist(), to_other_clocks(state), strict=True
            )
        )
        noises, span_s = self._noises(estimate, t_s), t_s - from_s
        without = np.array((a.without, b.without))
        shares = kept_shares(without, noises, span_s) * (without == estimate.without)
        sudden_rad = np.array((a.values[:, 12].max(), b.values[:, 12].max()))
        shaking = self._with_sudden(estimate.shaking.variances, sudden_rad)
        return Forecast(t_s, Way(span_s, state, P, (a, b), noises, shares, shaking))

    def withheld(self) -> bool:
        """Whether a live track is not to be told; `problems` says why.

        No fix has agreed with it, and few pictures have shown both lights. Or its clocks prove further apart than it
        bears, or did lately, or the last fixes contradict it: its first updates were then far from linear. Or both bars
        contradict each other by more than MOST_GAP. A track that starts anew believes in its clocks anew.
        """
        main = self.main
        if main is None:
            return False
        founded = not main.searched or main.agreed > 0 or self._founded_by_pictures(main)
        # A pair at rest tells little of its clocks, and less than it believes; a start that is not told may be wrong.
        far_s = max(FAR_CLOCK_S, FAR_SIGMAS * math.sqrt(main.covariance[CLOCK, CLOCK]))
        if founded and abs(main.state.clock_s) > far_s:
            self._apart_s = main.t_s
        apart = main.t_s - self._apart_s < APART_S
        # With a dark lamp there may be no fix but another's for minutes.
        lately = main.t_s - self._fix_s < APART_S
        contradicted = lately and main.contradicted >= max(FIXES_TO_DOUBT, SHARE_TO_DOUBT * main.agreed)
        unequal = main.confirmed and main.scale.found
        if unequal:
            self._problems.report(gap_words(main.scale.share, [node.name for node in self.nodes]), main.t_s)
        if apart:
            self._problems.report(f"{self.both}: their clocks are far apart: no live track", main.t_s)
        if contradicted and main.contradicted >= FIXES_TO_SAY:
            self._problems.report(f"{self.both}: poses contradict the live track", main.t_s)
        if main.confirmed and not founded:
            self._problems.report(f"{self.both}: no pose, and few pictures with both lamps: no live track", main.t_s)
        return apart or contradicted or not founded or (unequal and abs(main.scale.share) > MOST_GAP)

    @staticmethod
    def _founded_by_pictures(main: Estimate) -> bool:
        """Whether enough pictures have shown both lights to found a start without a fix."""
        lately = main.light_s - main.bar_s < LONE_S
        return main.late_bars >= LATE_BARS and (main.bars >= BARS_TO_FOLLOW or lately)

    def _take_sight(self, t_s: float, sight: Sight) -> None:
        self._check_units(t_s)
        self._hear(sight.node, t_s)
        if self.gone(1 - sight.node, t_s):
            self._go_on_alone(t_s, 1 - sight.node)
            return
        self._remember(t_s, sight)
        for estimate in self._estimates():
            if t_s >= estimate.t_s and t_s > estimate.start_s + estimate.skip_s:
                if estimate.unseen_by == sight.node and not estimate.confirmed:
                    self._fork(estimate, t_s, sight)
                if not estimate.confirmed:
                    self._follow(estimate, t_s, sight)
                    continue
                self._step(estimate, t_s, sight)
                estimate.pictures += 1
                estimate.bare += any(estimate.without)
                if estimate is self.main and estimate.last_seen is not None:
                    self.lamps.take(1 - sight.node, t_s, estimate.last_seen)
        self._judge(t_s)
        self._search(t_s, sight)
        self._search_window(t_s)

    def _begin_anew(self) -> None:
        self.main, self.challengers, self._apart_s = None, [], -np.inf

    def _go_on_alone(self, t_s: float, gone: int) -> None:
        """Go on to a picture that is not used, because the node that it may show is gone."""
        if self.main is not None and self.main.confirmed:
            self._step(self.main, t_s, None)
        self._judge(t_s)
        if self.main is not None and self.main.confirmed:
            self._problems.report(f"node {self.nodes[gone].name}: told nothing: its lamps alone show no track", t_s)

    def _take_fix(self, t_s: float, fix: FixSeen) -> None:
        self._fix_s = t_s
        agreed = False
        lost: list[Estimate] = []
        for estimate in self._estimates():
            chi2, wide = self._compared_with(estimate, t_s, fix)
            unused = wide and self._used_none(estimate)
            if chi2 < CONTRADICTS and estimate.searched and wide and (unused or estimate.evidence < CONFIRMED):
                lost.append(estimate)
                continue
            if chi2 < CONTRADICTS:
                estimate.gap_chi2 += (1.0 - MEAN_KEPT) * (chi2 - estimate.gap_chi2)
            if chi2 < CONTRADICTS and estimate.gap_chi2 < MEAN_CONTRADICTS:
                agreed = True
                if unused:
                    self._take_as_measured(estimate, t_s, fix)
                estimate.agreed_s = t_s
                estimate.agreed += 1
                estimate.contradicted = 0
            else:
                estimate.contradicted += 1
        started = None if agreed else self._start(t_s, fix)
        if started is None and not agreed:
            return
        self.challengers = [one for one in self.challengers if one not in lost]
        if self.main in lost:
            self.main = None
        if started is None:
            return
        if self.main is None:
            self.main = started
        else:
            started.baseline = self.main.evidence
            # Which lamps are dark is known already.
            started.detection = self.main.detection.copy()
            self.challengers.append(started)
            self.challengers = self.challengers[-3:]

    def _compared_with(self, estimate: Estimate, t_s: float, fix: FixSeen) -> tuple[float, bool]:
        """Give chi^2 (of 6) of a fix against an estimate, and whether the estimate is an unconfirmed, wide start."""
        state, P, rates_radps = self._predict(estimate, t_s)
        place, of_fix = place_covariance(state, P), fix.covariance[:3, :3]
        wide = not estimate.confirmed and float(place.trace()) > WIDER**2 * float(of_fix.trace())
        return fix_chi2(state, P[BLOCK], rates_radps, fix), wide

    @staticmethod
    def _used_none(estimate: Estimate) -> bool:
        """Whether an unconfirmed estimate could use no light of its last two pictures."""
        return sum(t_s > estimate.light_s for t_s, _ in estimate.evidence_history[-2:]) == 2

    def _take_as_measured(self, estimate: Estimate, t_s: float, fix: FixSeen) -> None:
        """Update a wide start by a fix. The lights of the fix's trigger are not used again.

        Fixes that have agreed so far do not count: a wide start agrees with any. Of shaking nothing is learned here;
        only lights teach it.
        """
        if t_s - estimate.t_s > TOGETHER_S:
            self._step(estimate, t_s, None)
        y, J, noise = fix_residual(estimate.state, estimate.rates_radps, fix)
        H = np.zeros((len(y), SIZE))
        H[:, COLUMNS] = J
        self._apply(estimate, H, y, noise)
        estimate.agreed = 0
        estimate.light_s, estimate.lit_m = t_s, float(estimate.state.range_m)
        estimate.skip_s = t_s - estimate.start_s + ONE_TRIGGER_S
        self._amend_step(estimate)

    def _start(self, t_s: float, fix: FixSeen) -> Estimate | None:
        attitudes = [newest_before(of_node, t_s + HOLD_S) for of_node in self.attitudes]
        force = self.samples[0].between(t_s - 0.5, t_s, t_s)[1][:, :3].mean(0) if len(self.samples[0]) else None
        rates = [samples.slow_rate(t_s, t_s + HOLD_S) for samples in self.samples]
        seen = attitudes[0][1] if attitudes[0] else None
        made = state_from_fix(self.nodes, fix, seen, force, rates, self.clock_sigma_s)
        if made is None:
            return None
        state, covariance = made
        if attitudes[1] is not None and not self._agrees_with(state, covariance, attitudes[1][1]):
            self._refused += 1
            if self._refused >= REFUSED_TO_SAY:
                why = "another's lights, or a wrong mount"
                self._problems.report(f"{self.both}: attitudes and fixes contradict each other: {why}", t_s)
            return None
        self._refused = 0
        estimate = Estimate(t_s, state, covariance, t_s, agreed_s=t_s, agreed=1)
        if attitudes[0] is not None:
            estimate.attitude_s[0] = t_s
            estimate.take_compass(0, 0.0, float(attitudes[0][1].sigma_rad[2] ** 2))
        estimate.light_s = t_s
        self._open(estimate)
        return estimate

    def _agrees_with(self, state: State, P: Floats, seen: AttitudeSeen) -> bool:
        """Whether B's attitude by a fix agrees with its message, whose compass iron may deflect.

        Two nodes that both look at a third node's bar can make a fix, but their headings contradict it.
        """
        y, H = anchors.attitude_residual(state, 1, self.level_camera(1, seen))
        noise = anchors.attitude_covariance(seen.R_ned_body, np.hypot(seen.sigma_rad, IRON_RAD), 1.0, 1.0)
        return float(y @ np.linalg.solve(noise + H @ P @ H.T, y)) < CONTRADICTS

    def _judge(self, t_s: float) -> None:
        """Confirm, replace or give up, by how well each estimate has explained the pictures."""
        main = self.main
        if main is not None and main.confirmed and t_s - main.light_s > LOST_S:
            range_m = float(np.linalg.norm(main.state.r_m))
            sigma_m = math.sqrt(float(np.trace(place_covariance(main.state, main.covariance))))
            if sigma_m > LOST_SHARE * min(range_m, LOST_RANGE_M):
                # It knows no more than a new start would.
                self._lose(main)
                main = None
        if main is not None and main.confirmed:
            for challenger in self.challengers:
                gained = main.evidence - challenger.baseline
                better = challenger.evidence > max(gained, 0.0) + REPLACED and min(challenger.evidence_by) > MUTUAL
                if better and self._is_supported(challenger, FIXES_TO_REPLACE, math.inf):
                    # What went wrong did so after the last fix that agreed; without any it may never have been right.
                    if main.agreed:
                        main.end_s = min(challenger.start_s, main.agreed_s)
                        main.steps.drop_after(main.end_s)
                        self.finished.append(main)
                    self._confirm(challenger)
                    self.challengers = []
                    return
            recent = [one for one in self.challengers if t_s - one.start_s < one.patience_s]
            self.challengers = self._thinned(t_s, recent)
            return
        pool = self._thinned(t_s, self._estimates())
        best = max(
            pool,
            key=lambda one: min((lead(one, other) for other in pool if other is not one), default=0.0),
            default=None,
        )
        self.main, self.challengers = best, [one for one in pool if one is not best]
        if (
            best
            and best.evidence > CONFIRMED
            and min(best.evidence_by) > MUTUAL
            and self._is_supported(best, FIXES_TO_CONFIRM, 2 * BARS)
        ):
            if not all(self._leads(best, rival) for rival in self.challengers):
                return
            for rival in self.challengers:
                # A rival goes on as a challenger: what it is to explain better is what came since both exist.
                rival.baseline = best.evidence - rival.evidence + lead(rival, best)
            self._confirm(best)

    def _confirm(self, estimate: Estimate) -> None:
        """Make an estimate the confirmed track, replayed if it started without a fix."""
        replays = estimate.searched and not (estimate.lone or any(estimate.without))
        self.main = self._replayed(estimate) if replays else estimate
        self.main.confirmed = True
        # Others are replayed, which tells which lamps are dark.
        for node, t_s, seen in estimate.seen_history if estimate.lone else ():
            self.lamps.take(node, t_s, seen)

    def _lose(self, main: Estimate) -> None:
        """End the track a second after its last light."""
        main.end_s = main.light_s + 1.0
        main.steps.drop_after(main.end_s)
        self.finished.append(main)
        self.main = None

    def _end_behind(self, since_s: float) -> None:
        """End all estimates that have not been carried on since then."""
        if self.main is not None and self.main.t_s < since_s:
            if self.main.confirmed:
                self._lose(self.main)
            self.main = None
        if self.challengers:
            self.challengers = [one for one in self.challengers if one.t_s >= since_s]

    @staticmethod
    def _thinned(t_s: float, pool: list[Estimate]) -> list[Estimate]:
        """Give those that are worth following, each pose once, the best first."""
        alive: list[Estimate] = []
        for estimate in sorted(pool, key=lambda one: -one.evidence):
            over = t_s - estimate.start_s > estimate.patience_s and (alive or estimate.evidence < CONFIRMED)
            if estimate.evidence < GIVEN_UP or over or any(lead(other, estimate) > REFUTED for other in pool):
                continue
            if not any(same_pose(estimate, better) for better in alive):
                alive.append(estimate)
        return alive[:MAX_TENTATIVE]

    def _leads(self, best: Estimate, rival: Estimate) -> bool:
        """Whether a rival is refuted: one that began later need only have fallen back."""
        late = rival.start_s > best.start_s + LATE_S
        return lead(best, rival) > (0.0 if late else CONFIRMED)

    @staticmethod
    def _is_supported(estimate: Estimate, fixes: int, bars: float) -> bool:
        """Whether enough speaks for an estimate beside its log odds.

        A start from a fix needs so many fixes that agree, or so many pictures with both lights (bars) and of each node:
        a single fix may be wrong, by chance or by another's lamp. A start without a fix may be of false candidates, or
        of a third node's bar: it needs pictures with both lights, and of both nodes.
        """
        if estimate.lone:
            place = place_covariance(estimate.state, estimate.covariance)
            share = math.sqrt(np.trace(place)) / float(np.linalg.norm(estimate.state.r_m))
            return min(estimate.lit_pictures) >= TOLD and share < LONE_SHARE
        if estimate.searched:
            return estimate.bars >= BARS and min(estimate.lit_pictures) >= TOLD
        return estimate.agreed >= fixes or min(estimate.bars, *estimate.lit_pictures) >= bars

    def _row(self, t_s: float, stamp_ns: int) -> DueRow | None:
        if self.main is None or not self.main.confirmed or t_s < self.main.t_s:
            return None
        main = self.main
        if self.withheld():
            return None
        while t_s - main.t_s > 1.5 * TICK_S:
            self._step(main, main.t_s + TICK_S, None)
        row = self._present(main, t_s)
        self._last_row = main, row
        return DueRow(stamp_ns, row, main.status)
