"""Take what was recorded onto the clock of the results, where a dive was solved with its nodes' clocks known."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from buddyline.protocol.clock import trigger_index
from buddyline.protocol.messages import Attitude, Candidates, LightTruth, Truth
from buddyline.solver_service.clock_curve import ClockCurve
from buddyline.tools.evaluation.recorded import Recorded
from buddyline.tools.evaluation.truth import CLOSE_NS
from buddyline.tools.pairs import Pair
from msgspec import UNSET
from msgspec.structs import replace

OfNode = TypeVar("OfNode", Attitude, Candidates, LightTruth)


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
    stamp_ns = max(message.stamp_ns - curve.offset_ns(message.stamp_ns), 0)
    if isinstance(message, Attitude) or info is None:
        return replace(message, stamp_ns=stamp_ns)
    return replace(message, stamp_ns=stamp_ns, trigger=trigger_index(stamp_ns, info.trigger_period_ns))


def truth_moved(truth: Truth, pair: Pair, curves: Mapping[str, ClockCurve]) -> Truth:
    """Move a truth, midway between both nodes' clocks, by half of what each of the two is moved by."""
    offsets_ns = [curves[node].offset_ns(truth.stamp_ns) for node in pair if node in curves]
    stamp_ns = max(truth.stamp_ns - sum(offsets_ns) // 2, 0)
    # Where it is moved far, the trigger of that number is another one.
    far = abs(stamp_ns - truth.stamp_ns) > CLOSE_NS
    return replace(truth, stamp_ns=stamp_ns, trigger=UNSET if far else truth.trigger)
