"""The motion of more than two nodes, or of nodes some of which are fixed: two groups that face each other."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np
from buddyline.node.sim import rotation
from buddyline.node.sim.randomness import Sway, generator
from buddyline.node.sim.rotation import Vector
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.trajectory import CLEARANCE_M, MARGIN_RAD, SPEED_MPS, Placement, look_away_rad, within

# Between neighbours of a group: two bars side by side do not cover each other.
SPACING_M: Final = 1.3
# The groups are at least so many of their widths apart: nearer, a camera does not hold a whole group.
NEAREST_WIDTHS: Final = 3.0
DRIFT_M: Final = 0.2


class TeamMotion:
    """Nodes 0, 2, 4, ... stay and sway; nodes 1, 3, 5, ... move away and back, and circle in front of them.

    Each node looks at the middle of the other group: it sees that group's nodes, and none of its own group.
    Fixed nodes do not move. Times in seconds since the start.
    """

    def __init__(self, scenario: Scenario) -> None:
        rng = generator(scenario.seed, "team")
        self.placement = lru_cache(maxsize=64)(self._placement)
        self._scenario = scenario
        nodes = scenario.nodes
        self._fixed = [node in scenario.fixed_nodes for node in nodes]
        self._heading_rad = float(rng.uniform(-math.pi, math.pi))
        self._phases = [float(phase) for phase in rng.uniform(0, 2 * math.pi, 2)]
        self._circle_s = float(rng.uniform(15, 24))
        self._turn = [[Sway(rng, 4.0, 14.0) for _ in range(3)] for _ in nodes]
        self._drift = [[Sway(rng, 5.0, 16.0) for _ in range(3)] for _ in nodes]
        self._along_m = rng.uniform(-0.4, 0.4, len(nodes))
        sizes = (len(nodes) + 1) // 2, len(nodes) // 2
        self._sizes = sizes
        half_group_m = SPACING_M * (max(sizes) - 1) / 2 + 0.55 * max(scenario.baseline_m(i) for i in range(2))
        self._half_group_m = half_group_m
        self._near_m = max(scenario.range_min_m, NEAREST_WIDTHS * SPACING_M * (max(sizes) - 1))
        self._far_m = max(scenario.far_m, self._near_m + 0.5)
        self._cycle_s = max(math.pi * (self._far_m - self._near_m) / SPEED_MPS, 20.0)
        cameras = [scenario.camera(i) for i in range(2)]
        self._half_h_rad = min(math.atan(scenario.width_px / 2 / c.fx_px) for c in cameras)
        self._half_v_rad = min(math.atan(scenario.height_px / 2 / c.fy_px) for c in cameras)

    def _placement(self, index: int, t_s: float) -> Placement:
        """Return where a node is at t_s."""
        if self._scenario.trajectory == "rest":
            t_s = 0.0
        group, fixed = index % 2, self._fixed[index]
        own_m, other_m = (self._centre_m(each, None if fixed else t_s) for each in (group, 1 - group))
        position_m = own_m + self._offset_m(index)
        if not fixed:
            position_m = position_m + DRIFT_M * np.array([sway(t_s) for sway in self._drift[index]])
        toward_m = other_m - (own_m + self._offset_m(index))
        flat_m = math.hypot(toward_m[0], toward_m[1])
        bearing, climb = math.atan2(toward_m[1], toward_m[0]), math.atan2(-toward_m[2], flat_m)
        across_rad, up_rad = self._room_rad(flat_m)
        roll, pitch, yaw = (0.0, 0.0, 0.0) if fixed else (sway(t_s) for sway in self._turn[index])
        away_rad = 0.0 if fixed or not self._scenario.interruptions else look_away_rad(self._scenario.seed, index, t_s)
        return Placement(
            rotation.from_euler(
                math.radians(5 if group == 0 else 14) * roll,
                climb + 0.4 * up_rad * pitch,
                bearing + 0.4 * across_rad * yaw + away_rad,
            ),
            position_m,
        )

    def _centre_m(self, group: int, t_s: float | None) -> Vector:
        """Return the middle of a group in NED at t_s; for None its mean place, around which its fixed nodes stand."""
        water = self._scenario.water
        if group == 0:
            return np.array([0.0, 0.0, water.depth_m])
        range_m, azimuth, elevation = (self._near_m + self._far_m) / 2, 0.0, 0.0
        if t_s is not None:
            cycle = 0.5 - 0.5 * math.cos(2 * math.pi * t_s / self._cycle_s)
            range_m = self._near_m + (self._far_m - self._near_m) * cycle
            across_rad, up_rad = self._room_rad(range_m)
            turn = 2 * math.pi * t_s / self._circle_s + self._phases[0]
            azimuth, elevation = 0.5 * across_rad * math.sin(turn), 0.4 * up_rad * math.cos(turn)
        climb_m = within(
            range_m * math.sin(elevation),
            water.depth_m - CLEARANCE_M,
            (water.floor_depth_m or math.inf) - water.depth_m - CLEARANCE_M,
        )
        flat_m = math.sqrt(max(range_m**2 - climb_m**2, 0.0))
        bearing = self._heading_rad + azimuth
        return np.array([flat_m * math.cos(bearing), flat_m * math.sin(bearing), water.depth_m - climb_m])

    def _offset_m(self, index: int) -> Vector:
        """Return a node's place in its group, NED."""
        slot, size = index // 2, self._sizes[index % 2]
        along_m, across_m = float(self._along_m[index]), SPACING_M * (slot - (size - 1) / 2)
        down_m = 0.3 * (-1.0) ** slot if size > 1 else 0.0
        c, s = math.cos(self._heading_rad), math.sin(self._heading_rad)
        return np.array([c * along_m - s * across_m, s * along_m + c * across_m, down_m])

    def _room_rad(self, range_m: float) -> tuple[float, float]:
        """Return how far (across, up) the other group may be from the picture's centre, rad."""
        across = self._half_h_rad - math.atan(self._half_group_m / range_m) - MARGIN_RAD
        up = self._half_v_rad - math.atan((0.3 + 0.15 * self._half_group_m) / range_m) - MARGIN_RAD
        return max(across, math.radians(1.0)), max(up, math.radians(1.0))
