"""Simulated divers who are steered while they dive: turned, moved, stopped, a lamp put out; and the solver's view.

Swimming: Dwyer and Lanphier, Oxygen Consumption in Underwater Swimming, 1954: 0.8 to 0.9 knot is normal. No figure of
how fast a diver turns was found; 45 degrees a second is an assumption.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from buddyline.node.sim import rotation
from buddyline.node.sim.dive import ATTITUDE_NS, BOOT, DEPTH_NS, IMU_NS
from buddyline.node.sim.glow import SCALE_PX, stands_out
from buddyline.node.sim.rotation import Vector
from buddyline.node.sim.scenario import Scenario, Water
from buddyline.node.sim.scene import Lamp
from buddyline.node.sim.trajectory import NodesMotion, PairMotion, Placement
from buddyline.node.sim.world import World
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.messages import Message, RelativePose
from buddyline.solver_service.config import SolveConfig
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.tracking import TrackSettings

START_NS: Final = 1_764_000_000 * S_NS
TICK_NS: Final = S_NS // 10
TICK_S: Final = TICK_NS / S_NS
TURN_DEGPS: Final = 45.0
SWIM_MPS: Final = 0.44
# In this time a diver reaches a rate, and gives it up.
RAMP_S: Final = 0.4
# A pose further from the truth than this share of the range is no fix.
RIGHT_SHARE: Final = 0.1
# In murky water a lamp is seen from this share of the longest range.
SEEN_SHARE: Final = 0.7


@dataclass(frozen=True)
class Murky(Scenario):
    """A dive in water that is so thick that a lamp is seen from SEEN_SHARE of the longest range."""

    @property
    def water(self) -> Water:
        """Optics of the environment."""
        return thickened(super().water, SEEN_SHARE * self.far_m)


@lru_cache
def thickened(water: Water, seen_m: float) -> Water:
    """Return water of which as much more is dissolved and stirred up that a lamp is just not seen at seen_m."""
    on_axis = np.array((0.0, 0.0, 1.0))
    lamp = Lamp(seen_m * on_axis, -on_axis, np.zeros(2), 1.0, math.radians(12.0))
    thick = 1.0
    while stands_out(lamp, water_of(water, thick), SCALE_PX):
        thick *= 1.05
    return water_of(water, thick)


def water_of(water: Water, thick: float) -> Water:
    """Return water with its absorption and scattering multiplied."""
    (b, g, r), (sb, sg, sr) = water.absorption_per_m, water.scattering_per_m
    absorption, scattering = (thick * b, thick * g, thick * r), (thick * sb, thick * sg, thick * sr)
    return replace(water, absorption_per_m=absorption, scattering_per_m=scattering)


class Stayed(NodesMotion):
    """A motion that comes to rest once its nodes are told to stay."""

    def __init__(self, base: NodesMotion) -> None:
        self._base = base
        self.stays_s = math.inf

    def placement(self, index: int, t_s: float) -> Placement:
        """Return where a node is at t_s."""
        over_s = max(t_s - self.stays_s, 0.0)
        return self._base.placement(index, t_s - over_s + RAMP_S * -math.expm1(-over_s / RAMP_S))


class Steering(NodesMotion):
    """A motion, and what the divers add to it: A's turn right and down, B's turn right and down, B's way away from A.

    begin (5,): what is added from the start on. rates (5,): of what is added, deg/s and m/s; most (5,): the greatest.
    They change as smoothly as divers can change them.
    """

    def __init__(
        self, base: NodesMotion, begin: Vector | None = None, turn_degps: float = TURN_DEGPS, since_s: float = 0.0
    ) -> None:
        self._base = base
        self.most = np.array([turn_degps] * 4 + [SWIM_MPS])
        self._since_s = self._until_s = since_s
        self._pieces = [(0.0, np.zeros(5) if begin is None else begin, np.zeros(5), np.zeros(5))]
        self.rates = np.zeros(5)

    def steer(self, wanted: Vector) -> None:
        """Go on by a tick, toward these rates."""
        _, value, rates, change = self._pieces[-1]
        value, rates = value + rates * TICK_S + change * TICK_S**2 / 2, rates + change * TICK_S
        most = self.most / RAMP_S
        self._pieces.append((self._until_s, value, rates, np.clip((wanted - rates) / TICK_S, -most, most)))
        self._until_s += TICK_S
        self.rates = rates

    def added(self, t_s: float) -> Vector:
        """Return what has been added at t_s."""
        begin_s, value, rates, change = self._pieces[
            min(max(int((t_s - self._since_s) / TICK_S) + 1, 0), len(self._pieces) - 1)
        ]
        since_s = max(t_s - begin_s, 0.0)
        added: Vector = value + rates * since_s + change * since_s**2 / 2
        return added

    def placement(self, index: int, t_s: float) -> Placement:
        """Return where a node is at t_s."""
        placed, added = self._base.placement(index, t_s), self.added(t_s)
        right_rad, down_rad = np.radians(added[2 * index : 2 * index + 2]).tolist()
        R = rotation.from_euler(0.0, 0.0, right_rad) @ placed.R_ned_body @ rotation.from_euler(0.0, -down_rad, 0.0)
        position_m = placed.position_ned_m
        if index == 1:
            sight_m = (position_m - self._base.placement(0, t_s).position_ned_m) * (1.0, 1.0, 0.0)
            position_m = position_m + added[4] * sight_m / np.linalg.norm(sight_m)
        return Placement(R, position_m)


class SteeredDive:
    """A simulated dive that goes on tick by tick, with the solver that sees it."""

    def __init__(
        self,
        scenario: Scenario,
        *,
        imu: bool,
        begin: Vector | None = None,
        turn_degps: float = TURN_DEGPS,
        since_s: float = 0.0,
    ) -> None:
        self.base = Stayed(PairMotion(scenario))
        self.motion = Steering(self.base, begin, turn_degps, since_s)
        self.scenario = scenario
        self._world, self._imu, self._seq = World(scenario, self.motion), imu, 0
        settings = TrackSettings(modes=frozenset(("filter",)), rate_hz=20.0)
        self._core = SolverCore(SolveConfig().settings("bench"), [("a", "b")], track=settings)
        for node in "ab":
            self._core.handle(self._world.info(node, START_NS, TICK_NS))
        self.now_ns = self.posed_ns = self.since_ns = START_NS + round(since_s / TICK_S) * TICK_NS

    @property
    def t_s(self) -> float:
        """Seconds since the start."""
        return (self.now_ns - self.since_ns) / S_NS

    def tick(self, wanted: Vector) -> None:
        """Go on by a tick; wanted: rates of steering."""
        self.motion.steer(wanted)
        end_ns = self.now_ns + TICK_NS
        said: list[Message] = []
        for node in "ab":
            said += [self._world.attitude(node, ns) for ns in range(self.now_ns + ATTITUDE_NS, end_ns + 1, ATTITUDE_NS)]
            said += [self._world.depth(node, ns) for ns in range(self.now_ns + DEPTH_NS, end_ns + 1, DEPTH_NS)]
            if self._imu:
                said += [self._world.imu(node, ns) for ns in range(self.now_ns + 3 * MS_NS, end_ns, IMU_NS)]
            said.append(self._world.candidates(node, end_ns, end_ns // TICK_NS, self._seq, BOOT))
        self._seq += 1
        self.now_ns = end_ns
        poses = [one for one in self._core.handle_many(said) if isinstance(one, RelativePose)]
        self.posed_ns = max([self.posed_ns, *(pose.stamp_ns for pose in poses if self._is_right(pose))])

    def put_out(self, *lamps: str) -> None:
        """Go on with these lamps dark, such as `a.left`; with none, all are lit."""
        self.scenario = replace(self.scenario, dead_lamps=lamps)
        self._world = World(self.scenario, self.motion)

    def _is_right(self, pose: RelativePose) -> bool:
        t_m = np.array(self._world.truth(pose.stamp_ns, pose.trigger).t_a_b_m)
        return bool(np.linalg.norm(pose.t_a_b_m - t_m) < RIGHT_SHARE * np.linalg.norm(t_m))

    def without_s(self) -> float:
        """Return the time since the last pose."""
        return (self.now_ns - self.posed_ns) / S_NS

    def advice(self) -> list[str]:
        """Return what the solver's status says now."""
        return self._core.pairs["a", "b"].advice()
