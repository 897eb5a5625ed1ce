"""What is wrong, since when, and what to do, in plain words."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Final, Literal

from buddyline.protocol.clock import S_NS
from buddyline.tools.monitor.picture import SILENT_NS, STALE_NS, NodePicture, PairPicture
from msgspec import UNSET

# How long a pair may be without a pose before it is said, and over how long its reasons are counted.
NO_FIX_NS: Final = 2 * S_NS
RECENT_NS: Final = 10 * S_NS
SOLVER_SILENT_NS: Final = 3 * S_NS
HOT_DEGC: Final = 75.0
CLOCK_OFF_S: Final = 0.005

Level = Literal["bad", "warn", "good"]


@dataclass(frozen=True)
class Finding:
    """One thing to say. who: node id, `solver`, `bus` or `pair`; since_ns: None where it is not known."""

    level: Level
    who: str
    what: str
    since_ns: int | None = None
    advice: str = ""


# Each reason of the contract: what it means, and what may help.
REASONS: Final[dict[str, tuple[str, str]]] = {
    "unmatched": (
        "the other node has no picture of that instant",
        "check that both nodes run, at one rate, with clocks in step",
    ),
    "no_info": ("a node's calibration is not known", "restart that node, or give the solver its calibration"),
    "too_few_candidates": (
        "a node does not see both lights",
        "turn the nodes toward each other; check lights and lens",
    ),
    "range_gap": (
        "the two distances disagree",
        "check that the lights' spacing in the configuration is what was built",
    ),
    "twist_gap": ("the two views disagree on the twist", "check the mounting of lights and camera"),
    "attitude": (
        "the attitude sensors contradict what is seen",
        "keep steel away from the compass; calibrate the sensors",
    ),
    "depth": ("the depth gauges contradict what is seen", "check both depth gauges at the surface"),
    "out_of_range": ("the distance is outside what is possible", "other lamps may be in view: switch them off"),
    "ambiguous": ("more than one arrangement fits", "other lamps may be in view: switch them off, or move apart"),
    "degenerate": ("the nodes stand so that no pose follows", "move one node a little aside or turn it"),
    "late": ("candidates came too late", "check the link's load and the clocks"),
    "duplicate": ("candidates came twice", "make sure that no two nodes have the same id"),
}


def reason_words(reason: str) -> str:
    """Return what a rejection's reason means, for a person."""
    return REASONS.get(reason, (reason.replace("_", " "), ""))[0]


def findings(picture: PairPicture, now_ns: int, *, live: bool = True) -> list[Finding]:
    """Return what there is to say, the worst first; an empty pair is waited for."""
    said: list[Finding] = []
    if live:
        bus = _bus(picture, now_ns)
        if bus is not None:
            return [bus]
    for node in sorted(picture.nodes):
        said += _node(picture.nodes[node], now_ns, live)
    if live:
        said += _missing(picture)
        said += _solver(picture, now_ns)
    said += _pair(picture, now_ns, live)
    if not said:
        said.append(Finding("good", "pair", "All is well: both nodes send, and the solver finds the pose."))
    order: dict[Level, int] = {"bad": 0, "warn": 1, "good": 2}
    return sorted(said, key=lambda finding: order[finding.level])


def _bus(picture: PairPicture, now_ns: int) -> Finding | None:
    if picture.last_ns is None:
        return Finding("warn", "bus", "Nothing has come over the bus yet.", None, "start hub, nodes and solver")
    # Every node and the solver say something each second: without any of it, it is the link.
    if now_ns - picture.last_ns > SILENT_NS:
        return Finding(
            "bad",
            "bus",
            "Nothing comes over the bus any more.",
            picture.last_ns,
            "check that the hub runs and the cable to it; the nodes go on recording by themselves",
        )
    return None


def _node(node: NodePicture, now_ns: int, live: bool) -> list[Finding]:
    name = node.node
    alive_ns = node.alive_ns()
    # What comes after it left says that it is back.
    if live and node.left_ns is not None and alive_ns <= node.left_ns + STALE_NS:
        return [
            Finding(
                "bad",
                name,
                f"Node {name} has left the bus.",
                node.left_ns,
                "check its power and its cable; if it still runs, it goes on recording by itself",
            )
        ]
    if alive_ns and now_ns - alive_ns > SILENT_NS:
        return [Finding("bad", name, f"Node {name} is silent.", alive_ns, "check its power and its cable")]
    said = []
    frames_ns = node.age_ns("candidates", now_ns)
    if frames_ns is None:
        if live and alive_ns:
            said.append(Finding("bad", name, f"Node {name} sends no pictures' candidates.", None, "check its camera"))
    elif frames_ns > SILENT_NS:
        since_ns = node.heard_ns["candidates"]
        said.append(Finding("bad", name, f"Node {name} has stopped finding lights in pictures.", since_ns, _CAMERA))
    for what, words in (("attitude", "Attitude"), ("depth", "Depth")):
        age_ns = node.age_ns(what, now_ns)
        if age_ns is not None and age_ns > 2 * STALE_NS:
            said.append(
                Finding("warn", name, f"{words} of node {name} has stopped.", node.heard_ns[what], "check that sensor")
            )
    if node.info is None and alive_ns:
        said.append(Finding("warn", name, f"The calibration of node {name} is not known.", None, "restart the node"))
    return said + _reported(node)


_CAMERA: Final = "check its camera and the camera's cable"


def _reported(node: NodePicture) -> list[Finding]:
    """Return what a node says of itself."""
    status, name = node.status, node.node
    if status is None:
        return []
    said = []
    if status.problem:
        said.append(Finding("bad", name, f"Node {name} reports: {status.problem}", node.problem_since_ns, ""))
    if status.temperature_degc is not UNSET and status.temperature_degc > HOT_DEGC:
        hot = f"Node {name} is hot: {status.temperature_degc:.0f} degrees C."
        said.append(Finding("warn", name, hot, None, "cool it, or lower its picture rate"))
    if status.clock_offset_s is not UNSET and abs(status.clock_offset_s) > CLOCK_OFF_S:
        off = f"The clock of node {name} is off by {status.clock_offset_s * 1e3:.1f} ms."
        said.append(Finding("warn", name, off, None, "wait for chrony, or check the time server"))
    return said


def _missing(picture: PairPicture) -> list[Finding]:
    ends = [end for end in picture.ends() if end is not None]
    absent = [end for end in ends if end not in picture.nodes]
    said = [
        Finding("bad", end, f"Node {end} is not on the bus.", None, "check its power and its cable") for end in absent
    ]
    if len(ends) < 2:
        only = f"Only node {ends[0]} is on the bus." if ends else "No node is on the bus."
        said.append(Finding("bad", "pair", only, None, "start the other one: a pose needs two"))
    for a, b in sorted(picture.other_pairs):
        said.append(Finding("warn", "pair", f"Poses of another pair, {a} and {b}, are not shown.", None, ""))
    return said


def _solver(picture: PairPicture, now_ns: int) -> list[Finding]:
    if picture.solver_left_ns is not None:
        gone_ns = picture.solver_left_ns
        return [Finding("bad", "solver", "The solver has left the bus.", gone_ns, "start it: buddyline solver")]
    if picture.solver is None or picture.solver_ns is None:
        if picture.pose is None:
            return [Finding("bad", "solver", "No solver is on the bus.", None, "start it: buddyline solver")]
        return []
    if now_ns - picture.solver_ns > SOLVER_SILENT_NS:
        return [Finding("bad", "solver", "The solver is silent.", picture.solver_ns, "start it: buddyline solver")]
    if picture.solver.problem:
        text = f"The solver reports: {picture.solver.problem}"
        return [Finding("warn", "solver", text, picture.solver_problem_since_ns, "")]
    return []


def _pair(picture: PairPicture, now_ns: int, live: bool) -> list[Finding]:
    """Say that there is no pose, and why, where the nodes themselves are well."""
    age_ns = picture.pose_age_ns(now_ns)
    if age_ns is not None and age_ns <= NO_FIX_NS:
        return []
    recent = Counter(miss.reason for miss in picture.misses if 0 <= now_ns - miss.at_ns <= RECENT_NS)
    if not recent:
        if live or picture.pose is not None or picture.first_ns is None or now_ns - picture.first_ns <= NO_FIX_NS:
            return []
        return [Finding("warn", "pair", "No pose yet in this log.", None, "solve it first: buddyline solve")]
    reason, count = recent.most_common(1)[0]
    advice = REASONS.get(reason, ("", ""))[1]
    share = "" if len(recent) == 1 else f" ({count} of {recent.total()})"
    return [Finding("bad", "pair", f"No pose: {reason_words(reason)}{share}.", picture.pose_ns, advice)]


def sentence(finding: Finding, now_ns: int) -> str:
    """Return what a finding says, and since when."""
    if finding.since_ns is None:
        return finding.what
    return f"{finding.what.rstrip('.')}, for {duration_words((now_ns - finding.since_ns) / S_NS)}."


def duration_words(seconds: float) -> str:
    """Return a duration as a person says it."""
    seconds = max(seconds, 0.0)
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
