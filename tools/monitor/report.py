"""`buddyline report`: a dive on one HTML page, to keep, to send and to print."""

from __future__ import annotations

import argparse
import logging
import math
from collections import Counter
from collections.abc import Sequence
from html import escape
from typing import Any, Final

import numpy as np
from buddyline.protocol import __version__
from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import load_config
from buddyline.protocol.health import NO_LIGHT_S, TRACK_SIGMA_SHARE
from buddyline.protocol.messages import NodeInfo, NodePose
from buddyline.tools.authenticity import check_logs
from buddyline.tools.dives import Dive
from buddyline.tools.draw import dive as dive_figures
from buddyline.tools.draw import figures
from buddyline.tools.draw.figures import inline_svg
from buddyline.tools.draw.page import data_block, page, section, table
from buddyline.tools.draw.volume import LEVELS_M, draw_seen_volume, seen_volume
from buddyline.tools.estimate import known
from buddyline.tools.health.words import duration_words, reason_words
from buddyline.tools.monitor.coverage import CSS as STRIP_CSS
from buddyline.tools.monitor.coverage import LEGEND, TRACK_LEGEND, clock_words
from buddyline.tools.monitor.outliers import MAX_LISTED, add_pictures, outliers
from buddyline.tools.monitor.panel import length_words
from buddyline.tools.monitor.replay import keyframes, replay_html
from buddyline.tools.monitor.report_net import net_numbers, net_of, net_sections
from buddyline.tools.monitor.report_numbers import MIN_STRETCH_S, ReportAbout, numbers_of
from buddyline.tools.monitor.report_text import budget_html, methods_html, outliers_html
from buddyline.tools.monitor.summary import Summary, summarize
from buddyline.tools.newfile import check_new, write_new
from buddyline.tools.pairs import Pair, solved_pair
from msgspec import UNSET

log = logging.getLogger(__name__)

MAX_STRETCHES: Final = 40
# Poses further apart than this are not joined.
JOINED_NS: Final = 3 * S_NS // 2

CSS: Final = (
    "@media screen and (min-width:700px){td:first-child{white-space:nowrap}}"
    ".two{display:grid;grid-template-columns:repeat(auto-fit,minmax(300px,1fr));gap:12px}.wide{min-width:640px}"
    ".cam svg{width:100%;background:#05080c}.replay canvas{width:100%;height:min(62vh,480px);display:block;"
    "touch-action:none;border-radius:4px;cursor:grab}"
    ".bar{display:flex;gap:8px;align-items:center;flex-wrap:wrap;margin:6px 0}.bar input{flex:1;min-width:120px}"
    ".bar output{min-width:13em;font-variant-numeric:tabular-nums}"
    "@media print{.live,.bar{display:none}.wide{min-width:0}.two{grid-template-columns:1fr 1fr}.cam{break-inside:avoid}"
    "td:first-child{min-width:8em}}" + STRIP_CSS
)


def run(args: argparse.Namespace) -> int:
    """Write the report; return 0."""
    figures.check()
    check_new(args.output)
    about = ReportAbout() if args.about is None else load_config(args.about, ReportAbout)
    with Dive(args.dives) as dive:
        checked = check_logs(dive.readers, args.authority)
        text = report_html(dive, solved_pair(dive, args.pair), checked, about)
        if not dive.ids("pose", "net_pose", "track"):
            first = "" if dive.ids("rejected") else "; solve it first: buddyline solve"
            log.warning("%s: no poses in it, so that the report has none%s", dive.name, first)
    write_new(args.output, text)
    log.info("%s: %.1f MB", args.output, len(text) / 1e6)
    return 0


def report_html(
    dive: Dive, pair: Pair | None, authenticity: Sequence[str] = (), about: ReportAbout | None = None
) -> str:
    """Return the report of a dive as one HTML page; pair: whose poses are reported.

    authenticity: lines that say whether the logs are what their nodes wrote.
    """
    about = about or ReportAbout()
    summary = summarize(dive, pair)
    found = outliers(summary.poses, summary.path) if len(summary.path) else None
    add_pictures(dive, (found or [])[:MAX_LISTED])
    net = net_of(dive)
    of_net = net_numbers(net)
    numbers = numbers_of(dive, summary, found, about) | {"network": of_net}
    nodes = " and ".join(sorted(summary.picture.nodes)) or "none"
    warnings = [*dive.losses, *authenticity]
    if not summary.poses:
        warnings.append("this log holds no pose; solve it first: buddyline solve DIVE.mcap -o OUT.mcap")
    elif not summary.tracks:
        warnings.append("this log holds no track of this pair")
    solver = summary.picture.solver
    if solver is not None and solver.problem:
        warnings.append(f"the solver's last status: {solver.problem}")
    missing = numbers["triggers"]["without_outcome"]
    if missing and missing < numbers["triggers"]["total"]:
        warnings.append(
            f"{missing} triggers of the nodes' frames have no recorded outcome: there was no solver, or no recorder; "
            "solve the nodes' logs again for them"
        )
    if summary.picture.other_pairs:
        others = ", ".join(f"{a} and {b}" for a, b in sorted(summary.picture.other_pairs))
        warnings.append(f"poses of other pairs are not reported: {others}; choose with --pair A/B")
    named = about.title or f"Dive report: {', '.join(reader.path.name for reader in dive.readers)}"
    begun = f"Begun {numbers['dive']['begun']}, {duration_words(dive.seconds)} long, nodes {nodes}."
    return page(
        named,
        f'<p class="dim">{escape(begun)}</p>',
        _about(about),
        *(f'<p class="warn">{escape(warning)}</p>' for warning in warnings),
        section("Figures", _figures(numbers)),
        *net_sections(dive, net, of_net),
        section("Methods", methods_html(numbers, summary)),
        section("Where the error of a place comes from", budget_html(numbers)),
        f'<div class="live">{section("Replay", _replay(summary))}</div>',
        section("Plan and profile", _maps(summary)),
        *_seen_volume(dive),
        section("Over time", f'<div class="scroll"><div class="wide">{_over_time(summary)}</div></div>'),
        section("Coverage: where there is a pose or a track, and where and why there is no pose", _coverage(summary)),
        section("Outliers: poses that contradict the track", outliers_html(numbers, found, dive.start_ns)),
        section("Pictures", _pictures(summary)),
        section("Calibration and versions", _calibration(summary), _versions(dive, summary)),
        data_block("numbers", numbers),
        css=CSS,
    )


def _about(about: ReportAbout) -> str:
    rows = [("site", about.site), ("people", ", ".join(about.people)), ("instrument", about.instrument)]
    told = [row for row in rows if row[1]]
    text = "".join(f"<p>{escape(line)}</p>" for line in about.text.split("\n\n") if line.strip())
    return (table(told) if told else "") + text


def _figures(numbers: dict[str, Any]) -> str:
    triggers, poses, track = numbers["triggers"], numbers["poses"], numbers["track"]
    rows = [("triggers", f"{triggers['total']}")]
    if triggers["total"]:
        share = triggers["with_pose"] / triggers["total"]
        rows.append(("with a pose", f"{triggers['with_pose']} ({share:.0%})"))
    if triggers["without_outcome"] is not None:
        rows.append(("without a recorded outcome", f"{triggers['without_outcome']}"))
    if track and track["covered"] is not None:
        name = f"covered by the track (1 sd below {TRACK_SIGMA_SHARE:.0%} of the range)"
        rows.append((name, f"{track['covered']:.0%}"))
        rows.append(("longest time without a light", duration_words(track["longest_without_light_s"])))
    if triggers["longest_without_pose_s"] is not None:
        rows.append(("longest time without a pose", duration_words(triggers["longest_without_pose_s"])))
    if poses:
        rows.append(("range", f"{poses['range_least_m']:.2f} to {poses['range_most_m']:.2f} m"))
        sigma = length_words(poses["sigma_median_m"])
        rows.append(("position's uncertainty (1 sd) of a pose, median", sigma))
    if track:
        rows.append(("position's uncertainty (1 sd) of the track, median", length_words(track["sigma_median_m"])))
    if poses and poses["range_gap_median_m"] is not None:
        rows.append(("range gap between both nodes, median", length_words(poses["range_gap_median_m"])))
    for node, depth in numbers["depths"].items():
        rows.append((f"depth of {node}", f"{depth['least_m']:.2f} to {depth['most_m']:.2f} m"))
    truth = numbers["against_truth"] or {}
    if truth.get("track", {}).get("samples"):
        rows.append(("wrong samples of the track", f"{truth['track']['wrong']} of {truth['track']['samples']}"))
    for name, of, what in (
        ("position of the poses", "poses", "position"),
        ("range of the poses", "poses", "range"),
        ("position of the track", "track", "position"),
        (f"position of the track without a light for {NO_LIGHT_S:g} s", "track", "position_without_light"),
    ):
        stats = truth.get(of, {}).get(what)
        if stats and stats["count"]:
            median, p95 = length_words(stats["median_m"]), length_words(stats["p95_m"])
            rows.append((f"against truth, {name}", f"{median} median, {p95} p95"))
    if not track:
        return table(rows)
    said = f"The track's figures are of one sample in {track['spacing_s']:g} s; buddyline evaluate takes all samples."
    return table(rows) + f'<p class="dim">{said}</p>'


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
    compass = (
        ", which contain the compass's error. A dot is turned by A's attitude of that instant" if by_compass else ""
    )
    return f'<div class="two">{plan}{profile}</div><p class="dim">{said}{compass}.</p>'


def _seen_volume(dive: Dive) -> list[str]:
    """Return a section that shows where the fixed nodes would see another well; nothing without fixed nodes."""
    infos = dive.infos()
    fixed = {node: info for node, info in sorted(infos.items()) if info.fixed is not UNSET}
    if not fixed:
        return []
    poses = [one.message for one in dive.messages("net_pose") if isinstance(one.message, NodePose)]
    nets = {info.fixed.net for info in fixed.values() if info.fixed is not UNSET}
    places_m = np.array([pose.p_m for pose in poses if not pose.fixed and pose.net in nets])
    moving = next((info for node, info in sorted(infos.items()) if node not in fixed), fixed[min(fixed)])
    volume = seen_volume(fixed, moving, places_m)
    shares = ", ".join(f"better than {length_words(level)} in {volume.share(level):.0%}" for level in LEVELS_M)
    said = (
        f"By the lights that fixed nodes {', '.join(fixed)} and node {moving.node} would see of each other: {shares} "
        "of this area. Tracks with inertial units do better, turbid water does worse."
    )
    drawn = inline_svg(draw_seen_volume(volume, fixed), "where the fixed nodes see well, from above")
    return [section("Where the network sees well", drawn, f'<p class="dim">{escape(said)}</p>')]


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
    ended = {one.trigger for one in summary.poses} | {one.trigger for one in summary.rejected}
    # As in the figures: also triggers without an outcome count.
    total = len(summary.asked.keys() | ended)
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
        ("candidate noise, as configured", f"{info.sigma_px:g} px"),
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
        notes = {"checks asked for" if key == "checks" else key: note for key, note in reader.metadata().items()}
        noted = ", ".join(f"{key} {note}" for key, note in sorted(notes.items()))
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
