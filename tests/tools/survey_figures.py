"""The survey's figures: simulated surveys of 12 to 30 legs through the true solver, against truth and by hand.

    python -m tests.tools.survey_figures --loops 40 --lines 20 --disturbed 20

Each survey is solved, made into legs, adjusted, and read by the real cavern.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from tests.tools import survey_world as world
from tools.survey import survex
from tools.survey.averages import wrap
from tools.survey.derive import Derived
from tools.survey.lines import bearing_of, line_of
from tools.survey.network import adjust
from tools.survey.readings import of_messages
from tools.survey.settings import AlarmSettings, SurveySettings

HANDS = 5


def measure(kind, seed, flaws, directory, figures):
    """Survey one course; add its figures, errors over sigmas and errors in % of the length, by name."""
    rng = np.random.default_rng(seed)
    course = {"loop": world.loop, "line": world.line}[kind](rng, int(rng.integers(12, 31)))
    derived = Derived()
    derived.add(of_messages(world.dive(course, rng, flaws, rest_s=8.0, swim_s=4.0)), SurveySettings(), AlarmSettings())
    at = dict(zip(course.names, (world.enu(place) for place in course.stations_m), strict=True))
    legs = [leg for leg in derived.legs if leg.from_ in at and leg.to in at]
    lost = len(course.legs) - len(legs)
    figures["legs lost"].append(lost)
    if lost:
        # It is said, and on the leg after it; what becomes of its stations is a person's to mark.
        figures["lost and not said"].append(not any("makes no leg" in problem.text for problem in derived.problems))
        return
    project = world.project_of(derived.legs)
    for leg in legs:
        way = at[leg.to] - at[leg.from_]
        line = line_of(leg, project, 0.0, {}, alone=True)
        figures["distance / sigma"].append((leg.distance_m - np.linalg.norm(way)) / leg.distance_sigma_m)
        azimuth = math.atan2(line.vector_m[0], line.vector_m[1]) - math.atan2(way[0], way[1])
        figures["azimuth / sigma"].append(wrap(azimuth) / bearing_of(leg, project).sigma)
        figures["rise / sigma"].append((line.vector_m[2] - way[2]) / line.rise_sigma_m)
    for depth in ("absolute", "readings"):
        project = world.project_of(derived.legs, depth)
        adjusted = adjust(project)
        said, ratios, found = world.cavern(directory, survex.diving(project, adjusted))
        figures["cavern's warnings"].append(len(said))
        same = [float(np.abs(p.position_m - found[name]).max()) for name, p in adjusted.positions.items()]
        figures["cavern differs, m"].append(max(same))
        figures[f"H, depths {depth}"] += [h for h, _ in ratios]
        if depth == "readings":
            figures["V, depths readings"] += [v for _, v in ratios]
    adjusted = adjust(world.project_of(derived.legs))
    start = at["0"]
    far = max(at, key=lambda name: float(np.linalg.norm(at[name] - start))) if kind == "loop" else course.names[-1]
    error = adjusted.positions[far].position_m - adjusted.positions["0"].position_m - (at[far] - start)
    figures["far end, % of length"].append(100 * float(np.linalg.norm(error)) / course.length_m)
    covariance = adjusted.positions[far].covariance[:2, :2]
    figures["far end / ellipse"].append(math.sqrt(error[:2] @ np.linalg.solve(covariance, error[:2]) / 2))
    figures["closure, % of length"] += [100 * loop.error_m / loop.length_m for loop in adjusted.loops]
    end = course.stations_m[course.legs[-1][1]]
    for _ in range(HANDS):
        missed = float(np.linalg.norm(world.by_hand(course, rng) - end))
        figures["by hand: closure, %" if kind == "loop" else "by hand: far end, %"].append(
            100 * missed / course.length_m
        )


def table(figures):
    """Return the figures as lines: median, 95th percentile and root mean square of the magnitudes."""
    rows = [f"{'':26}{'n':>6}{'median':>9}{'p95':>9}{'rms':>9}"]
    for name, values in figures.items():
        if values:
            size = np.abs(np.array(values, dtype=float))
            rms = math.sqrt(float((size**2).mean()))
            rows.append(f"{name:26}{len(size):6}{np.median(size):9.3f}{np.percentile(size, 95):9.3f}{rms:9.3f}")
    return rows


def campaign(kind, count, flaws):
    """Measure surveys 0 .. count - 1 of a kind."""
    figures = defaultdict(list)
    with tempfile.TemporaryDirectory() as directory:
        for seed in range(count):
            measure(kind, seed, flaws, Path(directory), figures)
    return figures


def main():
    """Print the figures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--loops", type=int, default=40)
    parser.add_argument("--lines", type=int, default=20)
    parser.add_argument("--disturbed", type=int, default=20)
    args = parser.parse_args()
    for title, kind, count, flaws in (
        ("loops, undisturbed", "loop", args.loops, world.Flaws()),
        ("lines, undisturbed", "line", args.lines, world.Flaws()),
        ("lines, a tenth of the stations disturbed", "line", args.disturbed, world.Flaws(disturbed_share=0.1)),
    ):
        print(f"{count} {title}", *table(campaign(kind, count, flaws)), sep="\n", flush=True)


if __name__ == "__main__":
    main()
