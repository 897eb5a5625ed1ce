"""Judge a pair and its nodes at an instant: what is wrong, since when, and what to do."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.health import (
    BEHIND_S,
    CLOCK_OFF_S,
    CLOCKS_APART_S,
    DETECT_SHARE,
    HOT_DEGC,
    NO_POSE_S,
    REASONS_S,
    SILENT_S,
    TRACK_SIGMA_SHARE,
    TRIGGER_OFF_S,
    WELL_S,
    stale_after_s,
)
from buddyline.protocol.messages import NodeStatus
from buddyline.protocol.topics import ATTITUDE, CANDIDATES, DEPTH, SOLVER_STATUS
from buddyline.solver_service.coach import LastPlace, advise
from buddyline.tools.estimate import sigma_m
from buddyline.tools.health import machine
from buddyline.tools.health.finding import Finding, worst_first
from buddyline.tools.health.words import REASONS, reason_words
from msgspec import UNSET

if TYPE_CHECKING:
    from buddyline.tools.monitor.picture import NodePicture, PairPicture

_POWER: Final = "check its power and its cable"
_CAMERA: Final = "check its camera and the camera's cable"
START_SOLVER: Final = "start it: buddyline solver"


def findings(picture: PairPicture, now_ns: int, *, live: bool = True) -> list[Finding]:
    """Return the findings on a pair, the worst first. live: a running pair, not a stored dive."""
    if live:
        bus = _bus(picture, now_ns)
        if bus is not None:
            return [bus]
    said: list[Finding] = []
    for node in sorted(picture.nodes):
        said += _node(picture.nodes[node], now_ns, live)
    if live:
        said += _missing(picture)
    said += (_solver(picture, now_ns) if live else []) or _reported_by_solver(picture)
    said += _track(picture, now_ns)
    said += _pair(picture, now_ns, live)
    if not said:
        missing = _unproven(picture, now_ns, live)
        if missing:
            text = f"Not known to be well: {', '.join(missing)}."
            said.append(
                Finding("pair", "warning", text, "wait a moment; if it stays, see the figures of nodes and solver")
            )
        else:
            better = ", ".join(_told(picture, now_ns))
            who = "both" if len(picture.nodes) <= 2 else "all"
            text = f"All is well: {who} nodes send, and the solver finds the pose."
            said.append(Finding("pair", "ok", text, better))
    return worst_first(said)


def coached(picture: PairPicture, now_ns: int, why: str = "") -> list[str]:
    """Return what the divers should do: in the solver's words if it says some now, else by the newest estimate.

    why: the rejection reason for which there is no pose; "" where there are poses.
    """
    if told := _told(picture, now_ns):
        return told
    kept = [
        (at_ns, estimate)
        for at_ns, estimate in ((picture.track_ns, picture.track), (picture.pose_ns, picture.pose))
        if at_ns is not None and estimate is not None
    ]
    infos = [node.info for node in picture.end_nodes() if node is not None and node.info is not None]
    if not kept or len(infos) < 2:
        return []
    at_ns, estimate = max(kept, key=lambda one: one[0])
    return advise(infos, LastPlace.of(estimate, (now_ns - at_ns) / S_NS, why))


def _told(picture: PairPicture, now_ns: int) -> list[str]:
    """Return what the solver's status says now that the divers should do."""
    status, at_ns = picture.solver, picture.solver_ns or 0
    if status is None or status.advice is UNSET or now_ns - at_ns > stale_after_s(SOLVER_STATUS) * S_NS:
        return []
    return status.advice


def _unproven(picture: PairPicture, now_ns: int, live: bool) -> list[str]:
    """Return the facts that are missing for all to be well, in words. That nothing is wrong is no such fact."""
    missing = []
    for end, node in zip(picture.ends(), picture.end_nodes(), strict=True):
        if node is None or now_ns - node.alive_ns() > WELL_S * S_NS:
            missing.append(f"nothing new from node {end or 'a or b'}")
    if live and (picture.solver_heard_ns is None or now_ns - picture.solver_heard_ns > WELL_S * S_NS):
        missing.append("nothing new from the solver")
    shown = picture.shown(now_ns)
    if shown is None or shown.stale:
        missing.append("no fresh track or pose")
    elif (behind_s := _behind_s(picture, shown.estimate.stamp_ns)) > BEHIND_S:
        missing.append(f"what the solver says is {behind_s:.0f} s behind the nodes")
    skew_s = UNSET if picture.solver is None else picture.solver.clock_skew_s
    if skew_s is not UNSET and abs(skew_s) > CLOCKS_APART_S:
        missing.append(f"the nodes' clocks are {abs(skew_s) * 1e3:.0f} ms apart")
    return missing


def _behind_s(picture: PairPicture, stamp_ns: int) -> float:
    """Return how far an estimate's time is behind the newest that its nodes have said, by the nodes' own clocks."""
    said_ns = [
        message.stamp_ns
        for node in picture.end_nodes()
        if node is not None
        for message in (node.status, node.attitude, node.candidates[-1] if node.candidates else None)
        if message is not None
    ]
    return (max(said_ns, default=stamp_ns) - stamp_ns) / S_NS


def reported(name: str, status: NodeStatus, since_ns: int | None = None, period_s: float = 0.0) -> list[Finding]:
    """Return the findings from a node's status: leak, its problem (since since_ns), heat, supply, battery, clock, load.

    The node's own `problem` already names problems of supply, battery, disk and load: here are their warnings alone.
    period_s: of its triggers; 0: not known.
    """
    said = []
    if status.leak is not UNSET and status.leak:
        said.append(Finding("leak", "problem", f"Water in the housing of {name}.", "bring it up at once"))
    if status.problem:
        said.append(Finding(name, "problem", f"{_named(name)} reports: {status.problem}", "", since_ns))
    if status.temperature_degc is not UNSET and status.temperature_degc >= HOT_DEGC:
        hot = f"{_named(name)} is hot: {status.temperature_degc:.0f} degrees C."
        said.append(Finding(name, "warning", hot, "cool it, or lower its picture rate"))
    supply = machine.power(None if status.throttled_bits is UNSET else status.throttled_bits)
    if supply.level == "warning":
        said.append(Finding(name, "warning", f"{_named(name)}: {supply.text}.", supply.advice))
    if status.battery_cell_v is not UNSET and machine.charge(status.battery_cell_v) == "warning":
        low = f"The battery of {name} is low: {status.battery_cell_v:.2f} V in each cell."
        said.append(Finding(name, "warning", low, machine.CHARGE))
    if status.clock_offset_s is not UNSET and abs(status.clock_offset_s) > CLOCK_OFF_S:
        off = f"The clock of {name} is off by {status.clock_offset_s * 1e3:.1f} ms."
        said.append(Finding(name, "warning", off, "wait for chrony, or check the time server"))
    if status.trigger_residual_s is not UNSET and abs(status.trigger_residual_s) > TRIGGER_OFF_S:
        late = f"The pictures of {name} are {status.trigger_residual_s * 1e3:+.0f} ms from their instants."
        said.append(Finding("trigger", "warning", late, "check the camera's trigger line and its settings"))
    if status.detect_s is not UNSET and period_s and status.detect_s > DETECT_SHARE * period_s:
        slow = f"{_named(name)} needs {status.detect_s * 1e3:.0f} of {period_s * 1e3:.0f} ms to find the lights."
        said.append(Finding("load", "warning", slow, "lower its picture rate or size"))
    return said


def _named(name: str) -> str:
    """Return a name as the beginning of a sentence."""
    return f"{name[0].upper()}{name[1:]}"


def _bus(picture: PairPicture, now_ns: int) -> Finding | None:
    if picture.last_ns is None:
        return Finding("bus", "warning", "Nothing has come over the bus yet.", "start hub, nodes and solver")
    # Every node and the solver send a status each second. If none comes, the link is down.
    if now_ns - picture.last_ns > SILENT_S * S_NS:
        advice = "check that the hub runs and the cable to it; the nodes go on recording by themselves"
        return Finding("bus", "problem", "Nothing comes over the bus any more.", advice, picture.last_ns)
    return None


def _node(node: NodePicture, now_ns: int, live: bool) -> list[Finding]:
    name, alive_ns = f"node {node.node}", node.alive_ns()
    # A message sent after it left shows that it is back; one that was on its way does not.
    if live and node.left_ns is not None and alive_ns <= node.left_ns + node.stale_after_ns(CANDIDATES):
        advice = f"{_POWER}; if it still runs, it goes on recording by itself"
        return [Finding(name, "problem", f"{_named(name)} has left the bus.", advice, node.left_ns)]
    silent_ns = max(SILENT_S * S_NS, node.stale_after_ns(CANDIDATES))
    if alive_ns and now_ns - alive_ns > silent_ns:
        return [Finding(name, "problem", f"{_named(name)} is silent.", _POWER, alive_ns)]
    said = []
    frames_ns = node.heard_ns.get(CANDIDATES.name)
    if frames_ns is None:
        if live and alive_ns:
            said.append(Finding(name, "problem", f"{_named(name)} sends no pictures' candidates.", "check its camera"))
    elif now_ns - frames_ns > silent_ns:
        text = f"{_named(name)} has stopped finding lights in pictures."
        said.append(Finding(name, "problem", text, _CAMERA, frames_ns))
    for topic in (ATTITUDE, DEPTH):
        if node.is_stale(topic, now_ns):
            text = f"{topic.name.capitalize()} of {name} has stopped."
            said.append(Finding(name, "warning", text, "check that sensor", node.heard_ns[topic.name]))
    if node.info is None and alive_ns:
        said.append(Finding(name, "warning", f"The calibration of {name} is not known.", "restart the node"))
    period_s = 0.0 if node.info is None else node.info.trigger_period_ns / S_NS
    return said + ([] if node.status is None else reported(name, node.status, node.problem_since_ns, period_s))


def _missing(picture: PairPicture) -> list[Finding]:
    ends = [end for end in picture.ends() if end is not None]
    absent = [end for end in ends if end not in picture.nodes]
    said = [Finding(f"node {end}", "problem", f"Node {end} is not on the bus.", _POWER) for end in absent]
    if len(ends) < 2:
        only = f"Only node {ends[0]} is on the bus." if ends else "No node is on the bus."
        said.append(Finding("pair", "problem", only, "start the other one: a pose needs two"))
    for a, b in sorted(picture.other_pairs):
        said.append(Finding("pair", "warning", f"Poses of another pair, {a} and {b}, are not shown."))
    return said


def _solver(picture: PairPicture, now_ns: int) -> list[Finding]:
    if picture.solver_left_ns is not None:
        return [Finding("solver", "problem", "The solver has left the bus.", START_SOLVER, picture.solver_left_ns)]
    if picture.solver is None or picture.solver_ns is None:
        absent = Finding("solver", "problem", "No solver is on the bus.", START_SOLVER)
        return [absent] if picture.pose is None else []
    if now_ns - picture.solver_ns > stale_after_s(SOLVER_STATUS) * S_NS:
        return [Finding("solver", "problem", "The solver is silent.", START_SOLVER, picture.solver_ns)]
    return []


def _reported_by_solver(picture: PairPicture) -> list[Finding]:
    """Return the problem that the solver reports: of nodes, clocks, inertial units or the track."""
    if picture.solver is None or not picture.solver.problem:
        return []
    text = f"The solver reports: {picture.solver.problem}"
    return [Finding("solver", "warning", text, "", picture.solver_problem_since_ns)]


def _track(picture: PairPicture, now_ns: int) -> list[Finding]:
    """Return a finding if the track has ended or is uncertain."""
    track = picture.track
    if track is None:
        return []
    if not picture.track_is_fresh(now_ns):
        advice = "turn the nodes toward each other: the next pose starts it again"
        return [Finding("track", "warning", "The track has ended.", advice, picture.track_ns)]
    off_m = sigma_m(track)
    if off_m <= TRACK_SIGMA_SHARE * track.range_m:
        return []
    text = f"The track is uncertain: by {off_m:.2f} m (1 sd) at {track.range_m:.2f} m."
    general = "turn the nodes toward each other: each light that is seen helps"
    return [Finding("track", "warning", text, ", ".join(coached(picture, now_ns)) or general)]


def _pair(picture: PairPicture, now_ns: int, live: bool) -> list[Finding]:
    """Return why there is no pose, if the nodes themselves are well."""
    age_ns = picture.pose_age_ns(now_ns)
    if age_ns is not None and age_ns <= NO_POSE_S * S_NS:
        return []
    recent = Counter(miss.reason for miss in picture.misses if 0 <= now_ns - miss.at_ns <= REASONS_S * S_NS)
    if recent:
        reason, count = recent.most_common(1)[0]
        share = "" if len(recent) == 1 else f" ({count} of {recent.total()})"
        tracked = picture.track_is_fresh(now_ns)
        text = f"No pose: {reason_words(reason)}{share}.{' The track goes on without.' if tracked else ''}"
        # What to do from where the nodes last were helps more than the reason's general advice.
        advice = ", ".join(coached(picture, now_ns, reason)) or REASONS.get(reason, ("", ""))[1]
        return [Finding("pair", "warning" if tracked else "problem", text, advice, picture.pose_ns)]
    if live or picture.pose is not None or picture.first_ns is None or now_ns - picture.first_ns <= NO_POSE_S * S_NS:
        return []
    return [Finding("pair", "warning", "No pose yet in this log.", "solve it first: buddyline solve")]
