"""The true pose, and the measured attitude, at any instant."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from buddyline.protocol.messages import Attitude, NodeInfo, NodePose, Truth
from buddyline.tools.evaluation.rotation import (
    Floats,
    conjugate,
    from_rotation_vector,
    multiply,
    normalized,
    rotate,
    rotation_vector,
)
from msgspec import UNSET
from msgspec.structs import replace

# Longest gap to interpolate: divers move and turn little within half a second, but not within a second.
MAX_GAP_NS: Final = 500_000_000
# The greatest distance in time at which a single truth is still used: the clocks of one dive may differ by this.
NEAREST_NS: Final = 20_000_000
# Between samples at most this far apart, and so near to any one, interpolation is as good as a sample. Farther away it
# misses what fins shake, several sigmas of a track that has inertial units.
DENSE_NS: Final = 50_000_000
CLOSE_NS: Final = 5_000_000


def inverted(truth: Truth) -> Truth:
    """Return the truth of T_b_a for a truth of T_a_b."""
    q = conjugate(normalized(np.array(truth.q_a_b_xyzw)))
    x, y, z = (-rotate(q, np.array(truth.t_a_b_m))).tolist()
    return replace(truth, t_a_b_m=(x, y, z), q_a_b_xyzw=tuple(q.tolist()))


class PoseHistory:
    """Rotations, and positions if there are any, over time.

    Between samples runs the cubic through the two before and the two after. A straight line would not do: at 5 truths a
    second a diver's swell bends it by centimetres, ten times what a track is off. Of samples of one stamp the first
    counts: a truth may stand in two logs.
    """

    def __init__(self, stamps_ns: Sequence[int], t_m: Floats, q_xyzw: Floats) -> None:
        first: dict[int, int] = {}
        for i, stamp_ns in enumerate(stamps_ns):
            first.setdefault(stamp_ns, i)
        order = [first[stamp_ns] for stamp_ns in sorted(first)]
        self.stamps_ns = [stamps_ns[i] for i in order]
        self.t_m = t_m[order]
        self.q_xyzw = normalized(q_xyzw[order])

    @classmethod
    def of_attitudes(cls, attitudes: Iterable[Attitude]) -> PoseHistory:
        """Return q_ned_body over time; its positions are zero."""
        samples = list(attitudes)
        q = np.array([sample.q_ned_body_xyzw for sample in samples]).reshape(-1, 4)
        return cls([sample.stamp_ns for sample in samples], np.zeros((len(samples), 3)), q)

    @classmethod
    def of_node(cls, poses: Sequence[NodePose]) -> PoseHistory:
        """Return one node's camera over time, as its poses give it; there is at least one."""
        return cls(
            [pose.stamp_ns for pose in poses],
            np.array([pose.p_m for pose in poses]),
            np.array([pose.q_xyzw for pose in poses]),
        )

    def at(self, stamp_ns: int) -> tuple[Floats, Floats] | None:
        """Return t (3,) and q (4,) at stamp_ns; None if no sample is near enough."""
        after = bisect_left(self.stamps_ns, stamp_ns)
        if 0 < after < len(self.stamps_ns) and self._joined(after):
            return self._between(after, stamp_ns)
        near = range(max(after - 1, 0), min(after + 1, len(self.stamps_ns)))
        best = min(near, key=lambda i: abs(self.stamps_ns[i] - stamp_ns), default=None)
        if best is None or abs(self.stamps_ns[best] - stamp_ns) > NEAREST_NS:
            return None
        return self.t_m[best], self.q_xyzw[best]

    def is_close(self, stamp_ns: int) -> bool:
        """Return whether `at` is as good as a sample: beside one, or between two that follow each other quickly."""
        after = bisect_left(self.stamps_ns, stamp_ns)
        near = self.stamps_ns[max(after - 1, 0) : after + 1]
        dense = len(near) == 2 and near[1] - near[0] <= DENSE_NS
        return dense or any(abs(one - stamp_ns) <= CLOSE_NS for one in near)

    def _joined(self, after: int) -> bool:
        """Tell whether a sample and the one before it are near enough to interpolate."""
        return self.stamps_ns[after] - self.stamps_ns[after - 1] <= MAX_GAP_NS

    def _between(self, after: int, stamp_ns: int) -> tuple[Floats, Floats]:
        """Return t and q between samples after - 1 and after, by Lagrange's formula."""
        first, last = after - 1, after
        if first > 0 and self._joined(first):
            first -= 1
        if last + 1 < len(self.stamps_ns) and self._joined(last + 1):
            last += 1
        times = np.array([stamp - stamp_ns for stamp in self.stamps_ns[first : last + 1]]) * 1e-9
        others = ~np.eye(len(times), dtype=bool)
        shares = np.array([np.prod(times[o] / (times[o] - times[i])) for i, o in enumerate(others)])
        q0 = self.q_xyzw[after - 1]
        turns = rotation_vector(multiply(self.q_xyzw[first : last + 1], conjugate(q0)))
        return shares @ self.t_m[first : last + 1], multiply(from_rotation_vector(shares @ turns), q0)


def ned_of_camera(
    truths: Sequence[NodePose], attitudes: Sequence[Attitude], info: NodeInfo | None
) -> PoseHistory | None:
    """Return a camera's poses in NED over time: the true ones if there are any, else from the measured attitudes."""
    if truths:
        return PoseHistory.of_node(truths)
    if info is None or not attitudes:
        return None
    body = PoseHistory.of_attitudes(attitudes)
    q_body_camera = normalized(np.array(info.q_body_camera_xyzw))
    return PoseHistory(body.stamps_ns, body.t_m, multiply(body.q_xyzw, q_body_camera))


class TruthTrack:
    """True T_a_b by time; by trigger where the truth has trigger numbers and another clock."""

    def __init__(self, truths: Sequence[Truth]) -> None:
        t = np.array([truth.t_a_b_m for truth in truths]).reshape(-1, 3)
        q = np.array([truth.q_a_b_xyzw for truth in truths]).reshape(-1, 4)
        self._track = PoseHistory([truth.stamp_ns for truth in truths], t, q)
        self._by_trigger: dict[int, tuple[int, Floats, Floats]] = {
            truth.trigger: (truth.stamp_ns, t[i], normalized(q[i]))
            for i, truth in enumerate(truths)
            if truth.trigger is not UNSET
        }

    def at(self, stamp_ns: int, trigger: int) -> tuple[Floats, Floats] | None:
        """Return the true t_a_b_m (3,) and q_a_b_xyzw (4,); None if they are not known.

        Pictures are taken some milliseconds beside the instant that the truth names, so the truth is moved to stamp_ns;
        not where it is so far off that the two clocks must differ.
        """
        named = self._by_trigger.get(trigger)
        if named is not None and abs(named[0] - stamp_ns) > NEAREST_NS:
            return named[1], named[2]
        return self.interpolated(stamp_ns)

    def interpolated(self, stamp_ns: int) -> tuple[Floats, Floats] | None:
        """Return the true t_a_b_m (3,) and q_a_b_xyzw (4,) by time only."""
        return self._track.at(stamp_ns)

    def is_close(self, stamp_ns: int) -> bool:
        """Return whether what is interpolated there is as good as a sample of the truth."""
        return self._track.is_close(stamp_ns)
