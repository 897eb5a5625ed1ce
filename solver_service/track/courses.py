"""Courses through some seconds: of a node by its samples, and of lamps through its pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log
from buddyline.solver_service.track.inputs import TrackNode
from buddyline.solver_service.track.lights import Sight
from buddyline.solver_service.track.moving import HOLD_S
from buddyline.solver_service.track.samples import Samples

# A lamp's candidates, followed from picture to picture: how far one may be from where the last ones foretell it, rad at
# first and rad later, and for how long it may be missing.
FIRST_RAD: Final = 0.05
NEXT_RAD: Final = 0.015
MISSING_S: Final = 0.8
LEAST_SEEN: Final = 15


@dataclass(frozen=True, eq=False)
class Course:
    """How a node has turned and moved since a window's start, by its samples, in its camera's axes then.

    At the window's times: D (N, 3, 3), its turn; w (N, 3), its turn rate in its own axes; a (N, 3), where the
    camera is by the specific force alone; b (N, 3), its velocity. G, A (N, 3, 15): the turn's error, in its own axes,
    and that of a, by the unit's biases (gyro, accelerometer), by their slopes, and by its mount.
    """

    D: Floats
    w: Floats
    a: Floats
    b: Floats
    G: Floats
    A: Floats


def course_of(samples: Samples, times_s: Floats, node: TrackNode, own: Floats) -> Course:
    """Integrate a node's samples from the first of times_s (N,) on.

    own (15,): the unit's biases, slopes and mount, as believed.
    """
    lever_m = np.zeros(3) if node.imu_m is None else node.imu_m
    delay_s = (node.imu_delay_ns or 0) * 1e-9
    known_s = times_s[-1] + HOLD_S
    grid, values, _ = samples.between(times_s[0] + delay_s, times_s[-1] + delay_s, known_s)
    grid = grid - delay_s
    h = np.diff(grid)
    middle = 0.5 * (values[1:, :6] + values[:-1, :6])
    since = 0.5 * (grid[1:] + grid[:-1]) - grid[0]
    # The samples as they are believed, and with a little more of each bias, slope or turn.
    small = np.repeat((1e-3, 1e-2, 1e-4, 1e-3, 1e-3), 3)
    errors = own + np.vstack((np.zeros(15), np.diag(small)))
    off = errors[:, None, 0:6] + since[:, None] * errors[:, None, 6:12]
    mount = rotation_exp(errors[:, 12:])[:, None]
    gyro = (mount @ (middle[:, 3:] - off[..., :3])[..., None])[..., 0]
    force = (mount @ (middle[:, :3] - off[..., 3:])[..., None])[..., 0]
    halves = rotation_exp((0.5 * h[:, None] * gyro).reshape(-1, 3)).reshape(16, len(h), 3, 3)
    D = np.empty((16, len(grid), 3, 3))
    D[:, 0] = np.eye(3)
    for j in range(len(h)):
        D[:, j + 1] = D[:, j] @ halves[:, j] @ halves[:, j]
    u = ((D[:, :-1] @ halves) @ force[..., None])[..., 0]
    dv = u * h[:, None]
    v = np.concatenate((np.zeros((16, 1, 3)), np.cumsum(dv, axis=1)), axis=1)
    a = np.zeros_like(v)
    a[:, 1:] = np.cumsum((v[:, :-1] + 0.5 * dv) * h[:, None], axis=1)
    a = a - D @ lever_m
    at = np.searchsorted(grid, times_s).clip(1, len(grid) - 1)
    share = ((times_s - grid[at - 1]) / (grid[at] - grid[at - 1]))[:, None]
    step = rotation_log(D[0, at - 1].swapaxes(1, 2) @ D[0, at])
    D_at = D[:, at - 1] @ rotation_exp(share * step)
    a_at = (1.0 - share) * a[:, at - 1] + share * a[:, at]
    turned = rotation_log((D_at[:1].swapaxes(-1, -2) @ D_at[1:]).reshape(-1, 3, 3)).reshape(15, -1, 3)
    G = np.moveaxis(turned / small[:, None, None], 0, -1)
    A = np.moveaxis((a_at[1:] - a_at[0]) / small[:, None, None], 0, -1)
    # The shaking's part is no motion: rates are means over some tenths of a second.
    w = np.stack([gyro[0, max(k - 10, 0) : k + 10].mean(0) for k in at.tolist()])
    b = v[0, at] - (D_at[0] @ np.cross(w, lever_m)[..., None])[..., 0]
    return Course(D_at[0], w, a_at[0], b, G, A)


def lamp_courses(sights: Sequence[Sight], D: Floats) -> list[list[tuple[int, int]]]:
    """Follow candidates through a node's pictures; give picture and candidate. D (N, 3, 3): how the camera has turned.

    Directions are compared as they were before the camera turned.
    """
    open_: list[tuple[list[tuple[int, int]], list[tuple[float, Floats]]]] = []
    done = []
    for n, sight in enumerate(sights):
        t_s = sight.t_s
        level = sight.bearings @ D[n].T
        free = set(range(len(level)))
        for ids, past in sorted(open_, key=lambda one: -len(one[0])):
            (last_s, last), first = past[-1], past[max(len(past) - 6, 0)]
            rate = (last - first[1]) / (last_s - first[0]) if len(past) > 2 else 0.0
            gap = np.linalg.norm(level - (last + rate * (t_s - last_s)), axis=1)
            gate = (FIRST_RAD if len(past) < 3 else NEXT_RAD) * max(1.0, (t_s - last_s) / 0.15)
            near = min(free, key=lambda k: gap[k], default=None)
            if near is not None and gap[near] < gate:
                free.discard(near)
                ids.append((n, near))
                past.append((t_s, level[near]))
        done += [ids for ids, past in open_ if t_s - past[-1][0] > MISSING_S]
        open_ = [one for one in open_ if t_s - one[1][-1][0] <= MISSING_S]
        open_ += [([(n, k)], [(t_s, level[k])]) for k in free]
    found = [ids for ids in done + [ids for ids, _ in open_] if len(ids) >= LEAST_SEEN]
    return sorted(found, key=len, reverse=True)
