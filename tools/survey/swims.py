"""The ways that nodes swim from rest to rest, as lines: seen from the node that stands, hung between its adjusted legs.

Two nodes see each other, and nothing that stands: only while one of them stands is the other's way a line in the cave.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.tools.survey.averages import Bools, Floats
from buddyline.tools.survey.normal import DENSE
from buddyline.tools.survey.project import Project, Swim, Turn
from buddyline.tools.survey.readings import PairReadings
from buddyline.tools.survey.settings import SurveySettings
from buddyline.tools.survey.turns import body_sights, carry, zero_of

if TYPE_CHECKING:
    from buddyline.tools.survey.observations import Solution

# A row for each step of this length. A place with a larger 1 sd than WORST_M is left out.
STEP_M: Final = 0.5
WORST_M: Final = 0.5
# Where the track has no row for so long, the way is in two parts.
GAP_S: Final = 2.0
# A leg with a shorter run than this tells no azimuth of a swim.
LEAST_RUN_M: Final = 0.5


@dataclass(frozen=True, eq=False)
class SwumWay:
    """A swim in the adjusted survey: seconds (n,) since its start, east, north, up (n, 3), covariances (n, 3, 3)."""

    swim: Swim
    seconds: Floats
    position_m: Floats
    covariance: Floats

    @property
    def parts(self) -> list[Floats]:
        """The way as lines (k, 3), parted where the track has a gap."""
        gaps = np.flatnonzero(np.diff(self.seconds) > GAP_S) + 1
        return [part for part in np.split(self.position_m, gaps) if len(part) > 1]


def swims_of(
    readings: PairReadings,
    chosen: Sequence[Bools],
    stations: Sequence[Mapping[str, str]],
    turns: Sequence[Turn],
    dive: int,
    settings: SurveySettings,
) -> list[Swim]:
    """Return the swims of a pair between rests at which one node stays at its station.

    chosen: the fixes (n,) of each rest; stations: of each rest, by node; turns: of both gyroscopes.
    """
    track = readings if readings.speed_mps is not None else readings.track
    if track is None or len(chosen) < 2:
        return []
    sigmas_deg = {(one.node, one.from_ns): one.sigma_deg for one in turns}
    spans_ns = [(int(at[0]), int(at[-1])) for at in (readings.stamps_ns[one] for one in chosen)]
    zeros = [zero_of(node, readings.stamps_ns, chosen, settings) for node in track.pair]
    sights_m, stamps_ns = body_sights(track, settings), track.stamps_ns
    along_m, across_m = _spreads(track)
    found = []
    for (before, after), (at, later) in zip(pairwise(spans_ns), pairwise(stations), strict=True):
        stays = [k for k, node in enumerate(track.nodes) if at[node] == later[node]]
        if len(stays) != 1:
            continue
        (k,) = stays
        node, mover = track.nodes[k], track.nodes[1 - k]
        index = np.flatnonzero((stamps_ns >= before[0]) & (stamps_ns <= after[1]) & (across_m < WORST_M))
        ends = [index[(stamps_ns[index] >= a) & (stamps_ns[index] <= b)] for a, b in (before, after)]
        if (node, before[0]) not in sigmas_deg or not all(map(len, ends)):
            continue
        carried = carry(track.pair[k], zeros[k], np.array(before), np.array(after))
        if carried is None:
            continue
        way_m = carried.level(stamps_ns[index], sights_m[k][index])
        first, last = int(np.searchsorted(index, ends[0][-1])), int(np.searchsorted(index, ends[1][0]))
        rows = [(ends[0][0], way_m[: first + 1].mean(axis=0))]
        for number in range(first + 1, last):
            if float(np.linalg.norm(way_m[number] - rows[-1][1])) >= STEP_M:
                rows.append((index[number], way_m[number]))
        rows.append((ends[1][-1], way_m[last:].mean(axis=0)))
        found.append(
            Swim(
                node=mover,
                station=at[node],
                from_=at[mover],
                to=later[mover],
                dive=dive,
                start_ns=before[0],
                sigma_deg=sigmas_deg[node, before[0]],
                rows=[
                    [
                        round(float(stamps_ns[row] - before[0]) / S_NS, 2),
                        *(round(float(value), 4) for value in (*place_m, along_m[row], across_m[row])),
                    ]
                    for row, place_m in rows
                ],
            )
        )
    return found


def _spreads(track: PairReadings) -> tuple[Floats, Floats]:
    """Return each row's 1 sd along the line between the nodes, and across it, (n,)."""
    unit = track.t_a_b_m / np.maximum(np.linalg.norm(track.t_a_b_m, axis=1), 1e-9)[:, None]
    position = track.covariance[:, :3, :3]
    along = np.einsum("ni,nij,nj->n", unit, position, unit)
    across = (np.trace(position, axis1=1, axis2=2) - along) / 2
    return np.sqrt(np.maximum(along, 0.0)), np.sqrt(np.maximum(across, 0.0))


def paths_of(project: Project, solution: Solution, origin_m: Floats) -> list[SwumWay]:
    """Return the swims between adjusted stations. origin_m: (3,), to which the solution is relative."""
    at = solution.observations.at
    known = [swim for swim in project.swim if {swim.station, swim.from_, swim.to} <= set(at)]
    stations = np.array([[at[name] for name in (swim.station, swim.from_, swim.to)] for swim in known], dtype=np.int64)
    unknowns = (3 * stations[..., None] + np.arange(3)).reshape(-1, 9)
    every = np.unique(unknowns)
    # Of few stations the inverse is made once.
    whole = solution.normal.inverse(every) if len(every) <= DENSE else None
    found: list[SwumWay | None] = []
    for swim, of, columns in zip(known, stations, unknowns, strict=True):
        place = np.searchsorted(every, columns)
        joint = solution.normal.inverse(columns) if whole is None else whole[np.ix_(place, place)]
        found.append(_hung(swim, solution.position_m[of] + origin_m, joint, project.settings))
    return [way for way in found if way is not None]


def _hung(swim: Swim, places_m: Floats, joint: Floats, settings: SurveySettings) -> SwumWay | None:
    """Hang a swim between its stations (3, 3): the standing node's, the first and the last; joint: (9, 9), of them.

    On the map a complex number c turns (and scales) the way to the leg at either end, and in between c goes evenly in
    angle and logarithm from one to the other; heights likewise, by a shift. None where neither leg tells an azimuth.
    """
    rows = np.array(swim.rows)
    seconds, (ahead, right, down), (along_m, across_m) = rows[:, 0], rows[:, 1:4].T, rows[:, 4:].T
    flat = right + 1j * ahead
    legs_m = places_m[1:] - places_m[0]
    runs = legs_m[:, 0] + 1j * legs_m[:, 1]
    tells = np.minimum(np.abs(runs), np.abs(flat[[0, -1]])) > LEAST_RUN_M
    if not tells.any():
        return None
    u = (seconds - seconds[0]) / max(seconds[-1] - seconds[0], 1e-3)
    shares = np.array([1 - u, u])
    weights = shares if tells.all() else np.repeat(tells[:, None].astype(float), len(u), axis=1)
    turned = np.array([run / one if known else 1.0 for run, one, known in zip(runs, flat[[0, -1]], tells, strict=True)])
    ratio = turned[1] / turned[0] if tells.all() else 1.0
    c = (turned[0] if tells[0] else turned[1]) * np.exp(weights[1] * np.log(ratio) if tells.all() else 0 * u)
    way = c * flat
    lifts_m = legs_m[:, 2] + down[[0, -1]]
    position_m = places_m[0] + np.column_stack([way.real, way.imag, shares.T @ lifts_m - down])
    # By the stations: of the leg's end m_k = w_k way / leg, of the standing node's 1 - m_0 - m_1.
    J = np.zeros((len(u), 3, 9))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    for k in range(2):
        m = weights[k] * way / runs[k] if tells[k] else 0 * way
        block = np.array([[m.real, -m.imag], [m.imag, m.real]]).transpose(2, 0, 1)
        J[:, :2, 3 + 3 * k : 5 + 3 * k] = block
        J[:, :2, :2] -= block
        J[:, 2, 5 + 3 * k] = shares[k]
    covariance = J @ joint @ J.transpose(0, 2, 1)
    # Its own errors: the track's along and across the sight, the gyroscope's between two known ends, the level's.
    range_m = np.sqrt(np.abs(way) ** 2 + down**2)
    unit = np.column_stack([way.real, way.imag, -down]) / np.maximum(range_m, 1e-6)[:, None]
    ray = unit[:, :, None] * unit[:, None, :]
    turn = math.radians(swim.sigma_deg) ** 2 * u * (1 - u) * range_m**2
    ends = (across_m[[0, -1]] / np.maximum(range_m[[0, -1]], 0.1)) ** 2
    across = across_m**2 + turn + (shares**2).T @ ends * range_m**2
    covariance += along_m[:, None, None] ** 2 * ray + across[:, None, None] * (np.eye(3) - ray)
    covariance += settings.centering_m**2 * np.eye(3)
    covariance[:, 2, 2] += (math.radians(settings.tilt_floor_deg) * range_m) ** 2
    return SwumWay(swim, seconds, position_m, covariance)
