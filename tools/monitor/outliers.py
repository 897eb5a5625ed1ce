"""Poses that contradict the track by more than their own covariance allows, with the pictures that they come from."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, CompressedImage, RelativePose, Track
from buddyline.tools.dives import Dive
from buddyline.tools.draw.marks import marked_svg
from buddyline.tools.evaluation.poses import nees
from buddyline.tools.monitor.panel import chosen_lights

# The 99.9 % point of chi-squared with 3 degrees of freedom: one in a thousand honest poses is beyond it.
GATE: Final = 16.266
MAX_LISTED: Final = 12
# The track is not interpolated across a longer gap.
GAP_NS: Final = S_NS // 2


class TrackPath:
    """B's places by the track, all samples: stamps and t_a_b_m. A long dive has some hundred thousand."""

    def __init__(self) -> None:
        self._stamps_ns, self._t_m = array("q"), array("d")

    def add(self, track: Track) -> None:
        """Take a sample; one whose stamp is not after the last is left out."""
        if not self._stamps_ns or track.stamp_ns > self._stamps_ns[-1]:
            self._stamps_ns.append(track.stamp_ns)
            self._t_m.extend(track.t_a_b_m)

    def at(self, stamp_ns: int) -> tuple[float, float, float] | None:
        """Return t_a_b_m at a time, on the straight line between two samples; None in a gap and beyond the ends."""
        after = bisect_left(self._stamps_ns, stamp_ns)
        if after < len(self._stamps_ns) and self._stamps_ns[after] == stamp_ns:
            return self._place(after)
        if not 0 < after < len(self._stamps_ns):
            return None
        begin_ns, end_ns = self._stamps_ns[after - 1], self._stamps_ns[after]
        if end_ns - begin_ns > GAP_NS:
            return None
        share = (stamp_ns - begin_ns) / (end_ns - begin_ns)
        one, other = self._place(after - 1), self._place(after)
        x, y, z = (a + share * (b - a) for a, b in zip(one, other, strict=True))
        return x, y, z

    def _place(self, index: int) -> tuple[float, float, float]:
        x, y, z = self._t_m[3 * index : 3 * index + 3]
        return x, y, z

    def __len__(self) -> int:
        return len(self._stamps_ns)


@dataclass(frozen=True)
class Outlier:
    """A pose beyond the gate. off_m: from the track's place; sigmas: the same by the pose's covariance.

    pictures: of each node, its marked picture as <svg>.
    """

    pose: RelativePose
    off_m: float
    sigmas: float
    pictures: dict[str, str] = field(default_factory=dict)


def outliers(poses: Sequence[RelativePose], path: TrackPath) -> list[Outlier]:
    """Return the poses beyond the gate, the furthest first."""
    placed = [(pose, known) for pose in poses if (known := path.at(pose.stamp_ns)) is not None]
    off_m = np.array([np.subtract(pose.t_a_b_m, known) for pose, known in placed]).reshape(-1, 3)
    covariances = np.array([pose.covariance for pose, _ in placed]).reshape(-1, 6, 6)[:, :3, :3]
    found = [
        Outlier(pose, float(np.linalg.norm(off)), math.sqrt(far))
        for (pose, _), off, far in zip(placed, off_m, nees(off_m, covariances).tolist(), strict=True)
        if far > GATE
    ]
    return sorted(found, key=lambda one: -one.sigmas)


def add_pictures(dive: Dive, found: Sequence[Outlier]) -> None:
    """Draw each outlier's two pictures, or the candidates alone where none was kept, with the chosen lights."""
    by_trigger = {one.pose.trigger: one for one in found}
    if not by_trigger:
        return
    frames: dict[tuple[str, int], Candidates] = {}
    images: dict[tuple[str, int], CompressedImage] = {}
    stamps_ns = np.array(sorted(one.pose.stamp_ns for one in found))
    for envelope in dive.messages("candidates", "image", doing="outliers"):
        message = envelope.message
        if isinstance(message, Candidates) and message.trigger in by_trigger:
            frames[message.node, message.trigger] = message
        elif isinstance(message, CompressedImage) and np.abs(stamps_ns - message.stamp_ns).min() < S_NS // 10:
            images[envelope.node, message.stamp_ns] = message
    for (node, trigger), frame in frames.items():
        one = by_trigger[trigger]
        if node in (one.pose.node_a, one.pose.node_b):
            image = images.get((node, frame.stamp_ns))
            one.pictures[node] = marked_svg(image, frame, chosen_lights(one.pose, node))
