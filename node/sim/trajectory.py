"""The motion of the two nodes: a smooth function of time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from buddyline.node.sim import rotation
from buddyline.node.sim.randomness import Sway, generator
from buddyline.node.sim.rotation import Matrix, Vector
from buddyline.node.sim.scenario import Scenario

SPEED_MPS = 0.7
LOOK_AWAY_PERIOD_S = 20.0
LOOK_AWAY_SHARE = 0.7
MARGIN_RAD = math.radians(2.0)
CLEARANCE_M = 0.5


@dataclass(frozen=True)
class Placement:
    """A node's pose: R_ned_body, and its camera's centre in NED (down is depth), metres."""

    R_ned_body: Matrix
    position_ned_m: Vector


class NodesMotion(Protocol):
    """Where each node of a scenario is at any time."""

    def placement(self, index: int, t_s: float) -> Placement:
        """Return where a node is at t_s."""
        ...


class PairMotion:
    """The two nodes' motion: A stays and sways; B moves away and back, and circles in front of A.

    At each range the angles scale with the free space that the bar leaves in the picture. So the lights are in view
    most of the time, but not always. Times in seconds since the start.
    """

    def __init__(self, scenario: Scenario) -> None:
        rng = generator(scenario.seed, "motion")
        # All messages of one instant need the same two placements.
        self.placement = lru_cache(maxsize=16)(self._placement)
        self._scenario = scenario
        self._heading_rad = float(rng.uniform(-math.pi, math.pi))
        self._phases = [float(p) for p in rng.uniform(0, 2 * math.pi, 3)]
        self._circle_s = float(rng.uniform(15, 24))
        span_m = scenario.far_m - scenario.range_min_m
        self._cycle_s = max(math.pi * span_m / SPEED_MPS, 20.0)
        self._turn = [[Sway(rng, 4.0, 14.0) for _ in range(3)] for _ in range(2)]
        self._drift = [[Sway(rng, 5.0, 16.0) for _ in range(3)] for _ in range(2)]
        self._elevation = Sway(rng, 25.0, 60.0)
        cameras = [scenario.camera(i) for i in range(2)]
        self._half_h_rad = min(math.atan(scenario.width_px / 2 / c.fx_px) for c in cameras)
        self._half_v_rad = min(math.atan(scenario.height_px / 2 / c.fy_px) for c in cameras)
        self._half_bar_m = 0.55 * max(scenario.baseline_a_m, scenario.baseline_b_m)

    def _placement(self, index: int, t_s: float) -> Placement:
        """Return where A (0) or B (1) is at t_s."""
        if self._scenario.trajectory == "rest":
            t_s = 0.0
        return self._a(t_s) if index == 0 else self._b(t_s)

    def range_m(self, t_s: float) -> float:
        """Return the nominal range, before sway."""
        s = self._scenario
        if s.trajectory == "rest":
            return (s.range_min_m + s.far_m) / 2
        cycle = 0.5 - 0.5 * math.cos(2 * math.pi * t_s / self._cycle_s)
        shape = 0.86 + 0.14 * math.sin(2 * math.pi * t_s / (1.618 * self._cycle_s) + self._phases[0])
        return s.range_min_m + (s.far_m - s.range_min_m) * cycle * shape

    def _room_rad(self, t_s: float) -> tuple[float, float]:
        """Return how far (across, up) the other node may be from the picture's centre, rad."""
        range_m = self.range_m(t_s)
        across = self._half_h_rad - math.atan(self._half_bar_m / range_m) - MARGIN_RAD
        up = self._half_v_rad - math.atan(0.35 * self._half_bar_m / range_m) - MARGIN_RAD
        return _soft_positive(across), _soft_positive(up)

    def _a(self, t_s: float) -> Placement:
        across_rad, up_rad = self._room_rad(t_s)
        roll, pitch, yaw = (sway(t_s) for sway in self._turn[0])
        R = rotation.from_euler(
            math.radians(5) * roll,
            0.2 * up_rad * pitch,
            self._heading_rad + 0.25 * across_rad * yaw + self._looking_away_rad(0, t_s),
        )
        drift_m = np.array([0.08, 0.08, 0.10]) * [sway(t_s) for sway in self._drift[0]]
        return Placement(R, np.array([0.0, 0.0, self._scenario.water.depth_m]) + drift_m)

    def _b(self, t_s: float) -> Placement:
        water = self._scenario.water
        across_rad, up_rad = self._room_rad(t_s)
        range_m = self.range_m(t_s)
        turn = 2 * math.pi * t_s / self._circle_s
        azimuth = 0.55 * across_rad * math.sin(turn + self._phases[1])
        elevation = up_rad * (0.45 * math.cos(turn + self._phases[1]) + 0.2 * self._elevation(t_s))
        climb_m = within(
            range_m * math.sin(elevation),
            water.depth_m - CLEARANCE_M,
            (water.floor_depth_m or math.inf) - water.depth_m - CLEARANCE_M,
        )
        flat_m = math.sqrt(max(range_m**2 - climb_m**2, 0.0))
        bearing = self._heading_rad + azimuth
        drift_m = np.array([0.06, 0.06, 0.06]) * [sway(t_s) for sway in self._drift[1]]
        offset = np.array([flat_m * math.cos(bearing), flat_m * math.sin(bearing), -climb_m])
        roll, pitch, yaw = (sway(t_s) for sway in self._turn[1])
        R = rotation.from_euler(
            math.radians(14) * roll,
            -math.asin(climb_m / range_m) + 0.4 * up_rad * pitch,
            bearing + math.pi + 0.5 * across_rad * yaw + self._looking_away_rad(1, t_s),
        )
        return Placement(R, offset + drift_m + [0.0, 0.0, water.depth_m])

    def _looking_away_rad(self, index: int, t_s: float) -> float:
        return look_away_rad(self._scenario.seed, index, t_s) if self._scenario.interruptions else 0.0


def look_away_rad(seed: int, index: int, t_s: float) -> float:
    """Return by how much a node looks away at t_s."""
    begin_s, length_s, angle_rad = _look_away(seed, index, math.floor(t_s / LOOK_AWAY_PERIOD_S))
    inside = (t_s - begin_s) / length_s
    return angle_rad * math.sin(math.pi * inside) ** 2 if 0 < inside < 1 else 0.0


@lru_cache(maxsize=64)
def _look_away(seed: int, index: int, window: int) -> tuple[float, float, float]:
    """Return begin (s), length (s) and angle (rad) of a window's one look away; the angle is 0 for none."""
    if window < 0:
        return 0.0, 1.0, 0.0
    rng = generator(seed, "look_away", index, window)
    length_s = float(rng.uniform(2.0, 5.0))
    begin_s = window * LOOK_AWAY_PERIOD_S + float(rng.uniform(4.0, LOOK_AWAY_PERIOD_S - length_s))
    angle_rad = float(rng.choice([-1.0, 1.0]) * math.radians(rng.uniform(25, 45)))
    return begin_s, length_s, angle_rad if rng.random() < LOOK_AWAY_SHARE else 0.0


def _soft_positive(angle_rad: float) -> float:
    """Keep an angle above 0 by a smooth function."""
    scale = math.radians(1.5)
    return scale * math.log1p(math.exp(angle_rad / scale)) if angle_rad < 30 * scale else angle_rad


def within(climb_m: float, up_m: float, down_m: float) -> float:
    """Keep a climb between up_m and -down_m by a smooth function; inf for no limit."""
    room_m = up_m if climb_m > 0 else down_m
    return climb_m if math.isinf(room_m) else room_m * math.tanh(climb_m / room_m)
