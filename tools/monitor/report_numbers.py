"""All numbers of a dive's report, in SI units: the page's texts are made of them, and it carries them as JSON."""

from __future__ import annotations

import math
import time
from collections import Counter
from typing import Any, Final

import msgspec
import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import Config
from buddyline.protocol.messages import Track
from buddyline.tools.dives import Dive
from buddyline.tools.estimate import range_gap_m, sigma_m
from buddyline.tools.evaluation.statistics import Stats
from buddyline.tools.evaluation.triggers import trigger_figures
from buddyline.tools.monitor.outliers import MAX_LISTED, Outlier
from buddyline.tools.monitor.summary import Summary
from msgspec import UNSET

MIN_STRETCH_S: Final = 1.0


class ReportAbout(Config, frozen=True, kw_only=True):
    """What a dive's report says of it, out of a small TOML file; every line may be left out."""

    title: str = ""
    site: str = ""
    people: list[str] = msgspec.field(default_factory=list)
    instrument: str = ""
    text: str = ""


def numbers_of(dive: Dive, summary: Summary, outliers: list[Outlier] | None, about: ReportAbout) -> dict[str, Any]:
    """Return the numbers. Times are s, from the dive's first message where they are not stamps."""
    triggers = trigger_figures(summary.poses, summary.rejected, summary.asked)
    gaps = [stretch for stretch in summary.coverage.without() if stretch.seconds >= MIN_STRETCH_S]
    return {
        "about": msgspec.to_builtins(about),
        "dive": {
            "begun": time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(dive.start_ns // S_NS)),
            "seconds": dive.seconds,
            "nodes": sorted(summary.picture.nodes),
            "pair": [name for name in summary.picture.ends() if name is not None],
        },
        "triggers": {
            "total": triggers.total,
            "with_pose": len(summary.poses),
            "rejected": triggers.rejected,
            "without_outcome": triggers.unanswered,
            "longest_without_pose_s": triggers.gap_s,
            "without_pose": [
                {
                    "from_s": (stretch.begin_at_ns - dive.start_ns) / S_NS,
                    "seconds": stretch.seconds,
                    "reasons": dict(stretch.reasons),
                }
                for stretch in gaps
            ],
        },
        "poses": _of_poses(summary),
        "track": _of_track(summary),
        "depths": {
            node: {"least_m": min(depths), "most_m": max(depths), "sigma_m": summary.depth_sigma_m[node]}
            for node, line in sorted(summary.depths.items())
            for depths in [[depth_m for _, depth_m in line]]
        },
        "against_truth": _against_truth(summary),
        "error_budget": _budget(summary),
        "outliers": None if outliers is None else {
            "judged": sum(summary.path.at(pose.stamp_ns) is not None for pose in summary.poses),
            "found": len(outliers),
            "listed": [
                {"trigger": one.pose.trigger, "stamp_ns": one.pose.stamp_ns, "off_m": one.off_m, "sigmas": one.sigmas}
                for one in outliers[:MAX_LISTED]
            ],
        },
    }  # fmt: skip


def _of_poses(summary: Summary) -> dict[str, Any] | None:
    poses, sigmas_px = summary.poses, summary.light_sigmas_px
    if not poses:
        return None
    ranges_m = [pose.range_m for pose in poses]
    gaps_m = [abs(gap_m) for pose in poses if not math.isnan(gap_m := range_gap_m(pose))]
    return {
        "range_least_m": min(ranges_m),
        "range_most_m": max(ranges_m),
        "range_median_m": _median(ranges_m),
        "sigma_median_m": _median([sigma_m(pose) for pose in poses]),
        "range_gap_median_m": _median(gaps_m) if gaps_m else None,
        "light_sigma_median_px": _median(list(sigmas_px)) if sigmas_px else None,
        "methods": dict(Counter(pose.method for pose in poses)),
        "checks": dict(Counter(check for pose in poses for check in pose.checks)),
    }


def _of_track(summary: Summary) -> dict[str, Any] | None:
    """Return what the track's kept samples tell: those that are spacing_s apart at least."""
    tracks = [point.estimate for point in summary.tracks if isinstance(point.estimate, Track)]
    if not tracks:
        return None
    return {
        "mode": tracks[0].mode,
        "spacing_s": summary.spacing_ns / S_NS,
        "samples": len(tracks),
        "covered": summary.covered(),
        "longest_without_light_s": summary.dark_s,
        "sigma_median_m": _median([sigma_m(track) for track in tracks]),
        "speed_median_mps": _median([math.hypot(*track.v_a_b_mps) for track in tracks]),
    }


def _against_truth(summary: Summary) -> dict[str, Any] | None:
    errors = summary.errors()
    if not len(errors):
        return None
    found: dict[str, Any] = {
        "poses": {"position": _stats(Stats.of(errors.translation_m)), "range": _stats(Stats.of(abs(errors.range_m)))}
    }
    for track in summary.track_figures():
        found["track"] = {
            "samples": track.samples,
            "wrong": track.wrong,
            "position": _stats(track.position_m),
            "position_without_light": _stats(track.in_gaps_m),
        }
    return found


def _stats(stats: Stats) -> dict[str, Any]:
    return {"count": stats.count, "median_m": stats.median, "p95_m": stats.p95, "rms_m": stats.rmse}


def _budget(summary: Summary) -> dict[str, Any] | None:
    """Return what the error of B's place is made of, 1 sd: medians over the poses.

    optics_m: by the pictures, the poses' covariance. compass_m: what A's attitude adds in north-east-down. depth_m:
    both gauges, of the difference of depth alone. clock_m: the way in the estimated offset of the two clocks, at the
    median speed of the track. None where it is not known.
    """
    poses = summary.poses
    if not poses:
        return None
    # By differences of variances: what the place in north-east-down has more than the place in A's camera frame.
    added = [
        math.sqrt(max(sum(s * s for s in pose.sigma_ned_m) - sigma_m(pose) ** 2, 0.0))
        for pose in poses
        if pose.sigma_ned_m is not UNSET
    ]
    gauges = [summary.depth_sigma_m.get(name or "") for name in summary.picture.ends()]
    solver = summary.picture.solver
    offset_s = None if solver is None or solver.clock_skew_s is UNSET else solver.clock_skew_s
    speeds = [math.hypot(*p.estimate.v_a_b_mps) for p in summary.tracks if isinstance(p.estimate, Track)]
    return {
        "optics_m": _median([sigma_m(pose) for pose in poses]),
        "compass_m": _median(added) if added else None,
        "depth_m": math.hypot(*(one for one in gauges if one is not None)) if None not in gauges else None,
        "clock_offset_s": offset_s,
        "clock_m": abs(offset_s) * _median(speeds) if offset_s is not None and speeds else None,
    }


def _median(values: list[float]) -> float:
    return float(np.median(values))
