"""Find the rests of a dive, in which both nodes are held still, from fixes and inertial sensors."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.tools.survey.averages import Bools, Floats, Ints
from buddyline.tools.survey.readings import NodeReadings, PairReadings
from buddyline.tools.survey.settings import SurveySettings
from buddyline.tools.survey.sights import Sights

# Time over which a speed is the slope. Headings drift meanwhile, by this share of their stated sigma or this minimum.
SLOPE_NS: Final = 4_000_000_000
WANDER_RADPS: Final = 0.006
WANDER_SHARE_HZ: Final = 0.23
# A longer gap between fixes ends a rest, unless the line between the nodes is still the same.
PAUSE_NS: Final = 5_000_000_000
# Poses so near to a stretch of refused ones tell whether the nodes moved during it.
BESIDE_NS: Final = 1_000_000_000
# Two lines are the same if they differ by less than this length plus this share of the range.
SAME_M: Final = 0.25
SAME_SHARE: Final = 0.06
LEAST_RUN: Final = 3
FEEL_NS: Final = 500_000_000
GRAVITY_MPS2: Final = 9.80665
# Reasons that mean that a node looked away, that the link lost a frame, or that the solver had no time.
UNSEEN: Final = ("unmatched", "no_info", "too_few_candidates", "late", "duplicate")


@dataclass(frozen=True, eq=False)
class Rest:
    """Fixes at one rest of the pair: chosen (n,) of the dive's; unused: other triggers during the rest, by reason.

    too_short: why it makes no leg, in words; empty if it makes one.
    """

    chosen: Bools
    start_ns: int
    end_ns: int
    line_m: Floats
    too_short: str = ""
    unused: dict[str, list[int]] = field(default_factory=dict)


def rests(readings: PairReadings, seen: Sights, settings: SurveySettings) -> list[Rest]:
    """Return the rests of a dive in their order; too_short where not rest_s long with rest_fixes fixes.

    Rests shorter than half of that are left out: they are a swimmer's pauses. Triggers that were rejected meanwhile
    count as fixes of a rest, but not of a leg.
    """
    handled_by = [handled(node, seen.stamps_ns, settings) for node in readings.pair]
    yaw_rad = np.nan_to_num(seen.sigma_rad[:, :, 2].max(axis=0))
    wander_mps = np.maximum(WANDER_RADPS, WANDER_SHARE_HZ * yaw_rad) * seen.range_m
    limit_mps = settings.rest_speed_mps + wander_mps
    still = (speeds_mps(seen) < limit_mps) & ~np.any(handled_by, axis=0)
    found: list[Rest] = []
    for run in _merged(_runs(seen, still), seen):
        start_ns, end_ns = int(seen.stamps_ns[run[0]]), int(seen.stamps_ns[run[-1]])
        if not _long_enough(len(run), end_ns - start_ns, settings, 0.5):
            continue
        whole = _long_enough(len(run), end_ns - start_ns, settings)
        too_short = "" if whole else f"{(end_ns - start_ns) / 1e9:.0f} s with {len(run)} fixes"
        chosen = np.zeros(len(seen.stamps_ns), dtype=bool)
        chosen[run] = True
        inside = (seen.stamps_ns >= start_ns) & (seen.stamps_ns <= end_ns) & ~chosen
        unused = {"moving": seen.triggers[inside].tolist()} if inside.any() else {}
        for one in readings.rejected:
            if start_ns <= one.stamp_ns <= end_ns:
                unused.setdefault(one.reason, []).append(one.trigger)
        found.append(Rest(chosen, start_ns, end_ns, _line_m(seen, run), too_short, unused))
    lost = _refused(readings, seen, still, found, settings)
    lost = [one for one in lost if not _moved(seen, one.start_ns, one.end_ns, limit_mps)]
    return sorted([*found, *lost], key=lambda one: one.start_ns)


def pauses(track: PairReadings, seen: Sights, settings: SurveySettings) -> list[Rest]:
    """Return the pauses of a dive, of its track's rows: of each stretch at rest the pause_s in which it moved least.

    At both ends of a stretch a node comes slowly to its station, or leaves it.
    """
    assert track.speed_mps is not None
    handled_by = [handled(node, seen.stamps_ns, settings) for node in track.pair]
    still = (track.speed_mps < settings.rest_speed_mps) & ~np.any(handled_by, axis=0)
    found = []
    for run in _merged(_runs(seen, still), seen):
        stamps_ns = seen.stamps_ns[run]
        ends = np.searchsorted(stamps_ns, stamps_ns + round(settings.pause_s * S_NS))
        fits = np.flatnonzero(ends < len(run))
        if not len(fits):
            continue
        line_m = seen.line_m[run]
        moved_m = [float(np.ptp(line_m[i : ends[i] + 1], axis=0).sum()) for i in fits]
        first = int(fits[int(np.argmin(moved_m))])
        part = run[first : int(ends[first]) + 1]
        chosen = np.zeros(len(seen.stamps_ns), dtype=bool)
        chosen[part] = True
        found.append(Rest(chosen, int(stamps_ns[first]), int(stamps_ns[ends[first]]), _line_m(seen, part)))
    return found


def _long_enough(count: int, span_ns: int, settings: SurveySettings, share: float = 1.0) -> bool:
    return count >= share * settings.rest_fixes and span_ns >= share * settings.rest_s * S_NS


def _refused(
    readings: PairReadings, seen: Sights, still: Bools, found: list[Rest], settings: SurveySettings
) -> list[Rest]:
    """Return stretches outside the found rests in which both nodes saw lights but hardly any pose was found.

    Poses that show the nodes moving, LEAST_RUN of them in a row, end a stretch. It is as long as a leg's rest: lights
    that are refused show of no shorter time whether the nodes stood still.
    """
    moving_ns = seen.stamps_ns[~still]
    events = [(int(seen.stamps_ns[i]), "fix") for i in np.flatnonzero(still).tolist()]
    events += [(one.stamp_ns, one.reason) for one in readings.rejected if one.reason not in UNSEEN]
    groups: list[list[tuple[int, str]]] = []
    for event in sorted(events):
        if any(one.start_ns - PAUSE_NS <= event[0] <= one.end_ns + PAUSE_NS for one in found):
            continue
        last_ns = groups[-1][-1][0] if groups else event[0] - PAUSE_NS
        moving = np.searchsorted(moving_ns, event[0]) - np.searchsorted(moving_ns, last_ns)
        if event[0] - last_ns < PAUSE_NS and moving < LEAST_RUN:
            groups[-1].append(event)
        else:
            groups.append([event])
    lost = []
    for group in groups:
        start_ns, end_ns = group[0][0], group[-1][0]
        if not _long_enough(len(group), end_ns - start_ns, settings):
            continue
        reasons = Counter(reason for _, reason in group)
        text = f"{(end_ns - start_ns) / 1e9:.0f} s with {reasons.pop('fix', 0)} fixes"
        if reasons:
            text += "; refused: " + ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
        lost.append(Rest(np.zeros(len(still), dtype=bool), start_ns, end_ns, np.zeros(3), text))
    return lost


def _moved(seen: Sights, start_ns: int, end_ns: int, limit_mps: Floats) -> bool:
    """Return whether the line between the nodes is elsewhere after a stretch than before it: they moved meanwhile.

    limit_mps (n,): the speed of each fix below which the pair counts as resting.
    """
    first, end = np.searchsorted(seen.stamps_ns, (start_ns, end_ns + 1)).tolist()
    before = [i for i in range(max(first - LEAST_RUN, 0), first) if seen.stamps_ns[i] > start_ns - BESIDE_NS]
    last = min(end + LEAST_RUN, len(limit_mps))
    after = [i for i in range(end, last) if seen.stamps_ns[i] < end_ns + BESIDE_NS]
    if not before or not after:
        return False
    apart_s = float(seen.stamps_ns[after].mean() - seen.stamps_ns[before].mean()) / S_NS
    moved_m = float(np.linalg.norm(_line_m(seen, after) - _line_m(seen, before)))
    return moved_m / apart_s > float(max(limit_mps[before[-1]], limit_mps[after[0]]))


def same_line(one_m: Floats, other_m: Floats) -> bool:
    """Return whether two lines (3,), m, NED, connect the same two places."""
    tolerance_m = SAME_M + SAME_SHARE * float(np.linalg.norm(one_m))
    return bool(np.linalg.norm(one_m - other_m) < tolerance_m)


def speeds_mps(seen: Sights) -> Floats:
    """Return the speed of b relative to a at each fix, (n,): the slope of the line over SLOPE_NS.

    Without any attitude, of the range alone.
    """
    line_m = seen.line_m
    known = np.asarray(~np.isnan(line_m).any(axis=1))
    value = np.where(known[:, None], line_m, np.outer(seen.range_m, [1.0, 0.0, 0.0]))
    stamps = seen.stamps_ns
    speed = np.zeros(len(stamps))
    for i, (start, end) in enumerate(_around(stamps, stamps, SLOPE_NS // 2)):
        part = np.flatnonzero(known[start:end] == known[i]) + start
        if len(part) < LEAST_RUN:
            continue
        t_s = (stamps[part] - stamps[i]) / 1e9
        # Medians of both halves, so that one gross error does not look like a motion.
        middle = len(part) // 2
        apart_s = float(t_s[middle:].mean() - t_s[:middle].mean())
        moved_m = np.median(value[part[middle:]], axis=0) - np.median(value[part[:middle]], axis=0)
        speed[i] = float(np.linalg.norm(moved_m)) / max(apart_s, 1e-3)
    return speed


def handled(node: NodeReadings, stamps_ns: Ints, settings: SurveySettings) -> Bools:
    """Return, for each of stamps_ns (n,), whether the node is turned or jolted; False without an IMU."""
    turn = np.linalg.norm(node.imu["gyro_radps"], axis=1)
    jolt = np.abs(np.linalg.norm(node.imu["accel_mps2"], axis=1) - GRAVITY_MPS2)
    felt = [
        start < end
        and (np.median(turn[start:end]) > settings.turn_radps or np.median(jolt[start:end]) > settings.jolt_mps2)
        for start, end in _around(node.imu.stamps_ns, stamps_ns, FEEL_NS)
    ]
    return np.array(felt, dtype=bool)


def _around(series_ns: Ints, stamps_ns: Ints, within_ns: int) -> list[tuple[int, int]]:
    """Return, for each of stamps_ns, which samples of a series are within within_ns of it, from start to end."""
    first = np.searchsorted(series_ns, stamps_ns - within_ns).tolist()
    return list(zip(first, np.searchsorted(series_ns, stamps_ns + within_ns, "right").tolist(), strict=True))


def _runs(seen: Sights, still: Bools) -> list[list[int]]:
    """Return runs of neighbouring fixes at rest that have the same line between the nodes."""
    runs: list[list[int]] = []
    last = -2
    for i in np.flatnonzero(still).tolist():
        close = bool(runs) and int(seen.stamps_ns[i] - seen.stamps_ns[last]) < PAUSE_NS and i - last <= 3
        if close and same_line(_line_m(seen, [last]), _line_m(seen, [i])):
            runs[-1].append(i)
        else:
            runs.append([i])
        last = i
    return runs


def _line_m(seen: Sights, run: list[int]) -> Floats:
    line_m = seen.line_m[run]
    if np.isnan(line_m).any():
        return np.array([float(np.median(seen.range_m[run])), 0.0, 0.0])
    return np.asarray(np.median(line_m, axis=0))


def _merged(runs: list[list[int]], seen: Sights) -> list[list[int]]:
    """Join neighbouring runs between which no node has moved: lights were out of sight, or a diver swayed."""
    merged: list[list[int]] = []
    for run in runs:
        if len(run) < LEAST_RUN:
            continue
        if merged and same_line(_line_m(seen, merged[-1]), _line_m(seen, run)):
            merged[-1].extend(run)
        else:
            merged.append(run)
    return merged
