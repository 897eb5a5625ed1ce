"""Compare the poses, rejections, tracks and candidates of one pair of nodes with truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from buddyline.protocol.messages import Candidates, Rejected
from buddyline.tools.evaluation.detection import DetectionFigures, detection_figures
from buddyline.tools.evaluation.lights import Blobs, is_right_pair, true_lights
from buddyline.tools.evaluation.ned import NedHonesty, ned_honesty
from buddyline.tools.evaluation.pairing import Pairing, VisibleTrigger, pairing_figures, visible_triggers
from buddyline.tools.evaluation.poses import PoseErrors, pose_errors
from buddyline.tools.evaluation.recorded import Recorded
from buddyline.tools.evaluation.rotation import Floats
from buddyline.tools.evaluation.statistics import Stats, in_bins, share
from buddyline.tools.evaluation.tracks import TrackFigures, tracks_figures
from buddyline.tools.evaluation.triggers import Skew, Triggers, skew_figures, trigger_figures
from buddyline.tools.evaluation.truth import TruthTrack, ned_of_camera

RANGE_EDGES_M: Final = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, float("inf"))
# The 95 % points of chi-square with 6 and 3 degrees of freedom.
NEES6_GATE: Final = 12.592
NEES3_GATE: Final = 7.815


@dataclass(frozen=True)
class Accuracy:
    """Errors of some poses; see PoseErrors. honest6, honest3: share with a NEES below its 95 % point."""

    poses: int
    wrong: int
    wrong_share: float | None
    translation_m: Stats
    rotation_rad: Stats
    range_m: Stats
    bearing_rad: Stats
    azimuth_rad: Stats
    inclination_rad: Stats
    nees6: Stats
    nees3: Stats
    honest6: float | None
    honest3: float | None

    @classmethod
    def of(cls, errors: PoseErrors) -> Accuracy:
        """Return the figures of these poses."""
        wrong = int(errors.wrong.sum())
        return cls(
            poses=len(errors),
            wrong=wrong,
            wrong_share=share(wrong, len(errors)),
            honest6=_share_within(errors.nees6, NEES6_GATE),
            honest3=_share_within(errors.nees3, NEES3_GATE),
            **{name: Stats.of(getattr(errors, name)) for name in _MEASURED},
        )


_MEASURED: Final = tuple(field.name for field in fields(Accuracy) if field.type == "Stats")


def _share_within(values: Floats, gate: float) -> float | None:
    known = values[np.isfinite(values)]
    return share(int((known <= gate).sum()), len(known))


@dataclass(frozen=True)
class RangeBin:
    """The figures of one bin of true range, from_m <= range < to_m. pairing: None if no trigger showed all lights."""

    from_m: float
    to_m: float
    accuracy: Accuracy
    pairing: Pairing | None


@dataclass(frozen=True, eq=False)
class Result:
    """All figures of one pair. without_truth: number of poses that could not be compared. tracks: one for each mode.

    ned: of the poses; None without true NED. environment: the water; empty if the logs do not name it.
    """

    node_a: str
    node_b: str
    poses: int
    without_truth: int
    triggers: Triggers
    skew: Skew | None
    accuracy: Accuracy
    bins: list[RangeBin]
    pairing: Pairing | None
    detection: DetectionFigures | None
    tracks: list[TrackFigures]
    errors: PoseErrors
    environment: str = ""
    ned: NedHonesty | None = None


def _bins(errors: PoseErrors, visible: Sequence[VisibleTrigger]) -> list[RangeBin]:
    bins = []
    for start_m, end_m, inside in in_bins(RANGE_EDGES_M, errors.true_range_m):
        seen = [one for one in visible if start_m <= one.range_m < end_m]
        if inside.any() or seen:
            bins.append(RangeBin(start_m, end_m, Accuracy.of(errors.select(inside)), pairing_figures(seen)))
    return bins


def _triggers_ns(frames: Iterable[Candidates], rejected: Iterable[Rejected]) -> list[int]:
    """Return when triggers were: without candidates, by outcomes. A late frame's stamp may be far off."""
    pictured = [frame.stamp_ns for frame in frames]
    return pictured or [one.stamp_ns for one in rejected if one.reason != "late"]


def evaluate(recorded: Recorded) -> Result:
    """Compare one pair's messages with truth.

    Of several Candidates of one node and trigger the first counts. Candidates of other nodes are left out.
    """
    nodes, poses, rejected, infos = recorded.nodes, recorded.poses, recorded.rejected, recorded.infos
    track = TruthTrack(recorded.truths)
    frames: dict[tuple[str, int], Candidates] = {}
    for frame in recorded.candidates:
        if frame.node in nodes:
            frames.setdefault((frame.node, frame.trigger), frame)
    blobs = {key: Blobs.of(frame) for key, frame in frames.items()}
    lights = true_lights(nodes, frames.values(), recorded.light_truths, infos, track)
    errors = pose_errors(
        poses,
        track,
        lambda pose: is_right_pair(pose, blobs, lights),
        ned_of_camera(recorded.ned_truths_a, recorded.attitudes_a, infos.get(nodes[0])),
    )
    # Sigmas in NED are compared only with true poses: a comparison by attitudes would not contain their errors.
    true_ned_a = ned_of_camera(recorded.ned_truths_a, [], None)
    between = recorded.ned_truths_a if recorded.ned_truths_between is None else recorded.ned_truths_between
    compared = [(pose, known[0]) for pose in poses if (known := track.at(pose.stamp_ns, pose.trigger)) is not None]
    seen = visible_triggers(nodes, poses, rejected, lights, blobs, set(errors.trigger[errors.wrong].tolist()))
    return Result(
        node_a=nodes[0],
        node_b=nodes[1],
        poses=len(poses),
        without_truth=len(poses) - len(errors),
        triggers=trigger_figures(
            poses, rejected, {frame.trigger: frame.stamp_ns for frame in frames.values()}, recorded.doubled
        ),
        skew=skew_figures(poses),
        accuracy=Accuracy.of(errors),
        bins=_bins(errors, seen),
        pairing=pairing_figures(seen),
        detection=detection_figures(lights, blobs),
        tracks=tracks_figures(
            recorded.tracks,
            poses,
            track,
            ned_of_camera(between, [], None),
            _triggers_ns(frames.values(), rejected),
        ),
        errors=errors,
        environment=recorded.environment,
        ned=ned_honesty(compared, true_ned_a),
    )
