"""Simulated dives in which one node stands and the other swims past places that are marked, against truth.

python -m tests.tools.swum_survey          # 20 dives of a minute, some minutes
"""

from __future__ import annotations

import argparse

import numpy as np
from buddyline.node.sim.dive import DivePlan
from buddyline.node.sim.dive import messages as dive_messages
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Mark, RelativePose, Track
from buddyline.solver_service.config import SolveConfig, track_settings
from buddyline.solver_service.core import SolverCore
from buddyline.tools.solve import TOGETHER
from buddyline.tools.survey.derive import Derived
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.readings import of_messages
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings

from tests.tools import survey_world

# Marks so far apart, the first after the track has begun.
EVERY_S, FIRST_S = 5.0, 6.0


def swim(seed, seconds):
    """Return the messages of a dive with its poses and its smoothed track, and its world; a stays."""
    world = World(Scenario(environment="cavern", seed=seed))
    plan = DivePlan(seconds=seconds)
    sent = [message for _, _, message in dive_messages(world, plan)]
    core = SolverCore(SolveConfig().settings("test"), [("a", "b")], track=track_settings("smooth", 50.0))
    solved = []
    for first in range(0, len(sent), TOGETHER):
        solved += core.handle_many(sent[first : first + TOGETHER])
    solved += core.flush()
    return sent + [one for one in solved if isinstance(one, RelativePose | Track)], world


def nees(seed, seconds=60.0, passing_m=0.0):
    """Return NEES / 3 of each place that was swum past, as the survey has it adjusted, and how many were marked.

    passing_m: how far from the place the node is, 1 sd of each axis, when it is marked.
    """
    messages, world = swim(seed, seconds)
    rng = np.random.default_rng(seed)
    # No rest is long enough here: a mark within 20 s of a rest would belong to it.
    settings, start_ns = SurveySettings(passing_m=passing_m, rest_s=60.0), world.scenario.start_ns
    marks = [Mark(node="a", stamp_ns=start_ns, name="S")]
    truth_m = {}
    for k in range(int((seconds - FIRST_S) / EVERY_S)):
        at_ns = start_ns + round((FIRST_S + k * EVERY_S) * S_NS)
        marks.append(Mark(node="b", stamp_ns=at_ns, name=f"M{k}"))
        way_m = world.T_ned_camera("b", at_ns)[1] - world.T_ned_camera("a", at_ns)[1]
        truth_m[f"M{k}"] = survey_world.enu(way_m + passing_m * rng.normal(size=3))
    derived = Derived()
    derived.add(of_messages([*messages, *marks]), settings, AlarmSettings())
    # A sways: each leg keeps its own two depths.
    adjusted = adjust(survey_world.project_of(derived.legs, "readings", settings=settings))
    found = []
    for name, way_m in truth_m.items():
        if name in adjusted.positions:
            place = adjusted.positions[name]
            off_m = place.position_m - adjusted.positions["S"].position_m - way_m
            found.append(float(off_m @ np.linalg.solve(place.covariance, off_m)) / 3)
    return found, len(truth_m)


def main():
    """Print the mean NEES / 3 of each dive's places, and of all."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--dives", type=int, default=20)
    parser.add_argument(
        "--passing", type=float, default=0.0, metavar="M", help="how far from the places it swims, 1 sd"
    )
    args = parser.parse_args()
    every: list[float] = []
    for seed in range(args.dives):
        found, count = nees(seed, passing_m=args.passing)
        every += found
        print(f"{seed}: {len(found)} of {count} places, NEES / 3 {np.mean(found):.2f}", flush=True)
    print(f"all: {len(every)} places, NEES / 3 {np.mean(every):.2f}, median {np.median(every):.2f}")


if __name__ == "__main__":
    main()
