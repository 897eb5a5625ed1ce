"""Dives in which others' lights are seen: a third party's bar, mirror images, divers with like bars."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Blob, Candidates, Depth, Imu, Message, NodeInfo, RelativePose, Track
from buddyline.protocol.messages import CameraModel as Model
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.rotation import Floats, matrix_to_quat
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.tracking import TrackSettings

from tests.solver_service.track.dives import (
    EPOCH_NS,
    FOCAL_PX,
    HEIGHT_PX,
    WIDTH_PX,
    KnownDive,
    Setting,
    SineSway,
    SwayingPair,
    make,
)

Kind = Literal["third", "third_goes", "formation", "wall", "surface", "like", "none"]
BAR_M = np.array(((-0.44, 0.0, 0.0), (0.44, 0.0, 0.0)))
NAMES = ("a", "b")


class Facing(SwayingPair):
    """Two nodes that look at each other, beside a mirror or divers with like bars."""

    def __init__(self, rng: np.random.Generator, setting: Setting, kind: Kind) -> None:
        super().__init__(rng, setting)
        self._kind = kind
        self._rng = rng
        mean_m = 0.5 * (setting.near_m + setting.far_m)
        self._wall_m = rng.uniform(0.8, 2.5)
        # Three divers with bars, about as far away as B, and looking about.
        self._at = np.stack([mean_m * np.array((rng.uniform(0.4, 1.4), rng.normal(0.0, 0.25), rng.normal(0.0, 0.08)))
                             for _ in range(3)])  # fmt: skip
        self._yaw = rng.normal(0.0, 0.5, 3) + self._heading + math.pi
        self._sways = [SineSway(rng, 5.0, 16.0) for _ in range(3)]

    def lamps(self, node: int, t: Floats) -> Floats:
        """Give the strangers' lamps (M, 3) that may be in a node's picture at t (1,), in north-east-down."""
        if self._kind == "like":
            c, s = math.cos(self._heading), math.sin(self._heading)
            along = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
            out = []
            for at, yaw, sway in zip(self._at, self._yaw, self._sways, strict=True):
                moved = 0.3 * sway(t)[0]
                aim = yaw + 0.3 * moved[2]
                bar = BAR_M[:, :1] * np.array((-math.sin(aim), math.cos(aim), 0.05 * moved[0]))
                out.append(along @ at + np.array((0.0, 0.0, 9.0)) + moved + bar)
            return np.concatenate(out)
        if self._kind == "none":
            return np.zeros((0, 3))
        own = self.places(1 - node, t)[0] + BAR_M @ self.attitudes(1 - node, t)[0].T
        if self._kind == "surface":
            return own * (1.0, 1.0, -1.0) + (0.0, 0.0, 2.0 * (9.0 - self._wall_m))
        # A wall beside both, along the mean line of sight.
        across = np.array((-math.sin(self._heading), math.cos(self._heading), 0.0))
        return own + 2.0 * np.outer(self._wall_m - own @ across, across)


class Onlookers(SwayingPair):
    """Two nodes that look at a third's bar from about equal range, apart_rad from each other as seen from there.

    goes: the third comes and goes along the middle. together: both go around it, and to and fro, in step.
    """

    def __init__(self, rng: np.random.Generator, setting: Setting, kind: Kind, apart_rad: float) -> None:
        super().__init__(rng, setting)
        self._kind = kind
        self._apart_rad = apart_rad
        self._range_m = rng.uniform(setting.near_m, setting.far_m)
        self._aims = rng.normal(0.0, 0.08, 2)
        self._bar_yaw = self._heading + rng.normal(0.0, 0.1)
        self._third = SineSway(rng, 5.0, 16.0)

    def places(self, node: int, t: Floats) -> Floats:
        """Positions (N, 3) in north-east-down; the third is near (0, 0, 9)."""
        step = np.sin(2.0 * np.pi * t / 17.0)
        in_step = self._kind == "formation"
        yaw = self._heading + (0.5 if node else -0.5) * self._apart_rad + (0.4 if in_step else 0.0) * step
        range_m = self._range_m * (1.0 - (0.2 * np.cos(2.0 * np.pi * t / 23.0) if in_step else 0.0))
        path = np.stack((-range_m * np.cos(yaw), -range_m * np.sin(yaw), 0.0 * t), axis=1)
        return np.array((0.0, 0.0, 9.0)) + path + (0.03 if node else 0.02) * self._sway[node](t)

    def third(self, t: Floats) -> Floats:
        """Where the third's bar is (N, 3)."""
        goes = 0.25 * self._range_m * np.sin(2.0 * np.pi * t / 14.0) if self._kind == "third_goes" else 0.0 * t
        toward = np.stack((math.cos(self._heading) * goes, math.sin(self._heading) * goes, 0.0 * t), axis=1)
        return np.array((0.0, 0.0, 9.0)) + toward + 0.02 * self._third(t)

    def attitudes(self, node: int, t: Floats) -> Floats:
        """R_ned_camera (N, 3, 3): toward the third, swaying."""
        toward = self.third(t) - self.places(node, t)
        return self._attitudes_toward(node, t, np.arctan2(toward[:, 1], toward[:, 0]) + self._aims[node])

    def lamps(self, node: int, t: Floats) -> Floats:
        """Give the third's lamps (2, 3) at t (1,)."""
        return self.third(t)[0] + BAR_M[:, :1] * np.array((-math.sin(self._bar_yaw), math.cos(self._bar_yaw), 0.0))


def strangers_dive(seed: int, kind: Kind, setting: Setting, apart_deg: float = 90.0) -> KnownDive:
    """Make a dive of one kind."""
    rng = np.random.default_rng((seed, 29))
    motion: Facing | Onlookers
    if kind in ("third", "third_goes", "formation"):
        motion = Onlookers(rng, setting, kind, math.radians(apart_deg))
    else:
        motion = Facing(rng, setting, kind)
    return make(seed, setting, motion, motion.lamps)


def messages_of(dive: KnownDive, setting: Setting, compass_off_rad: float = 0.0) -> list[Message]:
    """Give a dive's messages in the order of time; compass_off_rad: what B's compass is off by, beside its noise."""
    period_ns = round(S_NS / setting.rate_hz)
    timed: list[tuple[int, Message]] = []
    rng = np.random.default_rng(len(dive.records[0].frames))
    c, s = math.cos(compass_off_rad), math.sin(compass_off_rad)
    for node, (name, record) in enumerate(zip(NAMES, dive.records, strict=True)):
        rig = record.node.rig
        off = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0))) if node else np.eye(3)
        info = NodeInfo(
            node=name, stamp_ns=EPOCH_NS, width_px=round(WIDTH_PX), height_px=round(HEIGHT_PX),
            camera=Model(model="pinhole", fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=409.5, cy_px=307.5,
                         distortion=[0.0] * 5),
            light_left_m=_triple(rig.lights_m[0]), light_right_m=_triple(rig.lights_m[1]), sigma_px=setting.sigma_px,
            trigger_period_ns=period_ns, row_time_ns=0,
            q_body_camera_xyzw=tuple(matrix_to_quat(rig.R_body_camera).tolist()), depth_port_m=(0.0, 0.0, 0.0),
            imu_m=_triple(record.node.imu_m), software="test",
        )  # fmt: skip
        timed.append((EPOCH_NS, info))
        for k, frame in enumerate(record.frames):
            blobs = [
                Blob(u_px=u, v_px=v, sigma_px=setting.sigma_px, area_px=60.0, peak=255.0, elongation=1.0, dt_ns=0)
                for u, v in rng.permutation(frame.pixels).tolist()
                if 0.0 <= u <= WIDTH_PX - 1.0 and 0.0 <= v <= HEIGHT_PX - 1.0
            ]
            timed.append((frame.stamp_ns + 30_000_000, Candidates(
                node=name, stamp_ns=frame.stamp_ns, trigger=round(frame.stamp_ns / period_ns), seq=k, boot="test",
                width_px=round(WIDTH_PX), height_px=round(HEIGHT_PX), blobs=blobs, truncated=0,
            )))  # fmt: skip
        for seen in record.attitudes:
            q = matrix_to_quat(off @ seen.R_ned_body)
            sigma = _triple(seen.sigma_rad)
            timed.append((seen.stamp_ns, Attitude(
                node=name, stamp_ns=seen.stamp_ns, q_ned_body_xyzw=tuple(q.tolist()), sigma_rad=sigma
            )))  # fmt: skip
        for depth in record.depths:
            timed.append((depth.stamp_ns, Depth(
                node=name, stamp_ns=depth.stamp_ns, depth_m=depth.depth_m, sigma_m=depth.sigma_m, pressure_pa=2e5,
                temperature_degc=20.0,
            )))  # fmt: skip
        for stamp, accel, gyro in zip(record.imu_stamps_ns.tolist(), record.accel_mps2, record.gyro_radps, strict=True):
            timed.append((stamp, Imu(
                node=name, stamp_ns=stamp, accel_mps2=_triple(accel), gyro_radps=_triple(gyro)
            )))  # fmt: skip
    timed.sort(key=lambda item: item[0])
    return [message for _, message in timed]


@dataclass(frozen=True)
class StrangersTally:
    """What was published of a dive: how many poses and track rows of how many triggers, and how many wrong.

    reasons: of the rejections; covered: the share of triggers with a track of a sigma below 5 % of the range.
    """

    triggers: int
    poses: int
    wrong_poses: int
    rows: int
    wrong_rows: int
    covered: float
    reasons: dict[str, int]
    wrong_smooth: int = 0
    smooth: int = 0
    covered_smooth: float = 0.0


def outcome(
    dive: KnownDive, messages: Iterable[Message], modes: Iterable[str] = ("filter", "smooth")
) -> StrangersTally:
    """Solve a dive and judge it against its truth."""
    modes = frozenset(modes)
    core = SolverCore(Settings(), [NAMES], track=TrackSettings(modes, rate_hz=10.0) if modes else None)
    told = [one for message in messages for one in core.handle(message)] + core.flush()
    stamps = np.array(dive.stamps_ns, dtype=np.int64)
    poses = wrong = 0
    rows, wrong_rows, covered = {"filter": 0, "smooth": 0}, {"filter": 0, "smooth": 0}, {"filter": 0, "smooth": 0}
    for one in told:
        if not isinstance(one, RelativePose | Track) or not stamps[0] <= one.stamp_ns <= stamps[-1]:
            continue
        at = (one.stamp_ns - stamps[0]) * 1e-9
        true = np.array([np.interp(at, (stamps - stamps[0]) * 1e-9, axis) for axis in dive.t_a_b_m.T])
        off = true - one.t_a_b_m
        covariance = np.array(one.covariance).reshape(6, 6)[:3, :3]
        far = bool(np.linalg.norm(off) > 0.1 * np.linalg.norm(true) and off @ np.linalg.solve(covariance, off) > 9.0)
        if isinstance(one, RelativePose):
            poses += 1
            wrong += far
        else:
            rows[one.mode] += 1
            wrong_rows[one.mode] += far
            covered[one.mode] += math.sqrt(covariance.trace()) < 0.05 * one.range_m
    counts = dict(core.counts)
    counts.pop("solved", None)
    asked = max(sum(s >= EPOCH_NS + 200_000_000 for s in dive.stamps_ns) / 2, 1)
    return StrangersTally(
        triggers=sum(core.counts.values()), poses=poses, wrong_poses=wrong, rows=rows["filter"],
        wrong_rows=wrong_rows["filter"], covered=covered["filter"] / asked, reasons=counts,
        wrong_smooth=wrong_rows["smooth"], smooth=rows["smooth"], covered_smooth=covered["smooth"] / asked,
    )  # fmt: skip


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
