"""Whether the triggers that show all four lights end as a pose with the right pair."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from buddyline.protocol.messages import Rejected, RelativePose
from buddyline.tools.evaluation.lights import Blobs, TrueLights, is_right_pair
from buddyline.tools.evaluation.statistics import share


@dataclass(frozen=True)
class Pairing:
    """Triggers at which both pictures show both lights of the other node.

    marked: visible by LightTruth; else: the projected lights fall inside both pictures, whatever stands in between.
    right: of them, those that ended as a pose with the right pair; other_pair: as a pose with another; partial: as a
    pose from fewer than four lights; wrong: as a wrong pose, whatever its pair; ended: how the rest ended, by reason
    ("no result" among them). detected: of them, with a candidate near all four lights, and of these right_detected.
    None where candidates or results are not known.
    """

    marked: bool
    visible: int
    right: int | None
    other_pair: int | None
    partial: int | None
    wrong: int
    ended: dict[str, int]
    detected: int | None
    right_detected: int | None

    @property
    def right_share(self) -> float | None:
        """The share of visible triggers that ended as a pose with the right pair."""
        return None if self.right is None else share(self.right, self.visible)

    @property
    def right_detected_share(self) -> float | None:
        """The same, of the triggers at which all four lights were detected."""
        return (
            None if self.right_detected is None or self.detected is None else share(self.right_detected, self.detected)
        )


@dataclass(frozen=True)
class VisibleTrigger:
    """One trigger at which both pictures show both lights; ended: "pose", a rejection's reason, or "no result"."""

    range_m: float
    marked: bool
    detected: bool | None
    right: bool | None
    partial: bool
    wrong: bool
    ended: str


def visible_triggers(
    nodes: tuple[str, str],
    poses: Sequence[RelativePose],
    rejected: Sequence[Rejected],
    lights: Mapping[tuple[str, int], TrueLights],
    blobs: Mapping[tuple[str, int], Blobs],
    ranges_m: Mapping[int, float],
    wrong: Collection[int],
) -> list[VisibleTrigger]:
    """Return the triggers at which both pictures show both lights; ranges_m: the true range by trigger.

    wrong: the triggers of wrong poses.
    """
    pose_at = {pose.trigger: pose for pose in poses}
    reason_at = {rejection.trigger: rejection.reason for rejection in rejected}
    answered = bool(blobs and (poses or rejected))
    triggers_seen = []
    for trigger in sorted({trigger for _, trigger in lights}):
        views = [(lights.get((node, trigger)), blobs.get((node, trigger))) for node in nodes]
        if not all(true is not None and true.visible.all() for true, _ in views):
            continue
        pose = pose_at.get(trigger)
        near = [
            seen is not None and true is not None and bool((seen.distances_px(true) <= seen.tolerance_px).any(0).all())
            for true, seen in views
        ]
        triggers_seen.append(
            VisibleTrigger(
                range_m=ranges_m.get(trigger, float("nan")),
                marked=all(true is not None and true.marked for true, _ in views),
                detected=all(near) if blobs else None,
                right=(pose is not None and is_right_pair(pose, blobs, lights) is True) if answered else None,
                partial=pose is not None and min(*pose.blobs_a, *pose.blobs_b) < 0,
                wrong=trigger in wrong,
                ended="pose" if pose is not None else reason_at.get(trigger, "no result"),
            )
        )
    return triggers_seen


def pairing_figures(triggers_seen: Sequence[VisibleTrigger]) -> Pairing | None:
    """Return the figures of these triggers, None where there are none."""
    if not triggers_seen:
        return None
    judged = all(seen_trigger.right is not None for seen_trigger in triggers_seen)
    searched = all(seen_trigger.detected is not None for seen_trigger in triggers_seen)
    posed = sum(seen_trigger.ended == "pose" for seen_trigger in triggers_seen)
    right = sum(bool(seen_trigger.right) for seen_trigger in triggers_seen)
    partial = sum(seen_trigger.partial for seen_trigger in triggers_seen)
    return Pairing(
        marked=all(seen_trigger.marked for seen_trigger in triggers_seen),
        visible=len(triggers_seen),
        right=right if judged else None,
        other_pair=posed - right - partial if judged else None,
        partial=partial if judged else None,
        wrong=sum(seen_trigger.wrong for seen_trigger in triggers_seen),
        ended=dict(
            Counter(seen_trigger.ended for seen_trigger in triggers_seen if seen_trigger.ended != "pose").most_common()
        ),
        detected=sum(bool(seen_trigger.detected) for seen_trigger in triggers_seen) if searched else None,
        right_detected=sum(bool(seen_trigger.detected and seen_trigger.right) for seen_trigger in triggers_seen)
        if judged
        else None,
    )
