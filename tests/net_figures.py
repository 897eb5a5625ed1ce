"""The network's figures on simulated dives: errors of every node over the joint bound, and how true the sigmas are.

    .venv/bin/python -m tests.net_figures                                # six dives of four nodes, a fixed
    .venv/bin/python -m tests.net_figures --seeds 7520 7521 --seconds 20 --inertial poor
    .venv/bin/python -m tests.net_figures --basin                        # a fixed pair of nodes and a moving one, 20 Hz

The joint bound is what the same filter, or smoother, states when it is told the simulator's own sigmas of the units'
biases and their walks, mounts, lever arms and delays, and that clocks, gauges and the water's density are right. Its
own errors over it, and its NEES, stand beside ours: by how far they are from 1 is chance, which both share. Gross
errors of lights that pass add 0.03 to 0.08 to NEES. The last node and b stand side by side, do not see each other, and
are placed by others (`b-d`); their composed bound is that of both places together, as if independent. A dive of 10 s
takes about a quarter of a minute of CPU.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import numpy as np
from buddyline.node.sim import dive as simulation
from buddyline.node.sim.inertial import GRADES, Grade
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.messages import LightTruth, Message, NodePose, Truth
from buddyline.solver_service.config import SolveConfig, track_settings
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.rotation import Floats, quat_to_matrix, rotation_log
from buddyline.solver_service.network import filter as net_filter
from buddyline.solver_service.network import shaking, state
from buddyline.solver_service.network.estimate import NetEstimate
from buddyline.solver_service.network.rows import DueNetRow, plain_of_posed
from buddyline.solver_service.network.state import POSED, NetState, block
from buddyline.solver_service.network.trail import Told
from buddyline.solver_service.track import samples
from buddyline.solver_service.track.samples import Samples
from buddyline.solver_service.track.strapdown import Noise
from buddyline.solver_service.tracking import Coming, PairTracker

from tests.told_units import sigmas_of, walks_of

START_NS = 1_764_000_000_000_000_000
# Beyond these a row is wrong, as `evaluate` has it.
WRONG_M, WRONG_RAD = 0.3, 0.1
FOUR = {"more_nodes": ("c", "d"), "fixed_nodes": ("a",)}
# Nodes a and c stand, and b moves to 6 m away.
BASIN = {"more_nodes": ("c",), "fixed_nodes": ("a", "c"), "environment": "basin", "range_max_m": 6.0}


@dataclass
class NetRun:
    """What one run told. joint: by time, where each node's place stands in the joint covariance (3 n, 3 n)."""

    poses: list[NodePose]
    joint: dict[int, tuple[dict[str, int], Floats]]


@dataclass
class NetErrors:
    """Of one node in one dive: squared errors of place (N,), their variance, turns, and errors over the covariance."""

    squared_m2: Floats
    variance_m2: Floats
    turned_rad: Floats
    nees: Floats

    @property
    def wrong(self) -> int:
        """How many rows are wrong."""
        return int(((np.sqrt(self.squared_m2) > WRONG_M) | (self.turned_rad > WRONG_RAD)).sum())


@dataclass
class Pooled:
    """Squared errors and the bound's variances of one thing, by dive and node."""

    squared: list[Floats] = field(default_factory=list)
    bound: list[Floats] = field(default_factory=list)

    def add(self, squared: Floats, bound: Floats) -> None:
        """Take one node's rows of one dive."""
        if len(squared):
            self.squared.append(squared)
            self.bound.append(bound)

    def __str__(self) -> str:
        """Give the ratio of the roots over all, and the least and the greatest of a single one."""
        if not self.squared:
            return "no rows"
        ratios = [math.sqrt(a.mean() / b.mean()) for a, b in zip(self.squared, self.bound, strict=True)]
        pooled = math.sqrt(np.concatenate(self.squared).mean() / np.concatenate(self.bound).mean())
        return f"{pooled:5.2f} ({min(ratios):.2f} to {max(ratios):.2f})"


@dataclass
class Figures:
    """The figures of one mode over all dives. nees: ours and told, by dive: the mean of each node."""

    ratios: defaultdict[str, Pooled] = field(default_factory=lambda: defaultdict(Pooled))
    nees: defaultdict[str, list[list[float]]] = field(default_factory=lambda: defaultdict(list))
    errors: list[NetErrors] = field(default_factory=list)

    @property
    def over_all(self) -> str:
        """Say how far all rows are off together, and how many are wrong."""
        squared = np.concatenate([one.squared_m2 for one in self.errors])
        variance = np.concatenate([one.variance_m2 for one in self.errors])
        turned_deg = np.degrees(np.concatenate([one.turned_rad for one in self.errors]))
        rms_mm, sigma_mm = (1000.0 * math.sqrt(of.mean()) for of in (squared, variance))
        median_mm, most_mm = 1000.0 * np.sqrt(np.percentile(squared, (50.0, 95.0)))
        return (
            f"place RMS {rms_mm:.1f} mm, median {median_mm:.1f}, 95 % {most_mm:.1f}, of sigma {rms_mm / sigma_mm:.2f}, "
            f"turn {np.median(turned_deg):.3f} deg, wrong {self.wrong} of {len(squared)}"
        )

    @property
    def wrong(self) -> int:
        """How many rows are wrong."""
        return sum(one.wrong for one in self.errors)


@contextmanager
def told(grade: Grade) -> Iterator[None]:
    """Tell the network the simulator's own sigmas; a unit that nothing shakes is known not to be shaken."""

    def noise(self: Samples, time_s: float) -> Noise:
        gyro, accel = walks_of(grade)
        return sampled(self, time_s)._replace(gyro_bias_radps=gyro, accel_bias_mps2=accel)

    sampled = Samples.noise
    sigmas = {
        **sigmas_of(grade),
        # The simulator's clocks, gauges and density are right.
        "CLOCK_S": 1e-6,
        "GAUGE_M": 1e-5,
        "DEPTH_SCALE_SIGMA": 1e-6,
    }
    shaken: dict[str, Any] = {}
    if not grade.shake_radps:
        still = np.full(2, 2.0 * math.log(1e-6))
        shaken = {"_FIRST": still, "_BOUNDS": (still, still)}
    with (
        patch.multiple(state, **sigmas),
        # Its samples have no error but those here.
        patch.multiple(samples, GYRO_FLOOR=1e-6, ACCEL_FLOOR=1e-6),
        patch.multiple(shaking, **shaken) if shaken else nullcontext(),
        patch.object(Samples, "noise", noise),
        # The walks are known, so that no others are tried.
        patch.object(net_filter, "WALKS", np.ones(1)),
    ):
        yield


def solved(messages: Sequence[Message], mode: str, hz: float) -> NetRun:
    """Solve as a stored dive, without the pairs' tracks, and note the joint covariance of each row."""
    joint: dict[int, tuple[list[int], Floats]] = {}

    def note(stamp_ns: int, nodes: list[int], at: NetState, P: Floats) -> None:
        J = np.zeros((3 * len(at), POSED * len(at)))
        for i in range(len(at)):
            J[3 * i : 3 * i + 3, POSED * i : POSED * (i + 1)] = plain_of_posed(at.p_m[i], at.v_mps[i])[:3]
        joint[stamp_ns] = nodes, J @ P @ J.T

    def posed(at: NetState) -> list[int]:
        return [index for i in range(len(at)) for index in range(block(i).start, block(i).start + POSED)]

    noted, smoothed = NetEstimate.due_row, Told.smoothed

    def due_row(self: NetEstimate, t_s: float, stamp_ns: int, nodes: Sequence[int]) -> DueNetRow | None:
        found = noted(self, t_s, stamp_ns, nodes)
        if found is not None and self.state is not None:
            after, move, *_ = self._moved(t_s) if t_s - self.t_s > 1e-6 else (self.state, None)
            P = self.covariance if move is None else move.covariance(self.covariance)
            note(stamp_ns, [one.node for one in self.members], after, P[np.ix_(posed(after), posed(after))])
        return found

    def back(self: Told, mu: Floats, L: Floats) -> tuple[NetState, Floats]:
        after, own = smoothed(self, mu, L)
        P = self.covariance[:, posed(after)] - self.covariance @ L @ self.covariance.T
        note(self.stamp_ns, [one.node for one in self.members], after, P)
        return after, own

    silent = {"follow": lambda *_: Coming(), "tell": lambda *_: [], "finish": lambda *_: []}
    with (
        patch.object(NetEstimate, "due_row", due_row),
        patch.object(Told, "smoothed", back),
        patch.multiple(PairTracker, **silent),
    ):
        core = SolverCore(SolveConfig().settings("figures"), None, track=track_settings(mode, hz))
        found = [one for at in range(0, len(messages), 2000) for one in core.handle_many(messages[at : at + 2000])]
        found += core.flush()
        names = core.network.nodes if core.network is not None else []
    placed = {ns: ({names[node]: i for i, node in enumerate(nodes)}, P) for ns, (nodes, P) in joint.items()}
    return NetRun([one for one in found if isinstance(one, NodePose)], placed)


def errors_of(world: World, run: NetRun) -> dict[str, NetErrors]:
    """Give the errors of each node that moves."""
    rows: dict[str, list[tuple[float, float, float, float]]] = {}
    for pose in run.poses:
        if pose.fixed:
            continue
        true = world.node_truth(pose.node, pose.stamp_ns, "main")
        turn = rotation_log(quat_to_matrix(np.array(true.q_xyzw)) @ quat_to_matrix(np.array(pose.q_xyzw)).T)
        e = np.concatenate((np.array(true.p_m) - pose.p_m, turn))
        P = np.array(pose.covariance).reshape(6, 6)
        one = float(e[:3] @ e[:3]), float(np.trace(P[:3, :3])), float(np.linalg.norm(turn))
        rows.setdefault(pose.node, []).append((*one, float(e @ np.linalg.solve(P, e)) / 6.0))
    return {node: NetErrors(*np.array(found).T) for node, found in rows.items()}


def between(world: World, run: NetRun, one: str, two: str) -> dict[int, tuple[float, float, float]]:
    """Give by time the squared error of the way from one node to another, its variance, and both places' together."""
    places = {(pose.node, pose.stamp_ns): np.array(pose.p_m) for pose in run.poses}
    found = {}
    for ns, (index, P) in run.joint.items():
        if (one, ns) in places and (two, ns) in places:
            true = [np.array(world.node_truth(node, ns, "main").p_m) for node in (one, two)]
            e = places[two, ns] - places[one, ns] - (true[1] - true[0])
            i, j = (slice(3 * index[node], 3 * index[node] + 3) for node in (one, two))
            apart, cross = float(np.trace(P[i, i] + P[j, j])), float(np.trace(P[i, j] + P[j, i]))
            found[ns] = float(e @ e), apart - cross, apart
    return found


def compare(world: World, ours: NetRun, best: NetRun, nodes: tuple[str, str], figures: Figures) -> str:
    """Add one dive's figures, and return them as a line."""
    found, bound = errors_of(world, ours), errors_of(world, best)
    for name, run in (("place", found), ("told", bound)):
        of_mode = figures.nees["NEES/6" if run is found else "told, NEES/6"]
        of_mode.append([float(one.nees.mean()) for one in run.values()])
        for node in run.keys() & bound.keys():
            figures.ratios[f"{name}, RMS / bound"].add(run[node].squared_m2, bound[node].variance_m2)
    ways, least = between(world, ours, *nodes), between(world, best, *nodes)
    same = sorted(ways.keys() & least.keys())
    way, told_way = (np.array([of[ns] for ns in same]).reshape(-1, 3) for of in (ways, least))
    name = "-".join(nodes)
    figures.ratios[f"{name}, RMS / bound"].add(way[:, 0], told_way[:, 1])
    figures.ratios[f"{name} told, RMS / bound"].add(told_way[:, 0], told_way[:, 1])
    figures.ratios[f"{name}, RMS / composed bound"].add(way[:, 0], told_way[:, 2])
    over = [math.sqrt(of[:, 0].mean() / told_way[:, 1].mean()) if same else math.nan for of in (way, told_way)]
    lines = [f"  {name}: RMS over the joint bound {over[0]:.2f}, told {over[1]:.2f}"]
    for node, one in sorted(found.items()):
        median_mm = 1000.0 * math.sqrt(float(np.median(one.squared_m2)))
        rms_mm, sigma_mm = (1000.0 * math.sqrt(float(of.mean())) for of in (one.squared_m2, one.variance_m2))
        turn_deg = math.degrees(float(np.median(one.turned_rad)))
        off_mm = 1000.0 * math.sqrt(float(np.percentile(one.squared_m2, 95.0)))
        lines.append(
            f"  {node}: median {median_mm:.1f} mm, 95 % {off_mm:.1f}, RMS {rms_mm:.1f}, sigma {sigma_mm:.1f}, "
            f"turn {turn_deg:.3f} deg, NEES/6 {one.nees.mean():.2f}, wrong {one.wrong} of {len(one.nees)}"
        )
        figures.errors.append(one)
    return "\n".join(lines)


def main() -> int:
    """Run as a program; return 1 where more than one row of a thousand is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(7550, 7556)))
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--inertial", choices=list(GRADES), default="good")
    parser.add_argument("--modes", nargs="+", choices=["filter", "smooth"], default=["filter", "smooth"])
    parser.add_argument("--basin", action="store_true", help="a fixed pair of nodes and a moving one, at 20 Hz")
    args = parser.parse_args()
    scenario, hz = (BASIN, 20.0) if args.basin else (FOUR, 10.0)
    nodes = ("b", "c") if args.basin else ("b", "d")
    figures = {mode: Figures() for mode in args.modes}
    for seed in args.seeds:
        world = World(Scenario(seed=seed, start_ns=START_NS, inertial=args.inertial, **scenario))
        every = [one for _, _, one in simulation.messages(world, DivePlan(seconds=args.seconds, rate_hz=hz, imu=True))]
        messages = [one for one in every if not isinstance(one, Truth | LightTruth | NodePose)]
        for mode in args.modes:
            ours = solved(messages, mode, hz)
            with told(GRADES[args.inertial]):
                best = solved(messages, mode, hz)
            print(f"seed {seed}, {mode}\n{compare(world, ours, best, nodes, figures[mode])}", flush=True)
    for mode, of in figures.items():
        print(f"{mode}: {len(args.seeds)} dives of {args.seconds:g} s; in brackets single ones, least and greatest")
        for name, ratio in of.ratios.items():
            print(f"  {name:28} {ratio}")
        for name, dives in of.nees.items():
            every = [one for dive in dives for one in dive]
            # Nodes of one dive err alike: only dives are independent.
            chance = float(np.std([np.mean(dive) for dive in dives])) / math.sqrt(max(len(dives) - 1, 1))
            print(f"  {name:28} {np.mean(every):5.2f} +- {chance:.2f} ({min(every):.2f} to {max(every):.2f})")
        print(f"  {of.over_all}")
    return 1 if any(of.wrong > 0.001 * sum(len(one.nees) for one in of.errors) for of in figures.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
