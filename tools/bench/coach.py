"""The coach: how often its words, followed, give a fix within 5 s, in simulated dives that have lost it or had none.

One diver or both turn away, or B drifts off, until no trigger has given a pose for two seconds; or they begin so that
not both see both lamps. Then each diver does what the solver's status says, as it comes once a second, from half a
second after it: 45 degrees and 0.5 m a second. An amount counts from where the diver was when it came.
"""

from __future__ import annotations

import argparse
import math
import re
import statistics
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from buddyline.node.sim import rotation
from buddyline.node.sim.dive import ATTITUDE_NS, BOOT, DEPTH_NS, IMU_NS
from buddyline.node.sim.rotation import Vector
from buddyline.node.sim.scenario import Environment, Scenario
from buddyline.node.sim.trajectory import NodesMotion, PairMotion, Placement
from buddyline.node.sim.world import World
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.health import NO_POSE_S
from buddyline.protocol.messages import Message, RelativePose
from buddyline.solver_service.config import SolveConfig
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.tracking import TrackSettings
from buddyline.tools.measure.tables import text_table

CASES: Final = (
    *("one turns away", "both turn away", "one looks up or down", "B drifts off"),
    *("never: a lamp beyond each border", "never: one looks away", "never: one looks up or down"),
    *("never: both look away", "never: too far", "never: too near"),
)
NEVER: Final = "never: "
WATERS: Final[tuple[Environment, ...]] = ("cavern", "night_reef", "lake", "basin")
START_NS: Final = 1_764_000_000 * S_NS
TICK_NS: Final = S_NS // 10
TICK_S: Final = TICK_NS / S_NS
# A fix counts if it comes within this time after the first words.
WITHIN_S: Final = 5.0
# So long the divers swim undisturbed before one turns away.
SETTLE_S: Final = 8.0
# A dive that has not found its fix, or not lost it, by then does not count.
LOSE_WITHIN_S: Final = 40.0
# So long divers that never had a fix are watched before the first words count.
WATCHED_S: Final = 2.0
TRIES: Final = 40
REACTION_S: Final = 0.5
TURN_DEGPS: Final = 45.0
SWIM_MPS: Final = 0.5
# In this time a diver reaches a rate, and gives it up.
RAMP_S: Final = 0.4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmark's arguments."""
    parser.add_argument("--case", choices=CASES, action="append", help="may be given again; default: all")
    parser.add_argument("--dives", type=int, default=20, help="of each case; default: 20")
    parser.add_argument("--no-imu", action="store_true", help="nodes have attitude and depth, no inertial samples")
    parser.add_argument("--seed", type=int, default=1, help="default: 1")
    parser.add_argument("--turn", type=float, default=TURN_DEGPS, metavar="DEG", help="a second; default: %(default)g")


class Steering(NodesMotion):
    """A motion, and what the divers add to it: A's turn right and down, B's turn right and down, B's way away from A.

    begin (5,): what is added from the start on. rates (5,): of what is added, deg/s and m/s; most (5,): the greatest.
    They change as smoothly as divers can change them.
    """

    def __init__(self, base: NodesMotion, begin: Vector | None = None, turn_degps: float = TURN_DEGPS) -> None:
        self._base = base
        self.most = np.array([turn_degps] * 4 + [SWIM_MPS])
        self._until_s = 0.0
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
        begin_s, value, rates, change = self._pieces[min(max(int(t_s / TICK_S) + 1, 0), len(self._pieces) - 1)]
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
        environment: Environment,
        seed: int,
        *,
        imu: bool,
        begin: Vector | None = None,
        turn_degps: float = TURN_DEGPS,
    ) -> None:
        scenario = Scenario(environment=environment, seed=seed, start_ns=START_NS, interruptions=False)
        self.motion = Steering(PairMotion(scenario), begin, turn_degps)
        self._world, self._imu, self._seq = World(scenario, self.motion), imu, 0
        settings = TrackSettings(modes=frozenset(("filter",)), rate_hz=20.0)
        self._core = SolverCore(SolveConfig().settings("bench"), [("a", "b")], track=settings)
        for node in "ab":
            self._core.handle(self._world.info(node, START_NS, TICK_NS))
        self.now_ns = START_NS
        self.posed_ns = START_NS

    @property
    def t_s(self) -> float:
        """Seconds since the start."""
        return (self.now_ns - START_NS) / S_NS

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
        self.posed_ns = max([self.posed_ns, *(pose.stamp_ns for pose in poses)])

    def without_s(self) -> float:
        """Return the time since the last pose."""
        return (self.now_ns - self.posed_ns) / S_NS

    def advice(self) -> list[str]:
        """Return what the solver's status says now."""
        return self._core.pairs["a", "b"].advice()


def asked_for(words: list[str]) -> Vector:
    """Return how much words ask for of each of the five that are steered."""
    asked = np.zeros(5)
    for phrase in words:
        if turn := re.match(r"turn (\w) ", phrase):
            for amount, side in re.findall(r"(\d+) deg (\w+)", phrase):
                column = 2 * "ab".index(turn[1]) + (side in ("down", "up"))
                asked[column] = float(amount) * (1.0 if side in ("right", "down") else -1.0)
        elif way := re.match(r"(come|move) ([\d.]+) m", phrase):
            asked[4] = float(way[2]) * (1.0 if way[1] == "move" else -1.0)
    return asked


def losing(case: str, rng: np.random.Generator) -> Callable[[float], Vector]:
    """Return the rates of steering by which the fix is lost, by seconds since it began."""
    away, side = float(rng.uniform(40.0, 120.0)), rng.choice((-1.0, 1.0), 2)
    rates, lasts_s = np.zeros(5), 0.0
    if case == "one turns away":
        rates[2 * int(rng.integers(2))] = side[0] * 60.0
        lasts_s = away / 60.0
    elif case == "both turn away":
        rates[[0, 2]] = side * 60.0
        lasts_s = away / 60.0
    elif case == "one looks up or down":
        rates[2 * int(rng.integers(2)) + 1] = side[0] * 40.0
        lasts_s = float(rng.uniform(35.0, 60.0)) / 40.0
    else:
        rates[4], lasts_s = SWIM_MPS, math.inf
    return lambda since_s: rates if since_s < lasts_s else np.zeros(5)


def lamps_in_view(environment: Environment, seed: int, begin: Vector) -> list[int]:
    """Return how many lamps each node sees at the start of a dive that begins so."""
    scenario = Scenario(environment=environment, seed=seed, start_ns=START_NS, interruptions=False)
    world = World(scenario, Steering(PairMotion(scenario), begin))
    return [sum(lamp.visible for lamp in world.light_truth(node, START_NS, 0).lights) for node in "ab"]


def beginning(environment: Environment, case: str, seed: int, rng: np.random.Generator) -> Vector | None:
    """Return how divers stand that have no fix yet; None if this dive has no such beginning."""
    one, side = int(rng.integers(2)), rng.choice((-1.0, 1.0), 2)
    for k in range(TRIES):
        begin = np.zeros(5)
        if case.endswith("border"):
            begin[[0, 2]] = side * k
        elif case.endswith("one looks away"):
            begin[2 * one] = side[0] * rng.uniform(40.0, 120.0)
        elif case.endswith("down"):
            begin[2 * one + 1] = side[0] * rng.uniform(35.0, 60.0)
        elif case.endswith("both look away"):
            begin[[0, 2]] = side * rng.uniform(40.0, 120.0, 2)
        elif case.endswith("far"):
            begin[4] = float(k)
        else:
            begin[4] = -k / TRIES
        seen = lamps_in_view(environment, seed, begin)
        if seen == [1, 1] if case.endswith("border") else max(seen) < 2 if case.endswith("near") else min(seen) < 2:
            return begin
    return None


def lose(
    environment: Environment, case: str, seed: int, *, imu: bool, turn_degps: float = TURN_DEGPS
) -> SteeredDive | None:
    """Return a dive that has lost its fix, or never had one; None where the case does not come about."""
    rng, still = np.random.default_rng(seed), np.zeros(5)
    if case.startswith(NEVER):
        begin = beginning(environment, case, seed, rng)
        if begin is None:
            return None
        dive = SteeredDive(environment, seed, imu=imu, begin=begin, turn_degps=turn_degps)
        while dive.t_s < WATCHED_S:
            dive.tick(still)
        return dive if dive.posed_ns == START_NS else None
    dive = SteeredDive(environment, seed, imu=imu, turn_degps=turn_degps)
    while dive.t_s < SETTLE_S or dive.without_s() > 0.3:
        dive.tick(still)
        if dive.t_s > LOSE_WITHIN_S:
            return None
    lost, began_s = losing(case, rng), dive.t_s
    while dive.without_s() < NO_POSE_S:
        dive.tick(lost(dive.t_s - began_s))
        if dive.t_s > began_s + LOSE_WITHIN_S:
            return None
    return dive


def follow(
    environment: Environment, case: str, seed: int, *, imu: bool, turn_degps: float = TURN_DEGPS
) -> float | None:
    """Return the time from the first words to a fix, s; inf if there were none in time, None if no fix was missing."""
    dive = lose(environment, case, seed, imu=imu, turn_degps=turn_degps)
    if dive is None:
        return None
    told_s, asked, heard = dive.t_s, np.zeros(5), np.zeros(5)
    heard_s = told_s - 1.0
    while dive.without_s() > 0.05:
        if dive.t_s - told_s > WITHIN_S - TICK_S / 2:
            return math.inf
        if dive.t_s - heard_s > 1.0 - TICK_S / 2:
            heard, heard_s = asked_for(dive.advice()), dive.t_s
        if heard.any() and dive.t_s - heard_s > REACTION_S - TICK_S / 2:
            asked, heard = heard, np.zeros(5)
        # The rate falls toward the end, so that it is reached without going too far.
        dive.tick(np.clip(asked / RAMP_S, -dive.motion.most, dive.motion.most))
        for still_to_do in (asked, heard):
            np.subtract(still_to_do, dive.motion.rates * TICK_S, out=still_to_do, where=still_to_do != 0.0)
        asked[np.abs(asked) < (1.0, 1.0, 1.0, 1.0, 0.05)] = 0.0
    return dive.t_s - told_s


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Return, of each case, the times to a fix and the share within 5 s."""
    found: dict[str, Any] = {}
    for case in args.case or CASES:
        times_s = [
            follow(WATERS[k % len(WATERS)], case, 1000 * args.seed + k, imu=not args.no_imu, turn_degps=args.turn)
            for k in range(args.dives)
        ]
        counted = [one for one in times_s if one is not None]
        fixed = [one for one in counted if one < math.inf]
        found[case] = {
            "lost": len(counted),
            "fixed": len(fixed),
            "share": len(fixed) / len(counted) if counted else None,
            "median_s": statistics.median(fixed) if fixed else None,
        }
    return found


def table(figures: dict[str, Any]) -> str:
    """Return the figures for a person."""
    rows = [("no fix because", "dives", "fix within 5 s", "median, s")]
    for case, one in figures.items():
        median = "-" if one["median_s"] is None else f"{one['median_s']:.1f}"
        rows.append((case, str(one["lost"]), f"{one['fixed']}", median))
    return text_table(rows)
