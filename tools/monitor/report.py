"""`buddyline report`: a dive on one page that needs nothing else, to keep, to send and to print."""

from __future__ import annotations

import argparse
import logging
import math
import time
from html import escape
from pathlib import Path
from typing import Final

import numpy as np
from buddyline.protocol import __version__
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import NodeInfo
from buddyline.tools.dives import Dive
from buddyline.tools.health.words import duration_words, reason_words
from buddyline.tools.monitor.coverage import clock_words
from buddyline.tools.monitor.panel import REJECTED_COLOUR, stretches, time_plots
from buddyline.tools.monitor.picture import Point
from buddyline.tools.monitor.replay import replay_html, rig_outline
from buddyline.tools.monitor.summary import Summary, summarize
from buddyline.tools.monitor.svg import COLOURS, STYLE, Line, Plot, svg
from buddyline.tools.newfile import check_new, write_new
from msgspec import UNSET

log = logging.getLogger(__name__)

MIN_STRETCH_NS: Final = S_NS
MAX_STRETCHES: Final = 40
WIDE: Final = 900

CSS: Final = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:1000px;margin:0 auto;padding:12px 16px;color:#1b232b;"
    "background:#fff}h1{font-size:1.5em;margin:.3em 0}h2{font-size:1.15em;margin:1.6em 0 .4em;border-bottom:1px solid "
    "#ccd3da}table{border-collapse:collapse;font-variant-numeric:tabular-nums;max-width:100%}td,th{padding:2px 14px "
    "2px 0;text-align:left;vertical-align:top;overflow-wrap:break-word}td.n{text-align:right;white-space:nowrap}"
    "@media(min-width:700px){td:first-child{white-space:nowrap}}"
    ".dim{color:#5b6670;font-size:.87em}.two{display:grid;grid-template-columns:repeat(auto-fit,minmax(300px,1fr));"
    "gap:12px}.scroll{overflow-x:auto}.wide{min-width:640px}"
    ".warn{background:#fff3d6;border-left:4px solid #d9a520;padding:4px 10px}"
    ".strip{width:100%;height:26px;display:block;border-radius:3px}.cam svg{width:100%;height:auto;background:#05080c}"
    ".replay canvas{width:100%;height:min(62vh,480px);display:block;touch-action:none;border-radius:4px;cursor:grab}"
    ".bar{display:flex;gap:8px;align-items:center;flex-wrap:wrap;margin:6px 0}.bar input{flex:1;min-width:120px}"
    ".bar output{min-width:13em;font-variant-numeric:tabular-nums}@media print{.bar{display:none}}" + STYLE
)
# Nothing outside is ever asked for, and nothing in a log can make it so.
POLICY: Final = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="one dive: a solved log, or each node's own")
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="report.html")


def run(args: argparse.Namespace) -> int:
    """Write the report; return 0."""
    check_new(args.output)
    with Dive(args.dives) as dive:
        page = report_html(dive)
    write_new(args.output, page)
    log.info("%s: %.1f MB", args.output, len(page) / 1e6)
    return 0


def report_html(dive: Dive) -> str:
    """Return the report of a dive as one HTML page."""
    summary = summarize(dive)
    title = ", ".join(reader.path.name for reader in dive.readers)
    begun = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(dive.start_ns / S_NS))
    whole_s = (dive.end_ns - dive.start_ns) / S_NS
    warnings = [*dive.losses]
    if not summary.picture.solved:
        warnings.append("this log holds no pose; solve it first: buddyline solve DIVE.mcap -o OUT.mcap")
    parts = [
        f"<h1>Dive report: {escape(title)}</h1>",
        f'<p class="dim">Begun {begun}, {duration_words(whole_s)} long, '
        f"nodes {escape(' and '.join(sorted(summary.picture.nodes)) or 'none')}.</p>",
        *(f'<p class="warn">{escape(warning)}</p>' for warning in warnings),
        "<h2>Figures</h2>",
        _figures(summary),
        "<h2>Replay</h2>",
        _replay(summary),
        "<h2>Plan and profile</h2>",
        _maps(summary),
        "<h2>Over time</h2>",
        f'<div class="scroll"><div class="wide">{"".join(_plots(summary))}</div></div>',
        "<h2>Coverage: where there is a pose, and where and why not</h2>",
        _coverage(summary),
        _pictures(summary),
        "<h2>Calibration and versions</h2>",
        _calibration(summary),
        _versions(dive, summary),
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        f"<title>{escape(title)}</title><style>{CSS}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def _table(rows: list[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in rows)
    return f'<div class="scroll"><table>{cells}</table></div>'


def _figures(summary: Summary) -> str:
    solved, rejected = summary.picture.solved, summary.picture.rejected.total()
    rows = [("triggers", f"{solved + rejected}")]
    if solved + rejected:
        rows.append(("with a pose", f"{solved} ({solved / (solved + rejected):.0%})"))
    longest = max((end - begin for begin, end, _ in summary.coverage.without()), default=0)
    rows.append(("longest time without a pose", duration_words(longest / S_NS) if longest else "none"))
    if summary.ranges_m:
        rows.append(("range", f"{min(summary.ranges_m):.2f} to {max(summary.ranges_m):.2f} m"))
        rows.append(("position's uncertainty (1 sd), median", _length(float(np.median(summary.sigmas_m)))))
        gap_m = float(np.median(np.abs(summary.gaps_m)))
        rows.append(("range gap between both nodes, median", _length(gap_m)))
    for node, line in sorted(summary.depths.items()):
        depths_m = [depth_m for _, depth_m in line]
        rows.append((f"depth of {node}", f"{min(depths_m):.2f} to {max(depths_m):.2f} m"))
    if len(summary.errors_m):
        off_m, range_off_m = summary.errors_m[:, 0], np.abs(summary.errors_m[:, 1])
        rows.append(
            ("against truth, position", f"{_length(float(np.median(off_m)))} median, {_length(_p95(off_m))} p95")
        )
        rows.append(
            (
                "against truth, range",
                f"{_length(float(np.median(range_off_m)))} median, {_length(_p95(range_off_m))} p95",
            )
        )
    return _table(rows)


def _p95(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    return float(np.percentile(values, 95))


def _length(metres: float) -> str:
    return f"{metres * 1e3:.1f} mm" if metres < 0.1 else f"{metres:.2f} m"


def _replay(summary: Summary) -> str:
    names = summary.picture.ends()
    nodes = [summary.picture.nodes.get(name) if name else None for name in names]
    rigs = (rig_outline(nodes[0].info if nodes[0] else None), rig_outline(nodes[1].info if nodes[1] else None))
    levelled = any(point.levelled for point in summary.points)
    return replay_html(summary.keyframes, (names[0] or "A", names[1] or "B"), rigs, levelled=levelled)


def _maps(summary: Summary) -> str:
    """Return plan (from above, north up) and profile (distance and depth) of B as seen from A."""
    points = summary.points
    depth_a = summary.depths.get(summary.picture.ends()[0] or "", [])
    at_ns = np.array([ns for ns, _ in depth_a])
    depth_m = np.array([metres for _, metres in depth_a])

    def depth_of_b(point: Point) -> float:
        above_m = float(np.interp(point.at_ns, at_ns, depth_m)) if len(at_ns) else 0.0
        return above_m + point.t_m[2]

    plan = Plot(
        "Plan: B seen from A",
        "m; right is east, up is north" if any(p.levelled for p in points) else "m; right of A, ahead of A",
        [
            Line("B", _path(points, [(p.t_m[1], p.t_m[0]) for p in points])),
            Line("A", [(0.0, 0.0)], COLOURS[1], dots=True),
        ],
        equal=True,
        height=460,
    )
    profile = Plot(
        "Profile",
        "depth in m over horizontal distance in m" if len(at_ns) else "m below A over horizontal distance in m",
        [
            Line("B", _path(points, [(math.hypot(p.t_m[0], p.t_m[1]), depth_of_b(p)) for p in points])),
            Line("A", [(0.0, float(np.median(depth_m)) if len(depth_m) else 0.0)], COLOURS[1], dots=True),
        ],
        equal=True,
        y_down=True,
        height=460,
    )
    return f'<div class="two">{svg(plan)}{svg(profile)}</div>'


def _path(points: list[Point], at: list[tuple[float, float]]) -> list[tuple[float, float] | None]:
    path: list[tuple[float, float] | None] = []
    spacing_ns = _spacing_ns(points)
    for k, (point, xy) in enumerate(zip(points, at, strict=True)):
        if k and point.at_ns - points[k - 1].at_ns > spacing_ns:
            path.append(None)
        path.append(xy)
    return path


def _spacing_ns(points: list[Point]) -> int:
    """Return the time past which two points are not joined."""
    if len(points) < 2:
        return S_NS
    steps_ns = np.diff(np.array([point.at_ns for point in points]))
    return max(3 * S_NS // 2, 3 * int(np.median(steps_ns)))


def _plots(summary: Summary) -> list[str]:
    zero_ns = summary.coverage.begin_ns
    x_range = (0.0, (summary.coverage.end_ns - zero_ns) / S_NS)
    bands = [
        ((begin - zero_ns) / S_NS, (end - zero_ns) / S_NS, REJECTED_COLOUR)
        for begin, end in stretches(summary.misses, summary.pose_times_ns)
    ]
    plots = time_plots(summary.points, zero_ns, x_range, bands, "s from the start; red: no pose", width=WIDE)
    if summary.depths:
        lines = [
            Line(node, [((ns - zero_ns) / S_NS, metres) for ns, metres in line], COLOURS[k % len(COLOURS)])
            for k, (node, line) in enumerate(sorted(summary.depths.items()))
        ]
        plots.append(Plot("Depth", "m", lines, x_range, (), "s from the start", y_down=True, width=WIDE))
    return [svg(plot) for plot in plots]


def _coverage(summary: Summary) -> str:
    coverage, rejected = summary.coverage, summary.picture.rejected
    total = summary.picture.solved + rejected.total()
    rows = "".join(
        f"<tr><td>{escape(reason_words(reason))}</td><td class='dim'>{escape(reason)}</td><td class='n'>{count}</td>"
        f"<td class='n'>{count / total:.1%}</td></tr>"
        for reason, count in rejected.most_common()
    )
    gaps = [gap for gap in coverage.without() if gap[1] - gap[0] >= MIN_STRETCH_NS]
    longest = sorted(gaps, key=lambda gap: gap[0] - gap[1])[:MAX_STRETCHES]
    listed = "".join(f"<li>{escape(coverage.words(*gap))}</li>" for gap in sorted(longest, key=lambda gap: gap[0]))
    more = f"<p class='dim'>The {MAX_STRETCHES} longest of {len(gaps)}.</p>" if len(gaps) > MAX_STRETCHES else ""
    return (
        coverage.strip()
        + "<p class='dim'>Green: poses. Yellow: some triggers without. Red: most without. Grey: nothing to solve. "
        f"From 0 to {clock_words((coverage.end_ns - coverage.begin_ns) / S_NS)}.</p>"
        + (f"<div class='scroll'><table>{rows}</table></div>" if rows else "<p>No trigger ended without a pose.</p>")
        + (f"<p>Stretches of a second or more without a pose:</p><ul>{listed}</ul>{more}" if listed else "")
    )


def _pictures(summary: Summary) -> str:
    if not summary.shots:
        return ""
    cards = "".join(
        f"<div class='cam'>{shot.drawing}<div class='dim'>Node {escape(node)} at "
        f"{clock_words((shot.at_ns - summary.coverage.begin_ns) / S_NS)}. {escape(shot.words)} "
        "Yellow rings: candidates; red L and green R: the other node's left and right light.</div></div>"
        for node, shot in sorted(summary.shots.items())
    )
    return f"<h2>Pictures</h2><div class='two'>{cards}</div>"


def _calibration(summary: Summary) -> str:
    tables = []
    for node, infos in sorted(summary.infos.items()):
        changed = f" (changed {len(infos) - 1} times; the last)" if len(infos) > 1 else ""
        tables.append(f"<div><h3>Node {escape(node)}{changed}</h3>{_table(_rig_rows(infos[-1]))}</div>")
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
    return _table(rows)
