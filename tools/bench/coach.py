"""The coach: how often its words, followed, give a fix within 5 s, in simulated dives that have lost it or had none.

As dives have it: in the simulator's dives the divers look away, or something passes before a lamp, or a lamp is dead,
the water silts up, or B swims out of sight. From a second on without a pose both stay as they are. Made cases: one
diver or both turn away, or B drifts off; or they begin so that not both see both lamps.

Once no trigger has given a pose for two seconds, each diver does what the solver's status says, whenever it says
something new, REACTION_S after it. An amount counts from where the diver was when it came. A fix is a right pose:
within a tenth of the range of the truth.

How fast divers swim and turn: `steering`. Reaction: Green, How Long Does It Take to Stop?, 2000: 0.7 to 0.75 s to what
is expected.
"""

from __future__ import annotations

import argparse
import math
import re
import statistics
from collections import deque
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from buddyline.node.sim import candidates
from buddyline.node.sim.rotation import Vector
from buddyline.node.sim.scenario import Environment, Scenario
from buddyline.node.sim.scene import Scene
from buddyline.node.sim.trajectory import PairMotion
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.health import NO_POSE_S
from buddyline.protocol.options import finite
from buddyline.tools.bench.steering import (
    RAMP_S,
    SEEN_SHARE,
    START_NS,
    SWIM_MPS,
    TICK_S,
    TURN_DEGPS,
    Murky,
    SteeredDive,
    Steering,
)
from buddyline.tools.measure.tables import text_table

CASES: Final = (
    *("one turns away", "both turn away", "one looks up or down", "B drifts off"),
    *("never: a lamp beyond each border", "never: one looks away", "never: one looks up or down"),
    *("never: both look away", "never: too far", "never: too near", "never: a lamp is dark"),
)
DIVES: Final = ("a dive", "a dive in which a lamp goes out", "a dive in silt", "a dive out of sight")
NEVER: Final = "never: "
WATERS: Final[tuple[Environment, ...]] = ("cavern", "night_reef", "lake", "basin")
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
# The status comes once a second, and sooner where the words have changed, as the live solver looks.
STATUS_S: Final = 1.0
CHANGED_S: Final = 0.5
# Out of sight is beyond the longest range of the water's dives; in silt beyond this, with so many specks.
SILT_M: Final = 5.0
SILT_LIGHTS: Final = 12
# In dives, both stay as they are from this time without a pose on.
STAYS_S: Final = 1.0
LEAD_S: Final = 6.0
DIVE_S: Final = 120.0
# A diver who is told that a lamp is dark takes so long to light it.
SWITCH_S: Final = 2.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmark's arguments."""
    parser.add_argument("--case", choices=(*DIVES, *CASES), action="append", help="may be given again; default: all")
    parser.add_argument("--dives", type=int, default=20, help="of each case; default: 20")
    parser.add_argument("--no-imu", action="store_true", help="nodes have attitude and depth, no inertial samples")
    parser.add_argument("--seed", type=int, default=1, help="default: 1")
    parser.add_argument("--turn", type=finite, default=TURN_DEGPS, metavar="DEG", help="a second; default: %(default)g")


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


def some_lamp(seed: int) -> str:
    """Return the lamp that is dark in a case: each of the four in turn, in each water."""
    return f"{'ab'[seed // 4 % 2]}.{('left', 'right')[seed // 8 % 2]}"


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
    lamp = some_lamp(seed) if case.endswith("out") else ""
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
        if case.endswith("dark"):
            return begin if lamps_in_view(environment, seed, begin) == [2, 2] else None
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
        if case.endswith("dark"):
            dive.put_out(some_lamp(seed))
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
