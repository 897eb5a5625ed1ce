"""Rejection reasons, a node's power and durations in words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.health import UNDERVOLTAGE_NOW
from buddyline.protocol.messages import Message, NodeStatus, Rejected, SolverStatus
from buddyline.tools.health.finding import Finding
from msgspec import UNSET

# Each rejection reason of the protocol: what it means, and what may help.
REASONS: Final[dict[str, tuple[str, str]]] = {
    "unmatched": (
        "the other node has no picture of that instant, or the solver is behind",
        "check that both nodes run, at one rate, with clocks in step",
    ),
    "no_info": ("a node's calibration is not known", "restart that node, or give the solver its calibration"),
    "too_few_candidates": (
        "a node does not see both lights",
        "turn the nodes toward each other; check lights and lens",
    ),
    "range_gap": (
        "the two distances disagree",
        "one light was another's or half hidden; if it stays, check the lights' spacing in the configuration",
    ),
    "twist_gap": ("the two views disagree on the twist", "check the mounting of lights and camera"),
    "attitude": (
        "the attitude sensors contradict what is seen",
        "keep steel away from the compass; calibrate the sensors",
    ),
    "depth": ("the depth gauges contradict what is seen", "check both depth gauges at the surface"),
    "heading": (
        "the nodes do not face each other by their compasses",
        "another bar with two lights may be in view; keep steel away from the compass",
    ),
    "other_lights": (
        "what is seen is another diver's bar",
        "turn the nodes toward each other; keep steel away from the compass",
    ),
    "out_of_range": ("the distance is outside what is possible", "other lamps may be in view: switch them off"),
    "ambiguous": ("more than one arrangement fits", "other lamps may be in view: switch them off, or move apart"),
    "degenerate": ("the nodes stand so that no pose follows", "move one node a little aside or turn it"),
    "late": ("candidates came too late", "check the link's load and the clocks"),
    "duplicate": ("candidates came twice", "make sure that no two nodes have the same id"),
}

# What a node has lowered to save power or to cool down, by its status's `load`.
LOADS: Final = {"no_pictures": "load lowered: no pictures", "half_rate": "load lowered: no pictures, half the rate"}


def reason_words(reason: str) -> str:
    """Return a rejection's reason in words."""
    return REASONS.get(reason, (reason.replace("_", " "), ""))[0]


class Sayings:
    """What nodes and solver say, for a log of words: each speaker once, until it says something else."""

    def __init__(self) -> None:
        self._before: dict[str, str] = {}

    def new(self, message: Message) -> Iterator[tuple[str, str, str]]:
        """Yield speaker (`pose a/b`, `node a`, `solver a/b`, `coach a/b`), level (Info, Warning) and words."""
        for speaker, level, text in _said(message):
            if text and text != self._before.get(speaker):
                yield speaker, level, text
            self._before[speaker] = text


def _said(message: Message) -> list[tuple[str, str, str]]:
    if isinstance(message, NodeStatus):
        return [(f"node {message.node}", "Warning", message.problem)]
    if not isinstance(message, Rejected | SolverStatus):
        return []
    pair = f"{message.node_a}/{message.node_b}"
    if isinstance(message, Rejected):
        return [(f"pose {pair}", "Info", f"no pose: {reason_words(message.reason)}")]
    advice = "" if message.advice is UNSET else ", ".join(message.advice)
    return [(f"solver {pair}", "Warning", message.problem), (f"coach {pair}", "Info", advice)]


def power_words(status: NodeStatus) -> list[str]:
    """Return what a node's status says of heat, supply, battery and load, as far as it is known."""
    said = []
    if status.temperature_degc is not UNSET:
        said.append(f"{status.temperature_degc:.0f} °C")
    if status.battery_v is not UNSET:
        current = "" if status.battery_a is UNSET else f", {status.battery_a:.2f} A"
        said.append(f"battery {status.battery_v:.1f} V{current}")
    if status.throttled_bits is not UNSET and status.throttled_bits & UNDERVOLTAGE_NOW:
        said.append("undervoltage")
    if status.load is not UNSET and status.load != "full":
        said.append(LOADS[status.load])
    return said


def sentence(finding: Finding, now_ns: int) -> str:
    """Return a finding as a sentence, with its duration."""
    if finding.since_ns is None:
        return finding.text
    return f"{finding.text.rstrip('.')}, for {duration_words((now_ns - finding.since_ns) / S_NS)}."


def duration_words(seconds: float) -> str:
    """Return a duration in s, min or h."""
    seconds = max(seconds, 0.0)
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
