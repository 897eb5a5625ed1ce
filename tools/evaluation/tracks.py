"""Compare the track of one pair with truth: coverage, errors inside and outside gaps, NEES."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.health import NO_LIGHT_S, TRACK_SIGMA_SHARE
from buddyline.protocol.messages import RelativePose, Track, TrackMode
from buddyline.tools.evaluation.ned import NedHonesty, ned_honesty
from buddyline.tools.evaluation.poses import WRONG_SHARE, differences
from buddyline.tools.evaluation.statistics import Stats, share
from buddyline.tools.evaluation.truth import PoseHistory, TruthTrack
from buddyline.tools.progress import counted

COVERED_SHARE: Final = TRACK_SIGMA_SHARE
"""A track covers an instant if the sigma of its position is below this share of the range."""
WRONG_SIGMAS: Final = 3.0
"""A track is wrong if its position error is above WRONG_SHARE of the range and above this many sigmas."""
GAP_S: Final = NO_LIGHT_S
"""A track is in a gap after it has used no light for longer than this."""


@dataclass(frozen=True)
class TrackFigures:
    """The figures of one mode of a pair's track. samples: number with truth. wrong_in_gaps: wrong samples in a gap.

    covered: share of the time that it covers. covered_from: that time is from the first to the last pose, or trigger
    where there are no two poses. worst_m: largest position error. nees6, nees3: means are 6 and 3 if the covariance is
    true; where truth is sparse, of the samples at its instants alone. in_gaps_m, outside_m: position errors in and
    outside gaps. ned: None without true NED.
    """

    mode: TrackMode
    samples: int
    covered: float | None
    covered_from: Literal["pose", "trigger"]
    wrong: int
    wrong_in_gaps: int
    position_m: Stats
    worst_m: float | None
    rotation_rad: Stats
    in_gaps_m: Stats
    outside_m: Stats
    nees6: Stats
    nees3: Stats
    ned: NedHonesty | None = None


def tracks_figures(
    tracks: Sequence[Track],
    poses: Sequence[RelativePose],
    truth: TruthTrack,
    ned_camera_a: PoseHistory | None = None,
    triggers_ns: Collection[int] = (),
) -> list[TrackFigures]:
    """Return the figures of each mode among the tracks, in the order of the modes' first samples.

    ned_camera_a: node a's true camera poses in NED. triggers_ns: stamps of the triggers, as covered_share takes them.
    """
    modes = dict.fromkeys(track.mode for track in tracks)
    return [
        _figures(mode, [track for track in tracks if track.mode == mode], poses, truth, ned_camera_a, triggers_ns)
        for mode in modes
    ]


def _figures(
    mode: TrackMode,
    tracks: Sequence[Track],
    poses: Sequence[RelativePose],
    truth: TruthTrack,
    ned_camera_a: PoseHistory | None,
    triggers_ns: Collection[int],
) -> TrackFigures:
    found = [
        (track, known)
        for track in counted(tracks, "evaluate the track")
        if (known := truth.interpolated(track.stamp_ns)) is not None
    ]
    off = differences(found)
    close = np.array([truth.is_close(track.stamp_ns) for track, _ in found], dtype=bool)
    judged = close if close.any() else np.ones(len(found), dtype=bool)
    in_gap = np.array([track.age_s > GAP_S for track, _ in found], dtype=bool)
    wrong = (off.translation_m > WRONG_SHARE * off.true_range_m) & ~(off.nees3 <= WRONG_SIGMAS**2)
    return TrackFigures(
        mode=mode,
        samples=len(found),
        covered=covered_share(tracks, poses, triggers_ns),
        covered_from=covered_from(poses),
        wrong=int(wrong.sum()),
        wrong_in_gaps=int((wrong & in_gap).sum()),
        position_m=Stats.of(off.translation_m),
        worst_m=float(off.translation_m.max()) if found else None,
        rotation_rad=Stats.of(off.rotation_rad),
        in_gaps_m=Stats.of(off.translation_m[in_gap]),
        outside_m=Stats.of(off.translation_m[~in_gap]),
        nees6=Stats.of(off.nees6[judged]),
        nees3=Stats.of(off.nees3[judged]),
        ned=ned_honesty([(track, known[0]) for track, known in found], ned_camera_a),
    )


def covered_from(poses: Sequence[RelativePose]) -> Literal["pose", "trigger"]:
    """Return between the first and the last of what a track should cover a dive."""
    return "pose" if len(poses) > 1 else "trigger"


def covered_share(
    tracks: Sequence[Track], poses: Sequence[RelativePose], triggers_ns: Collection[int] = ()
) -> float | None:
    """Return the share of the time between first and last pose that is covered; below two poses, of the triggers'.

    triggers_ns: stamps of pictures or outcomes; None where there are not two either. Time is counted in the track's
    median period, so a missing sample counts as not covered.
    """
    ends_ns = triggers_ns if covered_from(poses) == "trigger" else [pose.stamp_ns for pose in poses]
    if len(ends_ns) < 2:
        return None
    if len(tracks) < 2:
        return 0.0
    first_ns, last_ns = min(ends_ns), max(ends_ns)
    stamps_ns = np.sort(np.array([track.stamp_ns for track in tracks]))
    period_s = float(np.median(np.diff(stamps_ns))) / S_NS
    if last_ns <= first_ns or period_s <= 0.0:
        return None
    sigma_m = np.sqrt([sum(track.covariance[i] for i in (0, 7, 14)) for track in tracks])
    range_m = np.array([track.range_m for track in tracks])
    inside = np.array([first_ns <= track.stamp_ns <= last_ns for track in tracks], dtype=bool)
    covered = int((inside & (sigma_m < COVERED_SHARE * range_m)).sum())
    return min(share(covered * period_s, (last_ns - first_ns) / S_NS) or 0.0, 1.0)
