"""The tracks of one pass over a dive, one after the other: do they agree, above all on the clocks?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Final

from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.state import CLOCK

# A pass that finds the offset off by as much is repeated with it; where a node has no inertial unit, only from
# MOST_LEFT_S on. Where the last pass still finds MOST_LEFT_S there is no track.
NEAR_CLOCK_S: Final = 0.005
MOST_LEFT_S: Final = 0.06
# An offset differs from the assumed one where it is so many sigmas off.
TOLD_SIGMAS: Final = 6.0
# Of several tracks those of one offset are enough where they last for so much of the time that all do: of the dive, if
# they last for less than LONG_S.
NEARLY_ALL: Final = 0.9
LONG_S: Final = 20.0
# Tracks are in pieces where their offsets differ by more than so many s, and so many sigmas.
PIECES_S: Final = 0.1
PIECES_SIGMAS: Final = 4.0
# Two quartz clocks drift apart by less, s a second.
MOST_DRIFT: Final = 100e-6


def parts_of(track: TrackFilter) -> list[Estimate]:
    """Give the confirmed tracks of a filter, one after the other in time."""
    parts = [part for part in track.finished if part.steps]
    if track.main is not None and track.main.confirmed and track.main.steps:
        parts.append(track.main)
    return parts


def goes_on(parts: Sequence[Estimate]) -> bool:
    """Whether tracks of one settled offset of the clocks are nearly all of a dive's tracks; others are false starts.

    With a wrong offset tracks are replaced after seconds, or go on but ask for another offset in each pass. Beside a
    track of single lamps, one of another start is a false one, and the other way round.
    """
    if len(parts) < 2:
        return True
    longest = max(parts, key=lasted_s)
    alike = [part for part in parts if part.lone == longest.lone]
    settled = [part for part in alike if not disagree(longest, part, NEAR_CLOCK_S) and not clock_left_ns([part])]
    together_s, all_s = (sum(map(lasted_s, some)) for some in (settled, parts))
    whole_s = max(part.t_s for part in parts) - min(part.start_s for part in parts)
    return together_s > NEARLY_ALL * (all_s if together_s > LONG_S else whole_s) and longest in settled


def lasted_s(part: Estimate) -> float:
    """Give for how long a track went on."""
    return min(part.t_s, part.end_s) - part.start_s


def mostly_without(part: Estimate) -> bool:
    """Whether one of a track's nodes has had no inertial unit in most of the pictures."""
    return part.bare > 0.5 * part.pictures


def in_pieces(parts: Sequence[Estimate]) -> bool:
    """Whether a dive's tracks disagree on the clocks' offset: it is further off than was tried."""
    return any(disagree(one, other, PIECES_S) for one, other in combinations(parts, 2))


def disagree(one: Estimate, other: Estimate, limit_s: float) -> bool:
    """Whether two tracks' clock offsets differ by more than limit_s beside drift, and more than PIECES_SIGMAS."""
    limit_s += MOST_DRIFT * abs(one.t_s - other.t_s)
    variance = float(one.covariance[CLOCK, CLOCK] + other.covariance[CLOCK, CLOCK])
    return abs(one.state.clock_s - other.state.clock_s) > max(limit_s, PIECES_SIGMAS * math.sqrt(variance))


def of_one_clock(parts: Sequence[Estimate]) -> list[Estimate]:
    """Leave out tracks that diverged: between one and the next the clocks' offset cannot have jumped.

    Of two that disagree on it, the one that explains more is kept. Further apart than PIECES_S it is the offset that
    is not known.
    """
    sound: list[Estimate] = []
    for part in parts:
        while sound and disagree(sound[-1], part, NEAR_CLOCK_S) and not disagree(sound[-1], part, PIECES_S):
            if sound[-1].evidence > part.evidence:
                break
            sound.pop()
        else:
            sound.append(part)
    return sound


def clock_left_ns(parts: Sequence[Estimate]) -> int:
    """Give by how much B's clock proves to be off what a pass assumed; 0 where that is near enough."""
    if not parts:
        return 0
    without = any(map(mostly_without, parts))
    off = clock_off_by(parts[-1], MOST_LEFT_S if without else NEAR_CLOCK_S)
    return round(parts[-1].state.clock_s * 1e9) if off else 0


def clock_off_by(part: Estimate, limit_s: float) -> bool:
    """Whether a track's clocks are limit_s and TOLD_SIGMAS off: at rest, its sigma is too small for fewer."""
    sigma_s = math.sqrt(part.covariance[CLOCK, CLOCK])
    return abs(part.state.clock_s) >= max(limit_s, TOLD_SIGMAS * sigma_s)
