"""How far two nodes' clocks are apart and how they drift, as tracks of stretches of a dive tell."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.track.dive import smooth
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.moving import KNOWN_CLOCK_S
from buddyline.solver_service.track.records import Records, in_order
from buddyline.solver_service.track.state import CLOCK

# A stretch of about this length: on a much shorter one a track estimates the offset worse than over a dive.
STRETCH_NS: Final = 60 * S_NS
MIN_FIXES: Final = 20
# A drift whose sigma is not below this is not given: quartz clocks drift apart by less than twice as much.
DRIFT_TOLD: Final = 20e-6


@dataclass(frozen=True)
class Clocks:
    """What a dive tells of two clocks, all 1 sd. offset_s: B's minus A's, at at_ns, the middle of what told it.

    drift: s a second, how fast the offset grows; None where the dive does not tell it. drift_sigma: how well it tells
    it, None where it is too short. stretches: how many stretches told the offset, each by itself. fixes: in them.
    """

    offset_s: float
    sigma_s: float
    at_ns: int
    drift: float | None
    drift_sigma: float | None
    stretches: int
    fixes: int


def clocks_of(records: Records, fixes: Sequence[FixSeen]) -> Clocks | None:
    """Estimate the clocks by tracks of a dive's stretches; None where none tells the offset."""
    told = [found for stretch in _stretches(records, fixes) if (found := _clock_of_stretch(*stretch)) is not None]
    return line_through(told) if told else None


def line_through(told: Sequence[tuple[float, float, float, int]]) -> Clocks:
    """Give the straight line through what stretches tell: time (s), offset, its sigma (s), and number of fixes.

    Where they scatter by more than they state, its sigmas grow.
    """
    times_s, offsets_s, sigmas_s, counts = np.array(told).T
    weights = sigmas_s**-2.0
    middle_s = float(weights @ times_s / weights.sum())
    levers_s = times_s - middle_s
    offset_s, sigma_s = float(weights @ offsets_s / weights.sum()), float(weights.sum()) ** -0.5
    drift, drift_sigma = 0.0, math.inf
    if len(told) > 1:
        turning = float(weights @ levers_s**2)
        drift, drift_sigma = float((weights * levers_s) @ offsets_s) / turning, turning**-0.5
    if len(told) > 2:
        left_s = offsets_s - offset_s - drift * levers_s
        scale = max(float(weights @ left_s**2) / (len(told) - 2), 1.0) ** 0.5
        sigma_s, drift_sigma = scale * sigma_s, scale * drift_sigma
    return Clocks(
        offset_s=offset_s,
        sigma_s=sigma_s,
        at_ns=round(middle_s * S_NS),
        drift=drift if drift_sigma < DRIFT_TOLD else None,
        drift_sigma=drift_sigma if math.isfinite(drift_sigma) else None,
        stretches=len(told),
        fixes=round(counts.sum()),
    )


def clock_now(track: TrackFilter) -> tuple[float, float] | None:
    """Give the offset as a running filter believes it, and its sigma, s.

    None without a confirmed track, or where a node has no inertial unit: its turning tells an offset too small.
    """
    main = track.main
    if main is None or not main.confirmed or any(main.without):
        return None
    return track.clock_ns / S_NS + float(main.state.clock_s), math.sqrt(main.covariance[CLOCK, CLOCK])


def _stretches(records: Records, fixes: Sequence[FixSeen]) -> Iterator[tuple[Records, list[FixSeen]]]:
    """Cut what lies between the first fix and the last into stretches of about one length."""
    if not fixes:
        return
    records, fixes = (in_order(records[0]), in_order(records[1])), sorted(fixes, key=lambda fix: fix.stamp_ns)
    start_ns, end_ns = fixes[0].stamp_ns - S_NS, fixes[-1].stamp_ns + S_NS
    count = max(1, (end_ns - start_ns) // STRETCH_NS)
    cuts_ns = [start_ns + (end_ns - start_ns) * k // count for k in range(count + 1)]
    for start, end in pairwise(cuts_ns):
        within = [fix for fix in fixes if start <= fix.stamp_ns < end]
        yield (records[0].between(start, end), records[1].between(start, end)), within


def _clock_of_stretch(records: Records, fixes: Sequence[FixSeen]) -> tuple[float, float, float, int] | None:
    """Give the middle of a stretch (s since the epoch), the offset there, its sigma and the number of fixes."""
    if len(fixes) < MIN_FIXES:
        return None
    found = smooth(records, fixes, ())
    offset_s, sigma_s = found.clock_offset_s, found.clock_sigma_s
    if not sigma_s < KNOWN_CLOCK_S:
        return None
    return 0.5 * (fixes[0].stamp_ns + fixes[-1].stamp_ns) / S_NS, offset_s, sigma_s, len(fixes)
