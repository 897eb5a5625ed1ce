"""Starts from single lamps: some seconds of both nodes' pictures and samples at once, by least squares.

One lamp of each node tells no range in a picture. Over seconds it does: a lamp moves by known metres as its bar rolls,
and as the depth gauges and the units say. Which lamp is which is told alike (docs/track.md, "One lamp each").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Final, TypeAlias

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log, skew
from buddyline.solver_service.track.anchors import attitude_covariance
from buddyline.solver_service.track.inputs import AttitudeSeen, DepthSeen, TrackNode
from buddyline.solver_service.track.lights import Sight
from buddyline.solver_service.track.samples import Samples
from buddyline.solver_service.track.start import (
    ACCEL_BIAS_MPS2,
    CLOCK_S,
    DEPTH_OFFSET_M,
    GYRO_BIAS_RADPS,
    MOUNT_RAD,
    SPEED_MPS,
    broad_start,
    constants_of,
)
from buddyline.solver_service.track.state import NAV, SIZE, State, invariant_of_plain
from buddyline.solver_service.track.stepping import HOLD_S
from numpy.typing import NDArray

# A lamp's candidates, followed from picture to picture: how far one may be from where the last ones foretell it, rad at
# first and rad later, and for how long it may be missing.
FIRST_RAD: Final = 0.05
NEXT_RAD: Final = 0.015
MISSING_S: Final = 0.8
LEAST_SEEN: Final = 15
# What biases walk, per s, and the noise in a picture beside the candidates' own (shaken units), px.
GYRO_WALK: Final = 0.0003
ACCEL_WALK: Final = 0.004
SHAKEN_PX: Final = 1.0
# Gross errors: the residuals' distribution has tails as of so many degrees of freedom.
HEAVY: Final = 12.0
# Ranges to begin with; rounds with the depths held, then free, until a round gains less than LEAST_GAIN.
RANGES_M: Final = (1.5, 2.7, 5.0, 9.0)
HELD_ROUNDS: Final = 3
ROUNDS: Final = 6
LEAST_GAIN: Final = 0.2
# Courses of a node that are tried, the longest; nodes face each other; pictures of each to begin with; fits to go on
# with.
COURSES: Final = 2
FACING: Final = -0.5
FEW: Final = 30
MOST_FITS: Final = 4
# What a light that is used tells against clutter, twice its log odds. A fit is refuted by so much of these; and is none
# where its lights cost more than UNFIT each.
USED: Final = 16.0
REFUTED_BY: Final = 60.0
UNFIT: Final = 5.0
# Parameters: r, v, the turns of A and B, of each the biases of gyro and accelerometer,
# their slopes and the mount, depth offset, clock.
_R, _V, _PHI = slice(0, 3), slice(3, 6), (slice(6, 9), slice(9, 12))
_OWN: Final = (slice(12, 27), slice(27, 42))
_DEPTH, _CLOCK, _SIZE = 42, 43, 44
Seen: TypeAlias = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Of each node's pictures the lights (N, 3) that are used: picture, candidate, light."""


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
    step = rotation_log(np.swapaxes(D[0, at - 1], 1, 2) @ D[0, at])
    D_at = D[:, at - 1] @ rotation_exp(share * step)
    a_at = (1.0 - share) * a[:, at - 1] + share * a[:, at]
    turned = rotation_log((np.swapaxes(D_at[:1], -1, -2) @ D_at[1:]).reshape(-1, 3, 3)).reshape(15, -1, 3)
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


@dataclass(frozen=True, eq=False)
class Anchors:
    """What gauges and attitudes tell, at times of a window by their index.

    depth_m (N,), depth_sigma_m (N,): of B's depth minus A's. R (M, 3, 3), root (M, 3, 3): each node's camera to level,
    and the square root of its error's information.
    """

    depth_at: NDArray[np.intp]
    depth_m: Floats
    depth_sigma_m: Floats
    attitude_at: tuple[NDArray[np.intp], NDArray[np.intp]]
    R: tuple[Floats, Floats]
    root: tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class Window:
    """Some seconds of both nodes.

    times_s (N,): its start, and those of all pictures. at: which of them are each node's sights. own (2, 15): what the
    courses take the units to be off.
    """

    nodes: tuple[TrackNode, TrackNode]
    samples: Sequence[Samples]
    times_s: Floats
    sights: tuple[Sequence[Sight], Sequence[Sight]]
    at: tuple[NDArray[np.intp], NDArray[np.intp]]
    courses: tuple[Course, Course]
    anchors: Anchors
    own: Floats

    def by(self, own: Floats) -> Window:
        """Give the window with the samples as they are by what the units are off."""
        courses = [
            course_of(samples, self.times_s, node, off)
            for samples, node, off in zip(self.samples, self.nodes, own, strict=True)
        ]
        return replace(self, courses=(courses[0], courses[1]), own=own)

    def sums(self, seen: Seen, x: Fit, held_m: float = 0.0) -> tuple[Floats, Floats, float]:
        """Give the normal equations at a fit: information, gradient, cost.

        held_m: the depth that all lights are taken to have; 0: their own.
        """
        N, g, cost = np.zeros((_SIZE, _SIZE)), np.zeros(_SIZE), 0.0
        for observer in (0, 1):
            n, _, light = seen[observer].T
            picked = [(self.sights[observer][i], k) for i, k, _ in seen[observer].tolist()]
            b = np.stack([sight.bearings[k] for sight, k in picked])
            T = np.stack([sight.tangents[k] for sight, k in picked])
            sigma = np.array([sight.sigma_px[k] for sight, k in picked])
            X, J = self.lights(observer, self.at[observer][n], self.nodes[1 - observer].rig.lights_m[light], x)
            depth = np.einsum("nc,nc->n", b, X)
            ahead = np.maximum(depth, 0.3 * x.near_m) if not held_m else np.full(len(n), held_m)
            h = np.einsum("nrc,nc->nr", T, X) / ahead[:, None]
            slope = T / ahead[:, None, None]
            if not held_m:
                slope = slope - h[:, :, None] * b[:, None, :] / ahead[:, None, None]
            H = slope @ J
            var = sigma**2 + SHAKEN_PX**2
            chi2 = (h * h).sum(1) / var
            w = 1.0 / (1.0 + chi2 / HEAVY) if not held_m else np.ones(len(n))
            cost += float((HEAVY * np.log1p(chi2 / HEAVY)).sum() if not held_m else chi2.sum())
            root = np.sqrt(w / var)[:, None]
            rows = (H * root[..., None]).reshape(-1, _SIZE)
            N += rows.T @ rows
            g -= rows.T @ (h * root).ravel()
        an = self.anchors
        c = self.courses
        r, dr = self.apart(an.depth_at, x)
        ports = [node.rig.depth_port_m for node in self.nodes]
        shown = r[:, 2] + x.depth_m
        row = dr[:, 2].copy()
        for node, sign in ((0, -1.0), (1, 1.0)):
            R = x.R[node] @ c[node].D[an.depth_at]
            arm = R @ ports[node]
            shown = shown + sign * arm[:, 2]
            row[:, _PHI[node]] -= sign * skew(arm)[:, 2]
        row[:, _DEPTH] += 1.0
        y = (an.depth_m - shown) / an.depth_sigma_m
        row = row / an.depth_sigma_m[:, None]
        N += row.T @ row
        g += row.T @ y
        cost += float(y @ y)
        for node in (0, 1):
            at = an.attitude_at[node]
            R = self.turned(node, at, x)
            y3 = rotation_log(an.R[node] @ np.swapaxes(R, 1, 2))
            H = np.zeros((len(at), 3, _SIZE))
            H[:, :, _PHI[node]] = np.eye(3)
            H[:, :, _OWN[node]] = R @ c[node].G[at]
            rows, gap = (an.root[node] @ H).reshape(-1, _SIZE), (an.root[node] @ y3[..., None]).ravel()
            N += rows.T @ rows
            g += rows.T @ gap
            cost += float(gap @ gap)
        prior = x.values()
        N += np.diag(_PRIOR)
        g -= _PRIOR * prior
        cost += float(_PRIOR @ (prior * prior))
        return N, g, cost

    def apart(self, n: NDArray[np.intp], x: Fit) -> tuple[Floats, Floats]:
        """Give r (N, 3) at times n, and its Jacobian."""
        a, b = self.courses
        t = (self.times_s[n] - self.times_s[0])[:, None]
        aA, aB = (x.R[i] @ (c.a[n] + c.A[n] @ (x.own[i] - self.own[i]))[..., None] for i, c in ((0, a), (1, b)))
        r = x.r + t * x.v + (aB - aA)[..., 0]
        J = np.zeros((len(n), 3, _SIZE))
        J[:, :, _R] = np.eye(3)
        J[:, :, _V] = t[..., None] * np.eye(3)
        J[:, :, _PHI[0]] = skew(aA[..., 0])
        J[:, :, _PHI[1]] = -skew(aB[..., 0])
        J[:, :, _OWN[0]] = -(x.R[0] @ a.A[n])
        J[:, :, _OWN[1]] = x.R[1] @ b.A[n]
        return r, J

    def turned(self, node: int, n: NDArray[np.intp], x: Fit) -> Floats:
        """Give a node's camera to level (N, 3, 3) at times n."""
        course = self.courses[node]
        return np.asarray(x.R[node] @ course.D[n] @ rotation_exp(course.G[n] @ (x.own[node] - self.own[node])))

    def lights(self, observer: int, n: NDArray[np.intp], lights_m: Floats, x: Fit) -> tuple[Floats, Floats]:
        """Give lights (N, 3) of the other node in the camera at times n, and the Jacobian.

        What the clock adds is by errors of motion alone, not of the units.
        """
        other = 1 - observer
        r, J = self.apart(n, x)
        sign = 1.0 if observer == 0 else -1.0
        own, theirs = self.courses[observer], self.courses[other]
        R_own, R_other = self.turned(observer, n, x), self.turned(other, n, x)
        arm = (R_other @ lights_m[..., None])[..., 0]
        d = sign * r + arm
        J = sign * J
        J[:, :, _PHI[other]] -= skew(arm)
        J[:, :, _OWN[other]] -= R_other @ skew(lights_m) @ theirs.G[n]
        # By the clock, B is in A's pictures where it will be; A in B's where it was.
        swept = (R_other @ np.cross(theirs.w[n], lights_m)[..., None])[..., 0]
        speed = np.zeros(3)
        if observer == 0:
            b_A, b_B = own.b[n] @ x.R[0].T, theirs.b[n] @ x.R[1].T
            speed = x.v + b_B - b_A
            J[:, :, _V] += x.clock_s * np.eye(3)
            J[:, :, _PHI[0]] += x.clock_s * skew(b_A)
            J[:, :, _PHI[1]] -= x.clock_s * skew(b_B)
        J[:, :, _CLOCK] += sign * swept + speed
        d = d + x.clock_s * (sign * swept + speed)
        J[:, :, _PHI[observer]] += skew(d)
        toward = np.swapaxes(R_own, 1, 2)
        X = (toward @ d[..., None])[..., 0]
        J = toward @ J
        J[:, :, _OWN[observer]] += skew(X) @ own.G[n]
        return X, J


_PRIOR: Final = np.zeros(_SIZE)
_PRIOR[_V] = SPEED_MPS**-2
for _own in _OWN:
    _PRIOR[_own] = np.repeat((GYRO_BIAS_RADPS, ACCEL_BIAS_MPS2, GYRO_WALK, ACCEL_WALK, MOUNT_RAD), 3) ** -2.0
_PRIOR[_DEPTH], _PRIOR[_CLOCK] = DEPTH_OFFSET_M**-2, CLOCK_S**-2


@dataclass(eq=False)
class Fit:
    """Both nodes at a window's start: r, v (3,), R (2, 3, 3), own (2, 15): what the units are off; how well it fits."""

    r: Floats
    v: Floats
    R: Floats
    own: Floats
    depth_m: float = 0.0
    clock_s: float = 0.0
    near_m: float = 1.0
    cost: float = math.inf
    information: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    seen: Seen = field(default_factory=lambda: (np.zeros((0, 3), np.intp), np.zeros((0, 3), np.intp)))

    @property
    def lights(self) -> int:
        """Give the number of its lights."""
        return sum(map(len, self.seen))

    @property
    def odds(self) -> float:
        """Give minus twice the log odds against clutter."""
        return self.cost - USED * self.lights

    def values(self) -> Floats:
        """Give the parameters that priors bear on."""
        return np.concatenate((np.zeros(3), self.v, np.zeros(6), self.own.ravel(), (self.depth_m, self.clock_s)))

    def plus(self, d: Floats) -> Fit:
        """Give the fit that is off this one by d (_SIZE,)."""
        R = np.stack([rotation_exp(d[_PHI[i]]) @ self.R[i] for i in (0, 1)])
        own = self.own + np.stack((d[_OWN[0]], d[_OWN[1]]))
        depth_m, clock_s = self.depth_m + float(d[_DEPTH]), self.clock_s + float(d[_CLOCK])
        return replace(self, r=self.r + d[_R], v=self.v + d[_V], R=R, own=own, depth_m=depth_m, clock_s=clock_s)


def _fitted(window: Window, seen: Seen, start: Fit) -> Fit:
    """Improve a start by Gauss-Newton, the lights' depths held first."""
    x, ahead = start, start.r / np.linalg.norm(start.r)
    for _ in range(HELD_ROUNDS):
        N, g, _ = window.sums(seen, x, start.near_m)
        N[_R, _R] += np.outer(ahead, ahead) / (0.1 * start.near_m) ** 2
        x = x.plus(np.asarray(np.linalg.solve(N, g), np.float64))
    return _polished(window, seen, x)


def _polished(window: Window, seen: Seen, x: Fit) -> Fit:
    """Improve a fit by Gauss-Newton, with shorter steps where a whole one makes it worse."""
    N, g, cost = window.sums(seen, x)
    for _ in range(ROUNDS):
        step, gained = np.asarray(np.linalg.solve(N, g), np.float64), 0.0
        for share in (1.0, 0.5, 0.2, 0.05):
            trial = x.plus(share * step)
            after = window.sums(seen, trial)
            if after[2] < cost:
                gained = cost - after[2]
                x, (N, g, cost) = trial, after
                break
        if gained < LEAST_GAIN:
            break
    return replace(x, cost=cost, information=N, seen=seen)


def gathered(
    nodes: tuple[TrackNode, TrackNode],
    samples: Sequence[Samples],
    attitudes: Sequence[Sequence[tuple[float, AttitudeSeen]]],
    depths: Sequence[Sequence[tuple[float, DepthSeen]]],
    sights: Sequence[Sight],
    start_s: float,
) -> Window | None:
    """Give the window of these pictures, all after start_s; None where samples or attitudes are missing."""
    of_node = tuple([sight for sight in sights if sight.node == node] for node in (0, 1))
    times_s = np.unique(np.array([start_s, *(sight.t_s for sight in sights)]))
    if not all(of.between(start_s, times_s[-1], times_s[-1] + HOLD_S)[2].all() for of in samples):
        return None
    seconds = np.arange(start_s, times_s[-1], 1.0)
    halves = np.arange(start_s, times_s[-1], 0.5)
    depth_at, depth_m, depth_sigma_m = [], [], []
    for t_s in halves.tolist():
        shown = [[seen for at_s, seen in depths[node] if t_s <= at_s < min(t_s + 0.5, times_s[-1])] for node in (0, 1)]
        if all(shown):
            depth_at.append(int(np.abs(times_s - (t_s + 0.25)).argmin()))
            a, b = (float(np.mean([seen.depth_m for seen in each])) for each in shown)
            depth_m.append(b - a)
            depth_sigma_m.append(math.sqrt(sum(each[0].sigma_m ** 2 / len(each) for each in shown)) + 0.005)
    R, root, attitude_at = [], [], []
    for node in (0, 1):
        when = np.array([at_s for at_s, _ in attitudes[node] if at_s <= times_s[-1]])
        at, Rs, inv = [], [], []
        for t_s in seconds.tolist():
            n = int(np.abs(times_s - t_s).argmin())
            if not len(when):
                return None
            k = int(np.abs(when - times_s[n]).argmin())
            if abs(when[k] - times_s[n]) < 0.03:
                seen = attitudes[node][k][1]
                at.append(n)
                Rs.append(seen.R_ned_body @ nodes[node].rig.R_body_camera)
                covariance = attitude_covariance(seen.R_ned_body, seen.sigma_rad, 1.0, 1.0)
                inv.append(np.linalg.inv(np.linalg.cholesky(covariance)))
        if not at or at[0] != 0:
            return None
        attitude_at.append(np.array(at))
        R.append(np.stack(Rs))
        root.append(np.stack(inv) / math.sqrt(len(at)))
    anchors = Anchors(
        np.array(depth_at, np.intp),
        np.array(depth_m),
        np.array(depth_sigma_m),
        (attitude_at[0], attitude_at[1]),
        (R[0], R[1]),
        (root[0], root[1]),
    )
    at_of = tuple(np.searchsorted(times_s, [sight.t_s for sight in each]) for each in of_node)
    own = np.zeros((2, 15))
    courses = tuple(course_of(samples[n], times_s, nodes[n], own[n]) for n in (0, 1))
    pictures = (of_node[0], of_node[1]), (at_of[0], at_of[1])
    return Window(nodes, samples, times_s, *pictures, (courses[0], courses[1]), anchors, own)


def _some(seen: NDArray[np.intp]) -> NDArray[np.intp]:
    return seen[:: max(len(seen) // FEW, 1)]


def fits(window: Window) -> list[Fit]:
    """Give what the window's courses of single lamps allow, the likeliest first, but what is refuted.

    Of each pair of courses, either lamp may be the left or the right one.
    """
    lamps = [lamp_courses(window.sights[n], window.courses[n].D[window.at[n]])[:COURSES] for n in (0, 1)]
    R0 = np.stack([window.anchors.R[n][0] for n in (0, 1)])
    unbiased = np.zeros((2, 15))
    found = []
    for of_a, of_b in product(*lamps):
        ahead, back = (
            R0[n] @ window.courses[n].D[window.at[n][at]] @ window.sights[n][at].bearings[k]
            for n, (at, k) in ((0, of_a[len(of_a) // 2]), (1, of_b[len(of_b) // 2]))
        )
        if float(ahead @ back) > FACING:
            continue
        for light_a, light_b in product((0, 1), (0, 1)):
            seen = (np.insert(np.array(of_a), 2, light_b, axis=1), np.insert(np.array(of_b), 2, light_a, axis=1))
            some = (_some(seen[0]), _some(seen[1]))
            coarse = [
                _fitted(window, some, Fit(range_m * ahead, np.zeros(3), R0, unbiased, near_m=range_m))
                for range_m in RANGES_M
            ]
            best = min(coarse, key=lambda one: one.cost)
            found.append(replace(best, seen=seen, cost=best.cost * len(seen[0]) / len(some[0])))
    kept: list[Fit] = []
    for fit in sorted(found, key=lambda one: one.odds)[:MOST_FITS]:
        full = _polished(window, fit.seen, fit)
        kept.append(_polished(window.by(full.own), full.seen, full))
    kept.sort(key=lambda one: one.odds)
    return [one for one in kept if one.odds < kept[0].odds + REFUTED_BY and one.cost < UNFIT * one.lights]


def state_of(window: Window, fit: Fit, clock_sigma_s: float) -> tuple[State, Floats]:
    """Give the state at a window's start, and a covariance of several of the fit's sigmas."""
    window = window.by(fit.own)
    r_m, v_mps = fit.r.copy(), fit.v.copy()
    for n, sign in ((0, -1.0), (1, 1.0)):
        r_m += sign * fit.R[n] @ window.courses[n].a[0]
        v_mps += sign * fit.R[n] @ window.courses[n].b[0]
    state = replace(
        constants_of(window.nodes, fit.R, r_m, clock_sigma_s)[0],
        v_mps=v_mps,
        gyro_bias_radps=fit.own[:, 0:3],
        accel_bias_mps2=fit.own[:, 3:6],
        mount_rad=fit.own[:, 12:15],
        clock_s=fit.clock_s,
        depth_offset_m=fit.depth_m,
    )
    known = np.zeros((SIZE, SIZE))
    T = invariant_of_plain(state)[:NAV, :NAV]
    known[:NAV, :NAV] = T @ np.linalg.inv(fit.information)[:NAV, :NAV] @ T.T
    return broad_start(window.nodes, state, clock_sigma_s, known)
