"""Recognition on return: which earlier station an end of the last leg may be, while the divers are still there."""

from __future__ import annotations

from collections.abc import Sequence

from buddyline.tools.survey.derive import Derived
from buddyline.tools.survey.gauges import adjust_gauges
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.project import Leg, Project
from buddyline.tools.survey.proposals import Proposal


def recognized(legs: Sequence[Leg]) -> list[Proposal]:
    """Return the proposals about a station of the last leg, the likeliest first; it is `station` in each."""
    derived = Derived()
    derived.legs = list(legs)
    project = Project(leg=derived.legs, station=derived.stations(adjust_gauges(legs).depths))
    last = {legs[-1].from_, legs[-1].to}
    before = {name for leg in legs[:-1] for name in (leg.from_, leg.to)}
    return [one for one in adjust(project).proposals if one.station in last - before and one.other in before]
