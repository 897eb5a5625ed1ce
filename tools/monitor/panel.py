"""The texts and pictures beside the scene, as HTML; all text from the bus is escaped."""

from __future__ import annotations

import math
from html import escape
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Rejected, RelativePose, Track, TrackMode
from buddyline.protocol.topics import CANDIDATES, IMAGE, MARK, NODE_STATUS
from buddyline.tools.draw.marks import marked_svg
from buddyline.tools.estimate import Estimate, known, range_sigma_m, sigma_m
from buddyline.tools.health.finding import Finding
from buddyline.tools.health.pair import findings
from buddyline.tools.health.words import duration_words, power_words, reason_words, sentence
from buddyline.tools.monitor.picture import NodePicture, PairPicture
from msgspec import UNSET

VERDICT_NS: Final = 60 * S_NS
TRACK_WORDS: Final[dict[TrackMode, str]] = {
    "filter": "from what came before",
    "lag": "from what came up to a second later",
    "smooth": "from the whole dive",
}


def figures(picture: PairPicture, now_ns: int) -> str:
    """Return B's place in large figures, which are struck through if they are stale."""
    shown = picture.shown(now_ns)
    if shown is None:
        return '<div class="dim">No pose yet.</div>'
    estimate = shown.estimate
    cells = "".join(
        f'<div class="figure"><div class="dim">{name}</div><div class="big">{value}</div>'
        f'<div class="dim">{sigma}</div></div>'
        for name, value, sigma in (
            ("range", f"{estimate.range_m:.2f} m", f"± {length_words(range_sigma_m(estimate))}"),
            ("azimuth", *_angle(estimate, "azimuth_rad", ".1f")),
            ("inclination", *_angle(estimate, "inclination_rad", "+.1f")),
        )
    )
    note = f"<b>{escape(shown.note[0].upper() + shown.note[1:])}.</b> " if shown.note else ""
    facts = f"From {estimate.node_a} to {estimate.node_b}{_ned_words(estimate)}. ± is 1 sd. {_origin(estimate)}"
    facts += "".join(
        f" {node.node} is {node.depth.depth_m:.2f} m deep." for node in picture.end_nodes() if node and node.depth
    )
    old = " old" if shown.stale else ""
    return f'<div class="grid{old}">{cells}</div><div class="dim facts">{note}{escape(facts)}</div>'


def _angle(estimate: Estimate, field: str, digits: str) -> tuple[str, str]:
    """Return an angle and its uncertainty, "" if that is not known."""
    angle_rad, sigma_rad = known(estimate, field), known(estimate, f"sigma_{field}")
    if angle_rad is None:
        # In smaller letters, because it is no figure.
        return "<span class='dim'>unknown</span>", ""
    sigma = "" if sigma_rad is None else f"± {math.degrees(sigma_rad):.1f}°"
    return f"{math.degrees(angle_rad):{digits}}°", sigma


def _ned_words(estimate: Estimate) -> str:
    """Return B from A north, east and down with its sigmas, compass included; else the position's sigma alone."""
    if estimate.t_ned_m is UNSET:
        return f", position ± {length_words(sigma_m(estimate))}"
    named = list(zip(("north", "east", "down"), estimate.t_ned_m, strict=True))
    if estimate.sigma_ned_m is UNSET:
        return ": " + ", ".join(f"{name} {x:+.2f} m" for name, x in named) + f", ± {length_words(sigma_m(estimate))}"
    both = zip(named, estimate.sigma_ned_m, strict=True)
    return ": " + ", ".join(f"{name} {_with_sigma(x, sigma)} m" for (name, x), sigma in both)


def _with_sigma(x_m: float, sigma_m: float) -> str:
    """Return a length and its sigma in m, both with as many digits as the sigma needs."""
    digits = 2 + (sigma_m < 0.01) + (sigma_m < 0.001)
    return f"{x_m:+.{digits}f} ± {sigma_m:.{digits}f}"


def _origin(estimate: Estimate) -> str:
    """Return the origin of an estimate in words."""
    if isinstance(estimate, Track):
        return f"Track ({TRACK_WORDS[estimate.mode]}), {estimate.lights} of 4 lights in the last pictures."
    upright = " Upright assumed." if "upright_assumed" in estimate.checks else ""
    checks = ", ".join(check.replace("_", " ") for check in estimate.checks if check != "upright_assumed") or "none"
    return f"One trigger's pose, checked by {checks}.{upright}"


def length_words(metres: float) -> str:
    """Return a length in mm or m."""
    return f"{metres * 1e3:.1f} mm" if metres < 0.1 else f"{metres:.2f} m"


def health(picture: PairPicture, now_ns: int, *, live: bool = True) -> str:
    """Return all findings, then each node's and the solver's figures and the rejections by reason."""
    said = "".join(_finding(finding, now_ns) for finding in findings(picture, now_ns, live=live))
    rows = [(f"Node {name}", _node_facts(picture.nodes[name], now_ns)) for name in sorted(picture.nodes)]
    rows += [("Solver", facts)] if (facts := _solver_facts(picture, now_ns)) else []
    table = "".join(
        f'<tr><td><b>{escape(who).replace(" ", "&nbsp;")}</b></td><td class="dim">{escape(", ".join(facts))}</td></tr>'
        for who, facts in rows
    )
    return f"{said}{_verdict(picture, now_ns)}<table>{table}</table>{_rejections(picture)}"


def _verdict(picture: PairPicture, now_ns: int) -> str:
    """Return what `survey watch` has said of the leg, once for both nodes."""
    said: dict[str, str] = {}
    for node in picture.end_nodes():
        age_ns = None if node is None else node.age_ns(MARK.name, now_ns)
        if node is not None and node.mark is not None and age_ns is not None and age_ns < VERDICT_NS:
            good = node.mark.kind == "leg"
            which = "an earlier leg" if node.mark.earlier else "the leg"
            verdict = "the leg is good" if good else f"measure {which} again ({node.mark.name})"
            said[f"Survey: {verdict}: {node.mark.note}."] = " ok" if good else " warning"
    return "".join(f'<div class="find{level}">{escape(text)}</div>' for text, level in said.items())


def _finding(finding: Finding, now_ns: int) -> str:
    advice = f'<div class="dim">What to do: {escape(finding.advice)}.</div>' if finding.advice else ""
    return f'<div class="find {finding.level}">{escape(sentence(finding, now_ns))}{advice}</div>'


def _node_facts(node: NodePicture, now_ns: int) -> list[str]:
    age_ns = node.age_ns(CANDIDATES.name, now_ns)
    facts = ["no pictures yet" if age_ns is None else f"newest picture {duration_words(age_ns / S_NS)} ago"]
    status = node.status
    if status is None or node.is_stale(NODE_STATUS, now_ns):
        return facts
    facts += [f"{what} {rate:.0f}/s" for what, rate in sorted(status.rates_hz.items()) if rate >= 0.5]
    facts += [f"{count} {cause.replace('_', ' ')} dropped" for cause, count in status.drops.items() if count]
    if status.disk_free_bytes is not UNSET:
        facts.append(f"{status.disk_free_bytes / 1e9:.1f} GB free")
    facts += power_words(status)
    if status.clock_offset_s is not UNSET:
        facts.append(f"clock {status.clock_offset_s * 1e3:+.1f} ms")
    if status.trigger_residual_s is not UNSET:
        facts.append(f"exposure {status.trigger_residual_s * 1e3:+.1f} ms from its instant")
    if status.detect_s is not UNSET:
        facts.append(f"detector {status.detect_s * 1e3:.0f} ms")
    if status.leak is not UNSET:
        facts.append("WATER IN THE HOUSING" if status.leak else "dry")
    return facts


def _solver_facts(picture: PairPicture, now_ns: int) -> list[str]:
    status = picture.solver
    if status is None or picture.solver_ns is None:
        return []
    facts = [f"{status.solved} poses of {status.matched} pairs of pictures", f"{status.late} late"]
    if status.latency_median_s is not UNSET:
        facts.append(f"latency {status.latency_median_s * 1e3:.0f} ms")
    if status.bad_messages:
        facts.append(f"{status.bad_messages} bad messages")
    return [*facts, f"heard {duration_words((now_ns - picture.solver_ns) / S_NS)} ago"]


def _rejections(picture: PairPicture) -> str:
    total = picture.solved + picture.rejected.total()
    if not total:
        return ""
    counts = [("pose found", "", picture.solved)]
    counts += [(reason_words(reason), reason, count) for reason, count in picture.rejected.most_common()]
    rows = "".join(
        f'<tr><td>{escape(words)} <span class="dim">{escape(reason)}</span></td>'
        f'<td class="n">{count}</td><td class="n">{count / total:.0%}</td></tr>'
        for words, reason, count in counts
    )
    return f'<div class="dim">Triggers seen here</div><table>{rows}</table>'


def camera(picture: PairPicture, node: NodePicture, now_ns: int) -> str:
    """Return a node's newest picture with its candidates and the trigger's outcome, or the candidates alone."""
    image, frame = node.image, node.shown()
    topic = CANDIDATES if image is None else IMAGE
    age_ns, old = node.age_ns(topic.name, now_ns), node.is_stale(topic, now_ns)
    if age_ns is None:
        return f'<div class="dim">Node {escape(node.node)}: no picture yet.</div>'
    facts = ["picture" if image is not None else "no preview, candidates only"]
    facts += [f"STALE: {duration_words(age_ns / S_NS)} old"] if old else []
    if frame is not None:
        facts.append(f"{len(frame.blobs)} candidates" + (f" and {frame.truncated} more" if frame.truncated else ""))
    drawing, words = judged_picture(picture, node)
    return (
        f'<div class="cam{" stale" if old else ""}">{drawing}<div><b>Node {escape(node.node)}</b> '
        f'<span class="dim">{", ".join(facts)}. {escape(words)}</span></div></div>'
    )


def judged_picture(picture: PairPicture, node: NodePicture) -> tuple[str, str]:
    """Return a node's newest picture as <svg>, marked, and its trigger's outcome in words ("" if not known)."""
    frame = node.shown()
    if frame is None:
        return marked_svg(node.image, None), ""
    result = picture.results.get(frame.trigger)
    if result is None:
        return marked_svg(node.image, frame), "The solver has not reported on this picture."
    if isinstance(result, Rejected):
        detail = f" ({result.detail})" if result.detail else ""
        return marked_svg(node.image, frame), f"No pose: {reason_words(result.reason)}{detail}."
    chosen = chosen_lights(result, node.node)
    seen = sum(index >= 0 for index in chosen)
    words = f"Pose at {result.range_m:.2f} m; {seen} of the other node's 2 lights chosen here."
    return marked_svg(node.image, frame, chosen), words


def chosen_lights(pose: RelativePose, node: str) -> tuple[int, int]:
    """Return which of a node's candidates the pose took for the left and the right light; -1: none."""
    if node not in (pose.node_a, pose.node_b):
        return -1, -1
    return pose.blobs_a if node == pose.node_a else pose.blobs_b
