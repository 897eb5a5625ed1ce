"""Some seconds of both nodes' pictures and samples at once: the model that starts from single lamps are fitted to.

What is unknown stands in `Fit`; the equations are in docs/track.md, "One lamp each".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Final, TypeAlias

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log, skew
from buddyline.solver_service.track.anchors import attitude_covariance
from buddyline.solver_service.track.courses import Course, course_of
from buddyline.solver_service.track.inputs import AttitudeSeen, DepthSeen, TrackNode
from buddyline.solver_service.track.lights import Sight
from buddyline.solver_service.track.moving import HOLD_S
from buddyline.solver_service.track.samples import Samples
from buddyline.solver_service.track.start import (
    ACCEL_BIAS_MPS2,
    CLOCK_S,
    DEPTH_OFFSET_M,
    GYRO_BIAS_RADPS,
    MOUNT_RAD,
    SPEED_MPS,
)
from numpy.typing import NDArray

# What biases walk, per s, and the noise in a picture beside the candidates' own (shaken units), px.
GYRO_WALK: Final = 0.0003
ACCEL_WALK: Final = 0.004
SHAKEN_PX: Final = 1.0
# Gross errors: the residuals' distribution has tails as of so many degrees of freedom.
HEAVY: Final = 12.0
# What a light that is used tells against clutter, twice its log odds.
USED: Final = 16.0
# Parameters: r, v, the turns of A and B, of each the biases of gyro and accelerometer,
# their slopes and the mount, depth offset, clock.
R_, V_, PHI = slice(0, 3), slice(3, 6), (slice(6, 9), slice(9, 12))
OWN: Final = (slice(12, 27), slice(27, 42))
DEPTH, CLOCK, PARAMETERS = 42, 43, 44
Seen: TypeAlias = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Of each node's pictures the lights (N, 3) that are used: picture, candidate, light."""
Term: TypeAlias = tuple[Floats, Floats, float]
"""What some measurements add to a fit's normal equations: whitened rows (M, PARAMETERS), residuals (M,), and cost."""


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
        N, g, cost = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS), 0.0
        terms = chain(self._of_lights(seen, x, held_m), (self._of_depths(x),), self._of_attitudes(x))
        for rows, y, its_cost in terms:
            N += rows.T @ rows
            g += rows.T @ y
            cost += its_cost
        prior = x.values()
        N += np.diag(_PRIOR)
        g -= _PRIOR * prior
        cost += float(_PRIOR @ (prior * prior))
        return N, g, cost

    def _of_lights(self, seen: Seen, x: Fit, held_m: float) -> Iterator[Term]:
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
            cost = float((HEAVY * np.log1p(chi2 / HEAVY)).sum() if not held_m else chi2.sum())
            root = np.sqrt(w / var)[:, None]
            yield (H * root[..., None]).reshape(-1, PARAMETERS), -(h * root).ravel(), cost

    def _of_depths(self, x: Fit) -> Term:
        at, sigma_m = self.anchors.depth_at, self.anchors.depth_sigma_m
        r, dr = self.apart(at, x)
        shown_m, rows = r[:, 2] + x.depth_m, dr[:, 2].copy()
        for node, sign in ((0, -1.0), (1, 1.0)):
            arm = x.R[node] @ self.courses[node].D[at] @ self.nodes[node].rig.depth_port_m
            shown_m = shown_m + sign * arm[:, 2]
            rows[:, PHI[node]] -= sign * skew(arm)[:, 2]
        rows[:, DEPTH] += 1.0
        y = (self.anchors.depth_m - shown_m) / sigma_m
        return rows / sigma_m[:, None], y, float(y @ y)

    def _of_attitudes(self, x: Fit) -> Iterator[Term]:
        for node, (at, told, root) in enumerate(
            zip(self.anchors.attitude_at, self.anchors.R, self.anchors.root, strict=True)
        ):
            R = self.turned(node, at, x)
            H = np.zeros((len(at), 3, PARAMETERS))
            H[:, :, PHI[node]] = np.eye(3)
            H[:, :, OWN[node]] = R @ self.courses[node].G[at]
            y = (root @ rotation_log(told @ R.swapaxes(1, 2))[..., None]).ravel()
            yield (root @ H).reshape(-1, PARAMETERS), y, float(y @ y)

    def apart(self, n: NDArray[np.intp], x: Fit) -> tuple[Floats, Floats]:
        """Give r (N, 3) at times n, and its Jacobian."""
        a, b = self.courses
        t = (self.times_s[n] - self.times_s[0])[:, None]
        aA, aB = (x.R[i] @ (c.a[n] + c.A[n] @ (x.own[i] - self.own[i]))[..., None] for i, c in ((0, a), (1, b)))
        r = x.r + t * x.v + (aB - aA)[..., 0]
        J = np.zeros((len(n), 3, PARAMETERS))
        J[:, :, R_] = np.eye(3)
        J[:, :, V_] = t[..., None] * np.eye(3)
        J[:, :, PHI[0]] = skew(aA[..., 0])
        J[:, :, PHI[1]] = -skew(aB[..., 0])
        J[:, :, OWN[0]] = -(x.R[0] @ a.A[n])
        J[:, :, OWN[1]] = x.R[1] @ b.A[n]
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
        J[:, :, PHI[other]] -= skew(arm)
        J[:, :, OWN[other]] -= R_other @ skew(lights_m) @ theirs.G[n]
        # By the clock, B is in A's pictures where it will be; A in B's where it was.
        swept = (R_other @ np.cross(theirs.w[n], lights_m)[..., None])[..., 0]
        speed = np.zeros(3)
        if observer == 0:
            b_A, b_B = own.b[n] @ x.R[0].T, theirs.b[n] @ x.R[1].T
            speed = x.v + b_B - b_A
            J[:, :, V_] += x.clock_s * np.eye(3)
            J[:, :, PHI[0]] += x.clock_s * skew(b_A)
            J[:, :, PHI[1]] -= x.clock_s * skew(b_B)
        J[:, :, CLOCK] += sign * swept + speed
        d = d + x.clock_s * (sign * swept + speed)
        J[:, :, PHI[observer]] += skew(d)
        toward = R_own.swapaxes(1, 2)
        X = (toward @ d[..., None])[..., 0]
        J = toward @ J
        J[:, :, OWN[observer]] += skew(X) @ own.G[n]
        return X, J


_PRIOR: Final = np.zeros(PARAMETERS)
_PRIOR[V_] = SPEED_MPS**-2
for _own in OWN:
    _PRIOR[_own] = np.repeat((GYRO_BIAS_RADPS, ACCEL_BIAS_MPS2, GYRO_WALK, ACCEL_WALK, MOUNT_RAD), 3) ** -2.0
_PRIOR[DEPTH], _PRIOR[CLOCK] = DEPTH_OFFSET_M**-2, CLOCK_S**-2


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
        """Give the fit that is off this one by d (PARAMETERS,)."""
        R = np.stack([rotation_exp(d[PHI[i]]) @ self.R[i] for i in (0, 1)])
        own = self.own + np.stack((d[OWN[0]], d[OWN[1]]))
        depth_m, clock_s = self.depth_m + float(d[DEPTH]), self.clock_s + float(d[CLOCK])
        return replace(self, r=self.r + d[R_], v=self.v + d[V_], R=R, own=own, depth_m=depth_m, clock_s=clock_s)


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
