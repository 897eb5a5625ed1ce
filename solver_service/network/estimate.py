"""One estimate of a network: its members, how they move, and what their sensors and lights say."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log, skew
from buddyline.solver_service.network.exclusive import share
from buddyline.solver_service.network.motion import Move, as_first_of_pair, moved_member
from buddyline.solver_service.network.shaking import NetShaking
from buddyline.solver_service.network.sights import columns, light_positions
from buddyline.solver_service.network.state import (
    BLOCK,
    CLOCK,
    DATUM_M,
    GAUGE,
    GYRO_BIAS,
    MOUNT,
    MOVING,
    P_,
    PHI,
    V_,
    NetState,
    block,
    blocks,
    lone,
)
from buddyline.solver_service.track import anchors
from buddyline.solver_service.track.association import weigh
from buddyline.solver_service.track.inputs import AttitudeSeen, FixSeen, TrackNode
from buddyline.solver_service.track.intake import TrackIntake, newest_before
from buddyline.solver_service.track.lights import Sight, in_picture, pixel_of, residuals
from buddyline.solver_service.track.start import tilt_of
from buddyline.solver_service.track.stepping import (
    ATTITUDE_EVERY_S,
    EDGE_PX,
    HOLD_S,
    MAX_DELAY_S,
    TICK_S,
    TOGETHER_S,
    WITHOUT_RAD,
    WITHOUT_RADPS,
)
from buddyline.solver_service.track.strapdown import Increment, Noise, integrate

# A node is confirmed once its lights explain the pictures better than clutter by this (log odds). It leaves below
# GIVEN_UP, or when it has not been confirmed within PATIENCE_S.
CONFIRMED: Final = 25.0
GIVEN_UP: Final = -15.0
PATIENCE_S: Final = 4.0
# Beyond this chi^2 a pose (6 degrees of freedom) or an attitude (3) contradicts the network.
CONTRADICTS: Final = 33.0
# A node's pose is given while its position is better than TOLD_M, 1 sd, or than a share of its distance from the
# frame's zero. A node leaves after LOST_S without a light when its position is worse than LOST_M.
TOLD_M: Final = 0.5
TOLD_SHARE: Final = 0.1
LOST_S: Final = 3.0
LOST_M: Final = 1.5
# A bar whose lights are further outside of a picture than this is not looked for in it.
OUTSIDE_PX: Final = 60.0
# What iron near a compass, or acceleration, adds to an attitude's sigmas (roll, pitch, yaw) when a join is checked.
IRON_RAD: Final = np.radians((1.0, 1.0, 8.0))
FREE_HEADING: Final = 1e6
# For so long after a pose made a node a member, its lights are not used: they are those of the pose.
SKIP_S: Final = 0.02


@dataclass(frozen=True, eq=False)
class KnownPlace:
    """Where a fixed node stands in the net's frame: p_m (3,), R (3, 3) camera to net, and how well it is known."""

    p_m: Floats
    R: Floats
    sigma_m: float
    sigma_rad: float


@dataclass(frozen=True, eq=False, slots=True)
class PairFix(FixSeen):
    """A pose of the node `other` from the node `node`, as indices of the network's nodes."""

    node: int = 0
    other: int = 0


@dataclass(frozen=True, eq=False)
class NetRow:
    """One node's pose in the net's frame at one time, as the message NodePose has it."""

    node: int
    stamp_ns: int
    p_m: Floats
    R: Floats
    v_mps: Floats
    covariance: Floats
    age_s: float


@dataclass(eq=False)
class Member:
    """What is known of a member beside its state.

    light_s: time of the last light that was used of it, or in its pictures. skip_s: earlier lights are not used, for
    they made it a member. evidence: log odds over clutter since it joined. without: it has no inertial unit now.
    """

    node: int
    since_s: float
    confirmed: bool
    light_s: float
    skip_s: float = -np.inf
    evidence: float = 0.0
    attitude_s: float = -np.inf
    depth_s: float = -np.inf
    without: bool = False


class NetEstimate:
    """One estimate. intake: what all nodes have told. places: of the fixed nodes, by index. dark: nodes without lamps.

    members, state, covariance, rates_radps, t_s: as they are now. evidence: log odds over clutter of all pictures so
    far. detection: by observer and other node, how likely each of its lights is found. surprise: chi^2 of all lights
    used; told: the number of their residuals.
    """

    def __init__(self, intake: TrackIntake) -> None:
        self.intake = intake
        self.places: dict[int, KnownPlace] = {}
        self.dark: set[int] = set()
        self.members: list[Member] = []
        self.state: NetState | None = None
        self.covariance: Floats = np.zeros((0, 0))
        self.rates_radps: Floats = np.zeros((0, 3))
        self.shaking = NetShaking.of_none()
        self.t_s = -np.inf
        self.start_s = -np.inf
        self.evidence = 0.0
        self.surprise, self.told = 0.0, 0
        self.detection: dict[tuple[int, int], Floats] = {}

    def copied(self) -> NetEstimate:
        """Give an estimate that goes its own way from here."""
        other = copy.copy(self)
        other.members = [replace(member) for member in self.members]
        other.detection = {pair: of.copy() for pair, of in self.detection.items()}
        return other

    @property
    def nodes(self) -> Sequence[TrackNode]:
        """All nodes, members or not."""
        return self.intake.nodes

    def member_of(self, node: int) -> int | None:
        """Return a node's place among the members, None where it is none."""
        return next((i for i, member in enumerate(self.members) if member.node == node), None)

    @property
    def anchor(self) -> int | None:
        """The member that the frame moves with; None where a fixed node holds it."""
        return 0 if not self.places else None

    # Members

    def begin(self, t_s: float) -> None:
        """Make the fixed nodes members."""
        self.t_s = t_s
        for node in sorted(self.places):
            self.settle(node, t_s)

    def settle(self, node: int, t_s: float) -> None:
        """Make a fixed node a member, at its place."""
        place = self.places[node]
        state, variances = lone(self.nodes[node], place.p_m, place.R)
        own = np.diag(variances)
        cross = skew(place.p_m)
        own[V_, V_] = 0.0
        own[PHI, PHI] = place.sigma_rad**2 * np.eye(3)
        own[P_, PHI] = place.sigma_rad**2 * cross
        own[PHI, P_] = own[P_, PHI].T
        own[P_, P_] = place.sigma_m**2 * np.eye(3) + place.sigma_rad**2 * cross @ cross.T
        self._add(Member(node, t_s, confirmed=True, light_s=-np.inf), state, own)

    def _add(self, member: Member, state: NetState, own: Floats, across: Floats | None = None) -> None:
        """Add a member with its covariance (BLOCK, BLOCK), and that with the errors so far (N, BLOCK)."""
        if self.state is None:
            self.state, self.covariance = state, np.array(((DATUM_M**2,),))
            # The net's clock is the first member's.
            own[CLOCK, :] = own[:, CLOCK] = 0.0
        else:
            self.state = self.state.joined(state)
        N = len(self.covariance)
        P = np.zeros((N + BLOCK, N + BLOCK))
        P[:N, :N], P[N:, N:] = self.covariance, own
        if across is not None:
            P[:N, N:], P[N:, :N] = across, across.T
        self.covariance = P
        self.members.append(member)
        self.shaking = self.shaking.joined()
        self.rates_radps = np.concatenate((self.rates_radps, np.zeros((1, 3))))

    def remove(self, index: int) -> None:
        """Let a member go."""
        gone = self.members[index]
        kept = [i for i in range(len(self.members)) if i != index]
        if self.state is None:
            return
        was_anchor = self.anchor == index
        self.members = [self.members[i] for i in kept]
        self.detection = {pair: of for pair, of in self.detection.items() if gone.node not in pair}
        if not self.members:
            self.state, self.covariance, self.rates_radps = None, np.zeros((0, 0)), np.zeros((0, 3))
            self.shaking = NetShaking.of_none()
            return
        if was_anchor:
            # The frame moves with another node from now on.
            self._anchor(kept[0])
        chosen = blocks(kept)
        self.state = self.state.chosen(kept)
        self.covariance = self.covariance[np.ix_(chosen, chosen)]
        self.rates_radps = self.rates_radps[kept]
        self.shaking = self.shaking.chosen(kept)

    def _anchor(self, index: int) -> None:
        if self.state is None:
            return
        n = len(self.state)
        p, v = self.state.p_m[index], self.state.v_mps[index]
        move = Move(np.broadcast_to(np.eye(BLOCK), (n, BLOCK, BLOCK)), np.zeros((n, BLOCK, BLOCK)), index, p, v)
        self.state = replace(self.state, p_m=self.state.p_m - p, v_mps=self.state.v_mps - v)
        self.covariance = move.covariance(self.covariance)

    # Motion

    def _increment(self, state: NetState, index: int, from_s: float, to_s: float) -> Increment:
        samples = self.intake.samples[self.members[index].node]
        shift = min(max(float(state.delay_s[index]), -MAX_DELAY_S), MAX_DELAY_S)
        known_s = to_s + HOLD_S
        grid, values, told, _ = samples.between(from_s + shift, to_s + shift, known_s)
        without = not told.any() and not samples.near(to_s + shift, known_s)
        if without:
            values = np.zeros_like(values)
        slow = [samples.slow_rate(each_s, known_s) for each_s in (from_s + shift, to_s + shift)]
        ends = [values[i, 3:] if each is None else each for i, each in zip((0, -1), slow, strict=True)]
        part = integrate(as_first_of_pair(state, index), 0, grid, values[:, :3], values[:, 3:], told, np.stack(ends))
        return replace(part, without=True) if without else part

    def _noise_of(self, node: int, t_s: float) -> Noise:
        noise = self.intake.samples[node].noise(t_s)
        stated = self.intake.turning[node].stated(t_s)
        return noise if stated is None else replace(noise, gap_tilt_rad=stated[0], gap_heading_rad=stated[1])

    def _moved(self, to_s: float) -> tuple[NetState, Move, Floats, list[bool], Floats]:
        """Give the state at to_s, the step to it, turn rates, who is without inertial unit, and what shaking adds."""
        assert self.state is not None
        state, n = self.state, len(self.state)
        F, Q = np.tile(np.eye(BLOCK), (n, 1, 1)), np.zeros((n, BLOCK, BLOCK))
        names = ("p_m", "v_mps", "R", "shake_rad", "shove_mps")
        fields = {name: getattr(state, name).copy() for name in names}
        rates, without = np.zeros((n, 3)), [False] * n
        shaking = self.shaking.variances
        drawn = np.zeros((n, 2, MOVING, MOVING))
        for i, member in enumerate(self.members):
            if member.node in self.places:
                continue
            part = self._increment(state, i, self.t_s, to_s)
            noise = self._noise_of(member.node, to_s)
            after, F[i], Q[i], drawn[i] = moved_member(state, i, part, noise, shaking[i], to_s - self.t_s)
            if part.without != member.without:
                # The unit has stopped, or come back: these errors now stand for something else, and are unknown.
                Q[i, GYRO_BIAS, GYRO_BIAS] += WITHOUT_RADPS**2 * np.eye(3)
                Q[i, MOUNT, MOUNT] += WITHOUT_RAD**2 * np.eye(3)
            without[i] = part.without
            rates[i] = part.rate_radps
            for name in names:
                fields[name][i] = after[name]
        move = Move(F, Q)
        if self.anchor is not None:
            p, v = fields["p_m"][self.anchor].copy(), fields["v_mps"][self.anchor].copy()
            move = Move(F, Q, self.anchor, p, v)
            fields["p_m"] -= p
            fields["v_mps"] -= v
        return replace(state, **fields), move, rates, without, drawn

    def step(self, t_s: float) -> None:
        """Bring the network to t_s, by ticks where that is long, and take what sensors say there."""
        while t_s - self.t_s > 1.5 * TICK_S:
            self.step(self.t_s + TICK_S)
        if t_s - self.t_s < TOGETHER_S:
            return
        self.state, move, self.rates_radps, without, drawn = self._moved(t_s)
        self.shaking = self.shaking.moved(move.F[:, :MOVING, :MOVING], drawn)
        for member, now in zip(self.members, without, strict=True):
            member.without = now
        self.covariance = move.covariance(self.covariance)
        self.t_s = t_s
        for index, member in enumerate(self.members):
            self._take_depth(index, member)
            if member.node not in self.places:
                self._take_attitude(index, member)
                self._take_turning(index, member)

    # Sensors

    def _apply(self, H: Floats, y: Floats, noise: Floats, *, teaches: bool = False) -> float:
        assert self.state is not None
        before = self.covariance
        error, self.covariance, chi2, S_inverse = anchors.kalman(before, H, y, noise)
        if teaches:
            self.shaking = self.shaking.taught(y, S_inverse, H, before)
        self.state = self.state.plus(error)
        return chi2

    def _take_depth(self, index: int, member: Member) -> None:
        """Update by a depth gauge: h = p_z + (R port)_z - v_z age + offset + datum."""
        assert self.state is not None
        found = newest_before(self.intake.depths[member.node], self.t_s)
        if found is None or found[0] <= member.depth_s or self.t_s - found[0] > 0.3:
            return
        time_s, seen = found
        member.depth_s = time_s
        age_s = self.t_s - time_s
        state = self.state
        port = state.R[index] @ self.nodes[member.node].rig.depth_port_m
        place = state.p_m[index] - age_s * state.v_mps[index] + port
        y = np.array((seen.depth_m - place[2] - state.gauge_m[index] - state.datum_m,))
        H = np.zeros((1, len(self.covariance)))
        own = H[:, block(index)]
        own[0, P_.stop - 1], own[0, V_.stop - 1] = 1.0, -age_s
        own[0, PHI] = place[1], -place[0], 0.0
        own[0, GAUGE] = 1.0
        H[0, 0] = 1.0
        # A frame that moves with a node may have risen or sunk since, by some 0.3 m/s.
        drift_m = 0.0 if self.anchor is None else 0.3 * age_s
        noise = np.array(((seen.sigma_m**2 + drift_m**2 + 1e-6,),))
        if y[0] ** 2 < 16.0 * float((H @ self.covariance @ H.T + noise)[0, 0]):
            self._apply(H, y, noise)

    def _take_attitude(self, index: int, member: Member) -> None:
        found = newest_before(self.intake.attitudes[member.node], self.t_s)
        since = self.t_s - member.attitude_s
        if found is None or since < ATTITUDE_EVERY_S or self.t_s - found[0] > 0.1:
            return
        assert self.state is not None
        time_s, seen = found
        first, member.attitude_s = member.attitude_s == -np.inf, self.t_s
        turn = rotation_exp(self.rates_radps[index] * (self.t_s - time_s))
        y, H = self._attitude_residual(index, self.intake.level_camera(member.node, seen) @ turn)
        factors = (1.0, 1.0) if first else (2.0 * anchors.TILT_TIME_S / since, 2.0 * anchors.HEADING_TIME_S / since)
        noise = self._attitude_noise(seen, *factors)
        chi2 = float(y @ np.linalg.solve(noise + H @ self.covariance @ H.T, y))
        if chi2 > 16.0:
            noise = noise * (chi2 / 4.0)
        self._apply(H, y, noise)

    def _attitude_residual(self, index: int, R_level_camera: Floats) -> tuple[Floats, Floats]:
        assert self.state is not None
        H = np.zeros((3, len(self.covariance)))
        H[:, block(index)][:, PHI] = np.eye(3)
        return rotation_log(R_level_camera @ self.state.R[index].T), H

    def _attitude_noise(self, seen: AttitudeSeen, tilt_factor: float, heading_factor: float) -> Floats:
        """Give an attitude's covariance; where fixed nodes say where north is, its heading does not count."""
        if self.places:
            heading_factor = FREE_HEADING
        return anchors.attitude_covariance(seen.R_ned_body, seen.sigma_rad, tilt_factor, heading_factor)

    def _take_turning(self, index: int, member: Member) -> None:
        """Update a node without an inertial unit by its attitude, which may be off by a slow error."""
        near = self.intake.turning[member.node].at(self.t_s, self.t_s + HOLD_S) if member.without else None
        if near is None:
            return
        assert self.state is not None
        R_level_camera, variances = near
        y, H = self._attitude_residual(index, R_level_camera)
        y = y - self.state.mount_rad[index]
        H[:, block(index)][:, MOUNT] = np.eye(3)
        noise = (R_level_camera * variances) @ R_level_camera.T
        if float(y @ np.linalg.solve(noise + H @ self.covariance @ H.T, y)) < 30.0:
            self._apply(H, y, noise)

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
        bars, compared, inside = [], [], []
        clutter = sight.clutter / camera.area_px2
        for other, member in enumerate(self.members):
            if other == observer or member.node in self.dark:
                continue
            if sight.t_s < max(member.skip_s, self.members[observer].skip_s if not member.confirmed else -np.inf):
                continue
            lights_m = self.nodes[member.node].rig.lights_m
            X, D = light_positions(
                self.state, observer, other, lights_m, self.rates_radps, dt_s if len(dt_s) else np.zeros(1)
            )
            which = columns(observer, other)
            P = self.covariance[np.ix_(which, which)]
            wide = float(np.trace(D[0, 0] @ P @ D[0, 0].T)) > (0.1 * float(np.linalg.norm(X[0, 0]))) ** 2
            pixels = [pixel_of(camera, X[0, light]) for light in (0, 1)]
            if not wide and not any(in_picture(camera, pixel, -OUTSIDE_PX) for pixel in pixels):
                continue
            within = [wide or in_picture(camera, pixel, EDGE_PX) for pixel in pixels]
            detection = self.detection.setdefault((sight.node, member.node), np.full(2, 0.8))
            found = detection * np.where(within, 1.0, 0.02)
            y, H = residuals(sight.bearings, sight.tangents, X[: len(dt_s)], D[: len(dt_s)])
            bars.append(weigh(y, H, P, sight.sigma_px, found, clutter))
            compared.append((other, which, y, H))
            inside.append(within)
        if not bars:
            return
        shared = share(bars, sight.sigma_px)
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
        self.surprise += self._apply(H, rows_y, noise, teaches=True)
        self.told += len(rows_y)

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

    def sigma_m(self, index: int) -> float:
        """Give how well a member's place is known, 1 sd of its distance."""
        assert self.state is not None
        J = self.plain(self.state, index)
        own = self.covariance[block(index), block(index)][:9, :9]
        return math.sqrt(max(float(np.trace((J @ own @ J.T)[:3, :3])), 0.0))

    @staticmethod
    def plain(state: NetState, index: int) -> Floats:
        """Give (9, 9): plain errors of place, velocity and attitude by a member's own."""
        J = np.eye(9)
        J[P_, PHI], J[V_, PHI] = -skew(np.stack((state.p_m[index], state.v_mps[index])))
        return J

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
        across = self.covariance @ by_member.T
        own += by_fix @ (fix.covariance + np.diag([1e-4] * 3 + [1e-5] * 3)) @ by_fix.T + by_member @ across
        seen = newest_before(self.intake.attitudes[node], t_s + HOLD_S)
        if seen is not None and t_s - seen[0] < 1.0:
            y = rotation_log(self.intake.level_camera(node, seen[1]) @ R.T)
            noise = self._attitude_noise(replace(seen[1], sigma_rad=np.hypot(seen[1].sigma_rad, IRON_RAD)), 1.0, 1.0)
            if float(y @ np.linalg.solve(noise + own[PHI, PHI], y)) > CONTRADICTS:
                return
        self._add(Member(node, t_s, confirmed=False, light_s=t_s, skip_s=t_s + SKIP_S), state, own, across)

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

    def rows(self, t_s: float, stamp_ns: int) -> list[NetRow]:
        """Give the confirmed members at a time at or after the last picture's."""
        if self.state is None or t_s < self.t_s - TOGETHER_S:
            return []
        while t_s - self.t_s > 1.5 * TICK_S:
            self.step(self.t_s + TICK_S)
        state, P = self.state, self.covariance
        if t_s - self.t_s > 1e-6:
            state, move, *_ = self._moved(t_s)
            P = move.covariance(P)
        rows = []
        for index, member in enumerate(self.members):
            if not member.confirmed:
                continue
            J = self.plain(state, index)
            own = J @ P[block(index), block(index)][:9, :9] @ J.T
            told_m = max(TOLD_M, TOLD_SHARE * float(np.linalg.norm(state.p_m[index])))
            if not math.sqrt(max(float(np.trace(own[:3, :3])), 0.0)) < told_m:
                continue
            which = np.r_[P_, PHI]
            rows.append(
                NetRow(
                    node=member.node,
                    stamp_ns=stamp_ns,
                    p_m=state.p_m[index],
                    R=state.R[index],
                    v_mps=state.v_mps[index],
                    covariance=own[np.ix_(which, which)],
                    age_s=max(t_s - max(member.light_s, member.since_s), 0.0),
                )
            )
        return rows
