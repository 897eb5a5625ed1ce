"""`buddyline experiments`: repeat the paper's experiments, with the paper's method and with ours."""

from __future__ import annotations

import argparse
import json
import logging
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.draw import errors as error_figures
from buddyline.tools.draw import figures
from buddyline.tools.draw.errors import ErrorCurve
from buddyline.tools.draw.page import page, picture, section, table
from buddyline.tools.evaluation.logs import load
from buddyline.tools.evaluation.truth import TruthTrack
from buddyline.tools.experiments import numbers, pictured, readme, tank, timing
from buddyline.tools.experiments.runs import (
    ENVIRONMENTS,
    FULL,
    OURS,
    QUICK,
    SEED,
    TAGS,
    Rendered,
    Size,
    long_dive,
    net_dives,
    rendered,
)
from buddyline.tools.measure.tables import cells_of, markdown_table, number
from buddyline.tools.progress import Progress

log = logging.getLogger(__name__)

SIGMA_PX = 0.7
PAIRS_NOTE = (
    "<p>In view: triggers at which both pictures show both lights, by the truth. Right: a pose from candidates within "
    "1 % of the width of the true lights. The paper's method is its detector, tuned to each water, its closed form and "
    "its test of the range gap, in our solver, which also asks that a pose be likelier than chance: milder than the "
    "paper's own choice of the smallest gap.</p>"
)


NET_HEAD = ("", "of the time, %", "median, mm", "RMS, mm", "stated, mm", "turn, median, mrad", "NEES / 6", "wrong")
NET_NOTE = (
    "<p>The smoothed places of all nodes in one frame, from simulated candidates and inertial samples. Stated: the RMS "
    "of the stated sigma of the place. NEES / 6 is 1 on average where the covariance is true. Wrong: off by more than "
    "0.3 m and 3 sigmas. <code>evaluate --net</code> gives the same of any dive.</p>"
)
BOUND_COLUMNS = {
    "range": "{from_m:g} to {to_m:g} m",
    "poses": "{poses}",
    "bound, RMS, m": "{bound_rms_m:.3f}",
    "RMS / RMS": "{rms_ratio:.2f} ± {rms_sd:.2f}",
    "bound, median, m": "{bound_median_m:.3f}",
    "median / median": "{median_ratio:.2f}",
}
BOUND_NOTE = (
    "<p>The bound (Cramér-Rao) is of one trigger's four lights with the noise of their places in the pictures. RMS is "
    "compared with the bound's RMS, the median with the median of errors at the bound. ±: by how much the ratio varies "
    "by chance (1 sd) in so few poses. Only by chance is an unbiased estimator below 1. Our pose from four lights uses "
    "nothing but these lights.</p>"
)


def run(args: argparse.Namespace) -> int:
    """Run everything and write the report; return 0."""
    figures.check()
    if args.tag_video is not None and not args.tag_video.is_file():
        raise BuddylineError(f"{args.tag_video}: no such video")
    if args.readme is not None:
        if args.quick:
            raise BuddylineError("--readme: a quick run gives no figures to quote; leave --quick out")
        readme.read_readme(args.readme)
    code_hash = readme.deciding_hash()
    try:
        args.output.mkdir(parents=True)
    except OSError as error:
        raise BuddylineError(f"{args.output}: cannot be made: {error.strerror}") from error
    cv2.setNumThreads(1)
    # The log messages of the single commands are not shown: the report has the results.
    logging.getLogger("buddyline").setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as folder:
        found = measure(QUICK if args.quick else FULL, Path(folder), args.output, args.tag_video)
    found["quick"] = args.quick
    found["code"] = code_hash
    rows = numbers.headline(found)
    (args.output / "experiments.json").write_text(json.dumps(found, allow_nan=False, indent=1) + "\n")
    (args.output / "headline.md").write_text(markdown_table(numbers.HEAD, rows))
    (args.output / "report.html").write_text(report(found, rows, args.output), encoding="utf-8")
    if args.readme is not None:
        # The file is read again, because it may have been edited during the run, which takes minutes.
        table = markdown_table(numbers.HEAD, [row for row in rows if row[0].startswith(numbers.README_ROWS)])
        text = readme.with_table(readme.read_readme(args.readme), table, code_hash)
        args.readme.write_text(text, encoding="utf-8")
    print(args.output / "report.html")
    return 0


def measure(size: Size, folder: Path, output: Path, video: Path | None) -> dict[str, Any]:
    """Run all experiments, write the pictures into `output`, and return the figures. folder: for temporary dives."""
    dives: list[Rendered] = []
    truths, starts = {}, {}
    found: dict[str, Any] = {"paper": numbers.PAPER_REPORTS, "seed": SEED, "reach": {}}
    with Progress("experiments", len(ENVIRONMENTS) + 4) as progress:
        for environment in ENVIRONMENTS:
            progress.show(len(dives), environment)
            dive = rendered(environment, size, folder)
            dives.append(dive)
            recorded = load([str(dive.dive)])
            truths[environment] = np.array([truth.t_a_b_m for truth in recorded.truths])
            starts[environment] = np.array([truth.stamp_ns for truth in recorded.truths])
            triggers = [int(truth.trigger) for truth in recorded.truths if isinstance(truth.trigger, int)]
            ranges_m = np.linalg.norm(truths[environment], axis=1)
            found["reach"][environment] = {
                name: numbers.reach(ranges_m, triggers, dive.results[name].errors)
                for name in (OURS, TAGS)
                if name in dive.results
            }
        progress.show(len(dives), "out to 20 m")
        long_log, long_results = long_dive(size, folder)
        found["right_pairs"] = numbers.pairs(dives)
        found["environments"] = numbers.environments(dives)
        found["distance"] = {name: numbers.by_range(result.errors) for name, result in long_results.items()}
        found["near"] = {name: numbers.near_share(result.errors) for name, result in long_results.items()}
        tagged = {dive.environment: dive.results[TAGS].errors for dive in dives if TAGS in dive.results}
        found["distance"] |= {f"AR tags, {named(name)}": numbers.by_range(errors) for name, errors in tagged.items()}
        errors = long_results[OURS].errors
        recorded = load([str(long_log)])
        bound = numbers.bounds(errors, TruthTrack(recorded.truths), recorded.infos, SIGMA_PX)
        found["bound"] = numbers.over_bound(errors, bound)
        progress.show(len(dives) + 1, "more than two nodes")
        found["networks"] = {name: [asdict(node) for node in nodes] for name, nodes in net_dives(size, folder).items()}
        progress.show(len(dives) + 2, "run times")
        found["time"] = {
            "eq1_ms": timing.equation_1(),
            "trigger": timing.trigger(long_log),
            "frame": {dive.environment: timing.frame(dive.dive) for dive in dives},
        }
        progress.show(len(dives) + 3, "pictures")
        if video is not None:
            found["tank"] = tank.figures(video, size.tank_step)
        curves = {dive.environment: curves_of(dive) for dive in dives}
        figure = error_figures.trajectories({named(name): (truths[name], curves[name]) for name in ENVIRONMENTS})
        figures.save(figure, output / "trajectories.png")
        for dive in dives:
            name = dive.environment
            stamps_ns, title = starts[name].tolist(), f"{named(name)}: lights and AR tags"
            figure = error_figures.over_time(curves[name], stamps_ns, truths[name], title)
            figures.save(figure, output / f"over_time_{name}.png")
            pictured.detections(dive, output / f"detection_{name}.png")
        figure = error_figures.medians_over_range(found["distance"], found["bound"])
        figures.save(figure, output / "error_over_range.png")
    return found


def named(environment: str) -> str:
    """Return an environment's name in words."""
    return environment.replace("_", " ")


def curves_of(dive: Rendered) -> list[ErrorCurve]:
    """Return the error curves of a dive's poses from lights and from tags, without wrong poses."""
    return [
        ErrorCurve(method, errors.select(~errors.wrong), colour, marker)
        for method, colour, marker in ((OURS, "tab:blue", "."), (TAGS, "tab:orange", "x"))
        if method in dive.results
        for errors in [dive.results[method].errors]
    ]


def pair_rows(pairs: dict[str, dict[str, dict[str, Any]]]) -> list[list[str]]:
    """Return the rows of the table of right pairs."""
    return [
        [
            method,
            named(environment),
            str(row["visible"]),
            *(number(None if row[key] is None else 100 * row[key], 1) for key in ("right_share", "right_of_poses")),
            str(row["other_pair"]),
            str(row["wrong"]),
        ]
        for method, rows in pairs.items()
        for environment, row in rows.items()
    ]


def net_rows(nodes: list[dict[str, Any]]) -> list[list[str]]:
    """Return the rows of the table of a net's nodes; what is fixed as the net's origin has no error."""
    return [
        [
            node["node"] + (", fixed" if node["fixed"] else ""),
            number(100 * node["covered"], 1),
            *(number(1000 * value, 1) for value in (node["position_m"]["median"], node["position_m"]["rmse"])),
            number(1000 * node["sigma_m"], 1),
            number(1000 * node["rotation_rad"]["median"], 2),
            number(node["nees6"]["mean"] / 6, 2),
            f"{node['wrong']} of {node['samples']}",
        ]
        for node in nodes
    ]


def report(found: dict[str, Any], rows: list[tuple[str, str, str, str]], output: Path) -> str:
    """Return the report's HTML."""
    quick = "<p><b>Quick look: short dives, not figures to quote.</b></p>" if found["quick"] else ""
    head, bounds = table(rows, numbers.HEAD), cells_of(found["bound"], BOUND_COLUMNS)
    sections = [
        ("At a glance", quick + head + "<p>Simulated dives, of seeds that nothing was tuned on: not the sea.</p>"),
        (
            "Trajectories",
            picture(output / "trajectories.png", "B before A (triangle), from above and from the side; grid 1 m"),
        ),
        (
            "Error against distance",
            picture(output / "error_over_range.png", "Median position error by range")
            + table(bounds[1:], bounds[0])
            + BOUND_NOTE,
        ),
        (
            "Right pairs",
            table(
                pair_rows(found["right_pairs"]),
                ("method", "water", "in view", "right, %", "of its poses, %", "another pair", "wrong poses"),
            )
            + PAIRS_NOTE,
        ),
    ]
    for environment in ENVIRONMENTS:
        name = named(environment)
        content = picture(output / f"over_time_{environment}.png", "Lights and AR tags over time, gaps included")
        ends = found["reach"][environment]
        content += table(
            [[method, number(one["farthest_m"], 1), number(one["ends_m"], 1)] for method, one in ends.items()],
            ("", "farthest pose, m", "half of the triggers give a pose up to, m"),
        )
        pictured = output / f"detection_{environment}.png"
        if pictured.exists():
            content += picture(pictured, "A left, B right: raw, candidates, chosen pair (red left, green right)")
        sections.append((f"In the {name}", content))
    nets = "".join(f"<h3>{name}</h3>" + table(net_rows(nodes), NET_HEAD) for name, nodes in found["networks"].items())
    sections.append(("More than two nodes", nets + NET_NOTE))
    times = found["time"]
    costs = [["Eq. 1, both ranges", number(times["eq1_ms"], 4)]]
    costs.append(["a whole trigger, median", number(times["trigger"]["median_ms"], 2)])
    for environment, frame in times["frame"].items():
        for name, detector in (("ours", "source_ms"), ("the paper's", "paper_ms")):
            costs.append([f"a frame, {environment}: {name}", number(frame[detector], 1)])
    sections.append(("Run time", table(costs, ("processor time of one thread, this machine", "ms"))))
    if "tank" in found:
        listed = [
            [name.replace("_", " "), f"{value:.4g}"] for name, value in found["tank"].items() if value is not None
        ]
        sections.append(("AR tags in real water", table(listed, ("underwater-apriltags' video", ""))))
    parts = [section(heading, content) for heading, content in sections]
    return page("Buddyline: the paper's experiments, again", *parts)
