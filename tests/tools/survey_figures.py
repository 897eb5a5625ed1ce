"""The survey's figures: simulated surveys of 12 to 30 legs through the true solver, against truth and by hand.

    python -m tests.tools.survey_figures                  # all of it, about half an hour
    python -m tests.tools.survey_figures --only loops --surveys 5

Each survey is solved, made into legs, adjusted, and read by the real cavern in all styles of .svx.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from buddyline.tools.survey import survex
from buddyline.tools.survey.averages import wrap
from buddyline.tools.survey.derive import Derived
from buddyline.tools.survey.lines import bearing_of, line_of, measures_of
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.readings import of_messages
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from buddyline.tools.survey.sheet import Sheet

from tests.tools import survey_world as world

HANDS = 5
# Swimming past the other and on to the next station, at this speed, and then tying off.
SWIM_MPS, TIE_S = 0.4, 20.0
STRETCH = 3
# As long as the manual asks for.
REST_S = 10.0


@dataclass(frozen=True)
class Campaign:
    """Surveys of one kind. disturbed: three stations in a row turn compasses by 6 to 20 degrees, each by its own."""

    kind: str
    flaws: world.Flaws = field(default_factory=world.Flaws)
    disturbed: bool = False


CAMPAIGNS = {
    "loops": Campaign("loop"),
    "loops-4deg": Campaign("loop", world.Flaws(compass_deg=4.0)),
    "lines": Campaign("line"),
    "lines-4deg": Campaign("line", world.Flaws(compass_deg=4.0)),
    "lines-4deg-disturbed": Campaign("line", world.Flaws(compass_deg=4.0), disturbed=True),
}


def measure(campaign, seed, directory, figures):
    """Survey one course; add its figures, errors over sigmas and errors in % of the length, by name."""
    rng = np.random.default_rng(seed)
    course = {"loop": world.loop, "line": world.line}[campaign.kind](rng, int(rng.integers(12, 31)))
    bad = {}
    if campaign.disturbed:
        first = int(rng.integers(1, len(course.stations_m) - STRETCH))
        bad = {first + k: float(rng.choice([-1, 1]) * rng.uniform(6, 20)) for k in range(STRETCH)}
    pause_s = 2 * course.length_m / len(course.legs) / SWIM_MPS + TIE_S
    messages = world.dive(
        course,
        rng,
        campaign.flaws,
        REST_S,
        4.0,
        disturb=lambda _, station: bad.get(station, 0.0),
        pause_s=pause_s,
    )
    derived = Derived()
    derived.add(of_messages(messages), SurveySettings(), AlarmSettings())
    at = dict(zip(course.names, (world.enu(place) for place in course.stations_m), strict=True))
    legs = [leg for leg in derived.legs if leg.from_ in at and leg.to in at]
    lost = len(course.legs) - len(legs)
    figures["legs lost"].append(lost)
    if lost:
        # The alarm is on this leg and on the next one; a person has to mark the stations.
        figures["lost and not said"].append(not any("NO LEG" in problem.text for problem in derived.problems))
        return
    _legs(legs, at, figures)
    _cavern(derived.legs, directory, figures)
    _far_ends(campaign, course, adjust(world.project_of(derived.legs)), at, bad, rng, figures)


def _legs(legs, at, figures):
    project = world.project_of(legs)
    for leg in legs:
        way = at[leg.to] - at[leg.from_]
        line = line_of(leg, measures_of(leg, project, 0.0, {}, alone=True), 0.0)
        figures["distance / sigma"].append((leg.distance_m - np.linalg.norm(way)) / leg.distance_sigma_m)
        azimuth = math.atan2(line.vector_m[0], line.vector_m[1]) - math.atan2(way[0], way[1])
        figures["azimuth / sigma"].append(wrap(azimuth) / bearing_of(leg, project).sigma)
        figures["rise / sigma"].append((line.vector_m[2] - way[2]) / line.rise_sigma_m)


def _cavern(legs, directory, figures):
    for depth in ("absolute", "readings"):
        project = world.project_of(legs, depth)
        adjusted = adjust(project)
        texts = {style: survex.svx(Sheet(project, adjusted), style) for style in ("auto", "diving", "normal")}
        for style, text in (texts | {"cartesian": survex.svx_cartesian(Sheet(project, adjusted))}).items():
            said, ratios, found = world.cavern(directory, text)
            which = f"{style}, {depth}"
            figures[f"cavern's warnings, {which}"].append(len(said))
            same = [float(np.abs(p.position_m - found[name]).max()) for name, p in adjusted.positions.items()]
            figures[f"cavern off, m: {which}"].append(max(same))
            figures[f"H: {which}"] += [h for h, _ in ratios]
            if depth == "readings":
                figures[f"V: {which}"] += [v for _, v in ratios]


def _far_ends(campaign, course, adjusted, at, bad, rng, figures):
    start = at["0"]
    far = course.names[-1]
    if campaign.kind == "loop":
        far = max(at, key=lambda name: float(np.linalg.norm(at[name] - start)))
    error = adjusted.positions[far].position_m - adjusted.positions["0"].position_m - (at[far] - start)
    figures["far end, % of length"].append(100 * float(np.linalg.norm(error)) / course.length_m)
    covariance = adjusted.positions[far].covariance[:2, :2]
    figures["far end / ellipse"].append(math.sqrt(error[:2] @ np.linalg.solve(covariance, error[:2]) / 2))
    figures["closure, % of length"] += [100 * loop.error_m / loop.length_m for loop in adjusted.loops]
    goal = course.names.index(far)
    for _ in range(HANDS):
        by_hand = world.by_hand(course, rng, bad)
        if campaign.kind == "loop":
            end = course.legs[-1][1]
            closure_m = by_hand[end] - course.stations_m[end]
            figures["by hand: closure, %"].append(100 * float(np.linalg.norm(closure_m)) / course.length_m)
            # Closed as surveyors close it: the misclosure shared out by length.
            walked_m = sum(
                float(np.linalg.norm(course.stations_m[j] - course.stations_m[i])) for i, j, _ in course.legs[:goal]
            )
            by_hand[goal] = by_hand[goal] - closure_m * walked_m / course.length_m
        missed = float(np.linalg.norm(by_hand[goal] - course.stations_m[goal]))
        figures["by hand: far end, %"].append(100 * missed / course.length_m)


def table(figures):
    """Return the figures as lines: median, 95th percentile, greatest and root mean square of the magnitudes."""
    rows = [f"{'':34}{'n':>6}{'median':>9}{'p95':>9}{'max':>9}{'rms':>9}"]
    for name, values in figures.items():
        if values:
            size = np.abs(np.array(values, dtype=float))
            parts = np.median(size), np.percentile(size, 95), size.max(), math.sqrt(float((size**2).mean()))
            rows.append(f"{name:34}{len(size):6}" + "".join(f"{part:9.3f}" for part in parts))
    return rows


def run(campaign, count):
    """Measure surveys 0 .. count - 1 of a campaign."""
    figures = defaultdict(list)
    with tempfile.TemporaryDirectory() as directory:
        for seed in range(count):
            measure(campaign, seed, Path(directory), figures)
    return figures


def main():
    """Print the figures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--surveys", type=int, default=40, help="of each kind; default: 40")
    parser.add_argument("--only", choices=list(CAMPAIGNS))
    args = parser.parse_args()
    for name, campaign in CAMPAIGNS.items():
        if args.only in (None, name):
            print(f"{args.surveys} {name}", *table(run(campaign, args.surveys)), sep="\n", flush=True)


if __name__ == "__main__":
    main()
