"""The coach: how often its words, followed, give a fix within 5 s, in simulated dives that have lost it or had none.

As dives have it: in the simulator's dives the divers look away, or something passes before a lamp, or a lamp is dead,
the water silts up, or B swims out of sight. From a second on without a pose both stay as they are. Made cases: one
diver or both turn away, or B drifts off; or they begin so that not both see both lamps.

Once no trigger has given a pose for two seconds, each diver does what the solver's status says, whenever it says
something new, REACTION_S after it. An amount counts from where the diver was when it came. A fix is a right pose:
within a tenth of the range of the truth.

Swimming: Dwyer and Lanphier, Oxygen Consumption in Underwater Swimming, 1954: 0.8 to 0.9 knot is normal. Reaction:
Green, How Long Does It Take to Stop?, 2000: 0.7 to 0.75 s to what is expected. No figure of how fast a diver turns was
found; 45 degrees a second is an assumption (`--turn`).
"""

from __future__ import annotations

import argparse
import math
import re
import statistics
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import numpy as np
from buddyline.node.sim import candidates, rotation
from buddyline.node.sim.dive import ATTITUDE_NS, BOOT, DEPTH_NS, IMU_NS
from buddyline.node.sim.glow import SCALE_PX, stands_out
from buddyline.node.sim.rotation import Vector
from buddyline.node.sim.scenario import Environment, Scenario, Water
from buddyline.node.sim.scene import Lamp, Scene
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
DIVES: Final = ("a dive", "a dive in which a lamp goes out", "a dive in silt", "a dive out of sight")
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
REACTION_S: Final = 0.7
TURN_DEGPS: Final = 45.0
SWIM_MPS: Final = 0.44
# The status comes once a second, and sooner where the words have changed, as the live solver looks.
STATUS_S: Final = 1.0
CHANGED_S: Final = 0.5
# A pose further from the truth than this share of the range is no fix.
RIGHT_SHARE: Final = 0.1
# Out of sight is beyond the longest range of the water's dives; in silt beyond this, with so many specks.
SILT_M: Final = 5.0
SILT_LIGHTS: Final = 12
SEEN_SHARE: Final = 0.7
# In dives, both stay as they are from this time without a pose on.
STAYS_S: Final = 1.0
LEAD_S: Final = 6.0
DIVE_S: Final = 120.0
# In this time a diver reaches a rate, and gives it up.
RAMP_S: Final = 0.4
# A diver who is told that a lamp is dark takes so long to light it.
SWITCH_S: Final = 2.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmark's arguments."""
    parser.add_argument("--case", choices=(*DIVES, *CASES), action="append", help="may be given again; default: all")
    parser.add_argument("--dives", type=int, default=20, help="of each case; default: 20")
    parser.add_argument("--no-imu", action="store_true", help="nodes have attitude and depth, no inertial samples")
    parser.add_argument("--seed", type=int, default=1, help="default: 1")
    parser.add_argument("--turn", type=float, default=TURN_DEGPS, metavar="DEG", help="a second; default: %(default)g")


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


def dived(case: str, environment: Environment, seed: int) -> Scenario:
    """Return the simulated dive of a case in which things are as dives have them."""
    if case.endswith("silt"):
        far_m = SILT_M / SEEN_SHARE
        return Murky(environment, seed, START_NS, interruptions=False, range_max_m=far_m, false_lights=SILT_LIGHTS)
    found = Scenario(environment, seed, START_NS)
    if case.endswith("sight"):
        return Murky(environment, seed, START_NS, interruptions=False, range_max_m=found.far_m / SEEN_SHARE)
    return found


def missing(scene: Scene, t_s: float) -> list[str]:
    """Return why lamps are not seen, a word for each that is not."""
    words = []
    for index, rig in enumerate(scene.rigs):
        view = scene.view(index, t_s)
        for lamp in view.lights:
            if candidates.visible(scene, index, view, lamp):
                continue
            (u, v), (x, y, z) = lamp.pixel, np.mean([each.position_m for each in view.lights], axis=0)
            width_px, height_px, camera = scene.scenario.width_px, scene.scenario.height_px, rig.camera
            middle = abs(x / z) < width_px / 2 / camera.fx_px and abs(y / z) < height_px / 2 / camera.fy_px and z > 0
            if lamp.intensity == 0.0:
                words.append("dead lamp")
            elif not (-0.5 <= u <= width_px - 0.5 and -0.5 <= v <= height_px - 0.5):
                words.append("too near" if middle else "looks away")
            else:
                words.append("covered" if view.hidden(lamp.pixel) else "too faint")
    return words


def fade(
    case: str, environment: Environment, seed: int, *, imu: bool, turn_degps: float
) -> tuple[SteeredDive, str] | None:
    """Return a dive whose divers have lost the fix as dives do, and why; None if they have not."""
    scenario = dived(case, environment, seed)
    scene, since_s, dark = Scene(scenario), 0.0, 0
    lamp = f"{'ab'[seed // 4 % 2]}.{('left', 'right')[seed // 8 % 2]}" if case.endswith("out") else ""
    # A lamp goes out in the midst of a dive, or as soon as there is no pose.
    while dark < STAYS_S / TICK_S and not (lamp and since_s > DIVE_S / 4):
        since_s += TICK_S
        dark = dark + 1 if len(missing(scene, since_s)) > 1 and since_s > LEAD_S else 0
        if since_s > DIVE_S:
            return None
    dive = SteeredDive(scenario, imu=imu, turn_degps=turn_degps, since_s=since_s - LEAD_S)
    dive.base.stays_s = since_s
    while dive.t_s < LEAD_S or dive.without_s() < NO_POSE_S:
        if lamp and dive.t_s > LEAD_S - TICK_S / 2:
            dive.put_out(lamp)
        dive.tick(np.zeros(5))
        if dive.t_s > LEAD_S + 2 * NO_POSE_S:
            return None
    if dive.posed_ns == dive.since_ns:
        return None
    why = missing(Scene(dive.scenario, dive.motion), (dive.now_ns - START_NS) / S_NS)
    return dive, max(sorted(set(why)), key=why.count) if why else "none missing"


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
    scenario = Scenario(environment=environment, seed=seed, start_ns=START_NS, interruptions=False)
    if case.startswith(NEVER):
        begin = beginning(environment, case, seed, rng)
        if begin is None:
            return None
        dive = SteeredDive(scenario, imu=imu, begin=begin, turn_degps=turn_degps)
        while dive.t_s < WATCHED_S:
            dive.tick(still)
        return dive if dive.posed_ns == START_NS else None
    dive = SteeredDive(scenario, imu=imu, turn_degps=turn_degps)
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


def _is_named(lamp: str, words: list[str]) -> bool:
    node, side = lamp.split(".")
    return any(phrase.startswith(f"{side} lamp of {node} is") for phrase in words)


def follow(dive: SteeredDive, within_s: float = WITHIN_S) -> float:
    """Return the time from the first words to a fix, s, the words followed; inf if there were none in time."""
    told_s, asked, words = dive.t_s, np.zeros(5), [""]
    heard: deque[tuple[float, Vector]] = deque()
    looked_s = heard_s = -math.inf
    lit_s = math.inf
    while dive.without_s() > 0.05:
        if dive.t_s - told_s > within_s - TICK_S / 2:
            return math.inf
        if dive.t_s - looked_s > CHANGED_S - TICK_S / 2:
            looked_s, said = dive.t_s, dive.advice()
            if said != words or dive.t_s - heard_s > STATUS_S - TICK_S / 2:
                words, heard_s = said, dive.t_s
                if any(_is_named(lamp, said) for lamp in dive.scenario.dead_lamps):
                    lit_s = min(lit_s, dive.t_s + REACTION_S + SWITCH_S)
                heard.append((dive.t_s, asked_for(words)))
        while heard and dive.t_s - heard[0][0] > REACTION_S - TICK_S / 2:
            if (new := heard.popleft()[1]).any():
                asked = new
        if dive.t_s > lit_s:
            dive.put_out()
            lit_s = math.inf
        # The rate falls toward the end, so that it is reached without going too far.
        dive.tick(np.clip(asked / RAMP_S, -dive.motion.most, dive.motion.most))
        for still_to_do in (asked, *(one for _, one in heard)):
            np.subtract(still_to_do, dive.motion.rates * TICK_S, out=still_to_do, where=still_to_do != 0.0)
        asked[np.abs(asked) < (1.0, 1.0, 1.0, 1.0, 0.05)] = 0.0
    return dive.t_s - told_s


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Return, of each case, the times to a fix and the share within 5 s."""
    times_s: dict[str, list[float]] = {}
    for case in args.case or (*DIVES, *CASES):
        for k in range(args.dives):
            water, seed, why = WATERS[k % len(WATERS)], 1000 * args.seed + k, ""
            if case in DIVES:
                faded = fade(case, water, seed, imu=not args.no_imu, turn_degps=args.turn)
                dive, why = (None, "") if faded is None else (faded[0], f": {faded[1]}")
            else:
                dive = lose(water, case, seed, imu=not args.no_imu, turn_degps=args.turn)
            if dive is not None:
                times_s.setdefault(f"{case}{why}", []).append(follow(dive))
    found: dict[str, Any] = {}
    for case, counted in times_s.items():
        fixed = [one for one in counted if one < math.inf]
        found[case] = {
            "lost": len(counted),
            "fixed": len(fixed),
            "share": len(fixed) / len(counted),
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
