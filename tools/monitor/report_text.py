"""The report's words about how its numbers came to be: methods, what the error is made of, and outliers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any, Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.health import TRACK_SIGMA_SHARE
from buddyline.tools.draw.page import table
from buddyline.tools.evaluation.tracks import covered_from
from buddyline.tools.monitor.coverage import clock_words
from buddyline.tools.monitor.outliers import GATE, Outlier
from buddyline.tools.monitor.panel import length_words
from buddyline.tools.monitor.summary import Summary

TRACK_MADE: Final = {
    "filter": "as a causal filter, from what came before each instant",
    "lag": "from what came up to a second after each instant",
    "smooth": "smoothed over the whole dive",
}


def methods_html(numbers: dict[str, Any], summary: Summary) -> str:
    """Return a paragraph for a paper's section on methods, with this dive's figures; "" without poses."""
    poses, track, triggers = numbers["poses"], numbers["track"], numbers["triggers"]
    if not poses:
        return ""
    a, b = numbers["dive"]["pair"]
    said, noise_px = [], poses["light_sigma_median_px"]
    located = f", which the other located with a noise of {noise_px:.2g} px (1 sd, stated, median)" if noise_px else ""
    infos = [summary.infos[node][-1] for node in (a, b) if node in summary.infos]
    if len(infos) == 2:
        cameras = " and ".join(f"{info.width_px} x {info.height_px} px ({info.camera.model})" for info in infos)
        bars = " and ".join(f"{math.dist(info.light_left_m, info.light_right_m):.3f} m" for info in infos)
        said.append(
            f"Nodes {a} and {b} took pictures at the same instants, {S_NS / infos[0].trigger_period_ns:g} a second "
            f"({cameras}). Each carried two lights, {bars} apart{located}."
        )
    said.append(
        f"Of {triggers['total']} triggers, {triggers['with_pose']} ({triggers['with_pose'] / triggers['total']:.1%}) "
        "gave the full relative pose from the lights that each node saw of the other, in closed form (Damron et al. "
        "2018)"
        + (" and refined by least squares" if poses["methods"].get("refined") else "")
        + f"; each hypothesis was tested by {_listed(poses['checks'])}."
    )
    said.append(f"Ranges were {poses['range_least_m']:.1f} to {poses['range_most_m']:.1f} m.")
    if track:
        said.append(
            f"The track between triggers was estimated {TRACK_MADE[track['mode']]}. It uses every light, and the "
            "attitudes, depths and inertial samples that the nodes sent."
        )
        if track["covered"] is not None:
            said.append(
                f"Its position's 1 sd is below {TRACK_SIGMA_SHARE:.0%} of the range during {track['covered']:.1%} of "
                f"the time between the first and the last {covered_from(summary.poses)}."
            )
    north = "true north" if infos and infos[0].declination_rad else "magnetic north"
    if numbers["error_budget"]["compass_m"] is not None:
        said.append(f"North-east-down is by {a}'s attitude sensor, from {north}.")
    solver = summary.picture.solver
    if solver is not None:
        said.append(f"Solved by {solver.software}.")
    return f"<p>{escape(' '.join(said))}</p>"


def _listed(checks: dict[str, int]) -> str:
    names = [name.replace("_", " ") for name in checks if name != "upright_assumed"]
    return ", ".join(names) if names else "chance alone"


def budget_html(numbers: dict[str, Any]) -> str:
    """Return the error budget as a table; "" without poses."""
    budget, poses = numbers["error_budget"], numbers["poses"]
    if not budget:
        return ""
    rows = []
    for name, size_m, basis in (
        ("optics", budget["optics_m"], "the poses' covariance: noise and geometry of the lights in the pictures"),
        ("compass and tilt", budget["compass_m"], "what A's attitude adds to the place in north-east-down"),
        ("depth", budget["depth_m"], "both gauges' stated sigma, on the difference of depth alone"),
        ("clock", budget["clock_m"], _clock(budget)),
    ):
        rows.append((name, "not known" if size_m is None else f"{size_m * 1e3:.1f} mm", basis))
    said = f"1 sd, medians over the poses, at a median range of {poses['range_median_m']:.2f} m."
    return table(rows, ("source", "error of B's place", "from")) + f'<p class="dim">{said}</p>'


def _clock(budget: dict[str, Any]) -> str:
    if budget["clock_offset_s"] is None:
        return "the solver has told no offset of the two clocks"
    return f"the clocks' estimated offset, {budget['clock_offset_s'] * 1e3:+.1f} ms, at the track's median speed"


def outliers_html(numbers: dict[str, Any], found: Sequence[Outlier] | None, start_ns: int) -> str:
    """Return the outliers with their pictures."""
    told = numbers["outliers"]
    if not numbers["poses"]:
        return ""
    if told is None:
        return "<p>Not judged: the log holds no track of this pair.</p>"
    said = (
        f"Of the {told['judged']} poses with a track at the same time, {told['found']} "
        f"{'is' if told['found'] == 1 else 'are'} further from it than 99.9 % of honest ones would be "
        f"({math.sqrt(GATE):.1f} sigma of their own covariance)."
    )
    cards = []
    for one in (found or ())[: len(told["listed"])]:
        at = clock_words((one.pose.stamp_ns - start_ns) / S_NS)
        lights = sum(index >= 0 for index in (*one.pose.blobs_a, *one.pose.blobs_b))
        words = (
            f"At {at}, trigger {one.pose.trigger}: {length_words(one.off_m)} off the track, {one.sigmas:.1f} sigma; "
            f"range {one.pose.range_m:.2f} m, {lights} lights."
        )
        pictures = "".join(
            f'<div class="cam">{drawing}<div class="dim">Node {escape(node)}</div></div>'
            for node, drawing in sorted(one.pictures.items())
        )
        cards.append(f'<p>{escape(words)}</p><div class="two">{pictures}</div>')
    rest = told["found"] - len(told["listed"])
    more = f'<p class="dim">And {rest} more, less far off.</p>' if rest > 0 else ""
    return f"<p>{said}</p>{''.join(cards)}{more}"
