"""The track's figures on simulated dives: errors as shares of the poses' errors, coverage, NEES, number of wrong rows.

    .venv/bin/python -m tests.track_figures                              # cavern, basin and lake, six seeds, a minute
    .venv/bin/python -m tests.track_figures --inertial fair --waters cavern --range 5 8 --seconds 120
    .venv/bin/python -m tests.track_figures --inertial none --range 4 8
    .venv/bin/python -m tests.track_figures --dead a.left --modes smooth
    .venv/bin/python -m tests.track_figures --dark 5 --range 4 8         # no light for 5 s in the middle
    .venv/bin/python -m tests.track_figures --clock-ms 300 --gauge 0.5   # unknown to the solver
    .venv/bin/python -m tests.track_figures --told                       # how good such a track can be

Dives go through the whole solver, and are judged as `evaluate` judges them. Each seed has one of the waters. A line for
each dive and mode, and one for each mode over all. With `--told` the track is told the simulator's own sigmas of the
units, and that clocks, gauges and the water's density are right: by what it errs then, no estimate can err much less.
Status 1 where more than a thousandth of a mode's rows are wrong, or no dive has a track. A dive of a minute takes some
10 s of CPU.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
from buddyline.node.sim import dive as simulation
from buddyline.node.sim.inertial import GRADES, Grade
from buddyline.node.sim.scenario import ENVIRONMENTS, INERTIAL_GRADES, DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.messages import (
    Candidates,
    Depth,
    LightTruth,
    Message,
    NodePose,
    RelativePose,
    Track,
    Truth,
)
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.track import dive as whole_dive
from buddyline.solver_service.track import start, walking
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.tracking import TrackSettings
from buddyline.tools.evaluation.poses import pose_errors
from buddyline.tools.evaluation.statistics import Stats
from buddyline.tools.evaluation.tracks import TrackFigures, tracks_figures
from buddyline.tools.evaluation.truth import TruthTrack
from buddyline.tools.solve import solved as solve
from msgspec.structs import replace

from tests.told_units import sigmas_of, walks_of

START_NS = 1_764_000_000 * S_NS
MODES = ("smooth", "lag", "filter")
# 1 sd of clocks that are told to be right.
KNOWN_S = 1e-5


@dataclass(frozen=True)
class TrackDive:
    """One mode's figures of a dive. dark_m: the largest error without any light. poses_m: of the poses, no track's."""

    figures: TrackFigures
    dark_m: float
    poses_m: Stats
    worst_pose_m: float

    @property
    def shares(self) -> tuple[float, float, float]:
        """Median, 95th percentile and largest error of the track as shares of the poses', NaN where there is none."""
        ours, theirs = self.figures, self.poses_m
        return (
            (ours.position_m.median or 0.0) / (theirs.median or np.nan),
            (ours.position_m.p95 or 0.0) / (theirs.p95 or np.nan),
            (ours.worst_m or 0.0) / (self.worst_pose_m or np.nan),
        )

    def __str__(self) -> str:
        of, (middle, most, worst) = self.figures, self.shares
        return (
            f"{of.mode:6} {1e3 * (of.position_m.median or 0.0):6.1f} mm, share of the poses' errors {middle:.2f} "
            f"{most:.2f} {worst:.2f}, covered {covered(of):6.1%}, NEES/6 {(of.nees6.mean or 0.0) / 6.0:.2f}, "
            f"wrong {of.wrong} of {of.samples}" + (f", dark {1e3 * self.dark_m:.0f} mm" if self.dark_m else "")
        )


def covered(figures: TrackFigures) -> float:
    """Return the share of the time between first and last pose that is covered, NaN where no two poses were."""
    return np.nan if figures.covered is None else figures.covered


def told(world: World, args: argparse.Namespace) -> Iterator[Message]:
    """Yield what the nodes of a dive publish, with the disturbances that were asked for."""
    plan = DivePlan(seconds=args.seconds, rate_hz=args.rate, imu=args.inertial != "none")
    for stamp_ns, _, message in simulation.messages(world, plan):
        if isinstance(message, Candidates) and is_dark(stamp_ns, args):
            yield replace(message, blobs=[])
        elif isinstance(message, Depth) and message.node == "b":
            yield replace(message, depth_m=message.depth_m + args.gauge)
        elif not isinstance(message, Truth | LightTruth | NodePose):
            yield message


@contextmanager
def told_units(grade: Grade) -> Iterator[None]:
    """Tell the track the simulator's own sigmas of its units, and that clocks, gauges and density are right."""
    sigmas = {**sigmas_of(grade), "DEPTH_OFFSET_M": 1e-4, "DEPTH_SCALE_SIGMA": 1e-5}
    first = walking.FIRST_LOGS, walking.FIRST_INFORMATION, walking.LEAST
    kept = [each.copy() for each in first]
    logs, information, least = first
    logs[walking.OF_UNITS] = least[walking.OF_UNITS] = 2.0 * np.log(walks_of(grade))
    # So they are not learned.
    information[walking.OF_UNITS, walking.OF_UNITS] *= 1e6
    try:
        with (
            patch.multiple(start, **sigmas),
            patch.dict(TrackFilter.__init__.__kwdefaults__, clock_sigma_s=KNOWN_S),
            patch.object(whole_dive, "CLOCK_S", KNOWN_S),
        ):
            yield
    finally:
        for each, before in zip(first, kept, strict=True):
            each[:] = before


def is_dark(stamp_ns: int, args: argparse.Namespace) -> bool:
    """Tell whether an instant is in the dark seconds, which are in the middle."""
    return abs((stamp_ns - START_NS) / S_NS - 0.5 * args.seconds) <= 0.5 * args.dark


def solved(seed: int, args: argparse.Namespace) -> list[TrackDive]:
    """Simulate and solve a dive; return the figures of each mode."""
    world = World(
        Scenario(
            environment=args.waters[seed % len(args.waters)],
            seed=seed,
            start_ns=START_NS,
            inertial="poor" if args.inertial == "none" else args.inertial,
            dead_lamps=tuple(args.dead),
            clock_offset_ns=round(args.clock_ms * MS_NS),
            range_min_m=args.range[0],
            range_max_m=args.range[1],
        )
    )
    core = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset(args.modes)))
    with told_units(GRADES[args.inertial]) if args.told else nullcontext():
        found = list(solve(core, told(world, args)))

    def truth_of(samples: list[RelativePose] | list[Track]) -> TruthTrack:
        return TruthTrack([world.truth(one.stamp_ns, 0) for one in samples])

    poses = [one for one in found if isinstance(one, RelativePose)]
    tracks = [one for one in found if isinstance(one, Track)]
    truth = truth_of(tracks)
    off_m = pose_errors(poses, truth_of(poses), lambda _: None, None).translation_m
    in_dark = [one for one in tracks if is_dark(one.stamp_ns, args)] if args.dark else []
    dark_m: defaultdict[str, float] = defaultdict(float)
    for one in tracks_figures(in_dark, poses, truth):
        dark_m[one.mode] = one.worst_m or 0.0
    return [
        TrackDive(one, dark_m[one.mode], Stats.of(off_m), float(off_m.max(initial=0.0)))
        for one in tracks_figures(tracks, poses, truth)
    ]


def options() -> argparse.ArgumentParser:
    """Return the program's options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(9300, 9306)))
    parser.add_argument("--waters", nargs="+", choices=ENVIRONMENTS, default=["cavern", "basin", "lake"])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=10.0, help="triggers a second")
    parser.add_argument("--inertial", choices=[*INERTIAL_GRADES, "none"], default="poor")
    parser.add_argument("--range", type=float, nargs=2, default=(1.5, 0.0), metavar="M", help="0: the waters' own")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES))
    parser.add_argument("--dead", nargs="+", default=[], metavar="LAMP")
    parser.add_argument("--dark", type=float, default=0.0, metavar="SECONDS")
    parser.add_argument("--clock-ms", type=float, default=0.0)
    parser.add_argument("--gauge", type=float, default=0.0, metavar="M")
    parser.add_argument("--told", action="store_true", help="tell the track what the simulator knows of the units")
    return parser


def main() -> int:
    """Run as a program."""
    parser = options()
    args = parser.parse_args()
    if args.told and (args.inertial == "none" or args.clock_ms or args.gauge):
        parser.error("--told tells of units, and that clocks and gauges are right")
    dives: defaultdict[str, list[TrackDive]] = defaultdict(list)
    for seed in args.seeds:
        for dive in solved(seed, args):
            dives[dive.figures.mode].append(dive)
            print(f"{seed} {dive}", flush=True)
    bad = False
    for mode, found in dives.items():
        shares = np.array([dive.shares for dive in found if dive.worst_pose_m])
        middle, most, worst = np.median(shares, axis=0) if len(shares) else (np.nan,) * 3
        nees = [(dive.figures.nees6.mean or 0.0) / 6.0 for dive in found]
        wrong, samples = (sum(getattr(dive.figures, name) for dive in found) for name in ("wrong", "samples"))
        in_gaps = sum(dive.figures.wrong_in_gaps for dive in found)
        bad |= wrong > 0.001 * samples
        print(
            f"{mode}, {len(found)} of {len(args.seeds)} dives: shares, median of the dives' {middle:.2f} {most:.2f} "
            f"{worst:.2f}; median {1e3 * np.median([dive.figures.position_m.median for dive in found]):.1f} mm; "
            f"covered at least {min(covered(dive.figures) for dive in found):.1%}; "
            f"NEES/6 {np.mean(nees):.2f} ({min(nees):.2f} to {max(nees):.2f}); "
            f"wrong {wrong} of {samples}, {in_gaps} in gaps; "
            f"dark at most {1e3 * max(dive.dark_m for dive in found):.0f} mm"
        )
    return 1 if bad or not dives else 0


if __name__ == "__main__":
    sys.exit(main())
