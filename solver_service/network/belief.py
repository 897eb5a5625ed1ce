"""The members of a network with their state and covariance: how they move, and what their own sensors say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.compasses import north_doubt, wrong_compass
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log, skew
from buddyline.solver_service.network.motion import Move, moved_members
from buddyline.solver_service.network.rows import NetWay, plain_of_posed
from buddyline.solver_service.network.shaking import NetShaking
from buddyline.solver_service.network.state import (
    BLOCK,
    CLOCK,
    CLOCK_WALK_S,
    CLOCK_WALK_WITHOUT_S,
    DATUM,
    DEPTH_SCALE,
    GAUGE,
    GYRO_BIAS,
    MOUNT,
    MOVING,
    P_,
    PHI,
    POSED,
    SHAKE,
    SHOVE,
    V_,
    NetState,
    block,
    blocks,
    common_variances,
    lone,
)
from buddyline.solver_service.network.trail import Chosen, Grown, Learned, NetTrail
from buddyline.solver_service.track import anchors
from buddyline.solver_service.track.inputs import AttitudeSeen, DepthSeen, TrackNode
from buddyline.solver_service.track.intake import TrackIntake, newest_before
from buddyline.solver_service.track.moving import (
    AWAY_RATE,
    HOLD_S,
    KNOWN_CLOCK_S,
    TOGETHER_S,
    WITHOUT_RAD,
    WITHOUT_RADPS,
    excerpt,
    increments,
    sudden_rate,
)
from buddyline.solver_service.track.shaking import without_doubts
from buddyline.solver_service.track.stepping import ATTITUDE_EVERY_S, TICK_S
from buddyline.solver_service.track.strapdown import Noise

# With fixed nodes the heading of an attitude gets this factor: it does not count.
FREE_HEADING: Final = 1e6
# How fast an attitude's slow error changes, as a share of its stated sigma per root s: as tracks of single pairs learn
# it (0.44 to 0.50 on five dives without inertial units).
WANDER: Final = 0.5
# What may be left of a clock's offset that was known, 1 sd: the first member, whose clock is the net's, may be another.
LEFT_S: Final = 0.01
# How a node's speed changes while it is brought to another time.
SPEEDS_UP_MPS2: Final = 0.3
# All gauges are used together once the datum is known better than this, 1 sd.
KNOWN_DATUM_M: Final = 10.0
# How a node's errors move its attitude without an inertial unit: its own, and the slow error in the mount's place.
_ATTITUDE: Final = np.zeros((3, BLOCK))
_ATTITUDE[:, PHI] = _ATTITUDE[:, MOUNT] = np.eye(3)


@dataclass(frozen=True, eq=False)
class KnownPlace:
    """Where a fixed node stands in the net's frame: p_m (3,), R (3, 3) camera to net, and how well it is known."""

    p_m: Floats
    R: Floats
    sigma_m: float
    sigma_rad: float


@dataclass(eq=False)
class Member:
    """What is known of a member beside its state.

    light_s: time of the last light that was used of it, or in its pictures. skip_s: earlier lights are not used, for
    they made it a member. evidence (2,): log odds over clutter since it joined, of the others' pictures for its lights,
    and of its own pictures for theirs. without: it has no inertial unit now.
    turning_off (3,), looks_away: as in the track's estimate, of its own turning and its own pictures. compass: its
    heading as its last attitude had it, minus the network's, rad, and the variance that it stated, rad^2.
    """

    node: int
    since_s: float
    confirmed: bool
    light_s: float
    skip_s: float = -np.inf
    evidence: tuple[float, float] = (0.0, 0.0)
    attitude_s: float = -np.inf
    depth_s: float = -np.inf
    without: bool = False
    turning_off: Floats = field(default_factory=lambda: np.zeros(3))
    looks_away: bool = False
    compass: tuple[float, float] = (0.0, math.inf)


class NetBelief:
    """The state and covariance of all members, moved on by inertial samples and updated by the nodes' own sensors.

    intake: what all nodes have told. places: of the fixed nodes, by index. shaken: logs (2,) of the variances of nodes'
    shaking, where an earlier pass has told them. walked: how far the units' biases walk, over what Noise has. clocks:
    of nodes whose clocks were known before, by how much these may be off, s, 1 sd. members, state, covariance,
    rates_radps, shaking and t_s: as they are now. trail: what led there, None where nothing is smoothed. north_doubt:
    the variance, rad^2, that north has beside the covariance, as compasses contradict each other.
    """

    def __init__(self, intake: TrackIntake) -> None:
        self.intake = intake
        self.places: dict[int, KnownPlace] = {}
        self.shaken: dict[int, Floats] = {}
        self.walked = 1.0
        self.clocks: dict[int, float] = {}
        self.members: list[Member] = []
        self.state: NetState | None = None
        self.covariance: Floats = np.zeros((0, 0))
        self.rates_radps: Floats = np.zeros((0, 3))
        self.shaking = NetShaking.of_none()
        self.t_s = -np.inf
        self.trail: NetTrail | None = None
        self.north_doubt = 0.0

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

    def clock(self, index: int) -> tuple[float, float]:
        """Return how far a member's clock is ahead of what is believed, and 1 sd of that, s."""
        assert self.state is not None
        at = block(index).start + CLOCK
        return float(self.state.clock_s[index]), math.sqrt(max(float(self.covariance[at, at]), 0.0))

    @property
    def clocks_now(self) -> list[tuple[float, float]]:
        """All members' clocks, as `clock`."""
        return [self.clock(index) for index in range(len(self.members))]

    def nudge(self, index: int, more_s: float) -> None:
        """Bring a member to where it is so little later by its own clock, which is by so much further ahead."""
        assert self.state is not None
        state, member = self.state, self.members[index]
        p_m, R, clock_s = state.p_m.copy(), state.R.copy(), state.clock_s.copy()
        p_m[index] += more_s * state.v_mps[index]
        R[index] = R[index] @ rotation_exp(more_s * self.rates_radps[index])
        clock_s[index] -= more_s
        self.state = replace(state, p_m=p_m, R=R, clock_s=clock_s)
        own = self.covariance[block(index), block(index)]
        for of, off in ((V_, SPEEDS_UP_MPS2 * more_s), (P_, 0.5 * SPEEDS_UP_MPS2 * more_s**2), (PHI, 0.5 * more_s**2)):
            own[of, of] += off**2 * np.eye(3)
        member.attitude_s, member.depth_s = member.attitude_s - more_s, member.depth_s - more_s

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

    def _add(self, member: Member, state: NetState, own: Floats, by: Floats | None = None) -> None:
        """Add a member with its covariance (BLOCK, BLOCK). by (BLOCK, N): its errors by those so far."""
        across = None if by is None else self.covariance @ by.T
        if member.node in self.clocks:
            own[CLOCK, CLOCK] = self.clocks[member.node] ** 2
        told = self.shaken.get(member.node)
        if told is not None:
            own[SHAKE, SHAKE], own[SHOVE, SHOVE] = (variance * np.eye(3) for variance in np.exp(told))
        if self.trail is not None:
            self.trail.events.append(Grown(np.zeros((BLOCK, len(self.covariance))) if by is None else by))
        if self.state is None:
            self.state, self.covariance = state, np.diag(common_variances())
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
        self.shaking = self.shaking.joined(told)
        self.rates_radps = np.concatenate((self.rates_radps, np.zeros((1, 3))))

    def remove(self, index: int) -> None:
        """Let a member go."""
        kept = [i for i in range(len(self.members)) if i != index]
        if self.state is None:
            return
        was_anchor = self.anchor == index
        member, (off_s, sigma_s) = self.members[index], self.clock(index)
        self.clocks.pop(member.node, None)
        if member.confirmed and sigma_s < KNOWN_CLOCK_S:
            self.clocks[member.node] = math.hypot(off_s, sigma_s, LEFT_S)
        self.members = [self.members[i] for i in kept]
        if not self.members:
            self._note_chosen([])
            self.state, self.covariance, self.rates_radps = None, np.zeros((0, 0)), np.zeros((0, 3))
            self.shaking, self.north_doubt = NetShaking.of_none(), 0.0
            return
        if was_anchor:
            # The frame moves with another node from now on.
            self._anchor(kept[0])
        chosen = blocks(kept)
        self._note_chosen(chosen)
        self.state = self.state.chosen(kept)
        self.covariance = self.covariance[np.ix_(chosen, chosen)]
        self.rates_radps = self.rates_radps[kept]
        self.shaking = self.shaking.chosen(kept)

    def _note_chosen(self, chosen: list[int]) -> None:
        if self.trail is not None:
            self.trail.events.append(Chosen(tuple(chosen), len(self.covariance)))

    def _anchor(self, index: int) -> None:
        if self.state is None:
            return
        n = len(self.state)
        p, v = self.state.p_m[index], self.state.v_mps[index]
        move = Move(np.broadcast_to(np.eye(BLOCK), (n, BLOCK, BLOCK)), np.zeros((n, BLOCK, BLOCK)), index, p, v)
        self.state = replace(self.state, p_m=self.state.p_m - p, v_mps=self.state.v_mps - v)
        if self.trail is not None:
            self.trail.moved(move)
        self.covariance = move.covariance(self.covariance)

    # Motion

    def _noise_of(self, member: Member, t_s: float) -> Noise:
        noise = self.intake.samples[member.node].noise(t_s)
        if self.walked != 1.0:
            gyro, accel = self.walked * noise.gyro_bias_radps, self.walked * noise.accel_bias_mps2
            noise = noise._replace(gyro_bias_radps=gyro, accel_bias_mps2=accel)
        if member.looks_away:
            noise = noise._replace(gap_rate_radps=max(noise.gap_rate_radps, AWAY_RATE))
        stated = self.intake.turning[member.node].stated(t_s)
        if stated is None:
            return noise
        return noise._replace(gap_tilt_rad=WANDER * stated[0], gap_heading_rad=WANDER * stated[1])

    @property
    def _moving(self) -> list[int]:
        """The members that are not fixed."""
        return [i for i, member in enumerate(self.members) if member.node not in self.places]

    def _moved(self, to_s: float) -> tuple[NetState, Move, Floats, list[bool], Floats]:
        """Give the state at to_s, the step to it, turn rates, who is without inertial unit, and what shaking adds."""
        assert self.state is not None
        state, moving, n = self.state, self._moving, len(self.state)
        F, Q = np.tile(np.eye(BLOCK), (n, 1, 1)), np.zeros((n, BLOCK, BLOCK))
        rates, without = np.zeros((n, 3)), [False] * n
        drawn = np.zeros((n, 2, MOVING, MOVING))
        if moving:
            nodes = [self.members[i].node for i in moving]
            of_moving = state if len(moving) == n else state.chosen(moving)
            parts = increments([self.intake.samples[node] for node in nodes], of_moving, self.t_s, to_s)
            noises = [self._noise_of(self.members[i], to_s) for i in moving]
            shaking = self.shaking.variances[moving]
            after, *step = moved_members(of_moving, parts, noises, shaking, to_s - self.t_s)
            turned = self._turned_suddenly(moving, after, step[0], step[1], to_s)
            if any(turned):
                noises = [
                    noise._replace(gap_rate_radps=max(noise.gap_rate_radps, rate))
                    for noise, rate in zip(noises, turned, strict=True)
                ]
                after, *step = moved_members(of_moving, parts, noises, shaking, to_s - self.t_s)
            F[moving], Q[moving], drawn[moving] = step
            rates[moving] = parts.rate_radps
            state = after if len(moving) == n else state.replaced(moving, after)
            for i, now in zip(moving, parts.without.tolist(), strict=True):
                without[i] = now
                if now != self.members[i].without:
                    # The unit has stopped, or come back: these errors now stand for something else, and are unknown.
                    Q[i, GYRO_BIAS, GYRO_BIAS] += WITHOUT_RADPS**2 * np.eye(3)
                    Q[i, MOUNT, MOUNT] += WITHOUT_RAD**2 * np.eye(3)
                    if now:
                        # From now on the mount's place holds the compass's slow error.
                        Q[i, MOUNT.stop - 1, MOUNT.stop - 1] += self._heading_rad(self.members[i].node, to_s) ** 2
        # The first member's clock is the net's.
        walks_s = np.where(without, CLOCK_WALK_WITHOUT_S, CLOCK_WALK_S)
        Q[1:, CLOCK, CLOCK] += walks_s[1:] ** 2 * (to_s - self.t_s)
        if self.anchor is None:
            return state, Move(F, Q), rates, without, drawn
        p, v = state.p_m[self.anchor], state.v_mps[self.anchor]
        state = replace(state, p_m=state.p_m - p, v_mps=state.v_mps - v)
        return state, Move(F, Q, self.anchor, p, v), rates, without, drawn

    def _heading_rad(self, node: int, t_s: float) -> float:
        """Give 1 sd of the slow error of a node's compass against the frame's north.

        All of the stated sigma may be slow error. The north of fixed nodes' frame may be anywhere.
        """
        stated = self.intake.turning[node].stated(t_s)
        return math.pi if self.places else stated[1] if stated is not None else 0.0

    def _turned_suddenly(self, moving: list[int], after: NetState, F: Floats, Q: Floats, to_s: float) -> list[float]:
        """Give the random walk of each moving member's turn rate (m,) in a step to to_s, by its attitude.

        after: the moving members after the step. F, Q (m, BLOCK, BLOCK): their step. 0 for a member that has an
        inertial unit, or shows no sudden turn.
        """
        rates = [0.0] * len(moving)
        for k, index in enumerate(moving):
            member = self.members[index]
            told = self._turning_residual(member, to_s, after.R[k], after.mount_rad[k])
            if told is None:
                continue
            y, noise = told
            own = F[k] @ self.covariance[block(index), block(index)] @ F[k].T + Q[k]
            S = _ATTITUDE @ own @ _ATTITUDE.T + noise
            rates[k], member.turning_off = sudden_rate(y, S, member.turning_off, to_s - self.t_s)
        return rates

    def _turning_residual(
        self, member: Member, t_s: float, R: Floats, mount_rad: Floats
    ) -> tuple[Floats, Floats] | None:
        """Give how far (3,) a node's attitude is off R (3, 3) and its slow error mount_rad (3,), and its noise (3, 3).

        None where there is no attitude, or the node has an inertial unit, which tells more.
        """
        near = self.intake.turning[member.node].at(t_s, t_s + HOLD_S) if member.without else None
        if near is None:
            return None
        R_level_camera, variances = near
        return rotation_log(R_level_camera @ R.T) - mount_rad, (R_level_camera * variances) @ R_level_camera.T

    def _way(self, to_s: float) -> NetWay:
        """Give what leads to the state at to_s, without going there."""
        assert self.state is not None
        moving = self._moving
        nodes, delays_s = [self.members[i].node for i in moving], self.state.delay_s[moving].tolist()
        samples = [
            excerpt(self.intake.samples[node], delay_s, self.t_s, to_s)
            for node, delay_s in zip(nodes, delays_s, strict=True)
        ]
        noises = [self._noise_of(self.members[i], to_s) for i in moving]
        return NetWay(to_s - self.t_s, moving, samples, noises, self.shaking.variances[moving])

    def step(self, t_s: float) -> None:
        """Bring the network to t_s, by ticks where that is long, and take what sensors say there."""
        while t_s - self.t_s > 1.5 * TICK_S:
            self.step(self.t_s + TICK_S)
        if t_s - self.t_s >= TOGETHER_S:
            self._go(t_s)

    def _go(self, t_s: float) -> None:
        """Bring the network to t_s in one step, and take what sensors say there."""
        self.state, move, self.rates_radps, without, drawn = self._moved(t_s)
        self.shaking = self.shaking.moved(move.F[:, :MOVING, :MOVING], drawn)
        for member, now in zip(self.members, without, strict=True):
            member.without = now
        if self.trail is not None:
            self.trail.moved(move)
        self.covariance = move.covariance(self.covariance)
        self.t_s = t_s
        self._take_depths()
        for index, member in enumerate(self.members):
            if member.node not in self.places:
                self._take_attitude(index, member)
                self._take_turning(index, member)

    # Sensors

    def _apply(self, H: Floats, y: Floats, noise: Floats, doubts: Floats | None = None) -> None:
        """Update by residuals. doubts (m,): of lights, which teach shaking, as of `track/seeing.told_by`."""
        assert self.state is not None
        error, self.covariance, _, S_inverse, gain = anchors.kalman(self.covariance, H, y, noise)
        if self.trail is not None:
            self.trail.events.append(Learned(H, gain, S_inverse, y))
        if doubts is not None:
            self.shaking = self.shaking.taught(y, without_doubts(S_inverse, doubts), H, gain)
        self.state = self.state.plus(error)

    def _take_depths(self) -> None:
        """Update by all new depths."""
        news: list[tuple[int, float, DepthSeen]] = []
        for index, member in enumerate(self.members):
            found = newest_before(self.intake.depths[member.node], self.t_s)
            if found is not None and found[0] > member.depth_s and self.t_s - found[0] <= 0.3:
                member.depth_s = found[0]
                news.append((index, self.t_s - found[0], found[1]))
        # Beside a variance as that of an unknown datum, together they would lose all digits of their own.
        together = self.covariance[DATUM, DATUM] < KNOWN_DATUM_M**2
        for some in [news] if together else [[one] for one in news]:
            self._take_gauges(some)

    def _take_gauges(self, news: Sequence[tuple[int, float, DepthSeen]]) -> None:
        """Update by some gauges in one: (1 - scale) h = p_z + (R port)_z - v_z age + offset + datum.

        news: member, age, message.
        """
        assert self.state is not None
        state = self.state
        y, noise, H = np.zeros(len(news)), np.zeros(len(news)), np.zeros((len(news), len(self.covariance)))
        H[:, DATUM] = 1.0
        for row, (index, age_s, seen) in enumerate(news):
            port = state.R[index] @ self.nodes[self.members[index].node].rig.depth_port_m
            north, east, down = (state.p_m[index] - age_s * state.v_mps[index] + port).tolist()
            y[row] = (1.0 - state.depth_scale) * seen.depth_m - down - state.gauge_m[index] - state.datum_m
            H[row, DEPTH_SCALE] = seen.depth_m
            own = H[row, block(index)]
            own[P_.stop - 1], own[V_.stop - 1] = 1.0, -age_s
            own[PHI] = east, -north, 0.0
            own[GAUGE] = 1.0
            # A frame that moves with a node may have risen or sunk since, by some 0.3 m/s.
            drift_m = 0.0 if self.anchor is None else 0.3 * age_s
            noise[row] = seen.sigma_m**2 + drift_m**2 + 1e-6
        kept = within(y, H @ self.covariance @ H.T + np.diag(noise))
        if kept:
            self._apply(H[kept], y[kept], np.diag(noise[kept]))

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
        self._take_compass(member, float(y[2]), float(seen.sigma_rad[2] ** 2))
        factors = (1.0, 1.0) if first else (2.0 * anchors.TILT_TIME_S / since, 2.0 * anchors.HEADING_TIME_S / since)
        noise = self._attitude_noise(seen, *factors)
        chi2 = float(y @ np.linalg.solve(noise + H @ self.covariance @ H.T, y))
        if chi2 > 16.0:
            noise = noise * (chi2 / 4.0)
        self._apply(H, y, noise)

    def _take_compass(self, member: Member, off_rad: float, variance: float) -> None:
        """Note by how much a member's compass is off its heading. Where fixed nodes hold the frame, none counts."""
        if self.places:
            return
        member.compass = off_rad, variance
        _, *compasses = self._compasses()
        self.north_doubt = north_doubt(*compasses)

    def _compasses(self) -> tuple[list[int], Floats, Floats, Floats]:
        """Give the members whose compasses have spoken, and the arguments of `north_doubt`."""
        told = [i for i, one in enumerate(self.members) if math.isfinite(one.compass[1])]
        off, stated = np.array([self.members[i].compass for i in told]).reshape(-1, 2).T
        about_down = [block(i).start + PHI.stop - 1 for i in told]
        return told, off, stated, self.covariance[np.ix_(about_down, about_down)]

    def wrong_compass(self) -> tuple[int, float] | None:
        """Give the node whose compass is wrong by what the others say, and by how much, rad; None if none is."""
        told, *compasses = self._compasses()
        wrong = wrong_compass(*compasses) if len(told) > 2 else None
        return None if wrong is None else (self.members[told[wrong[0]]].node, wrong[1])

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
        assert self.state is not None
        told = self._turning_residual(member, self.t_s, self.state.R[index], self.state.mount_rad[index])
        if told is None:
            return
        y, noise = told
        H = np.zeros((3, len(self.covariance)))
        H[:, block(index)] = _ATTITUDE
        if float(y @ np.linalg.solve(noise + H @ self.covariance @ H.T, y)) < 30.0:
            self._apply(H, y, noise)

    def sigma_m(self, index: int) -> float:
        """Give how well a member's place is known, 1 sd of its distance."""
        assert self.state is not None
        J = plain_of_posed(self.state.p_m[index], self.state.v_mps[index])[P_]
        own = self.covariance[block(index), block(index)][:POSED, :POSED]
        return math.sqrt(max(float(np.trace(J @ own @ J.T)), 0.0))


def within(y: Floats, S: Floats) -> list[int]:
    """Give which of some residuals (m,) of a covariance (m, m) are within 4 sigma, each by those before it."""
    y, S, kept = y.copy(), S.copy(), []
    for row in range(len(y)):
        if y[row] ** 2 < 16.0 * S[row, row]:
            kept.append(row)
            # What it tells of those after it.
            gain = S[row + 1 :, row] / S[row, row]
            y[row + 1 :] -= gain * y[row]
            S[row + 1 :, row + 1 :] -= np.outer(gain, S[row, row + 1 :])
    return kept
