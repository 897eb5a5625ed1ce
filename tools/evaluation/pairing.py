"""How many triggers that show all four lights give a pose from the right candidates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from buddyline.protocol.messages import Rejected, RelativePose
from buddyline.tools.evaluation.lights import Blobs, TrueLights, is_right_pair
from buddyline.tools.evaluation.statistics import share


@dataclass(frozen=True)
class Pairing:
    """The outcomes of the triggers at which both pictures show both lights of the other node.

    marked: visible by LightTruth; if false, the projected lights are inside both pictures, without regard to obstacles.
    Numbers of these triggers: right: a pose from the right pair. other_pair: a pose from another pair. partial: a pose
    from fewer than four lights. wrong: a wrong pose, from any pair. ended: the others, by reason (also "no result").
    detected: with a candidate near all four lights. right_detected: right ones among these. None if candidates or
    results are not known.
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
        """Share of the visible triggers with a pose from the right pair."""
        return None if self.right is None else share(self.right, self.visible)

    @property
    def right_detected_share(self) -> float | None:
        """Share of the triggers with all four lights detected that have a pose from the right pair."""
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
    wrong: Collection[int],
) -> list[VisibleTrigger]:
    """Return the triggers at which both pictures show both lights. wrong: trigger numbers of wrong poses."""
    pose_at = {pose.trigger: pose for pose in poses}
    reason_at = {rejection.trigger: rejection.reason for rejection in rejected}
    answered = bool(blobs and (poses or rejected))
    found = []
    for trigger in sorted({trigger for _, trigger in lights}):
        views = [lights[node, trigger] for node in nodes if (node, trigger) in lights]
        if len(views) < 2 or not all(true.visible.all() for true in views):
            continue
        pose = pose_at.get(trigger)
        seen = [blobs.get((node, trigger)) for node in nodes]
        near = [
            one is not None and bool((one.distances_px(true) <= one.tolerance_px).any(0).all())
            for one, true in zip(seen, views, strict=True)
        ]
        found.append(
            VisibleTrigger(
                range_m=views[1].range_m,
                marked=all(true.marked for true in views),
                detected=all(near) if blobs else None,
                right=(pose is not None and is_right_pair(pose, blobs, lights) is True) if answered else None,
                partial=pose is not None and min(*pose.blobs_a, *pose.blobs_b) < 0,
                wrong=trigger in wrong,
                ended="pose" if pose is not None else reason_at.get(trigger, "no result"),
            )
        )
    return found


def pairing_figures(found: Sequence[VisibleTrigger]) -> Pairing | None:
    """Return the figures of these triggers; None if there are none."""
    if not found:
        return None
    judged = all(one.right is not None for one in found)
    searched = all(one.detected is not None for one in found)
    ended = Counter(one.ended for one in found)
    posed = ended.pop("pose", 0)
    right, partial = sum(bool(one.right) for one in found), sum(one.partial for one in found)
    return Pairing(
        marked=all(one.marked for one in found),
        visible=len(found),
        right=right if judged else None,
        other_pair=posed - right - partial if judged else None,
        partial=partial if judged else None,
        wrong=sum(one.wrong for one in found),
        ended=dict(ended.most_common()),
        detected=sum(bool(one.detected) for one in found) if searched else None,
        right_detected=sum(bool(one.detected and one.right) for one in found) if judged else None,
    )
