"""Simulated lines that two nodes swim without long rests, through cameras, solver and track, against truth.

python -m tests.tools.swum_line                        # 20 dives of 12 legs, some 20 minutes
python -m tests.tools.swum_line --rest 10 --disturbed  # rests at every station, each fifth one disturbed

Each node in turn stands for some seconds while the other swims past it, on to the next station. Compasses err as
survey_world's do; all else is the simulator's own.
"""

from __future__ import annotations

import argparse
import math
from functools import lru_cache

import numpy as np
from buddyline.node.sim import rotation
from buddyline.node.sim.dive import DivePlan
from buddyline.node.sim.dive import messages as dive_messages
from buddyline.node.sim.randomness import Sway
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.trajectory import Placement
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Imu, NodeInfo, RelativePose, Track
from buddyline.solver_service.config import SolveConfig, track_settings
from buddyline.solver_service.core import SolverCore
from buddyline.tools.solve import TOGETHER
from buddyline.tools.survey.averages import wrap
from buddyline.tools.survey.derive import Derived
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.readings import of_messages
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from msgspec.structs import replace

from tests.tools import survey_world as world

SPEED_MPS, ASIDE_M = 0.35, 0.9
BEGIN_S = 3.0


class Leapfrog:
    """Who is where: at stations by turns, held with centering_m, and between them past the other one.

    arrivals, leaves: seconds at which both nodes hold still for each leg, and no longer do.
    """

    def __init__(self, course, rng, rest_s, flaws):
        self.course = course
        self.placement = lru_cache(maxsize=64)(self._placement)
        self.held_m = [place + rng.normal(0, flaws.centering_m, 3) for place in course.stations_m]
        self.arrivals, self.leaves, now_s = [], [], 0.0
        self.moves = []  # begin, end, node, curve
        for number, (start, end, rear) in enumerate(course.legs):
            self.arrivals.append(now_s)
            now_s += rng.uniform(*rest_s) + (BEGIN_S if number == 0 else 0.0)
            self.leaves.append(now_s)
            if number + 1 < len(course.legs):
                target = course.legs[number + 1][1]
                points_m = self.held_m[start], self.held_m[end], self.held_m[target]
                along_m = points_m[2] - points_m[0]
                side = np.array([-along_m[1], along_m[0], 0.0]) / max(math.hypot(along_m[0], along_m[1]), 0.1)
                past_m = points_m[1] + rng.choice([-1, 1]) * ASIDE_M * side
                sizes = np.linalg.norm(past_m - points_m[0]), np.linalg.norm(points_m[2] - past_m)
                share = sizes[0] / sum(sizes)
                moves_s = sum(sizes) / SPEED_MPS
                self.moves.append((now_s, now_s + moves_s, rear, (points_m[0], past_m, points_m[2], share)))
                now_s += moves_s
        self.seconds = now_s + 1.0
        self.sways = [[Sway(rng, 4.0, 14.0) for _ in range(6)] for _ in range(2)]
        first = course.legs[0]
        self.begin = {first[2]: self.held_m[first[0]], 1 - first[2]: self.held_m[first[1]]}

    def place_m(self, node, t_s):
        place = self.begin[node]
        for begin_s, end_s, mover, (a, b, c, share) in self.moves:
            if mover != node or t_s < begin_s:
                continue
            if t_s >= end_s:
                place = c
                continue
            u = (t_s - begin_s) / (end_s - begin_s)
            s = u**3 * (10 - 15 * u + 6 * u**2)
            place = (
                a * (s - share) * (s - 1) / share
                + b * s * (s - 1) / (share * (share - 1))
                + c * s * (s - share) / (1 - share)
            )
        return place

    def _placement(self, node, t_s):
        x, y, z, roll, pitch, yaw = (sway(t_s) for sway in self.sways[node])
        here_m = self.place_m(node, t_s)
        look_m = self.place_m(1 - node, t_s) - here_m
        R = rotation.from_euler(
            math.radians(6) * roll,
            math.atan2(-look_m[2], math.hypot(look_m[0], look_m[1])) + math.radians(4) * pitch,
            math.atan2(look_m[1], look_m[0]) + math.radians(5) * yaw,
        )
        return Placement(R, here_m + 0.01 * np.array([x, y, z]))


class _Compass:
    """What a node's attitude errs by: zero, iron, slow and new parts as survey_world has them; disturbed stations."""

    def __init__(self, rng, flaws, motion, index, disturbed_deg):
        self.rng, self.flaws, self.motion, self.index, self.disturbed_deg = rng, flaws, motion, index, disturbed_deg
        yaw = math.radians(flaws.compass_deg)
        self.offset, self.iron = rng.normal(0, yaw * math.sqrt(0.1)), rng.normal(0, yaw * math.sqrt(0.4), 2)
        self.slow, self.tilts = world._Slow(rng, 60.0), [world._Slow(rng, 15.0), world._Slow(rng, 15.0)]

    def disturbance_rad(self, t_s):
        here_m = self.motion.place_m(self.index, t_s)
        return sum(
            math.radians(angle) * math.exp(-(float(np.linalg.norm(here_m - self.motion.held_m[station])) ** 2))
            for station, angle in self.disturbed_deg.items()
        )

    def attitude(self, message, t_s):
        flaws, rng = self.flaws, self.rng
        yaw, tilt = math.radians(flaws.compass_deg), math.radians(flaws.tilt_deg)
        R = self.motion.placement(self.index, t_s).R_ned_body
        heading = math.atan2(R[1, 0], R[0, 0])
        error = self.offset + self.iron @ [math.cos(heading), math.sin(heading)] + self.disturbance_rad(t_s)
        error += yaw * (math.sqrt(0.4) * self.slow.at(t_s) + math.sqrt(0.1) * rng.normal())
        tilts = [tilt * (math.sqrt(0.7) * slow.at(t_s) + math.sqrt(0.3) * rng.normal()) for slow in self.tilts]
        R = rotation.from_euler(0, 0, error) @ R @ rotation.from_euler(tilts[0], tilts[1], 0)
        return replace(message, q_ned_body_xyzw=rotation.to_quaternion(R), sigma_rad=(tilt, tilt, yaw))


def swim(seed, legs=12, rest_s=(2.0, 4.0), disturbed=False, flaws=None):
    """Return the messages of a dive with poses and smoothed track, its motion and its course."""
    rng = np.random.default_rng([seed, 21])
    flaws = flaws or world.Flaws()
    course = world.line(rng, legs)
    motion = Leapfrog(course, rng, rest_s, flaws)
    scenario = Scenario(environment="cavern", seed=seed, start_ns=world.START_NS, interruptions=False)
    simulated = World(scenario, motion)
    bad = {}
    if disturbed:
        bad = {k: float(rng.choice([-1, 1]) * rng.uniform(10, 25)) for k in range(2, legs + 1, 5)}
    compasses = {name: _Compass(rng, flaws, motion, i, bad) for i, name in enumerate(world.NODES)}

    def flawed(message):
        if isinstance(message, NodeInfo):
            lights = np.array([message.light_left_m, message.light_right_m]) + rng.normal(0, 0.001, (2, 3))
            return replace(message, light_left_m=tuple(lights[0]), light_right_m=tuple(lights[1]))
        if isinstance(message, Attitude):
            t_s = (message.stamp_ns - world.START_NS) / S_NS
            return compasses[message.node].attitude(message, t_s)
        if isinstance(message, Imu) and bad:
            t_s, compass = (message.stamp_ns - world.START_NS) / S_NS, compasses[message.node]
            R = motion.placement(compass.index, t_s).R_ned_body
            turned = R.T @ rotation.from_euler(0, 0, -compass.disturbance_rad(t_s)) @ R
            return replace(message, mag_t=tuple((turned @ np.array(message.mag_t)).tolist()))
        return message

    plan = DivePlan(seconds=motion.seconds, imu=True)
    sent = [flawed(message) for _, _, message in dive_messages(simulated, plan)]
    core = SolverCore(SolveConfig().settings("test"), [world.NODES], track=track_settings("smooth", 20.0))
    solved = []
    for first in range(0, len(sent), TOGETHER):
        solved += core.handle_many(sent[first : first + TOGETHER])
    solved += core.flush()
    return sent + [one for one in solved if isinstance(one, RelativePose | Track)], motion, course


def judge(messages, motion, course, settings, *, turned=True):
    """Return a dive's figures by name, lists; those of its far end only where all legs are there.

    turned: with the gyroscopes' turns.
    """
    derived = Derived()
    derived.add(of_messages(messages), settings, AlarmSettings())
    names = [(course.names[start], course.names[end]) for start, end, _ in course.legs]
    found = {"legs": [len(derived.legs)], "right": [[(leg.from_, leg.to) for leg in derived.legs] == names]}
    if not found["right"][0]:
        return found
    project = world.project_of(
        derived.legs, turn=derived.turns if turned else [], swim=derived.swims, settings=settings
    )
    adjusted = adjust(project)
    at_m = dict(zip(course.names, map(world.enu, course.stations_m), strict=True))
    origin_m = adjusted.positions["0"].position_m - at_m["0"]
    azimuths = []
    for start, end in names:
        way_m = adjusted.positions[end].position_m - adjusted.positions[start].position_m
        true_m = at_m[end] - at_m[start]
        azimuths.append(math.degrees(wrap(math.atan2(*way_m[:2]) - math.atan2(*true_m[:2]))))
    found["azimuth scatter, deg"] = [float(np.std(azimuths))]
    far = names[-1][1]
    off_m = adjusted.positions[far].position_m - origin_m - at_m[far]
    covariance = adjusted.positions[far].covariance
    found["far end, m"] = [float(np.linalg.norm(off_m))]
    found["far end, chi2 / 2"] = [float(off_m[:2] @ np.linalg.solve(covariance[:2, :2], off_m[:2])) / 2]
    found["far end, up over sd"] = [float(off_m[2] / math.sqrt(covariance[2, 2]))]
    found["variance factor"] = [adjusted.fit.factor]
    found["swims"] = [len(adjusted.paths)]
    for path in adjusted.paths:
        node = world.NODES.index(path.swim.node)
        for seconds, place_m, spread in zip(
            path.seconds[1:-1], path.position_m[1:-1], path.covariance[1:-1], strict=True
        ):
            t_s = (path.swim.start_ns - world.START_NS) / S_NS + seconds
            off_m = place_m - origin_m - world.enu(motion.placement(node, t_s).position_ned_m)
            found.setdefault("path, m", []).append(float(np.linalg.norm(off_m)))
            found.setdefault("path, NEES / 3", []).append(float(off_m @ np.linalg.solve(spread, off_m)) / 3)
            local = off_m - (adjusted.positions[path.swim.station].position_m - origin_m - at_m[path.swim.station])
            found.setdefault("path from the standing node, m", []).append(float(np.linalg.norm(local)))
    return found


def main():
    """Print each dive's figures, and the mean and median of all."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--dives", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="seed of the first dive")
    parser.add_argument("--legs", type=int, default=12)
    parser.add_argument("--rest", type=float, default=2.0, help="seconds at each station, at least; at most twice that")
    parser.add_argument("--disturbed", action="store_true")
    args = parser.parse_args()
    every = {}
    settings = SurveySettings(pause_s=min(args.rest, 2.0))
    for seed in range(args.first, args.first + args.dives):
        dive = swim(seed, args.legs, (args.rest, 2 * args.rest), args.disturbed)
        found = judge(*dive, settings)
        for name, values in found.items():
            every.setdefault(name, []).extend(values)
        print(seed, {name: round(float(np.median(values)), 3) for name, values in found.items()}, flush=True)
    for name, values in every.items():
        print(f"{name:32} n {len(values):5} mean {np.mean(values):.3f} median {np.median(values):.3f}")


if __name__ == "__main__":
    main()
