"""Whether a node's gyro turns as its attitude messages do: is it turned, of other signs, in other units, or dead?"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp
from buddyline.solver_service.track.samples import GAP_S
from buddyline.solver_service.track.turning import small_log

# Turns over TURN_S, one each STEP_S, between means over MEAN_S. Over less the attitudes' noise rules, over more their
# slow errors do.
TURN_S: Final = 1.0
MEAN_S: Final = 0.25
STEP_S: Final = 0.25
# A gyro is judged every EVERY_S by the SPAN_S before.
SPAN_S: Final = 10.0
EVERY_S: Final = 2.0
# Attitudes further apart tell no turn.
PAUSE_S: Final = 0.5
LEAST_TURNS: Final = 6
# By how much chi^2 of the turns must be smaller for a faulty unit than for a sound one, and by how much larger for one
# that was faulty to be well again. In sound dives the first reaches 5, where stamps are 50 ms off 29 (docs/track.md).
FAULTY: Final = 60.0
WELL: Final = 10.0
# What one turn may add to it, and the share of turns that must speak for a fault by themselves, the others left out: a
# compass that passes iron is off by many sigmas in a few turns.
MOST_EACH: Final = 12.0
LEAST_SHARE: Final = 0.7
# An attitude's sigmas are taken to be at least these, and larger where no fault and no lag explains the turns: one
# degree of freedom then leaves this chi^2.
LEAST_RAD: Final = np.radians((1.0, 1.0, 3.0))
NOISY: Final = 1.5
# How far the attitudes may lag behind the gyro's stamps, or these behind the attitudes: filters do.
LAGS_S: Final = (0.0, -0.5, -0.35, -0.2, -0.1, -0.05, 0.05, 0.1, 0.2, 0.35, 0.5)
# What a faulty unit's turns leave of the attitudes' chi^2: an attitude that stands still is not the gyro's fault.
EXPLAINED: Final = 0.6
# Units in deg/s need not, where nothing turns that attitudes could show: the gyro's turns then are beyond this share.
ABSURD: Final = 100.0
# A dead gyro shows less than this share of the attitudes' rolling and pitching, which is TILTED variances on average:
# near iron a compass turns by itself.
DEAD_SHARE: Final = 0.02
TILTED: Final = 8.0
# Where the attitudes' turns have nothing to do with the gyro's, the chi^2 is smaller without a gyro. That is its fault
# where roll and pitch of the attitudes move as much as this share of its own: an attitude may stand still.
MOVING_SHARE: Final = 0.3
# Turned by less about the vertical, a unit cannot be told from a sound one by a compass.
TURNED_DEG: Final = (*range(-180, -29, 10), *range(30, 180, 10))
# A turn about the vertical that explains nearly as much as another fault is likelier.
NEARLY: Final = 0.9


@dataclass(frozen=True, eq=False)
class Turns:
    """Turns over TURN_S in the body frame, as attitudes and gyro show them, without their means.

    attitude_rad (K, 3), gyro_rad (L, K, 3) for each of LAGS_S; whiten (K, 3, 3) maps their difference to north, east
    and down, over the attitudes' sigmas. down_body (3,): the mean.
    """

    attitude_rad: Floats
    gyro_rad: Floats
    whiten: Floats
    down_body: Floats


@dataclass(frozen=True)
class GyroFault:
    """The likeliest fault of a gyro in words, and by how much chi^2 is smaller than for a sound one, `gain`."""

    gain: float
    said: str

    def of(self, node: str) -> str:
        """Say it of a node."""
        # What may differ from one time to the next stands between colons (problems.py).
        return f"node {node}: the gyro turns otherwise than the attitude: {self.said}: check mount and driver; not used"


@dataclass(frozen=True, eq=False)
class TurningTold:
    """What a node tells of its turning, in order of time.

    attitude_s (N,), R_ned_body (N, 3, 3), and sigma_rad (N, 3) of roll, pitch and yaw; gyro_s (M,) and rate_radps
    (M, 3), body frame.
    """

    attitude_s: Floats
    R_ned_body: Floats
    sigma_rad: Floats
    gyro_s: Floats
    rate_radps: Floats

    def between(self, start_s: float, end_s: float) -> TurningTold:
        """Give what was told from start_s on and before end_s."""
        at, of = (slice(*np.searchsorted(t, (start_s, end_s))) for t in (self.attitude_s, self.gyro_s))
        told = self.attitude_s[at], self.R_ned_body[at], self.sigma_rad[at]
        return TurningTold(*told, self.gyro_s[of], self.rate_radps[of])


def _swapped() -> Floats:
    """Give all (47, 3, 3) other orders and signs of three axes."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        M = np.zeros((3, 3))
        M[range(3), order] = signs
        found.append(M)
    return np.array(found[1:])


SWAPPED: Final = _swapped()
# What the units deg/s in place of rad/s do, and the other way round.
DEGREES: Final = len(TURNED_DEG) + len(SWAPPED)
SCALED: Final = np.eye(3) * np.array((math.pi / 180.0, 180.0 / math.pi))[:, None, None]


def turns_of(told: TurningTold) -> Turns | None:
    """Give the turns of some seconds; None where there is too little of attitudes or samples."""
    gyro_s, rate_radps = told.gyro_s, told.rate_radps
    if len(gyro_s) < 2:
        return None
    inside = slice(*np.searchsorted(told.attitude_s, (gyro_s[0], gyro_s[-1])))
    t, R = told.attitude_s[inside], told.R_ned_body[inside]
    if len(t) < 2 or t[-1] - t[0] < TURN_S + MEAN_S:
        return None
    # Turned angles in the body frame, summed axis by axis, of attitudes and of the gyro alike.
    shown = _summed(small_log(R[:-1].swapaxes(1, 2) @ R[1:]))
    steps_s = np.diff(gyro_s)
    sums = _summed(0.5 * (rate_radps[1:] + rate_radps[:-1]) * steps_s[:, None])
    after = np.searchsorted(gyro_s, t)
    begins = np.arange(t[0], t[-1] - TURN_S - MEAN_S, STEP_S)
    ends = begins + TURN_S
    edges = [np.searchsorted(t, at) for at in (begins, begins + MEAN_S, ends, ends + MEAN_S)]
    gaps = np.append(0, np.cumsum(steps_s > GAP_S))[after] + np.append(0, np.cumsum(np.diff(t) > PAUSE_S))
    known = (edges[1] > edges[0]) & (edges[3] > edges[2]) & (gaps[edges[3] - 1] == gaps[edges[0]])
    first, first_end, last, last_end = (edge[known] for edge in edges)
    if len(first) < LEAST_TURNS:
        return None

    def between(angles: Floats) -> Floats:
        sums = _summed(angles)
        early = (sums[first_end] - sums[first]) / (first_end - first)[:, None]
        turn = (sums[last_end] - sums[last]) / (last_end - last)[:, None] - early
        # A bias is no fault.
        return np.asarray(turn - turn.mean(axis=0))

    turned = [between(np.column_stack([np.interp(t + lag_s, gyro_s, along) for along in sums.T])) for lag_s in LAGS_S]
    middle = R[(first + last_end) // 2]
    whiten = middle / np.maximum(told.sigma_rad[inside][-1], LEAST_RAD)[:, None]
    return Turns(between(shown), np.array(turned), whiten, middle[:, 2].mean(axis=0))


def _summed(values: Floats) -> Floats:
    return np.concatenate((np.zeros((1, 3)), np.cumsum(values, axis=0)))


def gyro_fault(turns: Turns) -> GyroFault:
    """Give the likeliest fault of a gyro, and by how much it explains the turns better than a sound one does.

    A faulty gyro shows M^-1 w for a turn w: for each M the chi^2 of the attitudes' turns less M times the gyro's.
    """
    vertical = turns.down_body / np.linalg.norm(turns.down_body)
    upright = rotation_exp(np.radians(TURNED_DEG)[:, None] * vertical)
    faults = np.concatenate((upright, SWAPPED, SCALED, np.zeros((1, 3, 3))))
    sound = _chi2(turns, turns.attitude_rad - turns.gyro_rad)
    sound = sound[sound.sum(axis=1).argmin()]
    # Each turn's chi^2 for each fault (H, K), and all turns'.
    each = _chi2(turns, turns.attitude_rad - turns.gyro_rad[0] @ faults.swapaxes(1, 2))
    chi2 = each.sum(axis=1)
    # Rolling and pitching alone.
    shown, turned = (
        np.minimum(np.square(np.einsum("kij,kj->ki", turns.whiten[:, :2], turn)).sum(axis=1), MOST_EACH)
        for turn in (turns.attitude_rad, turns.gyro_rad[0])
    )
    if turned.mean() < DEAD_SHARE * shown.mean() and shown.mean() > TILTED:
        return GyroFault(float(shown.sum()), "it shows hardly any turn: it is dead, or its unit is not rad/s")
    best, about = int(chi2.argmin()), int(chi2[: len(upright)].argmin())
    if sound.sum() - chi2[about] >= NEARLY * (sound.sum() - chi2[best]):
        best = about
    # What is left where nothing explains the turns is no noise.
    noise = 1.0 if best == len(faults) - 1 else min(chi2[best], sound.sum()) / (3 * NOISY * len(sound))
    gains = np.clip(sound - each[best], -MOST_EACH, MOST_EACH) / max(noise, 1.0)
    gain = float(gains.sum())
    most = float(_chi2(turns, turns.attitude_rad).sum())
    absurd = best == DEGREES and sound.sum() > ABSURD * most and chi2[best] < 2.0 * most
    other = best == len(faults) - 1 and shown.mean() > MOVING_SHARE * turned.mean()
    explained = absurd or other or chi2[best] < EXPLAINED * most
    if not explained or np.sort(gains)[: round(LEAST_SHARE * len(gains))].sum() <= 0.0:
        gain = min(gain, 0.0)
    return GyroFault(gain, _words(best - len(upright), TURNED_DEG[about]))


def gyro_faults(told: TurningTold) -> Iterator[tuple[float, float, GyroFault]]:
    """Judge a dive's gyro every EVERY_S: give from when to when, s, and the likeliest fault, where turns are told."""
    if not len(told.gyro_s):
        return
    for end_s in np.arange(told.gyro_s[0] + EVERY_S, told.gyro_s[-1] + EVERY_S, EVERY_S).tolist():
        turns = turns_of(told.between(end_s - SPAN_S, end_s))
        if turns is not None:
            yield end_s - SPAN_S, end_s, gyro_fault(turns)


def faulty_spans(judged: Sequence[tuple[float, float, GyroFault]]) -> list[tuple[float, float, GyroFault]]:
    """Give from when to when, s, a gyro is faulty, of what `gyro_faults` gave, and the fault that is told best.

    A fault lasts from when the unit was last known to be well until it is again.
    """
    spans: list[tuple[float, float, GyroFault]] = []
    well_s, found = -math.inf, None
    for start_s, end_s, fault in judged:
        if fault.gain > FAULTY:
            found = fault if found is None or fault.gain > found.gain else found
            last_s = end_s
        elif fault.gain < -WELL:
            if found is not None:
                spans.append((well_s, max(start_s, last_s), found))
            well_s, found = end_s, None
    return [*spans, (well_s, math.inf, found)] if found is not None else spans


def _chi2(turns: Turns, left_rad: Floats) -> Floats:
    """Give each turn's chi^2 (..., K) of what is left of it (..., K, 3)."""
    of_each: Floats = np.square(np.einsum("kij,...kj->...ki", turns.whiten, left_rad)).sum(axis=-1)
    return of_each


def _words(beyond: int, turned_deg: int) -> str:
    """Say what a fault is. beyond: its number after those about the vertical, negative for these."""
    if beyond < 0:
        return f"the unit is mounted some {abs(turned_deg)} deg about the vertical otherwise than stated"
    if beyond < len(SWAPPED):
        return "the order or the signs of its axes are wrong"
    scaled = "deg/s in place of rad/s?", "its unit is larger than rad/s"
    return (*scaled, "its samples are another unit's, or of another time")[beyond - len(SWAPPED)]
