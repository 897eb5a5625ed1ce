"""How a node turns from one rest to the next, by its gyroscope: azimuths that need no compass."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.tools.evaluation.rotation import conjugate, multiply, normalized, rotate
from buddyline.tools.survey.averages import Bools, Floats, Ints, effective_count, unwrapped
from buddyline.tools.survey.project import Turn
from buddyline.tools.survey.readings import NodeReadings, PairReadings
from buddyline.tools.survey.settings import SurveySettings

# A gap between samples this many times the usual one may hide a turn.
GAP_SHARE: Final = 5.0
LEAST_SIGHTS: Final = 3
# Spans over which a gyroscope is held against attitude messages. Those that differ by 29 degrees and more are left out.
SPAN_NS: Final = 5 * S_NS
NEAR_COSINE: Final = math.cos(math.radians(14.5))


def turns_of(readings: PairReadings, chosen: Sequence[Bools], dive: int, settings: SurveySettings) -> list[Turn]:
    """Return both nodes' turns between rests that follow each other; chosen: the fixes (n,) of each rest."""
    found = []
    for node, line_body_m in zip(readings.pair, body_sights(readings, settings), strict=True):
        zero = zero_of(node, readings.stamps_ns, chosen, settings)
        turns = []
        for before, after in pairwise(chosen):
            turn = _turn(node, zero, readings.stamps_ns, line_body_m, np.flatnonzero(before), np.flatnonzero(after))
            if turn is not None:
                turns.append((int(readings.stamps_ns[before][0]), int(readings.stamps_ns[after][0]), *turn))
        # A gyroscope is at least as noisy as sights wander during rests, in its own frame.
        walk = max(float(np.median([one[-1] for one in turns])), 0.0) if turns else 0.0
        for from_ns, to_ns, angle, seconds, scatter, _ in turns:
            noise = math.sqrt((math.radians(settings.gyro_noise_dps_rthz) ** 2 + walk) * seconds)
            found.append(
                Turn(
                    node=node.info.node,
                    dive=dive,
                    from_ns=from_ns,
                    to_ns=to_ns,
                    seconds=round(seconds, 3),
                    angle_deg=round(math.degrees(angle), 4),
                    sigma_deg=round(math.degrees(math.hypot(noise, scatter)), 4),
                )
            )
    return found


def body_sights(readings: PairReadings, settings: SurveySettings) -> tuple[Floats, Floats]:
    """Return each node's line to the other one, (n, 3), from reference point to reference point in its body's axes."""
    references = [np.array(settings.reference_m.get(node, (0.0, 0.0, 0.0))) for node in readings.nodes]
    between_m = readings.t_a_b_m + rotate(readings.q_a_b, references[1]) - references[0]
    lines_m = between_m, -rotate(conjugate(readings.q_a_b), between_m)
    turns = [normalized(np.array(node.info.q_body_camera_xyzw)) for node in readings.pair]
    a, b = (rotate(np.broadcast_to(q, (len(one), 4)), one) for q, one in zip(turns, lines_m, strict=True))
    return a, b


def zero_of(node: NodeReadings, stamps_ns: Ints, chosen: Sequence[Bools], settings: SurveySettings) -> Floats:
    """Return what a gyroscope reads at rest, (3,), rad/s: the median over all rests of its mean.

    In short pauses a node sways: there it is what the gyroscope adds to the attitude messages' turning, all dive long.
    """
    if settings.pause_s:
        return _zero_by_attitude(node)
    rates = []
    for one in chosen:
        part = node.imu.between(int(stamps_ns[one][0]), int(stamps_ns[one][-1]))
        rates.append(np.nanmean(node.imu["gyro_radps"][part], axis=0) if part.stop > part.start else np.zeros(3))
    return np.asarray(np.median(rates, axis=0)) if rates else np.zeros(3)


def _zero_by_attitude(node: NodeReadings) -> Floats:
    """Return a gyroscope's zero: by how much it turns more than the attitude messages, over spans of SPAN_NS.

    Errors of single messages cancel, because each span begins where the one before ends.
    """
    imu, at_ns = node.imu, node.attitude.stamps_ns
    steps_s = np.diff(imu.stamps_ns) / S_NS
    rate = imu["gyro_radps"][1:]
    if len(at_ns) < 2 or len(steps_s) < LEAST_SIGHTS or np.isnan(rate).any():
        return np.zeros(3)
    marks = np.unique(np.searchsorted(at_ns, np.arange(imu.stamps_ns[0], imu.stamps_ns[-1], SPAN_NS)))
    marks = marks[marks < len(at_ns)]
    q = _carried(rate * steps_s[:, None])
    index = np.clip(np.searchsorted(imu.stamps_ns, at_ns[marks]), 0, len(q) - 1)
    said, felt = node.attitude["q_ned_body_xyzw"][marks], q[index]
    turned = [multiply(conjugate(one[:-1]), one[1:]) for one in (said, felt)]
    more = multiply(conjugate(turned[0]), turned[1])
    spans_s = np.diff(at_ns[marks]) / S_NS
    near = (spans_s < 2 * SPAN_NS / S_NS) & (np.abs(more[:, 3]) > NEAR_COSINE)
    angles = 2 * more[near, :3] * np.sign(more[near, 3:])
    return np.asarray(angles.sum(axis=0) / spans_s[near].sum()) if near.any() else np.zeros(3)


def _turn(
    node: NodeReadings, zero: Floats, stamps_ns: Ints, line_m: Floats, before: Ints, after: Ints
) -> tuple[float, float, float, float] | None:
    """Return the angle (rad, whole turns included), its time (s), and the 1 sd of both rests' sights (rad).

    The last is the random walk, rad^2/s, that the sights show during the rests: a walk over T has a variance of its
    rate times T / 6, beside the white noise that neighbours differ by.
    """
    carried = carry(node, zero, stamps_ns[before], stamps_ns[after])
    if carried is None:
        return None
    azimuths = []
    for sights in (before, after):
        seen_m = carried.level(stamps_ns[sights], line_m[sights])
        azimuths.append(unwrapped(np.arctan2(seen_m[:, 1], seen_m[:, 0])))
    turned = float(azimuths[1].mean() - azimuths[0].mean())
    # The way round that the node has gone.
    q = multiply(np.broadcast_to(carried.levels[0], carried.q.shape), carried.q)
    heading = rotate(q, np.array([1.0, 0.0, 0.0]))
    swept = np.unwrap(np.arctan2(heading[:, 1], heading[:, 0]))
    turned += 2 * math.pi * round((float(swept[-1] - swept[0]) - turned) / (2 * math.pi))
    times_s = stamps_ns / S_NS
    scatter = math.hypot(
        *(
            float(one.std(ddof=1)) / math.sqrt(effective_count(times_s[which], one)) if len(one) > 1 else math.pi
            for one, which in zip(azimuths, (before, after), strict=True)
        )
    )
    walks = [
        6 * float(one.var(ddof=1) - 0.5 * (np.diff(one) ** 2).mean()) / float(np.ptp(times_s[which]))
        for one, which in zip(azimuths, (before, after), strict=True)
        if len(one) > LEAST_SIGHTS
    ]
    return turned, float(times_s[after].mean() - times_s[before].mean()), scatter, float(np.mean(walks or [0.0]))


@dataclass(frozen=True, eq=False)
class CarriedAttitude:
    """A node's attitude from one rest to the next, by its gyroscope: q (m, 4), body to the first body, at at_ns (m,).

    levels: (2, 4), of each rest: from the first body to x ahead, z down. between_ns: end of the first rest, begin of
    the second.
    """

    at_ns: Ints
    q: Floats
    levels: Floats
    between_ns: tuple[int, int]

    def level(self, stamps_ns: Ints, vectors: Floats) -> Floats:
        """Return vectors (n, 3) of the body at stamps_ns (n,) in level axes, whose azimuth is arbitrary.

        By the accelerometer in both rests: what the gyroscope tilts from one to the other grew evenly.
        """
        index = np.clip(np.searchsorted(self.at_ns, stamps_ns), 0, len(self.at_ns) - 1)
        start_ns, end_ns = self.between_ns
        share = np.clip((stamps_ns - start_ns) / max(end_ns - start_ns, 1), 0.0, 1.0)[:, None]
        return rotate(normalized((1 - share) * self.levels[0] + share * self.levels[1]), rotate(self.q[index], vectors))


def carry(node: NodeReadings, zero: Floats, before_ns: Ints, after_ns: Ints) -> CarriedAttitude | None:
    """Carry a node's attitude through two rests, by their fixes' stamps; None where its samples have gaps."""
    imu = node.imu
    part = imu.between(int(before_ns[0]), int(after_ns[-1]))
    at_ns, rate, accel = imu.stamps_ns[part], imu["gyro_radps"][part], imu["accel_mps2"][part]
    steps_s = np.diff(at_ns) / S_NS
    if len(at_ns) < LEAST_SIGHTS or np.isnan(rate).any() or steps_s.max() > GAP_SHARE * float(np.median(steps_s)):
        return None
    q = _carried((rate[1:] - zero) * steps_s[:, None])
    levels = []
    for stamps_ns in (before_ns, after_ns):
        first, last = np.clip(np.searchsorted(at_ns, stamps_ns[[0, -1]]), 0, len(at_ns) - 1).tolist()
        # At rest the specific force points up: what the gyroscope has tilted since is taken off.
        levels.append(_levelling(rotate(q[first : last + 1], accel[first : last + 1]).mean(axis=0)))
    if levels[0] @ levels[1] < 0:
        levels[1] = -levels[1]
    return CarriedAttitude(at_ns, q, np.array(levels), (int(before_ns[-1]), int(after_ns[0])))


def _levelling(up: Floats) -> Floats:
    """Return the shortest rotation (4,) that takes `up` to up, which is -z."""
    unit = up / np.linalg.norm(up)
    q = np.array([*np.cross(unit, (0.0, 0.0, -1.0)), 1.0 - unit[2]])
    return normalized(q) if np.linalg.norm(q) > 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])


def _carried(turned_rad: Floats) -> Floats:
    """Return orientations (n + 1, 4) relative to the first, that turn by turned_rad (n, 3) in the body frame."""
    angle = np.linalg.norm(turned_rad, axis=1, keepdims=True)
    share = np.where(angle > 1e-9, np.sin(angle / 2) / np.maximum(angle, 1e-9), 0.5)
    start = np.array([[0.0, 0.0, 0.0, 1.0]])
    q = np.concatenate([start, np.hstack([share * turned_rad, np.cos(angle / 2)])])
    # Products of all before, in as many steps as the count has binary digits.
    reach = 1
    while reach < len(q):
        q = np.concatenate([q[:reach], multiply(q[:-reach], q[reach:])])
        reach *= 2
    return normalized(q)
