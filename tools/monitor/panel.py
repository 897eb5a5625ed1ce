"""The texts, pictures and plots beside the scene, as HTML; everything that came over the bus is escaped."""

from __future__ import annotations

import base64
import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from html import escape
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, CompressedImage, Rejected, RelativePose
from buddyline.protocol.topics import CANDIDATES, IMAGE, NODE_STATUS
from buddyline.tools.health.finding import Finding
from buddyline.tools.health.pair import findings
from buddyline.tools.health.words import duration_words, reason_words, sentence
from buddyline.tools.monitor.picture import Miss, NodePicture, PairPicture, Point
from buddyline.tools.monitor.svg import COLOURS, STYLE, Line, Plot, svg
from msgspec import UNSET

PLOTTED_NS: Final = 120 * S_NS
# Poses further apart than this are not joined by a line: between them nothing is known.
BREAK_NS: Final = 3 * S_NS // 2
REJECTED_COLOUR: Final = "#e0574f"
LEFT_COLOUR, RIGHT_COLOUR, OTHER_COLOUR = "#ff5c5c", "#4be37a", "#ffd34d"
_MIME: Final = {"jpeg": "image/jpeg", "jpg": "image/jpeg", "png": "image/png"}

CSS: Final = (
    "<style>"
    ".bl{font:13px/1.4 system-ui,sans-serif;padding:2px 12px;container-type:inline-size}"
    ".bl .banner{border-radius:6px;padding:6px 10px;margin:2px 0 6px;font-weight:600;color:#fff}"
    ".bl .ok{background:#2b7a43}.bl .warning{background:#8a6410}.bl .problem{background:#a32f2a}"
    ".bl .big{font-size:clamp(17px,6.4cqw,25px);font-weight:650;font-variant-numeric:tabular-nums;"
    "letter-spacing:-.5px;white-space:nowrap}"
    ".bl .old,.bl .old *{color:#8b8f96!important;text-decoration:line-through}"
    ".bl .grid{display:grid;grid-template-columns:repeat(3,1fr);gap:2px 8px}"
    ".bl .dim{opacity:.65;font-size:11px}"
    ".bl table{width:100%;border-collapse:collapse;font-variant-numeric:tabular-nums}"
    ".bl td{padding:1px 4px 1px 0;vertical-align:top}.bl td.n{text-align:right;white-space:nowrap}"
    ".bl .find{border-left:4px solid;padding:1px 8px;margin:4px 0;background:rgba(128,128,128,.1)}"
    ".bl .find.problem{border-color:#e0574f;background:rgba(224,87,79,.14)}.bl .find.warning{border-color:#e0a93b;"
    "background:rgba(224,169,59,.12)}.bl .find.ok{border-color:#4caf6a;background:rgba(76,175,106,.12)}"
    ".bl .cam{position:relative;margin:4px 0}.bl .cam svg{width:100%;height:auto;display:block;background:#05080c;"
    "border-radius:4px}.bl .cam.stale svg{filter:grayscale(1) brightness(.55)}" + STYLE + "</style>"
)


def block(*parts: str) -> str:
    """Wrap parts of HTML as one block of the panel, with its style."""
    return f'{CSS}<div class="bl">{"".join(parts)}</div>'


def headline(picture: PairPicture, now_ns: int, *, live: bool = True) -> str:
    """Return the worst thing to say, and the newest pose in large figures, struck through once it is stale."""
    worst = findings(picture, now_ns, live=live)[0]
    banner = f'<div class="banner {worst.level}">{escape(sentence(worst, now_ns))}</div>'
    return block(banner, _figures(picture, now_ns))


# Smaller than a figure, which it is not.
UNKNOWN: Final = "<span class='dim'>unknown</span>"


def _figures(picture: PairPicture, now_ns: int) -> str:
    pose, age_ns = picture.pose, picture.pose_age_ns(now_ns)
    if pose is None or age_ns is None:
        return '<div class="dim">No pose yet.</div>'
    stale = picture.is_stale(now_ns)
    sigma_m = math.sqrt(sum(max(pose.covariance[i], 0.0) for i in (0, 7, 14)))
    azimuth = UNKNOWN if pose.azimuth_rad is UNSET else f"{math.degrees(pose.azimuth_rad):.1f}°"
    inclination = UNKNOWN if pose.inclination_rad is UNSET else f"{math.degrees(pose.inclination_rad):+.1f}°"
    cells = "".join(
        f'<div><div class="dim">{name}</div><div class="big">{value}</div></div>'
        for name, value in (("range", f"{pose.range_m:.2f} m"), ("azimuth", azimuth), ("inclination", inclination))
    )
    age = f"<b>STALE: {duration_words(age_ns / S_NS)} old.</b> " if stale else ""
    depths = ", ".join(
        f"{escape(end)} {node.depth.depth_m:.2f} m deep"
        for end in picture.ends()
        if end is not None and (node := picture.nodes.get(end)) is not None and node.depth is not None
    )
    upright = " Upright assumed." if "upright_assumed" in pose.checks else ""
    checks = ", ".join(check.replace("_", " ") for check in pose.checks if check != "upright_assumed") or "none"
    note = (
        f"{age}From {escape(pose.node_a)} to {escape(pose.node_b)}, position ± {_length(sigma_m)} (1 sd)"
        f"{'; ' + depths if depths else ''}. Checked by {escape(checks)}.{upright}"
    )
    return f'<div class="grid{" old" if stale else ""}">{cells}</div><div class="dim">{note}</div>'


def _length(metres: float) -> str:
    return f"{metres * 1e3:.1f} mm" if metres < 0.1 else f"{metres:.2f} m"


def health(picture: PairPicture, now_ns: int, *, live: bool = True) -> str:
    """Return all there is to say, then each node's and the solver's figures and the rejections by reason."""
    said = "".join(_finding(finding, now_ns) for finding in findings(picture, now_ns, live=live))
    rows = "".join(_node_row(picture.nodes[name], now_ns) for name in sorted(picture.nodes))
    return block(said, f"<table>{rows}{_solver_row(picture, now_ns)}</table>", _rejections(picture))


def _finding(finding: Finding, now_ns: int) -> str:
    advice = f'<div class="dim">What to do: {escape(finding.advice)}.</div>' if finding.advice else ""
    return f'<div class="find {finding.level}">{escape(sentence(finding, now_ns))}{advice}</div>'


def _node_row(node: NodePicture, now_ns: int) -> str:
    age_ns = node.age_ns(CANDIDATES.name, now_ns)
    pictures = "no pictures yet" if age_ns is None else f"newest picture {duration_words(age_ns / S_NS)} ago"
    facts = [pictures]
    status = node.status
    if status is not None and not node.is_stale(NODE_STATUS, now_ns):
        facts += [f"{escape(what)} {rate:.0f}/s" for what, rate in sorted(status.rates_hz.items()) if rate >= 0.5]
        facts += [
            f"{count} {escape(cause.replace('_', ' '))} dropped" for cause, count in status.drops.items() if count
        ]
        if status.disk_free_bytes is not UNSET:
            facts.append(f"{status.disk_free_bytes / 1e9:.1f} GB free")
        if status.temperature_degc is not UNSET:
            facts.append(f"{status.temperature_degc:.0f} °C")
        if status.clock_offset_s is not UNSET:
            facts.append(f"clock {status.clock_offset_s * 1e3:+.1f} ms")
    return f'<tr><td><b>Node&nbsp;{escape(node.node)}</b></td><td class="dim">{", ".join(facts)}</td></tr>'


def _solver_row(picture: PairPicture, now_ns: int) -> str:
    status = picture.solver
    if status is None or picture.solver_ns is None:
        return ""
    facts = [f"{status.solved} poses of {status.matched} pairs of pictures", f"{status.late} late"]
    if status.latency_median_s is not UNSET:
        facts.append(f"latency {status.latency_median_s * 1e3:.0f} ms")
    if status.bad_messages:
        facts.append(f"{status.bad_messages} bad messages")
    facts.append(f"heard {duration_words((now_ns - picture.solver_ns) / S_NS)} ago")
    return f'<tr><td><b>Solver</b></td><td class="dim">{", ".join(facts)}</td></tr>'


def _rejections(picture: PairPicture) -> str:
    total = picture.solved + picture.rejected.total()
    if not total:
        return ""
    rows = "".join(
        f'<tr><td>{escape(reason_words(reason))} <span class="dim">{escape(reason)}</span></td>'
        f'<td class="n">{count}</td><td class="n">{count / total:.0%}</td></tr>'
        for reason, count in picture.rejected.most_common()
    )
    solved = (
        f'<tr><td>pose found</td><td class="n">{picture.solved}</td><td class="n">{picture.solved / total:.0%}</td>'
    )
    return f'<div class="dim" style="margin-top:6px">Triggers seen here</div><table>{solved}</tr>{rows}</table>'


def camera(picture: PairPicture, node: NodePicture, now_ns: int) -> str:
    """Return a node's newest picture with what was found in it and what became of it, or its candidates alone."""
    image = node.image
    frame = node.seen_at(image.stamp_ns) if image is not None else (node.candidates[-1] if node.candidates else None)
    topic = CANDIDATES if image is None else IMAGE
    age_ns = node.age_ns(topic.name, now_ns)
    if age_ns is None:
        return block(f'<div class="dim">Node {escape(node.node)}: no picture yet.</div>')
    old = node.is_stale(topic, now_ns)
    result = picture.results.get(frame.trigger) if frame is not None else None
    heading = f'<b>Node {escape(node.node)}</b> <span class="dim">{_picture_words(image, frame, age_ns, old)}</span>'
    drawing = marked_picture(image, frame, result, node.node)
    words = result_words(result, node.node) if frame is not None else ""
    return block(
        f'<div class="cam{" stale" if old else ""}">{heading}{drawing}<div class="dim">{escape(words)}</div></div>'
    )


def _picture_words(image: CompressedImage | None, frame: Candidates | None, age_ns: int, old: bool) -> str:
    lights = (
        ""
        if frame is None
        else f", {len(frame.blobs)} candidates" + (f" and {frame.truncated} more" if frame.truncated else "")
    )
    kind = "picture" if image is not None else "no preview, candidates only"
    return f"{kind}{', STALE: ' + duration_words(age_ns / S_NS) + ' old' if old else ''}{lights}"


def result_words(result: RelativePose | Rejected | None, node: str) -> str:
    """Say what became of a picture."""
    if result is None:
        return "The solver has said nothing of this picture."
    if isinstance(result, Rejected):
        detail = f" ({result.detail})" if result.detail else ""
        return f"No pose: {reason_words(result.reason)}{detail}."
    seen = sum(index >= 0 for index in _chosen(result, node))
    return f"Pose at {result.range_m:.2f} m; {seen} of the other node's 2 lights chosen here."


def _chosen(result: RelativePose, node: str) -> tuple[int, int]:
    return result.blobs_a if node == result.node_a else result.blobs_b


def marked_picture(
    image: CompressedImage | None, frame: Candidates | None, result: RelativePose | Rejected | None, node: str
) -> str:
    """Return a picture as <svg> with its candidates as rings, and the chosen left and right light marked."""
    width, height = (frame.width_px, frame.height_px) if frame is not None else (4, 3)
    parts = []
    mime = _MIME.get(image.format.lower()) if image is not None else None
    if image is not None and mime is not None:
        data = base64.b64encode(image.data).decode("ascii")
        fitted = "none" if frame is not None else "xMidYMid meet"
        parts.append(
            f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" preserveAspectRatio="{fitted}" '
            f'href="data:{mime};base64,{data}"/>'
        )
    if frame is not None:
        parts += _marks(frame, result, node)
    return f'<svg viewBox="-0.5 -0.5 {width} {height}">{"".join(parts)}</svg>'


def _marks(frame: Candidates, result: RelativePose | Rejected | None, node: str) -> Iterable[str]:
    unit_px = frame.width_px / 100
    chosen = _chosen(result, node) if isinstance(result, RelativePose) else (-1, -1)
    for index, blob in enumerate(frame.blobs):
        if index in chosen:
            side = chosen.index(index)
            colour, name = ((LEFT_COLOUR, "L"), (RIGHT_COLOUR, "R"))[side]
            size = unit_px * 4
            text_x = blob.u_px + (-1 if side == 0 else 1) * unit_px * 3
            yield (
                f'<circle cx="{blob.u_px:.1f}" cy="{blob.v_px:.1f}" r="{unit_px * 2.2:.1f}" fill="none" '
                f'stroke="{colour}" stroke-width="{unit_px * 0.6:.1f}"/>'
                f'<text x="{text_x:.1f}" y="{blob.v_px - unit_px * 2:.1f}" fill="{colour}" font-size="{size:.1f}" '
                f'font-weight="700" text-anchor="{"end" if side == 0 else "start"}">{name}</text>'
            )
        else:
            yield (
                f'<circle cx="{blob.u_px:.1f}" cy="{blob.v_px:.1f}" r="{unit_px * 1.3:.1f}" fill="none" '
                f'stroke="{OTHER_COLOUR}" stroke-width="{unit_px * 0.3:.1f}" stroke-opacity="0.8"/>'
            )


def plots(picture: PairPicture, now_ns: int) -> str:
    """Return the last minutes as plots; stretches without a pose are marked and never bridged."""
    points = picture.recent(now_ns, PLOTTED_NS)
    begin_ns = max(now_ns - PLOTTED_NS, picture.first_ns or 0)
    x_range = (min((begin_ns - now_ns) / S_NS, -10.0), 0.0)
    bands = [
        ((begin - now_ns) / S_NS, (end - now_ns) / S_NS, REJECTED_COLOUR)
        for begin, end in stretches(
            [miss for miss in picture.misses if miss.at_ns >= begin_ns], [point.at_ns for point in points]
        )
    ]
    return block(*(svg(plot) for plot in time_plots(points, now_ns, x_range, bands, "s before now")))


def time_plots(
    points: Sequence[Point],
    zero_ns: int,
    x_range: tuple[float, float],
    bands: Sequence[tuple[float, float, str]],
    x_title: str,
    width: int = 460,
) -> list[Plot]:
    """Return the plots of range, direction, gap and latency over the time from zero_ns (s)."""
    bearing = [point for point in points if point.azimuth_rad is not None and point.inclination_rad is not None]
    azimuth = Line("azimuth", _turns(bearing, zero_ns), COLOURS[1], dots=True)
    up = Line("inclination", _curve(bearing, zero_ns, [math.degrees(p.inclination_rad or 0.0) for p in bearing]))
    timed = [point for point in points if point.latency_s is not None]
    wanted = [
        ("Range", "m", [Line("", _curve(points, zero_ns, [p.range_m for p in points]))]),
        ("Azimuth", "deg from north, clockwise", [azimuth]),
        ("Inclination", "deg, up positive", [up]),
        ("Range gap", "mm between both nodes' ranges", [_gap(points, zero_ns)]),
    ]
    if timed:
        delay = [(p.latency_s or 0.0) * 1e3 for p in timed]
        wanted.append(("Latency", "ms from exposure to here", [Line("", _curve(timed, zero_ns, delay), COLOURS[2])]))
    return [
        Plot(title, unit, [_nameless(line) for line in lines], x_range, bands, x_title, width=width)
        for title, unit, lines in wanted
    ]


def _nameless(line: Line) -> Line:
    return Line("", line.points, line.colour, line.dots)


def _gap(points: Sequence[Point], zero_ns: int) -> Line:
    return Line("", _curve(points, zero_ns, [p.range_gap_m * 1e3 for p in points]), COLOURS[3])


def _curve(points: Sequence[Point], zero_ns: int, values: Sequence[float]) -> list[tuple[float, float] | None]:
    curve: list[tuple[float, float] | None] = []
    before_ns: int | None = None
    for point, value in zip(points, values, strict=True):
        if before_ns is not None and point.at_ns - before_ns > BREAK_NS:
            curve.append(None)
        curve.append(((point.at_ns - zero_ns) / S_NS, value))
        before_ns = point.at_ns
    return curve


def _turns(points: Sequence[Point], zero_ns: int) -> list[tuple[float, float] | None]:
    """Return azimuths in deg, on the turn nearest to the one before: no jump where north is crossed."""
    values: list[float] = []
    for point in points:
        value = math.degrees(point.azimuth_rad or 0.0)
        if values:
            value += 360.0 * round((values[-1] - value) / 360.0)
        values.append(value)
    return _curve(points, zero_ns, values)


def stretches(misses: Sequence[Miss], poses_ns: Sequence[int], joined_ns: int = S_NS) -> list[tuple[int, int]]:
    """Return the stretches (from, to) of triggers without a pose.

    poses_ns: when poses came, ascending; one in between parts two stretches. joined_ns: misses further apart are
    two stretches all the same: between them nothing was tried.
    """
    found: list[tuple[int, int]] = []
    for miss in misses:
        if found and 0 <= miss.at_ns - found[-1][1] <= joined_ns:
            begin, end = found[-1]
            following = bisect_left(poses_ns, end)
            if following == len(poses_ns) or poses_ns[following] > miss.at_ns:
                found[-1] = (begin, miss.at_ns)
                continue
        found.append((miss.at_ns, miss.at_ns))
    return found
