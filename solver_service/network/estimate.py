"""One estimate of a network: what lights say, who joins and leaves, and the poses that it gives."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.protocol.blinking import lit
from buddyline.protocol.messages import Blink
from buddyline.solver_service.geometry.rotation import Floats, rotation_log, skew
from buddyline.solver_service.network.belief import Member, NetBelief
from buddyline.solver_service.network.exclusive import share
from buddyline.solver_service.network.rows import DueNetRow, NetRow, rows_of
from buddyline.solver_service.network.sights import columns, light_positions
from buddyline.solver_service.network.state import BLOCK, P_, PHI, V_, block, lone
from buddyline.solver_service.network.trail import Present, Told
from buddyline.solver_service.track import anchors
from buddyline.solver_service.track.association import odds_of
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.intake import TrackIntake, newest_before
from buddyline.solver_service.track.lights import Sight, in_picture, pixel_of, residuals
from buddyline.solver_service.track.moving import HOLD_S, TOGETHER_S
from buddyline.solver_service.track.seeing import EDGE_PX
from buddyline.solver_service.track.start import tilt_of
from buddyline.solver_service.track.stepping import TICK_S

# A node is confirmed once its lights explain the pictures better than clutter by this (log odds). It leaves below
# GIVEN_UP, or when it has not been confirmed within PATIENCE_S.
CONFIRMED: Final = 25.0
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
# What iron near a compass, or acceleration, adds to an attitude's sigmas (roll, pitch, yaw) when a join is checked.
IRON_RAD: Final = np.radians((1.0, 1.0, 8.0))
# For so long after a pose made a node a member, its lights are not used: they are those of the pose.
SKIP_S: Final = 0.02


@dataclass(frozen=True, eq=False, slots=True)
class PairFix(FixSeen):
    """A pose of the node `other` from the node `node`, as indices of the network's nodes."""

    node: int = 0
    other: int = 0


class NetEstimate(NetBelief):
    """One estimate of the network: a belief that also takes lights, lets nodes join and leave, and gives rows.

    dark: nodes without lamps. blinks: how lamps blink, by node. start_s: when a challenger began. evidence: log odds
    over clutter of all pictures so far. detection: by observer and other node, how likely each of its lights is found.
    """

    def __init__(self, intake: TrackIntake) -> None:
        super().__init__(intake)
        self.dark: set[int] = set()
        self.blinks: dict[int, Blink] = {}
        self.start_s = -np.inf
        self.evidence = 0.0
        self.detection: dict[tuple[int, int], Floats] = {}

    def copied(self) -> NetEstimate:
        """Give an estimate that goes its own way from here."""
        other = copy.copy(self)
        other.members = [replace(member) for member in self.members]
        other.detection = {pair: of.copy() for pair, of in self.detection.items()}
        other.trail = None if self.trail is None else self.trail.copied()
        return other

    def remove(self, index: int) -> None:
        """Let a member go, and what was learned of its lights and of those in its pictures."""
        gone = self.members[index].node
        super().remove(index)
        self.detection = {pair: of for pair, of in self.detection.items() if gone not in pair}

    # Lights

    def take_sight(self, t_s: float, sight: Sight) -> None:
        """Go on to a picture, and use the lights in it."""
        if self.state is None or t_s < self.t_s - TOGETHER_S:
            return
        self.step(t_s)
        index = self.member_of(sight.node)
        if index is not None:
            self._take_lights(index, sight)
            self._judge()

    def _take_lights(self, observer: int, sight: Sight) -> None:
        assert self.state is not None
        camera = self.nodes[sight.node].rig.camera
        dt_s = sight.dt_s + (sight.t_s - self.t_s)
        others = [other for other in range(len(self.members)) if self._may_show(observer, other, sight)]
        if not others:
            return
        lights_m = np.array([self.nodes[self.members[other].node].rig.lights_m for other in others])
        X, D = light_positions(self.state, observer, others, lights_m, self.rates_radps, dt_s)
        which = np.array([columns(observer, other) for other in others])
        P = self.covariance[which[:, :, None], which[:, None, :]]
        first = D[:, 0, 0]
        spread_m2 = np.trace(first @ P @ np.swapaxes(first, 1, 2), axis1=1, axis2=2)
        wide = spread_m2 > 0.01 * (X[:, 0, 0] ** 2).sum(axis=1)
        kept, likely, inside = [], [], []
        for bar, other in enumerate(others):
            node = self.members[other].node
            pixels = [pixel_of(camera, X[bar, 0, light]) for light in (0, 1)]
            if not wide[bar] and not any(in_picture(camera, pixel, -OUTSIDE_PX) for pixel in pixels):
                continue
            within = [bool(wide[bar]) or in_picture(camera, pixel, EDGE_PX) for pixel in pixels]
            detection = self.detection.setdefault((sight.node, node), np.full(2, 0.8))
            shines = self._lit(node, sight)
            kept.append(bar)
            likely.append(np.where(shines, detection * np.where(within, 1.0, 0.02), SHOWN_DARK))
            inside.append([there and on for there, on in zip(within, shines, strict=True)])
        if not kept:
            return
        y, H = residuals(sight.bearings, sight.tangents, X[kept], D[kept])
        clutter = np.full(len(kept), sight.clutter / camera.area_px2)
        every = odds_of(y, H, P[kept], np.tile(sight.sigma_px, (len(kept), 1)), clutter)
        shared = share([odds.weighed(found) for odds, found in zip(every, likely, strict=True)], sight.sigma_px)
        compared = [(others[bar], which[bar], y[place], H[place]) for place, bar in enumerate(kept)]
        self.evidence += shared.total
        for (other, *_), seen, gained, within in zip(compared, shared.seen, shared.evidence, inside, strict=True):
            member = self.members[other]
            for one in (member, self.members[observer]):
                if not one.confirmed:
                    one.evidence += float(gained)
            detection = self.detection[sight.node, member.node]
            detection += 0.05 * np.where(within, seen - detection, 0.0)
            np.clip(detection, 0.02, 0.97, out=detection)
        if shared.chosen:
            self._update(observer, sight, shared.chosen, compared)

    def _may_show(self, observer: int, other: int, sight: Sight) -> bool:
        """Whether a picture of a member may tell of another's lights."""
        member = self.members[other]
        skip_s = max(member.skip_s, self.members[observer].skip_s if not member.confirmed else -np.inf)
        return other != observer and member.node not in self.dark and sight.t_s >= skip_s

    def _lit(self, node: int, sight: Sight) -> tuple[bool, bool]:
        """Return which of a node's lamps are lit in a picture."""
        blink = self.blinks.get(node)
        return (True, True) if blink is None else lit(blink, sight.stamp_ns)

    def _update(
        self,
        observer: int,
        sight: Sight,
        chosen: Sequence[tuple[int, int, int, float]],
        compared: Sequence[tuple[int, Floats, Floats, Floats]],
    ) -> None:
        rows_y = np.concatenate([compared[bar][2][k, light] for k, bar, light, _ in chosen])
        H = np.zeros((len(rows_y), len(self.covariance)))
        for row, (k, bar, light, _) in enumerate(chosen):
            H[2 * row : 2 * row + 2, compared[bar][1]] = compared[bar][3][k, light]
            for member in (self.members[compared[bar][0]], self.members[observer]):
                member.light_s = max(member.light_s, sight.t_s)
        noise = np.diag(np.repeat([variance for *_, variance in chosen], 2))
        self._apply(H, rows_y, noise, teaches=True)

    def _judge(self) -> None:
        """Confirm members, and remove those of which no light tells any more."""
        for index in range(len(self.members) - 1, -1, -1):
            member = self.members[index]
            if member.node in self.places:
                continue
            if not member.confirmed:
                member.confirmed = member.evidence > CONFIRMED
                late = self.t_s - member.since_s > PATIENCE_S
                if not member.confirmed and (late or member.evidence < GIVEN_UP):
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
        if seen is not None and t_s - seen[0] < 1.0:
            R = self.intake.level_camera(fix.node, seen[1])
            level = anchors.attitude_covariance(seen[1].R_ned_body, seen[1].sigma_rad, 1.0, 1.0)
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
        self._add(Member(fix.node, t_s, confirmed=False, light_s=t_s, skip_s=t_s + SKIP_S, attitude_s=t_s), state, own)
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
        own += by_fix @ (fix.covariance + np.diag([1e-4] * 3 + [1e-5] * 3)) @ by_fix.T
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
        H = np.zeros((6, len(self.covariance)))
        mine, yours = H[:, block(one)], H[:, block(two)]
        yours[:3, P_], mine[:3, P_] = toward, -toward
        yours[:3, PHI] = -toward @ skew(state.p_m[two])
        mine[:3, PHI] = toward @ (skew(state.p_m[one]) + skew(away))
        yours[3:, PHI], mine[3:, PHI] = toward, -toward
        S = H @ self.covariance @ H.T + fix.covariance + np.diag([1e-4] * 3 + [1e-5] * 3)
        return gap, float(gap @ np.linalg.solve(S, gap))

    # Rows

    def due_row(self, t_s: float, stamp_ns: int) -> DueNetRow | None:
        """Note what the confirmed members' row is made of, at a time at or after the last picture's; None before it."""
        if self.state is None or not self._ticks_to(t_s):
            return None
        way = self._way(t_s) if t_s - self.t_s > 1e-6 else None
        return DueNetRow(stamp_ns, self._present(t_s), self.state, self.covariance, way, self.anchor)

    def ask(self, t_s: float, stamp_ns: int) -> None:
        """Note that `smoothed` is to give a row of a time at or after the last picture's, and go on to there."""
        assert self.trail is not None
        if self.state is None or not self._ticks_to(t_s):
            return
        if t_s - self.t_s > 1e-6:
            self._go(t_s)
        self.trail.events.append(Told.of(t_s, stamp_ns, self._present(t_s), self.state, self.covariance))

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
        sure = {(member.node, member.since_s) for member in self.members if member.confirmed}
        rows: list[list[NetRow]] = []
        for told, state, own in self.trail.smoothed(len(self.covariance)):
            sure |= {(one.node, one.since_s) for one in told.members if one.confirmed}
            if since_s < told.t_s <= until_s:
                present = [replace(one, confirmed=(one.node, one.since_s) in sure) for one in told.members]
                rows.append(rows_of([told.stamp_ns] * len(present), present, state, own))
        return [row for of_time in reversed(rows) for row in of_time]

    def _present(self, t_s: float) -> list[Present]:
        return [
            Present(one.node, one.since_s, one.confirmed, max(t_s - max(one.light_s, one.since_s), 0.0))
            for one in self.members
        ]
