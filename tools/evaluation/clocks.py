"""Take what was recorded onto the clock of the results, where a dive was solved with its nodes' clocks known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self, TypeVar

from buddyline.protocol.messages import Attitude, Candidates, LightTruth, NodePose, Truth
from buddyline.solver_service.clock_curve import ClockCurve, trigger_moved
from buddyline.tools.evaluation.recorded import Recorded
from buddyline.tools.evaluation.truth import CLOSE_NS
from buddyline.tools.pairs import Pair
from msgspec import UNSET
from msgspec.structs import replace

OfNode = TypeVar("OfNode", Attitude, Candidates, LightTruth)


@dataclass(frozen=True)
class SimulatedClocks:
    """The clocks of a simulated dive: all but the first node's are ahead, by offset_ns at the start, and gain drift."""

    first: str = "a"
    start_ns: int = 0
    offset_ns: int = 0
    drift: float = 0.0

    @classmethod
    def of(cls, metadata: Mapping[str, str]) -> Self:
        """Return those that `simulate` has noted; all agree where it has not."""
        return cls(
            metadata.get("node_a", "a"),
            int(metadata.get("start_ns", "0")),
            int(metadata.get("clock_offset_ns", "0")),
            float(metadata.get("clock_drift", "0")),
        )

    def ahead_ns(self, node: str, stamp_ns: int) -> int:
        """Return a node's clock minus the first node's, at a stamp of the first node's."""
        return 0 if node == self.first else self.offset_ns + round(self.drift * (stamp_ns - self.start_ns))


def take_ned_truths(recorded: Recorded, clocks: SimulatedClocks, curves: Mapping[str, ClockCurve]) -> None:
    """Take A's true poses onto the clock that A's stamps were solved on, and for tracks between both nodes' clocks.

    curves: with which the dive was solved.
    """

    def moved(truth: NodePose, nodes: tuple[str, ...]) -> NodePose:
        own_ns = clocks.ahead_ns(truth.node, truth.stamp_ns)
        offsets_ns = [clocks.ahead_ns(node, truth.stamp_ns) - own_ns for node in nodes]
        offsets_ns += [-curves[node].offset_ns(truth.stamp_ns) for node in nodes if node in curves]
        return replace(truth, stamp_ns=max(truth.stamp_ns + sum(offsets_ns) // len(nodes), 0))

    recorded.ned_truths_between = [moved(truth, recorded.nodes) for truth in recorded.ned_truths_a]
    recorded.ned_truths_a = [moved(truth, recorded.nodes[:1]) for truth in recorded.ned_truths_a]


def take_onto_common_clock(recorded: Recorded, curves: Mapping[str, ClockCurve]) -> None:
    """Move stamps, and number triggers anew, as the solver did with these curves. Results stay as they are."""
    if not any(node in curves for node in recorded.nodes):
        return
    recorded.truths = [truth_moved(truth, recorded.nodes, curves) for truth in recorded.truths]
    recorded.candidates = [_moved(one, recorded, curves) for one in recorded.candidates]
    recorded.light_truths = [_moved(one, recorded, curves) for one in recorded.light_truths]
    recorded.attitudes_a = [_moved(one, recorded, curves) for one in recorded.attitudes_a]


def _moved(message: OfNode, recorded: Recorded, curves: Mapping[str, ClockCurve]) -> OfNode:
    curve, info = curves.get(message.node), recorded.infos.get(message.node)
    if curve is None:
        return message
    offset_ns = curve.offset_ns(message.stamp_ns)
    stamp_ns = max(message.stamp_ns - offset_ns, 0)
    if isinstance(message, Attitude) or info is None:
        return replace(message, stamp_ns=stamp_ns)
    trigger = trigger_moved(message.trigger, offset_ns, info.trigger_period_ns)
    return replace(message, stamp_ns=stamp_ns, trigger=trigger)


def truth_moved(truth: Truth, pair: Pair, curves: Mapping[str, ClockCurve]) -> Truth:
    """Move a truth, midway between both nodes' clocks, by half of what each of the two is moved by."""
    offsets_ns = [curves[node].offset_ns(truth.stamp_ns) for node in pair if node in curves]
    stamp_ns = max(truth.stamp_ns - sum(offsets_ns) // 2, 0)
    # Where it is moved far, the trigger of that number is another one.
    far = abs(stamp_ns - truth.stamp_ns) > CLOSE_NS
    return replace(truth, stamp_ns=stamp_ns, trigger=UNSET if far else truth.trigger)
