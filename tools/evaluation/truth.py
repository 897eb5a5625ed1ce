"""The true pose, and the measured attitude, at any instant."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from buddyline.protocol.messages import Attitude, NodeInfo, NodePose, Truth
from buddyline.tools.evaluation.rotation import Floats, conjugate, interpolate, multiply, normalized, rotate
from msgspec import UNSET
from msgspec.structs import replace

# Longest gap to interpolate: divers move and turn little within half a second, but not within a second.
MAX_GAP_NS: Final = 500_000_000
# The greatest distance in time at which a single truth is still used: the clocks of one dive may differ by this.
NEAREST_NS: Final = 20_000_000


def inverted(truth: Truth) -> Truth:
    """Return the truth of T_b_a for a truth of T_a_b."""
    q = conjugate(normalized(np.array(truth.q_a_b_xyzw)))
    x, y, z = (-rotate(q, np.array(truth.t_a_b_m))).tolist()
    return replace(truth, t_a_b_m=(x, y, z), q_a_b_xyzw=tuple(q.tolist()))


class PoseHistory:
    """Rotations, and positions if there are any, over time; interpolated between samples."""

    def __init__(self, stamps_ns: Sequence[int], t_m: Floats, q_xyzw: Floats) -> None:
        order = sorted(range(len(stamps_ns)), key=stamps_ns.__getitem__)
        self.stamps_ns = [stamps_ns[i] for i in order]
        self.t_m = t_m[order]
        self.q_xyzw = normalized(q_xyzw[order])

    @classmethod
    def of_attitudes(cls, attitudes: Iterable[Attitude]) -> PoseHistory:
        """Return q_ned_body over time; its positions are zero."""
        samples = list(attitudes)
        q = np.array([sample.q_ned_body_xyzw for sample in samples]).reshape(-1, 4)
        return cls([sample.stamp_ns for sample in samples], np.zeros((len(samples), 3)), q)

    def at(self, stamp_ns: int) -> tuple[Floats, Floats] | None:
        """Return t (3,) and q (4,) at stamp_ns; None if no sample is near enough."""
        after = bisect_left(self.stamps_ns, stamp_ns)
        if 0 < after < len(self.stamps_ns):
            start_ns, end_ns = self.stamps_ns[after - 1], self.stamps_ns[after]
            if end_ns - start_ns <= MAX_GAP_NS:
                share = (stamp_ns - start_ns) / (end_ns - start_ns)
                t = self.t_m[after - 1] * (1.0 - share) + self.t_m[after] * share
                return t, interpolate(self.q_xyzw[after - 1], self.q_xyzw[after], share)
        near = range(max(after - 1, 0), min(after + 1, len(self.stamps_ns)))
        best = min(near, key=lambda i: abs(self.stamps_ns[i] - stamp_ns), default=None)
        if best is None or abs(self.stamps_ns[best] - stamp_ns) > NEAREST_NS:
            return None
        return self.t_m[best], self.q_xyzw[best]


def ned_of_camera(
    truths: Sequence[NodePose], attitudes: Sequence[Attitude], info: NodeInfo | None
) -> PoseHistory | None:
    """Return a camera's poses in NED over time: the true ones if there are any, else from the measured attitudes."""
    if truths:
        return PoseHistory(
            [truth.stamp_ns for truth in truths],
            np.array([truth.p_m for truth in truths]),
            np.array([truth.q_xyzw for truth in truths]),
        )
    if info is None or not attitudes:
        return None
    body = PoseHistory.of_attitudes(attitudes)
    q_body_camera = normalized(np.array(info.q_body_camera_xyzw))
    return PoseHistory(body.stamps_ns, body.t_m, multiply(body.q_xyzw, q_body_camera))


class TruthTrack:
    """True T_a_b: by trigger if the truth has trigger numbers, else by time."""

    def __init__(self, truths: Sequence[Truth]) -> None:
        t = np.array([truth.t_a_b_m for truth in truths]).reshape(-1, 3)
        q = np.array([truth.q_a_b_xyzw for truth in truths]).reshape(-1, 4)
        self._track = PoseHistory([truth.stamp_ns for truth in truths], t, q)
        self._by_trigger: dict[int, tuple[Floats, Floats]] = {
            truth.trigger: (t[i], normalized(q[i])) for i, truth in enumerate(truths) if truth.trigger is not UNSET
        }

    def at(self, stamp_ns: int, trigger: int) -> tuple[Floats, Floats] | None:
        """Return the true t_a_b_m (3,) and q_a_b_xyzw (4,); None if they are not known."""
        named = self._by_trigger.get(trigger)
        return named if named is not None else self.interpolated(stamp_ns)

    def interpolated(self, stamp_ns: int) -> tuple[Floats, Floats] | None:
        """Return the true t_a_b_m (3,) and q_a_b_xyzw (4,) by time only."""
        return self._track.at(stamp_ns)
