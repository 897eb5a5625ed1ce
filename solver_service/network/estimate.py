"""One estimate of a network: what lights say, who joins and leaves, and the poses that it gives."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final, TypeAlias

import numpy as np
from buddyline.protocol.blinking import lit
from buddyline.protocol.messages import Blink
from buddyline.solver_service.geometry.rotation import Floats, Indices, rotation_log, skew
from buddyline.solver_service.network.belief import Member, NetBelief
from buddyline.solver_service.network.clocks import BETWEEN_MPS, BETWEEN_RADPS, seems_far
from buddyline.solver_service.network.exclusive import share
from buddyline.solver_service.network.rows import DueNetRow, NetRow, rows_of
from buddyline.solver_service.network.sights import SightArrays, by_clocks_px2, columns, light_positions
from buddyline.solver_service.network.state import BLOCK, CLOCK, P_, PHI, V_, NetState, block, lone
from buddyline.solver_service.network.trail import Present, Told
from buddyline.solver_service.track import anchors
from buddyline.solver_service.track.association import NOWHERE_PX, Odds, doubt_of, odds_of
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.intake import TrackIntake, newest_before
from buddyline.solver_service.track.lights import Sight, in_picture, lasting_factor, pixels_of, residuals, with_stamp
from buddyline.solver_service.track.moving import HOLD_S, TOGETHER_S
from buddyline.solver_service.track.seeing import ABOUT_STEPS, noise_of
from buddyline.solver_service.track.start import tilt_of
from buddyline.solver_service.track.stepping import TICK_S
from buddyline.solver_service.track.visible import EDGE_PX
from numpy.typing import NDArray

# A node is confirmed once its lights in the others' pictures and theirs in its own explain these better than clutter by
# CONFIRMED (log odds) together, and each alone by EACH: a node that takes lights for another's sees, but is not seen.
# It leaves when one of both is below GIVEN_UP, or when it has not been confirmed within PATIENCE_S.
CONFIRMED: Final = 25.0
EACH: Final = 7.0
GIVEN_UP: Final = -15.0
PATIENCE_S: Final = 4.0
# Beyond this chi^2 a pose (6 degrees of freedom) or an attitude (3) contradicts the network.
CONTRADICTS: Final = 33.0
# A node leaves after LOST_S without a light when its position is worse than LOST_M.
LOST_S: Final = 3.0
LOST_M: Final = 1.5
# A bar whose lights are further outside of a picture than this is not looked for in it.
OUTSIDE_PX: Final = 60.0
# How likely a lamp that is switched off by its code is in the picture after all: it was switched late.
SHOWN_DARK: Final = 0.01
# How likely a light is found, before pictures have told.
FIRST_DETECTION: Final = np.full(2, 0.8)
# What iron near a compass, or acceleration, adds to an attitude's sigmas (roll, pitch, yaw) when a join is checked.
IRON_RAD: Final = np.radians((1.0, 1.0, 8.0))
# For so long after a pose made a node a member, its lights are not used: they are those of the pose.
SKIP_S: Final = 0.02
_POSE: Final = np.r_[P_, PHI]

Candidate: TypeAlias = tuple[int, int]
"""A candidate of a trigger: the node, and its place in that node's picture."""


@dataclass(frozen=True, eq=False, slots=True)
class PairFix(FixSeen):
    """A pose of the node `other` from the node `node`, as indices of the network's nodes.

    trigger: whose pictures it is of. candidates: what it takes for lamps.
    """

    node: int = 0
    other: int = 0
    trigger: int = 0
    candidates: frozenset[Candidate] = frozenset()


@dataclass(frozen=True, eq=False, slots=True)
class Bar:
    """Another member's bar in one member's picture, by their places among the members."""

    observer: int
    other: int
    sight: Sight


class NetEstimate(NetBelief):
    """One estimate of the network: a belief that also takes lights, lets nodes join and leave, and gives rows.

    dark: nodes without lamps. blinks: how lamps blink, by node. start_s: when a challenger began. evidence: log odds
    over clutter of all pictures so far. detection: by observer and other node, how likely each of its lights is found.
    lit_s: by observer, other node and light, when it was last used.
    """

    def __init__(self, intake: TrackIntake) -> None:
        super().__init__(intake)
        self.dark: set[int] = set()
        self.blinks: dict[int, Blink] = {}
        self.start_s = -np.inf
        self.evidence = 0.0
        self.detection: dict[tuple[int, int], Floats] = {}
        self.lit_s: dict[tuple[int, int, int], float] = {}

    def copied(self) -> NetEstimate:
        """Give an estimate that goes its own way from here."""
        other = copy.copy(self)
        other.members = [replace(member) for member in self.members]
        other.detection = {pair: of.copy() for pair, of in self.detection.items()}
        other.lit_s = dict(self.lit_s)
        other.clocks = dict(self.clocks)
        other.trail = None if self.trail is None else self.trail.copied()
        return other

    def remove(self, index: int) -> None:
        """Let a member go, and what was learned of its lights and of those in its pictures."""
        gone = self.members[index].node
        super().remove(index)
        self.detection = {pair: of for pair, of in self.detection.items() if gone not in pair}

    # Lights

    def take_sights(self, t_s: float, sights: Sequence[Sight]) -> None:
        """Go on to some pictures of one trigger, and use the lights in them."""
        if self.state is None or t_s < self.t_s - TOGETHER_S:
            return
        self.step(t_s)
        seen = [(index, sight) for sight in sights if (index := self.member_of(sight.node)) is not None]
        for index, _ in seen:
            self.members[index].looks_away = True
        if seen:
            self._take_lights(seen)
            self._judge()

    def _take_lights(self, seen: Sequence[tuple[int, Sight]]) -> None:
        """Use the lights in pictures of some members; all bars in all pictures are worked out together."""
        assert self.state is not None
        bars = [
            Bar(observer, other, sight)
            for observer, sight in seen
            for other in range(len(self.members))
            if self._may_show(observer, other, sight)
        ]
        if not bars:
            return
        observers, others = [bar.observer for bar in bars], [bar.other for bar in bars]
        candidates = SightArrays([bar.sight for bar in bars])
        times_s = candidates.dt_s + np.array([[bar.sight.t_s - self.t_s] for bar in bars])
        lights_m = np.array([self.nodes[self.members[other].node].rig.lights_m for other in others])
        X, D = light_positions(self.state, observers, others, lights_m, self.rates_radps, times_s)
        which = columns(observers, others)
        P = with_stamp(self.covariance[which[:, :, None], which[:, None, :]])
        first = D[:, 0, 0]
        spread_m2 = np.trace(first @ P @ first.swapaxes(1, 2), axis1=1, axis2=2)
        wide = spread_m2 > 0.01 * (X[:, 0, 0] ** 2).sum(axis=1)
        if wide.any() and len(seen) > 1:
            # Where little is known, the second picture's lights are linear only about where the first one's put them.
            for one in seen:
                self._take_lights([one])
            return
        within = [self._within(bar, X[n, 0], wide=bool(wide[n])) for n, bar in enumerate(bars)]
        kept = [n for n, inside in enumerate(within) if inside is not None]
        if not kept:
            return
        bars, which, inside = [bars[n] for n in kept], which[kept], np.array([within[n] for n in kept])
        y, H = residuals(candidates.bearings[kept], candidates.tangents[kept], X[kept], D[kept])
        clutter = np.array([bar.sight.clutter / self.nodes[bar.sight.node].rig.camera.area_px2 for bar in bars])
        odds = odds_of(y, H, P[kept], candidates.sigma_px[kept], clutter)
        chosen = self._associate(bars, odds, inside)
        if not chosen:
            return

        def compared(state: NetState) -> tuple[Floats, Floats]:
            of_kept = [observers[n] for n in kept], [others[n] for n in kept], lights_m[kept]
            return residuals(
                candidates.bearings[kept],
                candidates.tangents[kept],
                *light_positions(state, *of_kept, self.rates_radps, times_s[kept]),
            )

        about = any(wide[kept[n]] and self._both_confirmed(bars[n]) for n, *_ in chosen)
        self._update(bars, which, y, H, chosen, by_clocks_px2(H, P[kept]), compared if about else None)

    def _both_confirmed(self, bar: Bar) -> bool:
        """Whether both members of a bar are confirmed."""
        return self.members[bar.observer].confirmed and self.members[bar.other].confirmed

    def _within(self, bar: Bar, X: Floats, *, wide: bool) -> tuple[bool, bool] | None:
        """Tell which of a bar's lights ought to be in the picture by where they stand, X (2, 3) before the camera.

        None where the whole bar is outside. wide: whether its place is known too poorly to tell.
        """
        if wide:
            return True, True
        camera = self.nodes[bar.sight.node].rig.camera
        at = pixels_of(camera, X)
        if not in_picture(camera, at, -OUTSIDE_PX).any():
            return None
        left, right = in_picture(camera, at, EDGE_PX).tolist()
        return left, right

    def _associate(
        self, bars: Sequence[Bar], odds: Sequence[Odds], inside: NDArray[np.bool_]
    ) -> list[tuple[int, int, int, float]]:
        """Choose the lights that are sure, as bar, candidate, light and variance; learn how well pictures are explained
        and how often lights are found. inside (B, 2): whether each is in the picture."""
        pairs = [(bar.sight.node, self.members[bar.other].node) for bar in bars]
        lit = np.array([self._lit(other, bar.sight) for bar, (_, other) in zip(bars, pairs, strict=True)])
        detection = np.array([self.detection.get(pair, FIRST_DETECTION) for pair in pairs])
        likely = np.where(lit, detection * np.where(inside, 1.0, 0.02), SHOWN_DARK)
        weighed = [one.weighed(found) for one, found in zip(odds, likely, strict=True)]
        chosen: list[tuple[int, int, int, float]] = []
        seen = np.zeros((len(bars), 2))
        # Each candidate of a picture is one lamp's at most.
        for _, of_sight in groupby(range(len(bars)), key=lambda n: id(bars[n].sight)):
            ns = list(of_sight)
            shared = share([weighed[n] for n in ns], bars[ns[0]].sight.sigma_px)
            chosen += [(ns[bar], k, light, variance) for k, bar, light, variance in shared.chosen]
            seen[ns] = shared.seen
            self.evidence += shared.total
            for n, gained in zip(ns, shared.evidence.tolist(), strict=True):
                other, observer = self.members[bars[n].other], self.members[bars[n].observer]
                if not other.confirmed:
                    other.evidence = other.evidence[0] + gained, other.evidence[1]
                if not observer.confirmed:
                    observer.evidence = observer.evidence[0], observer.evidence[1] + gained
        detection = np.clip(detection + 0.05 * np.where(inside & lit, seen - detection, 0.0), 0.02, 0.97)
        self.detection.update(zip(pairs, detection, strict=True))
        return chosen

    def _may_show(self, observer: int, other: int, sight: Sight) -> bool:
        """Whether a picture of a member may tell of another's lights."""
        member = self.members[other]
        skip_s = max(member.skip_s, self.members[observer].skip_s if not member.confirmed else -np.inf)
        if other == observer or member.node in self.dark or sight.t_s < skip_s:
            return False
        return member.node in self.places or not self.intake.gone(member.node, sight.t_s)

    def _lit(self, node: int, sight: Sight) -> tuple[bool, bool]:
        """Return which of a node's lamps are lit in a picture."""
        blink = self.blinks.get(node)
        return (True, True) if blink is None else lit(blink, sight.stamp_ns)

    def _update(
        self,
        bars: Sequence[Bar],
        which: Indices,
        y: Floats,
        H: Floats,
        chosen: Sequence[tuple[int, int, int, float]],
        more_px2: Floats,
        compared: Callable[[NetState], tuple[Floats, Floats]] | None = None,
    ) -> None:
        """Update by the lights chosen, each by bar, candidate, light and variance; which (B, WIDTH): as `columns`.

        more_px2 (B,): what the clocks add to the variances. compared: gives y and H about another state, None where
        they are linear enough. After seconds without light one linear step from the prediction ends far from the
        lights, with the sigma of a sound one. These steps (Gauss-Newton, the iterated update) end where the lights say.
        """
        assert self.state is not None
        n, k, light, variances = (np.array(each) for each in zip(*chosen, strict=True))
        for bar in (bars[one] for one, *_ in chosen):
            for member in (self.members[bar.other], self.members[bar.observer]):
                member.light_s = max(member.light_s, bar.sight.t_s)
            self.members[bar.observer].looks_away = False
        counted = (variances + more_px2[n]) * [
            self._lasting_factor(bars[bar], candidate, of) for bar, candidate, of, _ in chosen
        ]
        sigma_px = [float(bars[bar].sight.sigma_px[candidate]) for bar, candidate, *_ in chosen]
        doubts = np.repeat([doubt_of(one, sigma) for one, sigma in zip(variances.tolist(), sigma_px, strict=True)], 2)
        pictures = np.array([id(bars[one].sight) for one in n])

        def of_chosen(y: Floats, H: Floats) -> tuple[Floats, Floats, Floats]:
            rows = np.zeros((len(chosen), 2, len(self.covariance)))
            rows[np.arange(len(chosen))[:, None, None], [[0], [1]], which[n][:, None]] = H[n, k, light, :, :-1]
            noise = noise_of(counted, H[n, k, light, :, -1], pictures)
            return rows.reshape(2 * len(chosen), -1), y[n, k, light].ravel(), noise

        rows = of_chosen(y, H)
        for _ in range(ABOUT_STEPS - 1 if compared is not None else 0):
            assert compared is not None
            error = anchors.kalman(self.covariance, *rows).error
            y, H = compared(self.state.plus(error))
            if (np.abs(y[n, k, light]) >= NOWHERE_PX).any():
                # One is behind the camera there.
                break
            rows = of_chosen(y + (H[..., :-1] @ error[which][:, None, None, :, None])[..., 0], H)
        self._apply(*rows, doubts)

    def _lasting_factor(self, bar: Bar, k: int, light: int) -> float:
        """Give how many pictures tell as much as this one of a light, candidate k (track/seeing.counted); note it."""
        observer, other = self.members[bar.observer], self.members[bar.other]
        key = observer.node, other.node, light
        apart_s = bar.sight.t_s - self.lit_s.get(key, -math.inf)
        self.lit_s[key] = bar.sight.t_s
        return 1.0 if observer.without or other.without else lasting_factor(float(bar.sight.lasting_s[k]), apart_s)

    def _judge(self) -> None:
        """Confirm members, and remove those of which no light tells any more."""
        for index in range(len(self.members) - 1, -1, -1):
            member = self.members[index]
            if member.node in self.places:
                continue
            if not member.confirmed:
                least = min(member.evidence)
                member.confirmed = sum(member.evidence) > CONFIRMED and least > EACH
                late = self.t_s - member.since_s > PATIENCE_S
                if not member.confirmed and (late or least < GIVEN_UP):
                    self.remove(index)
            elif self.t_s - member.light_s > LOST_S and self.sigma_m(index) > LOST_M:
                self.remove(index)
        if self.members and not self.places and len(self.members) == 1:
            self.remove(0)

    # Poses

    def open(self, t_s: float, fix: PairFix) -> bool:
        """Begin a network without fixed nodes at the first node of a pose, by its attitude or its accelerometer."""
        seen = newest_before(self.intake.attitudes[fix.node], t_s + HOLD_S)
        samples = self.intake.samples[fix.node]
        member = Member(fix.node, t_s, confirmed=False, light_s=t_s, skip_s=t_s + SKIP_S, attitude_s=t_s)
        if seen is not None and t_s - seen[0] < 1.0:
            R = self.intake.level_camera(fix.node, seen[1])
            level = anchors.attitude_covariance(seen[1].R_ned_body, seen[1].sigma_rad, 1.0, 1.0)
            member.compass = 0.0, float(seen[1].sigma_rad[2] ** 2)
        else:
            tilt = tilt_of(samples.between(t_s - 0.5, t_s, t_s)[1][:, :3].mean(0)) if len(samples) else None
            if tilt is None:
                return False
            R, level = tilt, np.diag((0.05, 0.05, math.pi)) ** 2
        self.t_s = t_s
        state, variances = lone(self.nodes[fix.node], np.zeros(3), R)
        own = np.diag(variances)
        own[P_, P_] = own[V_, V_] = 0.0
        own[PHI, PHI] = level
        self._add(member, state, own)
        return True

    def join(self, t_s: float, fix: PairFix, index: int, node: int) -> None:
        """Make a node a member at a pose of it from a member; not where its attitude contradicts that pose.

        p_j = p_i + R_i t, R_j = R_i R_ab: dp_j = dp_i + R_i e_t + [p_j]x R_i e_w, phi_j = phi_i + R_i e_w.
        """
        self.step(t_s)
        assert self.state is not None
        R_i = self.state.R[index]
        p, R = self.state.p_m[index] + R_i @ fix.t_a_b_m, R_i @ fix.R_a_b
        state, variances = lone(self.nodes[node], p, R)
        own = np.diag(variances)
        by_fix = np.zeros((BLOCK, 6))
        by_fix[P_, :3], by_fix[P_, 3:], by_fix[PHI, 3:] = R_i, skew(p) @ R_i, R_i
        by_member = np.zeros((BLOCK, len(self.covariance)))
        by_member[P_, block(index)][:, P_] = by_member[PHI, block(index)][:, PHI] = np.eye(3)
        own += by_fix @ (fix.covariance + self._beside_fix(fix, index, float(own[CLOCK, CLOCK]))) @ by_fix.T
        own += by_member @ self.covariance @ by_member.T
        seen = newest_before(self.intake.attitudes[node], t_s + HOLD_S)
        if seen is not None and t_s - seen[0] < 1.0:
            y = rotation_log(self.intake.level_camera(node, seen[1]) @ R.T)
            noise = self._attitude_noise(replace(seen[1], sigma_rad=np.hypot(seen[1].sigma_rad, IRON_RAD)), 1.0, 1.0)
            if float(y @ np.linalg.solve(noise + own[PHI, PHI], y)) > CONTRADICTS:
                return
        self._add(Member(node, t_s, confirmed=False, light_s=t_s, skip_s=t_s + SKIP_S), state, own, by_member)

    def gap(self, t_s: float, fix: PairFix, one: int, two: int) -> tuple[Floats, float]:
        """Give how far a pose between two members is off (6,), m and rad, and its chi^2."""
        self.step(t_s)
        assert self.state is not None
        state = self.state
        toward = state.R[one].T
        away = state.p_m[two] - state.p_m[one]
        gap = np.concatenate((fix.t_a_b_m - toward @ away, rotation_log(fix.R_a_b @ (toward @ state.R[two]).T)))
        # By place and attitude of the one, then of the other.
        H = np.zeros((6, 12))
        H[:3, 0:3], H[:3, 3:6] = -toward, toward @ (skew(state.p_m[one]) + skew(away))
        H[:3, 6:9], H[:3, 9:12] = toward, -toward @ skew(state.p_m[two])
        H[3:, 3:6], H[3:, 9:12] = -toward, toward
        which = np.concatenate([block(member).start + _POSE for member in (one, two)])
        _, sigma_s = self.clock(two)
        beside = self._beside_fix(fix, one, sigma_s**2 + float(state.clock_s[two]) ** 2)
        S = H @ self.covariance[which[:, None], which] @ H.T + fix.covariance + beside
        return gap, float(gap @ np.linalg.solve(S, gap))

    def _beside_fix(self, fix: PairFix, index: int, square_s2: float) -> Floats:
        """Give what a pose's covariance (6, 6) leaves out.

        index: the member that is its first node. square_s2: the mean square of how far the other node's clock is off
        what is believed, s^2.
        """
        off_s, sigma_s = self.clock(index)
        apart_s = 1e-9 * (self.intake.ahead_ns(fix.other) - self.intake.ahead_ns(fix.node))
        squares_s2 = apart_s**2 + off_s**2 + sigma_s**2 + square_s2
        moved = np.repeat((BETWEEN_MPS, BETWEEN_RADPS), 3) ** 2 * squares_s2
        beside: Floats = np.diag([1e-4] * 3 + [1e-5] * 3) + np.diag(moved)
        return beside

    # Rows

    def due_row(self, t_s: float, stamp_ns: int, nodes: Sequence[int]) -> DueNetRow | None:
        """Note what confirmed members' rows are made of, at a time at or after the last picture's; None before it."""
        if self.state is None or not self._ticks_to(t_s):
            return None
        way = self._way(t_s) if t_s - self.t_s > 1e-6 else None
        return DueNetRow(
            stamp_ns, self._present(t_s, nodes), self.state, self.covariance, way, self.anchor, self.north_doubt
        )

    def ask(self, t_s: float, stamp_ns: int, nodes: Sequence[int]) -> None:
        """Note that `smoothed` is to give a row of a time at or after the last picture's, and go on to there."""
        assert self.trail is not None
        if self.state is None or not self._ticks_to(t_s):
            return
        if t_s - self.t_s > 1e-6:
            self._go(t_s)
        present = self._present(t_s, nodes)
        self.trail.events.append(Told.of(t_s, stamp_ns, present, self.state, self.covariance, self.north_doubt))

    def _ticks_to(self, t_s: float) -> bool:
        """Go on to less than two ticks before a time; return whether that is not in the past."""
        while t_s - self.t_s > 1.5 * TICK_S:
            self.step(self.t_s + TICK_S)
        return t_s >= self.t_s - TOGETHER_S

    def smoothed(self, since_s: float, until_s: float) -> list[NetRow]:
        """Give the rows that were asked for after since_s, until until_s, by all that came up to now.

        A member that is confirmed now was right before.
        """
        assert self.trail is not None
        now = [index for index, member in enumerate(self.members) if member.confirmed and self.is_timed(index)]
        sure = {(self.members[index].node, self.members[index].since_s) for index in now}
        rows: list[list[NetRow]] = []
        for told, state, own in self.trail.smoothed(len(self.covariance)):
            sure |= {(one.node, one.since_s) for one in told.members if one.confirmed}
            if since_s < told.t_s <= until_s:
                present = [replace(one, confirmed=(one.node, one.since_s) in sure) for one in told.members]
                n = len(present)
                rows.append(rows_of([told.stamp_ns] * n, present, state, own, np.full(n, told.north_doubt)))
        return [row for of_time in reversed(rows) for row in of_time]

    def _present(self, t_s: float, nodes: Sequence[int]) -> list[Present]:
        return [
            Present(
                one.node,
                one.since_s,
                one.confirmed and self.is_timed(index),
                max(t_s - max(one.light_s, one.since_s), 0.0),
                one.node in nodes,
            )
            for index, one in enumerate(self.members)
        ]

    def is_timed(self, index: int) -> bool:
        """Whether no clock seems so far off that a member's rows are not to be told.

        A fixed node's place does not depend on its clock. Where the frame moves with a node, each clock moves all.
        """
        if self.members[index].node in self.places:
            return True
        return not any(map(self.is_far, range(len(self.members)) if self.anchor is not None else [index]))

    def is_far(self, index: int) -> bool:
        """Whether a member's clock seems too far off for what is made of its lights.

        Without an inertial unit it is not known well enough to be put right.
        """
        off_s, sigma_s = self.clock(index)
        member, first = self.members[index], self.members[0]
        if member.without:
            off_s += 1e-9 * (self.intake.ahead_ns(member.node) - self.intake.ahead_ns(first.node))
        return seems_far(off_s, sigma_s)
