"""Random dives for the track: two nodes' motion, lights, inertial units and sensors, made from nothing of the track."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.inputs import AttitudeSeen, DepthSeen, FixSeen, FrameSeen, TrackNode
from buddyline.solver_service.track.output import TrackRow
from buddyline.solver_service.track.records import NodeRecord, feed

EPOCH_NS = 1_764_000_000_000_000_000
GRAVITY = np.array((0.0, 0.0, 9.80665))
R_BODY_CAMERA = np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
# The lamps (M, 3) of others that a node may see at a time, in north-east-down.
Lamps = Callable[[int, Floats], Floats]
FOCAL_PX, WIDTH_PX, HEIGHT_PX = 900.0, 820, 616


@dataclass(frozen=True)
class Setting:
    """What a dive is like. poor: the inertial units are off their mounts, late, off their told place, and walk.

    cabled: a cable triggers both nodes at one instant, in place of each one's own clock.
    lasting_s: half of each light's variance is of an error that wanders, exp(-t / lasting_s); candidates tell so.
    """

    seconds: float = 30.0
    rate_hz: float = 10.0
    near_m: float = 2.5
    far_m: float = 7.0
    poor: bool = False
    sigma_px: float = 0.7
    false: int = 3
    dead: tuple[tuple[int, int], ...] = ()
    dark_s: tuple[float, float] | None = None
    clock_s: float = 0.0
    cabled: bool = False
    depth_offset_m: float = 0.0
    lasting_s: float = 0.0


@dataclass(frozen=True)
class KnownDive:
    """A dive and its truth at stamps (N,): t_a_b (N, 3), R_a_b (N, 3, 3)."""

    records: tuple[NodeRecord, NodeRecord]
    fixes: list[FixSeen]
    stamps_ns: list[int]
    t_a_b_m: Floats
    R_a_b: Floats


class SineSway:
    """A sum of sines (3 axes) with random phases and periods, of about unit deviation."""

    def __init__(self, rng: np.random.Generator, shortest_s: float, longest_s: float) -> None:
        self._rate = 2.0 * np.pi / rng.uniform(shortest_s, longest_s, (4, 3))
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (4, 3))

    def __call__(self, t: Floats) -> Floats:
        return np.sin(t[:, None, None] * self._rate + self._phase).sum(1) / np.sqrt(2.0)


class SwayingPair:
    """A rests and sways, B comes and goes before it; each looks at the other, roughly."""

    def __init__(self, rng: np.random.Generator, setting: Setting) -> None:
        self._s = setting
        self._sway = [SineSway(rng, 5.0, 16.0), SineSway(rng, 5.0, 16.0)]
        self._turn = [SineSway(rng, 4.0, 14.0), SineSway(rng, 4.0, 14.0)]
        self._shake = [SineSway(rng, 0.4, 0.7), SineSway(rng, 0.4, 0.7)]
        self._heading, self._cycle_s, self._phase = rng.uniform(-3.0, 3.0), rng.uniform(25.0, 45.0), rng.uniform(0, 6.0)

    def places(self, node: int, t: Floats) -> Floats:
        """Positions (N, 3) in north-east-down."""
        s = self._s
        range_m = 0.5 * (s.near_m + s.far_m) - 0.5 * (s.far_m - s.near_m) * np.cos(
            2.0 * np.pi * t / self._cycle_s + self._phase
        )
        away = self._heading + 0.35 * np.sin(2.0 * np.pi * t / 19.0)
        path = np.stack((range_m * np.cos(away), range_m * np.sin(away), 0.4 * np.sin(t / 5.0)), axis=1)
        shake = 0.003 * self._shake[node](t) if s.poor else 0.0
        depth = np.array((0.0, 0.0, 9.0))
        return depth + (path if node else 0.0) + (0.12 if node else 0.05) * self._sway[node](t) + shake

    def attitudes(self, node: int, t: Floats) -> Floats:
        """R_ned_camera (N, 3, 3): toward the other, swaying."""
        toward = self.places(1 - node, t) - self.places(node, t)
        return self._attitudes_toward(node, t, np.arctan2(toward[:, 1], toward[:, 0]))

    def _attitudes_toward(self, node: int, t: Floats, yaw: Floats) -> Floats:
        """R_ned_camera (N, 3, 3): toward yaw (N,), swaying."""
        angles = np.array((0.08, 0.07, 0.10)) * self._turn[node](t)
        if self._s.poor:
            angles = angles + 0.004 * self._shake[node](t)
        zero = np.zeros_like(yaw)
        R = rotation_exp(np.stack((zero, zero, yaw + angles[:, 2]), axis=1))
        R = R @ rotation_exp(np.stack((zero, angles[:, 1], zero), axis=1))
        R = R @ rotation_exp(np.stack((angles[:, 0], zero, zero), axis=1))
        turned: Floats = R @ R_BODY_CAMERA
        return turned


class RestlessPair(SwayingPair):
    """They turn to and fro within one to three seconds."""

    def __init__(self, rng: np.random.Generator, setting: Setting) -> None:
        super().__init__(rng, setting)
        self._turn = [SineSway(rng, 1.2, 3.0), SineSway(rng, 1.2, 3.0)]


def make(seed: int, setting: Setting, motion: SwayingPair | None = None, lamps: Lamps | None = None) -> KnownDive:
    """Make a dive; lamps: of others than the two nodes."""
    rng = np.random.default_rng((seed, 17))
    motion = motion or SwayingPair(rng, setting)
    camera = Camera("pinhole", WIDTH_PX, HEIGHT_PX, FOCAL_PX, FOCAL_PX, 409.5, 307.5)
    nodes = []
    units = []
    for name in ("a", "b"):
        lights = np.array(((-0.44, 0.0, 0.0), (0.44, 0.0, 0.0)))
        lights[:, 1:] += rng.normal(0.0, 0.004, (2, 2))
        lever = rng.normal(0.0, 0.06, 3) if setting.poor else np.zeros(3)
        told = lever + (rng.normal(0.0, 0.005, 3) if setting.poor else 0.0)
        nodes.append(TrackNode(name, Rig(camera, lights, R_BODY_CAMERA), told))
        off = rotation_exp(rng.normal(0.0, np.radians(1.0), 3)) if setting.poor else np.eye(3)
        units.append((lever, off, rng.uniform(0.002, 0.006) if setting.poor else 0.0))
    triggers = np.arange(2, int(setting.seconds * setting.rate_hz)) / setting.rate_hz
    later_s = 0.0 if setting.cabled else setting.clock_s
    frames = [
        _frames(rng, motion, nodes, node, instants, setting, lamps)
        for node, instants in enumerate((triggers, triggers - later_s))
    ]
    records = []
    for node in (0, 1):
        clock_s = setting.clock_s if node else 0.0
        records.append(
            replace(
                _sensors(rng, motion, nodes[node], node, setting, *units[node]),
                frames=[shifted(frame, clock_s) for frame, _ in frames[node] if frame is not None],
            )
        )
    fixes = [
        fix
        for one, two in zip(frames[0], frames[1], strict=True)
        if one[0] is not None and two[0] is not None and one[1].all() and two[1].all()
        for fix in [_fix(nodes, one, two, motion)]
        if fix is not None
    ]
    stamps = [EPOCH_NS + round(t * 1e9) for t in np.arange(0.2, setting.seconds - 0.2, 0.05)]
    times = np.array([(stamp - EPOCH_NS) * 1e-9 for stamp in stamps])
    # Fixes and truth are stamped between both clocks.
    between_ns = round(0.5e9 * setting.clock_s)
    fixes = [replace(fix, stamp_ns=fix.stamp_ns + between_ns) for fix in fixes]
    stamps = [stamp + between_ns for stamp in stamps]
    R_a, R_b = motion.attitudes(0, times), motion.attitudes(1, times)
    apart = motion.places(1, times) - motion.places(0, times)
    toward = np.swapaxes(R_a, 1, 2)
    return KnownDive((records[0], records[1]), fixes, stamps, (toward @ apart[:, :, None])[:, :, 0], toward @ R_b)


def filter_of(
    records: tuple[NodeRecord, NodeRecord], fixes: Sequence[FixSeen], *, keep_s: float = math.inf
) -> TrackFilter:
    """Make a filter that keeps its steps for keep_s and holds a whole dive."""
    track = TrackFilter(records[0].node, records[1].node, keep_s=keep_s)
    for node, record in enumerate(records):
        feed(track, node, record)
    for fix in fixes:
        track.add_fix(fix)
    return track


def shifted(frame: FrameSeen, clock_s: float) -> FrameSeen:
    """Stamp a frame by a clock that is ahead."""
    return replace(frame, stamp_ns=frame.stamp_ns + round(clock_s * 1e9))


def project(X: Floats) -> Floats:
    """Image points (N, 3) of the camera frame."""
    pixels: Floats = np.array((409.5, 307.5)) + FOCAL_PX * X[:, :2] / X[:, 2:]
    return pixels


def _frames(
    rng: np.random.Generator,
    motion: SwayingPair,
    nodes: list[TrackNode],
    node: int,
    triggers: Floats,
    setting: Setting,
    lamps: Lamps | None,
) -> list[tuple[FrameSeen | None, Floats]]:
    """Each trigger's frame, and which of the other's lights are truly in it (2,); the lights' pixels come first."""
    wander, wandered_s = rng.spawn(1)[0], -math.inf
    wandering = np.zeros((2, 2))
    hidden = rng.uniform(0.0, setting.seconds, (2, 2))
    lengths = rng.uniform(0.5, 2.5, (2, 2))
    out: list[tuple[FrameSeen | None, Floats]] = []
    for nominal in triggers.tolist():
        t = nominal + rng.normal(0.0, 0.0005)
        at = np.array((t,))
        R = motion.attitudes(node, at)[0]
        R_other = motion.attitudes(1 - node, at)[0]
        apart = motion.places(1 - node, at)[0] - motion.places(node, at)[0]
        X = (apart + nodes[1 - node].rig.lights_m @ R_other.T) @ R
        true = project(X)
        inside = (X[:, 2] > 0.1) & (true > 0.0).all(1) & (true < np.array((WIDTH_PX - 1, HEIGHT_PX - 1))).all(1)
        for light in (0, 1):
            covered = ((t > hidden[light]) & (t < hidden[light] + lengths[light])).any()
            if covered or rng.uniform() < 0.03 or (1 - node, light) in setting.dead:
                inside[light] = False
        if setting.dark_s and setting.dark_s[0] <= t <= setting.dark_s[1]:
            inside[:] = False
        gross = rng.uniform(size=2) < 0.03
        own = rng.normal(0.0, 1.0, (2, 2))
        if setting.lasting_s:
            kept = math.exp((wandered_s - t) / setting.lasting_s)
            wandering = kept * wandering + math.sqrt(1.0 - kept**2) * wander.normal(0.0, 1.0, (2, 2))
            own, wandered_s = math.sqrt(0.5) * (own + wandering), t
        noisy = true + own * np.where(gross, 6.0, setting.sigma_px)[:, None]
        false = rng.uniform((0.0, 0.0), (WIDTH_PX - 1.0, HEIGHT_PX - 1.0), (rng.poisson(setting.false), 2))
        pixels = np.concatenate((noisy[inside], false))
        if lamps is not None:
            pixels = np.concatenate((pixels, _seen(rng, (lamps(node, at) - motion.places(node, at)[0]) @ R, setting)))
        if rng.uniform() < 0.02:
            out.append((None, inside))
            continue
        sigma_px = np.full(len(pixels), setting.sigma_px)
        lasting_s = np.full(len(pixels), setting.lasting_s)
        frame = FrameSeen(EPOCH_NS + round(t * 1e9), pixels, sigma_px, lasting_s=lasting_s)
        out.append((frame, inside & ~gross))
    return out


def _seen(rng: np.random.Generator, X: Floats, setting: Setting) -> Floats:
    """Give the pixels of lamps X (M, 3) in the camera frame that are in the picture, with noise and misses."""
    X = X[X[:, 2] > 0.3]
    pixels = project(X) + rng.normal(0.0, setting.sigma_px, (len(X), 2))
    inside = (pixels > 0.0).all(1) & (pixels < np.array((WIDTH_PX - 1, HEIGHT_PX - 1))).all(1)
    return pixels[inside & (rng.uniform(size=len(X)) > 0.03)]


def _fix(
    nodes: list[TrackNode],
    one: tuple[FrameSeen | None, Floats],
    two: tuple[FrameSeen | None, Floats],
    motion: SwayingPair,
) -> FixSeen | None:
    """Fit a pose to the eight coordinates of a trigger, from the truth on."""
    assert one[0] is not None
    assert two[0] is not None
    stamp_ns = (one[0].stamp_ns + two[0].stamp_ns) // 2
    at = np.array(((stamp_ns - EPOCH_NS) * 1e-9,))
    R_a = motion.attitudes(0, at)[0]
    R, t = R_a.T @ motion.attitudes(1, at)[0], R_a.T @ (motion.places(1, at)[0] - motion.places(0, at)[0])
    measured = np.concatenate((one[0].pixels[:2], two[0].pixels[:2])).ravel()

    def foretold(t: Floats, R: Floats) -> Floats:
        seen_a, seen_b = t + nodes[1].rig.lights_m @ R.T, (nodes[0].rig.lights_m - t) @ R
        return np.concatenate((project(seen_a), project(seen_b))).ravel()

    for _ in range(4):
        h, J = foretold(t, R), np.empty((8, 6))
        for k in range(6):
            step = np.zeros(6)
            step[k] = 1e-6
            J[:, k] = (foretold(t + step[:3], rotation_exp(step[3:]) @ R) - h) / 1e-6
        delta = np.linalg.lstsq(J, measured - h, rcond=None)[0]
        t, R = t + delta[:3], rotation_exp(delta[3:]) @ R
    sigma = float(one[0].sigma_px[0])
    if float(((measured - foretold(t, R)) ** 2).sum()) > 12.0 * sigma**2:
        return None
    return FixSeen(stamp_ns, t, R, sigma**2 * np.linalg.inv(J.T @ J))


def _sensors(
    rng: np.random.Generator,
    motion: SwayingPair,
    node: TrackNode,
    index: int,
    setting: Setting,
    lever_m: Floats,
    off: Floats,
    late_s: float,
) -> NodeRecord:
    t = np.arange(0.03, setting.seconds, 0.01)
    h = 0.002
    R = motion.attitudes(index, t)
    R_before, R_after = motion.attitudes(index, t - h), motion.attitudes(index, t + h)
    rate = np.stack([rotation_log(a.T @ b) for a, b in zip(R_before, R_after, strict=True)]) / (2.0 * h)
    before, after = (motion.places(index, t + s) + motion.attitudes(index, t + s) @ lever_m for s in (-h, h))
    force = (after - 2.0 * (motion.places(index, t) + R @ lever_m) + before) / h**2 - GRAVITY
    force = (np.swapaxes(R, 1, 2) @ force[:, :, None])[:, :, 0]
    to_unit = R_BODY_CAMERA @ off
    walk = 1.0 if setting.poor else 0.0
    gyro_bias = rng.normal(0.0, 0.003, 3) + walk * np.cumsum(rng.normal(0.0, 1e-5, (len(t), 3)), axis=0)
    accel_bias = walk * (rng.normal(0.0, 0.05, 3) + np.cumsum(rng.normal(0.0, 1e-4, (len(t), 3)), axis=0))
    gyro = rate @ to_unit.T + gyro_bias + rng.normal(0.0, 0.004, (len(t), 3))
    accel = force @ to_unit.T + accel_bias + rng.normal(0.0, 0.03, (len(t), 3))
    clock_ns = round((setting.clock_s if index else 0.0) * 1e9)
    stamps = EPOCH_NS + clock_ns + np.round((t + late_s) * 1e9).astype(np.int64)
    slow, fast = SineSway(rng, 8.0, 40.0), SineSway(rng, 1.4, 3.0)
    at = np.arange(0.05, setting.seconds, 0.02)
    sigma = np.array((np.radians(1.0), np.radians(1.0), np.radians(4.0)))
    errors = sigma * (0.6 * slow(at) + 0.5 * fast(at) + 0.5 * rng.normal(0.0, 1.0, (len(at), 3)))
    seen = rotation_exp(errors) @ motion.attitudes(index, at) @ R_BODY_CAMERA.T
    attitudes = [
        AttitudeSeen(EPOCH_NS + clock_ns + round(s * 1e9), turned, sigma)
        for s, turned in zip(at.tolist(), seen, strict=True)
    ]
    at = np.arange(0.07, setting.seconds, 0.1)
    shown = motion.places(index, at)[:, 2] + rng.normal(0.0, 0.02, len(at))
    shown = shown + (setting.depth_offset_m if index else 0.0)
    depths = [
        DepthSeen(EPOCH_NS + clock_ns + round(s * 1e9), depth, 0.02)
        for s, depth in zip(at.tolist(), shown.tolist(), strict=True)
    ]
    return NodeRecord(node, (), stamps, accel, gyro, attitudes, depths)


@dataclass(frozen=True)
class Score:
    """Errors of rows against a dive's truth. nees: of pose, over 6; nees_position, nees_rotation: over 3."""

    errors_m: Floats
    nees: float
    nees_position: float
    nees_rotation: float
    covered: float
    wrong: int
    rows: int


def score(dive: KnownDive, rows: Iterable[TrackRow]) -> Score:
    """Judge rows of a track."""
    told = list(rows)
    place = {stamp: i for i, stamp in enumerate(dive.stamps_ns)}
    first, last = dive.fixes[0].stamp_ns, dive.fixes[-1].stamp_ns
    asked = [stamp for stamp in dive.stamps_ns if first <= stamp <= last]
    errors, nees, by_position, by_rotation, covered, wrong = [], [], [], [], 0, 0
    for row in told:
        i = place[row.stamp_ns]
        x, y, z, w = row.q_a_b_xyzw
        R = rotation_exp(_vector(x, y, z, w))
        e = np.concatenate((dive.t_a_b_m[i] - row.t_a_b_m, rotation_log(dive.R_a_b[i] @ R.T)))
        C = row.covariance
        error, sigma = float(np.linalg.norm(e[:3])), float(np.sqrt(np.trace(C[:3, :3])))
        errors.append(error)
        nees.append(e @ np.linalg.solve(C, e) / 6.0)
        by_position.append(e[:3] @ np.linalg.solve(C[:3, :3], e[:3]) / 3.0)
        by_rotation.append(e[3:] @ np.linalg.solve(C[3:, 3:], e[3:]) / 3.0)
        covered += first <= row.stamp_ns <= last and sigma < 0.05 * row.range_m
        wrong += error - 3.0 * sigma > 0.1 * row.range_m
    means = [float(np.mean(values)) if values else np.nan for values in (nees, by_position, by_rotation)]
    return Score(np.array(errors), *means, covered / max(len(asked), 1), wrong, len(told))


def _vector(x: float, y: float, z: float, w: float) -> Floats:
    axis = np.array((x, y, z)) * (1.0 if w >= 0.0 else -1.0)
    sine = float(np.linalg.norm(axis))
    return axis * (2.0 * np.arctan2(sine, abs(w)) / sine) if sine > 1e-12 else 2.0 * axis


def fix_errors(dive: KnownDive) -> Floats:
    """Position errors of the dive's fixes, m, against the truth between its stamps."""
    stamps = np.array([stamp - dive.stamps_ns[0] for stamp in dive.stamps_ns], dtype=float)
    out = []
    for fix in dive.fixes:
        true = [np.interp(fix.stamp_ns - dive.stamps_ns[0], stamps, dive.t_a_b_m[:, axis]) for axis in range(3)]
        out.append(float(np.linalg.norm(fix.t_a_b_m - true)))
    return np.array(out)


def bare_of(dive: KnownDive) -> tuple[NodeRecord, NodeRecord]:
    """The records without inertial samples."""
    none = np.zeros((0, 3))
    a, b = (
        replace(record, imu_stamps_ns=np.zeros(0, np.int64), accel_mps2=none, gyro_radps=none)
        for record in dive.records
    )
    return a, b
