"""`buddyline report`: a dive on one HTML page, to keep, to send and to print."""

from __future__ import annotations

import argparse
import logging
import math
import time
from collections import Counter
from collections.abc import Sequence
from html import escape
from typing import Final

import numpy as np
from buddyline.protocol import __version__
from buddyline.protocol.clock import S_NS
from buddyline.protocol.health import NO_LIGHT_S, TRACK_SIGMA_SHARE
from buddyline.protocol.messages import NodeInfo
from buddyline.tools.authenticity import check_logs
from buddyline.tools.dives import Dive
from buddyline.tools.draw import dive as dive_figures
from buddyline.tools.draw import figures
from buddyline.tools.draw.figures import inline_svg
from buddyline.tools.draw.page import page, section, table
from buddyline.tools.estimate import known, sigma_m
from buddyline.tools.evaluation.statistics import Stats
from buddyline.tools.evaluation.triggers import trigger_figures
from buddyline.tools.health.words import duration_words, reason_words
from buddyline.tools.monitor.coverage import CSS as STRIP_CSS
from buddyline.tools.monitor.coverage import LEGEND, TRACK_LEGEND, clock_words
from buddyline.tools.monitor.panel import length_words
from buddyline.tools.monitor.replay import keyframes, replay_html
from buddyline.tools.monitor.summary import Summary, summarize
from buddyline.tools.newfile import check_new, write_new
from buddyline.tools.pairs import Pair, solved_pair
from msgspec import UNSET

log = logging.getLogger(__name__)

MIN_STRETCH_S: Final = 1.0
MAX_STRETCHES: Final = 40
# Poses further apart than this are not joined.
JOINED_NS: Final = 3 * S_NS // 2

CSS: Final = (
    "@media(min-width:700px){td:first-child{white-space:nowrap}}"
    ".two{display:grid;grid-template-columns:repeat(auto-fit,minmax(300px,1fr));gap:12px}.wide{min-width:640px}"
    ".cam svg{width:100%;background:#05080c}.replay canvas{width:100%;height:min(62vh,480px);display:block;"
    "touch-action:none;border-radius:4px;cursor:grab}"
    ".bar{display:flex;gap:8px;align-items:center;flex-wrap:wrap;margin:6px 0}.bar input{flex:1;min-width:120px}"
    ".bar output{min-width:13em;font-variant-numeric:tabular-nums}@media print{.bar{display:none}}" + STRIP_CSS
)


def run(args: argparse.Namespace) -> int:
    """Write the report; return 0."""
    figures.check()
    check_new(args.output)
    with Dive(args.dives) as dive:
        text = report_html(dive, solved_pair(dive, args.pair), check_logs(dive.readers, args.authority))
    write_new(args.output, text)
    log.info("%s: %.1f MB", args.output, len(text) / 1e6)
    return 0


def report_html(dive: Dive, pair: Pair | None, authenticity: Sequence[str] = ()) -> str:
    """Return the report of a dive as one HTML page; pair: whose poses are reported.

    authenticity: lines that say whether the logs are what their nodes wrote.
    """
    summary = summarize(dive, pair)
    begun = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(dive.start_ns / S_NS))
    nodes = " and ".join(sorted(summary.picture.nodes)) or "none"
    warnings = [*dive.losses, *authenticity]
    if not summary.poses:
        warnings.append("this log holds no pose; solve it first: buddyline solve DIVE.mcap -o OUT.mcap")
    if summary.picture.other_pairs:
        others = ", ".join(f"{a} and {b}" for a, b in sorted(summary.picture.other_pairs))
        warnings.append(f"poses of other pairs are not reported: {others}; choose with --pair A/B")
    return page(
        f"Dive report: {', '.join(reader.path.name for reader in dive.readers)}",
        f'<p class="dim">Begun {begun}, {duration_words(dive.seconds)} long, nodes {escape(nodes)}.</p>',
        *(f'<p class="warn">{escape(warning)}</p>' for warning in warnings),
        section("Figures", _figures(summary)),
        section("Replay", _replay(summary)),
        section("Plan and profile", _maps(summary)),
        section("Over time", f'<div class="scroll"><div class="wide">{_over_time(summary)}</div></div>'),
        section("Coverage: where there is a pose or a track, and where and why there is no pose", _coverage(summary)),
        section("Pictures", _pictures(summary)),
        section("Calibration and versions", _calibration(summary), _versions(dive, summary)),
        css=CSS,
    )


def _figures(summary: Summary) -> str:
    triggers = trigger_figures(summary.poses, summary.rejected, [])
    rows = [("triggers", f"{triggers.total}")]
    if triggers.total:
        rows.append(("with a pose", f"{len(summary.poses)} ({len(summary.poses) / triggers.total:.0%})"))
    covered = summary.covered()
    if summary.tracks and covered is not None:
        rows.append((f"covered by the track (1 sd below {TRACK_SIGMA_SHARE:.0%} of the range)", f"{covered:.0%}"))
        rows.append(("longest time without a light", duration_words(summary.dark_s)))
    if triggers.gap_s is not None:
        rows.append(("longest time without a pose", duration_words(triggers.gap_s)))
    if summary.poses:
        ranges_m = [pose.range_m for pose in summary.poses]
        rows.append(("range", f"{min(ranges_m):.2f} to {max(ranges_m):.2f} m"))
        sigmas_m = [sigma_m(pose) for pose in summary.poses]
        rows.append(("position's uncertainty (1 sd) of a pose, median", length_words(float(np.median(sigmas_m)))))
    if summary.tracks:
        sigmas_m = [sigma_m(point.estimate) for point in summary.tracks]
        rows.append(("position's uncertainty (1 sd) of the track, median", length_words(float(np.median(sigmas_m)))))
    if summary.poses:
        gaps_m = [abs(pose.range_gap_m) for pose in summary.poses]
        rows.append(("range gap between both nodes, median", length_words(float(np.median(gaps_m)))))
    for node, line in sorted(summary.depths.items()):
        depths_m = [depth_m for _, depth_m in line]
        rows.append((f"depth of {node}", f"{min(depths_m):.2f} to {max(depths_m):.2f} m"))
    errors = summary.errors()
    against = [
        ("position of the poses", Stats.of(errors.translation_m)),
        ("range of the poses", Stats.of(abs(errors.range_m))),
    ]
    for track in summary.track_figures():
        if track.samples:
            rows.append(("wrong samples of the track", f"{track.wrong} of {track.samples}"))
        against += [
            ("position of the track", track.position_m),
            (f"position of the track without a light for {NO_LIGHT_S:g} s", track.in_gaps_m),
        ]
    for name, stats in against:
        if stats.median is not None and stats.p95 is not None:
            rows.append(
                (f"against truth, {name}", f"{length_words(stats.median)} median, {length_words(stats.p95)} p95")
            )
    return table(rows)


def _replay(summary: Summary) -> str:
    points, joined_ns = summary.drawn(), max(JOINED_NS, 2 * summary.spacing_ns)
    return replay_html(
        keyframes(points, summary.coverage.begin_ns, joined_ns),
        summary.picture,
        levelled=any(point.frame.levelled for point in points),
        what="track" if summary.tracks else "pose",
        stale_s=max(1.0, 2 * summary.spacing_ns / S_NS),
    )


def _maps(summary: Summary) -> str:
    """Return plan (from above, north up) and profile (distance and depth) of B as seen from A."""
    depths_a = summary.depths.get(summary.picture.ends()[0] or "", [])
    plan = inline_svg(dive_figures.plan(summary.points, summary.tracks), "plan")
    profile = inline_svg(dive_figures.profile(summary.points, summary.tracks, depths_a), "profile")
    said = (
        "Dots: poses. Line: the track, with some 95 % ellipses"
        if summary.tracks
        else "Line: poses; the log holds no track of this pair"
    )
    by_compass = any(known(point.estimate, "sigma_azimuth_rad") for point in summary.tracks)
    compass = ", which contain the compass's error" if by_compass else ""
    return f'<div class="two">{plan}{profile}</div><p class="dim">{said}{compass}.</p>'


def _over_time(summary: Summary) -> str:
    coverage = summary.coverage
    span_ns = coverage.begin_ns, coverage.end_ns
    without_ns = [
        (stretch.begin_at_ns, stretch.end_at_ns) for stretch in coverage.without() if stretch.seconds >= MIN_STRETCH_S
    ]
    return inline_svg(
        dive_figures.over_time([*summary.points, *summary.tracks], summary.depths, span_ns, without_ns), "over time"
    )


def _coverage(summary: Summary) -> str:
    coverage, rejected = summary.coverage, Counter(rejection.reason for rejection in summary.rejected)
    total = len(summary.poses) + len(summary.rejected)
    rows = [(reason_words(why), why, f"{count}", f"{count / total:.1%}") for why, count in rejected.most_common()]
    gaps = [stretch for stretch in coverage.without() if stretch.seconds >= MIN_STRETCH_S]
    longest = sorted(sorted(gaps, key=lambda gap: -gap.seconds)[:MAX_STRETCHES], key=lambda gap: gap.begin_ns)
    listed = "".join(f"<li>{escape(coverage.words(gap))}</li>" for gap in longest)
    more = f"<p class='dim'>The {MAX_STRETCHES} longest of {len(gaps)}.</p>" if len(gaps) > MAX_STRETCHES else ""
    track = summary.track_coverage
    return (
        coverage.strip()
        + f"<p class='dim'>{LEGEND.capitalize()}. "
        + f"From 0 to {clock_words((coverage.end_ns - coverage.begin_ns) / S_NS)}.</p>"
        + (f"{track.strip()}<p class='dim'>{TRACK_LEGEND.capitalize()}.</p>" if track is not None else "")
        + (table(rows) if rows else "<p>No trigger ended without a pose.</p>")
        + (f"<p>Stretches of a second or more without a pose:</p><ul>{listed}</ul>{more}" if listed else "")
    )


def _pictures(summary: Summary) -> str:
    cards = "".join(
        f"<div class='cam'>{shot.drawing}<div class='dim'>Node {escape(node)} at "
        f"{clock_words((shot.at_ns - summary.coverage.begin_ns) / S_NS)}. {escape(shot.words)} "
        "Yellow rings: candidates; red L and green R: the other node's left and right light.</div></div>"
        for node, shot in sorted(summary.shots.items())
    )
    return f"<div class='two'>{cards}</div>" if cards else ""


def _calibration(summary: Summary) -> str:
    tables = []
    for node, infos in sorted(summary.infos.items()):
        changed = f" (changed {len(infos) - 1} times; the last)" if len(infos) > 1 else ""
        tables.append(f"<div><h3>Node {escape(node)}{changed}</h3>{table(_rig_rows(infos[-1]))}</div>")
    return f'<div class="two">{"".join(tables)}</div>' if tables else "<p>The log holds no calibration.</p>"


def _rig_rows(info: NodeInfo) -> list[tuple[str, str]]:
    camera = info.camera
    return [
        ("picture", f"{info.width_px} x {info.height_px} px, {S_NS / info.trigger_period_ns:g} a second"),
        ("camera", f"{camera.model}, f {camera.fx_px:.2f}, {camera.fy_px:.2f} px, "
                   f"centre {camera.cx_px:.2f}, {camera.cy_px:.2f} px"),
        ("distortion", ", ".join(f"{value:.5g}" for value in camera.distortion)),
        ("left light", _vector(info.light_left_m)),
        ("right light", _vector(info.light_right_m)),
        ("light spacing", f"{math.dist(info.light_left_m, info.light_right_m):.4f} m"),
        ("candidate noise", f"{info.sigma_px:g} px"),
        ("depth port", _vector(info.depth_port_m)),
        ("declination", f"{math.degrees(info.declination_rad):.2f} deg" if info.declination_rad else
                        "not set: headings are magnetic"),
        ("software", info.software or "not said"),
        ("configuration's sha256", info.config_sha256 or "not said"),
    ]  # fmt: skip


def _vector(xyz: tuple[float, float, float]) -> str:
    return "x {:.4f}, y {:.4f}, z {:.4f} m (camera frame)".format(*xyz)


def _versions(dive: Dive, summary: Summary) -> str:
    rows = [("this report", f"buddyline {__version__}")]
    solver = summary.picture.solver
    if solver is not None:
        rows.append(("solver", solver.software))
    for reader in dive.readers:
        noted = ", ".join(f"{key} {value}" for key, value in sorted(reader.metadata().items()))
        rows.append((reader.path.name, noted or "no notes"))
    for node in sorted(summary.picture.nodes.values(), key=lambda node: node.node):
        if node.status is not None:
            temperature = node.status.temperature_degc
            hot = "" if temperature is UNSET else f", {temperature:.0f} degrees C at the end"
            rows.append(
                (f"node {node.node}", f"{node.status.software}, up {duration_words(node.status.uptime_s)}{hot}")
            )
    counted = ", ".join(f"{key.removeprefix('buddyline/')} {count}" for key, count in sorted(summary.counts.items()))
    rows.append(("messages", counted))
    return table(rows)
