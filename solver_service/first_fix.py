"""What the divers should do for a fix where none tells how they stand: from what each camera sees and where it looks.

Directions are pairs of angles, rad: to the right and down. With an attitude sensor they are from north and from the
horizon, without one from the camera's present axis.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, NodeInfo
from buddyline.solver_service.geometry.rig import NOMINAL_R_BODY_CAMERA, Rig
from buddyline.solver_service.geometry.rotation import Floats, quat_to_matrix
from buddyline.solver_service.sensors import attitude_at
from buddyline.solver_service.streams import NodeStream
from msgspec import UNSET

# A light this share of the half field of view off the axis is well in the picture.
WELL_INSIDE: Final = 0.8
# Smaller turns are not worth a word; a diver turns in steps, and swims in steps.
STEP_DEG: Final = 5
STEP_M: Final = 0.5
# So long a light that has left the picture is remembered; without an attitude sensor, and in the picture, this long.
REMEMBERED_NS: Final = 3 * S_NS
NOW_NS: Final = S_NS // 2
# Of the newest frames about ten a second are looked at, and in each the likeliest candidates.
FRAME_STEP_NS: Final = S_NS // 12
BLOBS: Final = 12
LIKELY: Final = 0.3
# A lamp stays where it is, but for the divers' own motion; others' noise does not.
STAYS_RAD: Final = math.radians(2.0)
STAYS_RADPS: Final = math.radians(6.0)
STAYING_SHARE: Final = 0.6
# A bar is about level: it rises less than it reaches to the side.
STEEPEST: Final = 1.0
# By both compasses a node looks at the other to within this; further off it sees someone else's lamp.
ASTRAY_RAD: Final = math.radians(12.0)
# By more than this the two views tell on which side the other lamp must be.
SIDE_RAD: Final = math.radians(8.0)
# A lamp that looks larger than this, by its radius, is near.
NEAR_RAD: Final = 0.012
# More candidates than this hide the lamps.
CROWD: Final = 20
# Where a search has looked in this time is not searched again.
SEARCHED_NS: Final = 20 * S_NS
SEARCH_STEP_NS: Final = S_NS // 4
LEVEL_RAD: Final = math.radians(25.0)
# A search is said anew each second; until then it goes on by this much, so that the divers need not stop and listen.
ONWARD_RAD: Final = math.radians(180.0)
# What a diver turns too far before he hears that the other was found, and what it costs to turn back.
HEARD_RAD: Final = math.radians(45.0)
# Who looks toward the other still misses it so often: a body hides the lamps, or they shine elsewhere.
MISSED_SHARE: Final = 0.25
# How much likelier the other is where one light stands that only one of them sees.
LONE_ODDS: Final = 10.0
# Two lone lights further than this from lying face to face are not both of this pair, however near it is.
CONTRADICTS_RAD: Final = math.radians(45.0)
SLOW_RADPS: Final = math.radians(10.0)
WAYS: Final = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b]
GRID_RAD: Final = np.radians(np.arange(0.0, 360.0, 5.0))


@dataclass(frozen=True, eq=False)
class NodeLook:
    """What one node sees, and where it looks.

    lights (n, 3), n <= 2: directions of what may be the other's lamps, and their radii, rad. axis (2,): of the camera.
    half_rad (2,): half of its field of view. oriented: whether directions are from north and the horizon.
    shown: median number of candidates. path (m, 3): its axis before, with the times, s.
    """

    lights: Floats
    axis: Floats
    half_rad: Floats
    oriented: bool
    shown: float
    path: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def middle(self) -> Floats:
        """The middle (2,) of the lights."""
        turns = np.array([wrap(self.lights[:, 0] - self.lights[0, 0]), self.lights[:, 1]])
        middle: Floats = turns.mean(axis=1) + np.array((self.lights[0, 0], 0.0))
        return middle

    @property
    def apart_rad(self) -> float:
        """How far two lights are apart."""
        return math.hypot(float(wrap(self.lights[1, 0] - self.lights[0, 0])), float(np.diff(self.lights[:, 1])[0]))


def wrap(angle_rad: Floats) -> Floats:
    """Bring angles into -pi to pi."""
    wrapped: Floats = (angle_rad + math.pi) % (2.0 * math.pi) - math.pi
    return wrapped


def look_of(stream: NodeStream, info: NodeInfo, rig: Rig) -> NodeLook:
    """Return what a node sees and where it looks, by its newest frames and attitudes."""
    newest_ns = stream.newest_ns or 0
    oriented = attitude_at(stream.attitude, stream.attitude.newest_ns or 0) is not None
    frames: list[Candidates] = []
    for frame in reversed(stream.frames.between(newest_ns - (REMEMBERED_NS if oriented else NOW_NS), newest_ns)):
        if not frames or frames[-1].stamp_ns - frame.stamp_ns >= FRAME_STEP_NS:
            frames.append(frame)
    seen = [_directions(stream, frame, rig, oriented) for frame in frames]
    now_ns = stream.attitude.newest_ns or newest_ns
    camera = info.camera
    half_rad = np.array((math.atan(info.width_px / 2 / camera.fx_px), math.atan(info.height_px / 2 / camera.fy_px)))
    axis = _angles(_R_level_camera(stream, now_ns, rig, oriented)[:, 2])
    lights = _bar(_steady(seen, [(newest_ns - frame.stamp_ns) / S_NS for frame in frames], axis, half_rad))
    shown = statistics.median([len(frame.blobs) + frame.truncated for frame in frames]) if frames else 0.0
    return NodeLook(lights, axis, half_rad, oriented, shown, _path(stream, rig) if oriented else np.zeros((0, 3)))


def advise_first(infos: Sequence[NodeInfo], looks: Sequence[NodeLook]) -> list[str]:
    """Return what A and B should do; empty where nothing that they see says what is missing."""
    names = [info.node for info in infos]
    said = [
        f"{name} sees {look.shown:.0f} lights: cover other lamps, keep away from silt"
        for name, look in zip(names, looks, strict=True)
        if look.shown > CROWD
    ]
    looks = _agreeing(looks)
    lengths_m = [math.dist(info.light_left_m, info.light_right_m) for info in infos]
    goals = [_goal(looks[k], looks[1 - k], lengths_m[1 - k] / lengths_m[k]) for k in range(2)]
    if (goals[0] is None and goals[1] is None) or _doubtful(looks):
        return said + _search(names, looks)
    turns = [
        f"turn {name} {words}"
        for name, look, goal in zip(names, looks, goals, strict=True)
        if goal is not None and (words := _turn(look, goal))
    ]
    return said + (turns or _distance(names, looks, lengths_m))


def turn_words(right_rad: float, down_rad: float) -> str:
    """Return a turn in steps, such as "20 deg left and 10 deg up"; "" for none."""
    words = []
    for angle_rad, (plus, minus) in ((right_rad, ("right", "left")), (down_rad, ("down", "up"))):
        rounded = STEP_DEG * round(abs(math.degrees(angle_rad)) / STEP_DEG)
        if rounded:
            words.append(f"{rounded} deg {plus if angle_rad > 0 else minus}")
    return " and ".join(words)


def _R_level_camera(stream: NodeStream, stamp_ns: int, rig: Rig, oriented: bool) -> Floats:
    found = attitude_at(stream.attitude, stamp_ns) if oriented else None
    R: Floats = NOMINAL_R_BODY_CAMERA if found is None else quat_to_matrix(found[0]) @ rig.R_body_camera
    return R


def _angles(directions: Floats) -> Floats:
    """Return the angles (..., 2) of directions (..., 3)."""
    north, east, down = np.moveaxis(directions, -1, 0)
    angles: Floats = np.stack((np.arctan2(east, north), np.arctan2(down, np.hypot(north, east))), axis=-1)
    return angles


def _directions(stream: NodeStream, frame: Candidates, rig: Rig, oriented: bool) -> Floats:
    """Return the directions and radii (n, 3) of a frame's likeliest candidates; none if its attitude is not known."""
    likely = [blob for blob in frame.blobs if blob.score is UNSET or blob.score >= LIKELY][:BLOBS]
    if not likely or (oriented and attitude_at(stream.attitude, frame.stamp_ns) is None):
        return np.zeros((0, 3))
    bearings = rig.camera.bearings(np.array([(blob.u_px, blob.v_px) for blob in likely]))
    radii_rad = np.sqrt([blob.area_px / math.pi for blob in likely]) / rig.camera.fx_px
    angles = _angles(bearings @ _R_level_camera(stream, frame.stamp_ns, rig, oriented).T)
    return np.column_stack((angles, radii_rad))[np.isfinite(bearings).all(axis=1)]


def _steady(seen: list[Floats], ages_s: list[float], axis: Floats, half_rad: Floats) -> list[Floats]:
    """Return the lights (3,) that most of four neighbouring frames agree on, the newest first.

    seen: directions and radii in each frame, the newest first. Of what should be in the picture now only the
    present counts.
    """
    steady: list[tuple[Floats, float]] = []
    for k, directions in enumerate(seen):
        beside = [j for j in range(max(k - 2, 0), min(k + 3, len(seen))) if j != k]
        for one in directions:
            inside = bool((np.abs(_between(one, axis)) < 0.9 * half_rad).all())
            known = any(_near(one, other[None], ages_s[k] - age_s) for other, age_s in steady if age_s < ages_s[k])
            if known or (inside and ages_s[k] > NOW_NS / S_NS):
                continue
            agree = sum(_near(one, seen[j], abs(ages_s[j] - ages_s[k])) for j in beside)
            if agree >= max(STAYING_SHARE * len(beside), 2):
                steady.append((one, ages_s[k]))
    return [one for one, _ in steady]


def _between(one: Floats, other: Floats) -> Floats:
    """Return the turn (2,) from another direction to this one; more columns do not count."""
    turn: Floats = np.array((float(wrap(one[0] - other[0])), float(one[1] - other[1])))
    return turn


def _near(one: Floats, others: Floats, apart_s: float) -> bool:
    """Return whether one of others (n, 3) may be the same light, apart_s before or after."""
    off_rad = np.hypot(wrap(others[:, 0] - one[0]) * math.cos(one[1]), others[:, 1] - one[1])
    return bool((off_rad < STAYS_RAD + STAYS_RADPS * apart_s).any())


def _bar(lights: list[Floats]) -> Floats:
    """Return the two (2, 3) of several lights that stand most level beside each other; of two, both."""
    if len(lights) < 3:
        return np.array(lights).reshape(-1, 3)

    pairs = [(one, other) for at, one in enumerate(lights) for other in lights[:at]]
    best = min(pairs, key=lambda pair: _steepness(*pair))
    return np.array(best) if _steepness(*best) < STEEPEST else np.array(lights[:1])


def _steepness(one: Floats, other: Floats) -> float:
    """Return how much two lights rise, over how far they reach to the side."""
    right_rad, down_rad = np.abs(_between(one, other)).tolist()
    return float(down_rad / max(right_rad, 1e-6))


def _path(stream: NodeStream, rig: Rig) -> Floats:
    """Return where a camera has looked lately: rows of right, down and time, s."""
    newest_ns = stream.attitude.newest_ns or 0
    rows: list[tuple[float, float, float]] = []
    for sample in reversed(stream.attitude.between(newest_ns - SEARCHED_NS, newest_ns)):
        at_s = sample.stamp_ns / S_NS
        if not rows or rows[-1][2] - at_s >= SEARCH_STEP_NS / S_NS:
            right_rad, down_rad = _angles(quat_to_matrix(np.array(sample.q_ned_body_xyzw)) @ rig.R_body_camera[:, 2])
            rows.append((float(right_rad), float(down_rad), at_s))
    return np.array(rows).reshape(-1, 3)


def _back(look: NodeLook) -> Floats:
    """Return the direction (2,) in which the other must look to see this node, by the lights that this node sees."""
    back: Floats = look.middle * (1.0, -1.0) + np.array((math.pi, 0.0))
    return back


def _agreeing(looks: Sequence[NodeLook]) -> Sequence[NodeLook]:
    """Return both looks; of two bars that contradict each other, without the one that is less level.

    Reflections stand above, and strangers' lamps at any height.
    """
    if not all(look.oriented and len(look.lights) == 2 for look in looks):
        return looks
    if float(np.abs(_between(_back(looks[0]), looks[1].middle)).max()) <= 2.0 * ASTRAY_RAD:
        return looks
    worse = max(looks, key=lambda look: abs(look.middle[1]) + math.atan(_steepness(*look.lights)))
    return [replace(look, lights=np.zeros((0, 3))) if look is worse else look for look in looks]


def _doubtful(looks: Sequence[NodeLook]) -> bool:
    """Return whether all that is seen are lone lights that may be a stranger's: the other does not see its part."""
    if not all(look.oriented for look in looks) or max(len(look.lights) for look in looks) != 1:
        return False
    seer, other = sorted(looks, key=lambda look: -len(look.lights))
    if len(other.lights):
        return float(np.abs(_between(_back(seer), other.lights[0])).max()) > CONTRADICTS_RAD
    in_view = bool((np.abs(_between(_back(seer), other.axis)) < WELL_INSIDE * other.half_rad).all())
    # The lamps of two who look at each other may be too faint for one of them, but not where they are near.
    return not in_view or bool(seer.lights[0, 2] > NEAR_RAD)


def _goal(look: NodeLook, other: NodeLook, size: float) -> Floats | None:
    """Return the directions (n, 2) in which the other's lamps, or its camera, must be; None where nothing says it.

    size: length of the other's bar over that of this node's own.
    """
    if len(look.lights) == 2:
        return look.lights[:, :2]
    facing = None
    if look.oriented and other.oriented and len(other.lights):
        facing = _back(other)
    if len(look.lights) == 0:
        return None if facing is None else facing[None]
    light = look.lights[0, :2]
    off_rad = _between(light, look.axis)
    missed_rad = None if facing is None else _between(facing, light)
    known = len(other.lights) == 2
    apart_rad = other.apart_rad * size if known else WELL_INSIDE * float(look.half_rad[0])
    if known and missed_rad is not None and float(np.abs(missed_rad).max()) > ASTRAY_RAD + apart_rad / 2:
        # What it sees is a stranger's lamp.
        return None if facing is None else facing[None]
    side = off_rad[0]
    if missed_rad is not None and (known or abs(missed_rad[0]) > SIDE_RAD):
        side = missed_rad[0]
    elif float(np.abs(off_rad / look.half_rad).max()) < 0.5:
        # Nothing tells on which side the other lamp is.
        return light[None]
    lamps: Floats = light + np.array(((0.0, 0.0), (math.copysign(apart_rad, side), 0.0)))
    return lamps


def _turn(look: NodeLook, goal: Floats) -> str:
    """Return the turn to the middle of a goal (n, 2); "" if all of it is well in the picture."""
    offs = np.array([_between(one, look.axis) for one in goal])
    inside = np.abs(offs).max(axis=0) <= WELL_INSIDE * look.half_rad
    right_rad = 0.0 if inside[0] else float(np.angle(np.exp(1j * offs[:, 0]).sum()))
    down_rad = 0.0 if inside[1] else float(offs[:, 1].mean())
    # Almost half a turn goes on the way that the node turns, or else to the right: the words must not alternate.
    way = math.copysign(1.0, _turning(look))
    if right_rad * way < 0.0 and 2.0 * (math.pi - abs(right_rad)) < HEARD_RAD:
        right_rad += way * 2.0 * math.pi
    return turn_words(right_rad, down_rad)


def _distance(names: list[str], looks: Sequence[NodeLook], lengths_m: list[float]) -> list[str]:
    """Return what nodes should do that look at each other: lights too far apart for the picture, or too faint."""
    nearer_m, ranges_m = 0.0, []
    for look, length_m in zip(looks, reversed(lengths_m), strict=True):
        if len(look.lights) == 2:
            range_m = length_m / 2 / math.tan(max(look.apart_rad, 1e-3) / 2)
            ranges_m.append(range_m)
            nearer_m = max(nearer_m, length_m / 2 / math.tan(WELL_INSIDE * float(look.half_rad[0])) - range_m)
    if nearer_m > 0.0:
        return [f"move {math.ceil(nearer_m / STEP_M) * STEP_M:.1f} m apart"]
    if all(len(look.lights) == 1 and look.lights[0, 2] > NEAR_RAD for look in looks):
        return [f"move {2 * STEP_M:.1f} m apart"]
    few = [k for k in range(2) if len(looks[k].lights) < 2]
    words = [f"{names[k]} sees {('no lamp', 'one lamp')[len(looks[k].lights)]} of {names[1 - k]}" for k in few]
    step_m = round(0.25 * min(ranges_m) / STEP_M) * STEP_M if ranges_m else 2 * STEP_M
    return [*words, f"come {max(step_m, STEP_M):.1f} m closer"] if few else []


def _search(names: list[str], looks: Sequence[NodeLook]) -> list[str]:
    """Return where two nodes should look that see nothing of each other: each turns to one side, or holds still.

    Lamps shine to all sides, if weakly, so who looks toward the other finds it, and then the other is told where to
    turn. Of all ways the one that is the shortest in the mean, over the directions in which the other may be, is said.
    """
    words = [f"{name} sees one light" for name, look in zip(names, looks, strict=True) if len(look.lights)]
    words = words or [f"{names[0]} and {names[1]} do not see each other"]
    blind = [name for name, look in zip(names, looks, strict=True) if not look.oriented]
    if blind:
        return [*words, f"turn {blind[0]} slowly left"]
    ways = _ways(looks)
    for name, look, way in zip(names, looks, ways, strict=True):
        down_rad = -float(look.axis[1]) if abs(look.axis[1]) > LEVEL_RAD else 0.0
        if turn := turn_words(way * ONWARD_RAD, down_rad):
            words.append(f"turn {name} {turn}")
        else:
            words.append(f"hold {name} still")
    return words


def _ways(looks: Sequence[NodeLook]) -> tuple[int, int]:
    """Return the way that each node should turn: 1 for right, -1 for left, 0 for none."""
    off = np.array([wrap(GRID_RAD + k * math.pi - look.axis[0]) for k, look in enumerate(looks)])
    likely = np.prod([_likely(look, k * math.pi) for k, look in enumerate(looks)], axis=0)
    half = np.array([[WELL_INSIDE * look.half_rad[0]] for look in looks])
    rates = [_turning(look) for look in looks]

    def cost(ways: tuple[int, int]) -> float:
        turned = np.array(ways)[:, None]
        # By how much each turns until the other is in its picture; who holds still waits.
        until = np.where(np.abs(off) <= half, 0.0, np.where(turned == 0, np.inf, (turned * off) % (2 * math.pi) - half))
        first = until.min(axis=0)
        rest = np.maximum(np.abs(wrap(off - turned * first)) - half, 0.0).max(axis=0)
        back = sum(rate * way < 0.0 for rate, way in zip(rates, ways, strict=True)) * HEARD_RAD
        return float(likely @ (first + rest + np.where(rest > 0.0, HEARD_RAD, 0.0))) + back * float(likely.sum())

    return min(WAYS, key=cost)


def _likely(look: NodeLook, behind_rad: float) -> Floats:
    """Return how likely this node makes each direction from A to B on the grid: it missed the other, or saw a light."""
    seen = np.abs(wrap(GRID_RAD[:, None] + behind_rad - look.path[:, 0])) < WELL_INSIDE * look.half_rad[0]
    likely: Floats = np.where((seen & (np.abs(look.path[:, 1]) < LEVEL_RAD)).any(axis=1), MISSED_SHARE, 1.0)
    for light in look.lights:
        likely[np.abs(wrap(GRID_RAD + behind_rad - light[0])) < ASTRAY_RAD] = LONE_ODDS
    return likely


def _turning(look: NodeLook) -> float:
    """Return how fast a node turns to the right, rad/s; 0 where that is slow."""
    if len(look.path) < 2:
        return 0.0
    rate_radps = float(wrap(look.path[0, 0] - look.path[1, 0]) / (look.path[0, 2] - look.path[1, 2]))
    return rate_radps if abs(rate_radps) > SLOW_RADPS else 0.0
