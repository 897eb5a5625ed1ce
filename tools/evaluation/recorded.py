"""What dive logs hold of one pair of nodes: what is evaluated, or exported."""

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
    """One pair's messages; truths are of T_a_b whichever way the log has them.

    nodes: a and b. ned_truths_a: node a's true poses in NED, for azimuth and inclination; attitudes_a: its attitudes,
    where these are not known. problems: for a person, a line each.
    doubled: second outcomes of a trigger, which the logs hold and this does not.
    environment: the water, where a log names it.
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
    infos: dict[str, NodeInfo] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    doubled: int = 0
    environment: str = ""
