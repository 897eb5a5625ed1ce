"""The messages of one pair of nodes, as evaluated or exported."""

from __future__ import annotations

from dataclasses import dataclass, field

from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    LightTruth,
    NodeInfo,
    NodePose,
    Rejected,
    RelativePose,
    Track,
    Truth,
)
from buddyline.tools.pairs import Pair


@dataclass
class Recorded:
    """One pair's messages. truths are of T_a_b, also if the log has T_b_a.

    nodes: a and b. ned_truths_a: node a's true poses in NED, by a's clock, for azimuth and inclination.
    ned_truths_between: the same, stamped as the tracks are; None where that is the same. attitudes_a: its attitudes,
    used if there are no true poses. problems: lines for a person. doubled: number of second outcomes of a trigger that
    were left out. environment: the water, if a log names it.
    """

    nodes: Pair
    poses: list[RelativePose] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)
    truths: list[Truth] = field(default_factory=list)
    candidates: list[Candidates] = field(default_factory=list)
    light_truths: list[LightTruth] = field(default_factory=list)
    tracks: list[Track] = field(default_factory=list)
    attitudes_a: list[Attitude] = field(default_factory=list)
    ned_truths_a: list[NodePose] = field(default_factory=list)
    ned_truths_between: list[NodePose] | None = None
    infos: dict[str, NodeInfo] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    doubled: int = 0
    environment: str = ""
