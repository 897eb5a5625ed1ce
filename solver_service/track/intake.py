"""What comes into a track, or a network: samples, sensors, pictures and fixes, each at its time."""

from __future__ import annotations

import bisect
import heapq
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, TypeAlias, TypeVar

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.gyros import (
    EVERY_S,
    FAULTY,
    SPAN_S,
    WELL,
    TurningTold,
    gyro_fault,
    turns_of,
)
from buddyline.solver_service.track.inputs import AttitudeSeen, DepthSeen, FixSeen, FrameSeen, Stamps, TrackNode
from buddyline.solver_service.track.lights import Sight, sights_of
from buddyline.solver_service.track.problems import Problems
from buddyline.solver_service.track.samples import Samples
from buddyline.solver_service.track.turning import Turning, time_of
from buddyline.solver_service.track.units import clipped, fault_of, stuck

CHECK_EVERY_S: Final = 2.0
SILENT_S: Final = 1.0
# For so long an attitude tells how its node stands.
ATTITUDE_HOLD_S: Final = 0.5
# A node that has told nothing for so long, and for GONE_PICTURES of its own, is gone. Nothing says how it turns then:
# its lamps alone look the same whether it turns to the left or to the right.
GONE_S: Final = 0.5
GONE_PICTURES: Final = 3
LEAST_SIGMA_RAD: Final = 1e-3
# Taken for roll, pitch and yaw where a message states a sigma below LEAST_SIGMA_RAD, which no attitude filter reaches.
UNTOLD_SIGMA_RAD: Final = np.radians((1.5, 1.5, 6.0))
# No fix's numbers, in m, rad and their squares, are as large.
BEYOND: Final = 1e4
Seen = TypeVar("Seen", AttitudeSeen, DepthSeen)
# A picture, a fix, or a row that is asked for: its stamp, in a network with the nodes that it is asked of behind.
What: TypeAlias = Sight | FixSeen | int | tuple[int, ...]


class TrackIntake:
    """All that nodes have told, in order of time. `problems` says what is wrong with it.

    Of a pair, node a is 0 and node b is 1; clock_ns is then b's clock minus a's, as first believed.
    """

    nodes: Sequence[TrackNode]

    def __init__(self, nodes: Sequence[TrackNode]) -> None:
        self.nodes = nodes
        self._problems = Problems()
        self.epoch_ns: int | None = None
        self.clock_ns = 0
        self.samples = [Samples() for _ in nodes]
        self.attitudes: list[list[tuple[float, AttitudeSeen]]] = [[] for _ in nodes]
        self.depths: list[list[tuple[float, DepthSeen]]] = [[] for _ in nodes]
        self._events: list[tuple[float, int, int, What]] = []
        self.turning = list(map(self._turning_of, range(len(nodes))))
        self._count = 0
        self._checked_s = -np.inf
        self._compared_s = -np.inf
        self._gyro_faults: dict[int, str] = {}
        # Of nodes whose unit was judged by the whole dive: from when to when it is faulty, s, and why.
        self._known_faults: dict[int, list[tuple[float, float, str]]] = {}
        self._rejected = [0 for _ in nodes]
        # Of each node that has a picture, when its last one was, and how long after the one before.
        self._pictured_s: dict[int, tuple[float, float]] = {}

    def seconds(self, node: int, stamp_ns: int) -> float:
        """Give a stamp of a node as s since the epoch, on A's clock as first believed."""
        return self.since_epoch(stamp_ns - self.ahead_ns(node))

    def since_epoch(self, stamp_ns: int) -> float:
        """Give a stamp of the common clock, A's, as s since the epoch."""
        if self.epoch_ns is None:
            self.epoch_ns = stamp_ns - stamp_ns % 86_400_000_000_000
        return (stamp_ns - self.epoch_ns) * 1e-9

    def ahead_ns(self, node: int) -> int:
        """Give a node's clock minus A's, as first believed."""
        return self.clock_ns if node else 0

    def stamp_ns(self, t_s: float) -> int:
        """Give the stamp of A's clock at a time since the epoch."""
        return (self.epoch_ns or 0) + round(t_s * 1e9)

    def pair_seconds(self, stamp_ns: int) -> float:
        """Give a stamp midway between both clocks, as those of fixes and rows are, in the seconds of `seconds`."""
        return self.seconds(0, stamp_ns - self.clock_ns // 2)

    def add_imu(
        self, node: int, stamps_ns: Stamps, accel_mps2: Floats, gyro_radps: Floats, fast: Floats | None = None
    ) -> None:
        """Take inertial samples (N,), (N, 3), (N, 3) in the body frame.

        fast (N, 7): the fast part of both, and the camera's sudden turn.
        """
        if not len(stamps_ns):
            return
        self.seconds(node, int(stamps_ns[0]))
        assert self.epoch_ns is not None
        times_s = np.asarray(stamps_ns - self.ahead_ns(node) - self.epoch_ns, np.float64) * 1e-9
        R_body_camera = self.nodes[node].rig.R_body_camera
        with np.errstate(invalid="ignore", over="ignore"):
            values = np.hstack((accel_mps2 @ R_body_camera, gyro_radps @ R_body_camera))
            values[clipped(gyro_radps), 3:] = np.nan
        if fast is not None:
            fast = np.hstack((fast[:, :3] @ R_body_camera, fast[:, 3:6] @ R_body_camera, fast[:, 6:]))
        self.samples[node].add(times_s, values, fast)

    def know_faults(self, node: int, faults: Sequence[tuple[int, int, str]]) -> None:
        """Take when a node's unit is faulty, by its stamps, and why; its gyro is not judged on the way then."""
        self._known_faults[node] = [
            (self.seconds(node, start_ns), self.seconds(node, end_ns), said) for start_ns, end_ns, said in faults
        ]

    def take_off(self, shares: Floats) -> None:
        """Use the samples without these shares (2 nodes, 2: force, rate) of their fast parts."""
        for samples, of_node in zip(self.samples, shares, strict=True):
            samples.shares = of_node

    def add_attitude(self, node: int, seen: AttitudeSeen) -> None:
        """Take an attitude message; sigmas that no attitude filter reaches are taken for unknown."""
        if not all(sigma > LEAST_SIGMA_RAD for sigma in seen.sigma_rad.tolist()):
            seen = replace(seen, sigma_rad=np.maximum(seen.sigma_rad, UNTOLD_SIGMA_RAD))
            said = f"node {self.nodes[node].name}: attitude sigmas of zero are taken as unknown"
            self._problems.report(said, self.seconds(node, seen.stamp_ns))
        bisect.insort(self.attitudes[node], (self.seconds(node, seen.stamp_ns), seen), key=time_of)

    def add_depth(self, node: int, seen: DepthSeen) -> None:
        """Take a depth message."""
        bisect.insort(self.depths[node], (self.seconds(node, seen.stamp_ns), seen), key=time_of)

    def add_frames(self, node: int, frames: Sequence[FrameSeen]) -> None:
        """Take the candidates of pictures."""
        times_s = [self.seconds(node, frame.stamp_ns) for frame in frames]
        for sight in sights_of(self.nodes[node].rig, node, times_s, frames):
            self._push(sight.t_s, 1 + node, sight)

    def add_fix(self, fix: FixSeen) -> None:
        """Take a pose that one trigger's lights gave by themselves; one out of numeric range is left out."""
        numbers = np.concatenate((fix.t_a_b_m.ravel(), fix.R_a_b.ravel(), fix.covariance.ravel()))
        if not np.isfinite(numbers).all() or np.abs(numbers).max() > BEYOND:
            self._problems.report(f"{self.both}: fixes out of numeric range are left out", self.fix_seconds(fix))
            return
        self._push(self.fix_seconds(fix), 0, fix)

    def fix_seconds(self, fix: FixSeen) -> float:
        """Give a fix's time since the epoch."""
        return self.pair_seconds(fix.stamp_ns)

    def _push(self, t_s: float, rank: int, what: What) -> None:
        """Have something taken at t_s. rank: the order at one time: fixes, then pictures by node, then asked rows."""
        # The count keeps two of a rank at one time in their order: they cannot be compared.
        self._count += 1
        heapq.heappush(self._events, (t_s, rank, self._count, what))

    def _turning_of(self, node: int) -> Turning:
        return Turning(self.attitudes[node], self.nodes[node].rig.R_body_camera)

    def level_camera(self, node: int, seen: AttitudeSeen) -> Floats:
        """Give R_level_camera of an attitude message."""
        R: Floats = seen.R_ned_body @ self.nodes[node].rig.R_body_camera
        return R

    def _check_units(self, t_s: float) -> None:
        """Every seconds, say what is wrong with a unit; it is not used until it is well again."""
        self._problems.pass_to(t_s)
        for node in self._known_faults:
            if self._fault_found(node, t_s) is not None:
                self.samples[node].trusted = False
        if t_s - self._checked_s < CHECK_EVERY_S:
            return
        # At the dive's start there is little to judge by: at every picture, until there is enough.
        if min(len(samples.last(t_s, CHECK_EVERY_S)[0]) for samples in self.samples) > 100:
            self._checked_s = t_s
        if t_s - self._compared_s > EVERY_S:
            self._compared_s = t_s
            self._compare_gyros(t_s)
        for node, samples in enumerate(self.samples):
            name, (times_s, lately) = self.nodes[node].name, samples.last(t_s, CHECK_EVERY_S)
            unchanging, found = stuck(name, lately), self._fault_found(node, t_s)
            if unchanging is None:
                fault = fault_of(name, *self._with_attitudes(node, t_s, times_s, lately[:, :3])) or found
            else:
                fault = found if found and node in self._known_faults else unchanging
                if samples.trusted:
                    self._begin_anew()
            samples.trusted = fault is None
            if fault is not None:
                self._problems.report(fault, t_s)
                self._rejected[node] = samples.rejected
            elif len(samples) and not (len(samples.last(t_s + SILENT_S, 2.0 * SILENT_S)[0]) or self.gone(node, t_s)):
                self._problems.report(f"node {name}: inertial samples are missing: the track does without them", t_s)
            if samples.rejected > self._rejected[node]:
                said = (
                    f"node {name}: {samples.rejected} inertial samples so far are left out: "
                    "not finite, clipped, sent twice or far from their neighbours"
                )
                self._problems.report(said, t_s)
                self._rejected[node] = samples.rejected

    def _with_attitudes(self, node: int, t_s: float, times_s: Floats, force: Floats) -> tuple[Floats, Floats | None]:
        """Give the forces (N, 3) of the last seconds up to t_s with R_level_camera (N, 3, 3) at each, by the attitudes.

        Forces are left out where the attitude before them is older than ATTITUDE_HOLD_S. All are given, without R,
        where the newest attitude is that old at t_s.
        """
        start_s, items = t_s - CHECK_EVERY_S, self.attitudes[node]
        first = bisect.bisect_left(items, start_s - ATTITUDE_HOLD_S, key=time_of)
        seen = items[first : bisect.bisect_right(items, t_s, key=time_of)]
        if not seen or t_s - seen[-1][0] >= ATTITUDE_HOLD_S:
            return force, None
        seen_s = np.array([at_s for at_s, _ in seen])
        at = np.searchsorted(seen_s, times_s, side="right") - 1
        near = (at >= 0) & (times_s - seen_s[at] < ATTITUDE_HOLD_S)
        R = np.array([one.R_ned_body for _, one in seen]) @ self.nodes[node].rig.R_body_camera
        return force[near], R[at[near]]

    def _compare_gyros(self, t_s: float) -> None:
        """Judge gyros by the attitudes of the last seconds; where these do not tell, what was found stays."""
        for node, samples in enumerate(self.samples):
            if node in self._known_faults:
                continue
            turns = turns_of(self._turning_told(node, t_s - SPAN_S, t_s))
            found = gyro_fault(turns) if turns is not None else None
            if found is None:
                continue
            if found.gain < -WELL:
                self._gyro_faults.pop(node, None)
            elif found.gain > FAULTY:
                used = node not in self._gyro_faults and samples.trusted
                self._gyro_faults[node] = found.of(self.nodes[node].name)
                if used:
                    self._begin_anew()

    def _begin_anew(self) -> None:
        """Drop what samples of a faulty unit have told for seconds."""

    def _turning_told(self, node: int, start_s: float, end_s: float) -> TurningTold:
        items, samples = self.attitudes[node], self.samples[node]
        seen = items[bisect.bisect_left(items, start_s, key=time_of) : bisect.bisect_left(items, end_s, key=time_of)]
        first, stop = np.searchsorted(samples.times_s, (start_s, end_s))
        return TurningTold(
            np.array([at_s for at_s, _ in seen]),
            np.array([one.R_ned_body for _, one in seen]).reshape(-1, 3, 3),
            np.array([one.sigma_rad for _, one in seen]).reshape(-1, 3),
            samples.times_s[first:stop],
            samples.values[first:stop, 3:] @ self.nodes[node].rig.R_body_camera.T,
        )

    def _fault_found(self, node: int, t_s: float) -> str | None:
        if node not in self._known_faults:
            return self._gyro_faults.get(node)
        return next((said for start_s, end_s, said in self._known_faults[node] if start_s <= t_s < end_s), None)

    def _hear(self, node: int, t_s: float) -> None:
        """Note a node's picture, which has its turn."""
        before_s, _ = self._pictured_s.get(node, (t_s, 0.0))
        self._pictured_s[node] = t_s, max(t_s - before_s, 0.0)

    def between_pictures_s(self, node: int) -> float:
        """Give how long passed between a node's last two pictures, 0 before there are two."""
        return self._pictured_s.get(node, (0.0, 0.0))[1]

    def gone(self, node: int, t_s: float) -> bool:
        """Whether a node tells no pictures, samples or attitudes at t_s. Nothing later than t_s is looked at."""
        pictured_s, apart_s = self._pictured_s.get(node, (-np.inf, 0.0))
        if t_s - pictured_s <= max(GONE_S, GONE_PICTURES * apart_s):
            return False
        seen = newest_before(self.attitudes[node], t_s)
        return (seen is None or t_s - seen[0] > GONE_S) and not len(self.samples[node].last(t_s, GONE_S)[0])

    def goes_on_to(self, t_s: float) -> None:
        """Note that the dive goes on up to t_s, where problems that were found before may have ended."""
        self._problems.pass_to(t_s)

    @property
    def both(self) -> str:
        """The nodes, in words."""
        return f"nodes {' and '.join(node.name for node in self.nodes)}"

    @property
    def problems(self) -> list[str]:
        """What is wrong, in words; what has ended says so."""
        return self._problems.texts()

    def _forget_before(self, t_s: float) -> None:
        """Drop what no step will look at again."""
        for node in range(len(self.nodes)):
            self.samples[node].forget_before(t_s)
            for items in (self.attitudes[node], self.depths[node]):
                del items[: min(bisect.bisect_left(items, t_s, key=time_of), len(items) - 1)]


def newest_before(items: list[tuple[float, Seen]], t_s: float) -> tuple[float, Seen] | None:
    """Give the last of (time, message) at or before t_s, None where there is none."""
    at = bisect.bisect_right(items, t_s, key=time_of)
    return items[at - 1] if at else None
