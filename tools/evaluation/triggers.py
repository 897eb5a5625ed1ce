"""The outcomes of the triggers, their rate, and the difference of the nodes' stamps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from buddyline.protocol.messages import Rejected, RelativePose
from buddyline.tools.evaluation.statistics import share
from buddyline.tools.evaluation.stretches import Outcome, stretches


@dataclass(frozen=True)
class Triggers:
    """The outcomes of the triggers. Each trigger should have exactly one pose or one rejection.

    unanswered: number with Candidates and without an outcome; None if the logs have no Candidates. doubled: number of
    second outcomes, which do not count. gap_s: the longest stretch without a pose (stretches.py); None without a pose.
    """

    total: int
    unanswered: int | None
    doubled: int
    rejected: dict[str, int]
    span_s: float
    triggers_hz: float | None
    poses_hz: float | None
    gap_s: float | None


@dataclass(frozen=True)
class Skew:
    """stamp_a - stamp_b over the poses. drift: its slope in ppm, with 1 sd."""

    median_s: float
    p95_s: float
    largest_s: float
    drift_ppm: float | None
    drift_sd_ppm: float | None


def trigger_figures(
    poses: Sequence[RelativePose], rejected: Sequence[Rejected], frames: Mapping[int, int], doubled: int = 0
) -> Triggers:
    """Return the outcomes of all triggers, including frames without an outcome; frames: stamps, ns, by trigger."""
    stamps_ns = dict(frames) | {rejection.trigger: rejection.stamp_ns for rejection in rejected}
    stamps_ns |= {pose.trigger: pose.stamp_ns for pose in poses}
    results = {pose.trigger for pose in poses} | {rejection.trigger for rejection in rejected}
    span_s = (max(stamps_ns.values()) - min(stamps_ns.values())) / 1e9 if stamps_ns else 0.0
    outcomes = [Outcome(pose.stamp_ns, pose.stamp_ns, None) for pose in poses]
    outcomes += [Outcome(rejection.stamp_ns, rejection.stamp_ns, rejection.reason) for rejection in rejected]
    solved = sorted(pose.stamp_ns for pose in poses)
    # Without a stretch, the longest time is that from one pose to the next.
    gaps_s = [(end - start) / 1e9 for start, end in pairwise(solved)] + [each.seconds for each in stretches(outcomes)]
    return Triggers(
        total=len(frames.keys() | results),
        unanswered=len(frames.keys() - results) if frames else None,
        doubled=doubled,
        rejected=dict(Counter(rejection.reason for rejection in rejected).most_common()),
        span_s=span_s,
        triggers_hz=share(len(stamps_ns) - 1, span_s),
        poses_hz=share(len(poses), span_s),
        gap_s=max(gaps_s, default=None) if poses else None,
    )


def skew_figures(poses: Sequence[RelativePose]) -> Skew | None:
    """Return the difference of the stamps of matched frames; None without poses."""
    if not poses:
        return None
    skew_s = np.array([pose.skew_ns for pose in poses]) / 1e9
    size_s = np.abs(skew_s)
    first_ns = min(pose.stamp_ns for pose in poses)
    t_s = np.array([pose.stamp_ns - first_ns for pose in poses]) / 1e9
    drift = drift_sd = None
    spread = float(((t_s - t_s.mean()) ** 2).sum())
    if len(poses) > 2 and spread > 0.0:
        slope = float(((t_s - t_s.mean()) * (skew_s - skew_s.mean())).sum()) / spread
        rest = skew_s - skew_s.mean() - slope * (t_s - t_s.mean())
        drift, drift_sd = slope * 1e6, float(np.sqrt((rest**2).sum() / (len(poses) - 2) / spread)) * 1e6
    return Skew(float(np.median(skew_s)), float(np.percentile(size_s, 95)), float(size_s.max()), drift, drift_sd)
