"""The network's smoother, against the joint normal distribution of all states."""

from __future__ import annotations

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.network.motion import Move
from buddyline.solver_service.network.state import BLOCK, COMMON, NetState, block, blocks, lone
from buddyline.solver_service.network.trail import Chosen, Grown, Learned, NetTrail, Present, Told
from buddyline.solver_service.track.inputs import TrackNode

from tests.solver_service.scenes import IDEAL

NODE = TrackNode("a", IDEAL)


def still() -> NetState:
    return lone(NODE, np.zeros(3), np.eye(3))[0]


class RandomCourse:
    """A random course of steps and updates with a growing and shrinking state, twice: as trail, and as one big normal.

    Of the big one the mean and covariance of all errors at all times are kept, and conditioned on all residuals.
    """

    def __init__(self, seed: int, anchor: int | None) -> None:
        self.rng = np.random.default_rng(seed)
        self.trail, self.anchor = NetTrail(), anchor
        self.n, N = 2, COMMON + 2 * BLOCK
        root = self.rng.normal(0.0, 0.02, (N, N))
        self.state = still().joined(still())
        # By the filter.
        self.P = root @ root.T
        # All errors so far: rows of the present ones in them, and the covariance of the independent ones.
        self.sources, self.rows = self.P.copy(), np.eye(N)
        self.told: list[tuple[Floats, Floats]] = []
        self.H: list[Floats] = []
        self.noise: list[float] = []
        self.y: list[float] = []

    def _add_source(self, Q: Floats, by: Floats) -> None:
        width = len(self.sources)
        grown = np.zeros((width + len(Q), width + len(Q)))
        grown[:width, :width], grown[width:, width:] = self.sources, Q
        self.sources = grown
        self.rows = np.hstack((self.rows, by))
        self.H = [np.concatenate((one, np.zeros(len(Q)))) for one in self.H]
        self.told = [(rows, np.hstack((now, np.zeros((len(now), len(Q)))))) for rows, now in self.told]

    def step(self) -> None:
        n, rng = self.n, self.rng
        F = np.eye(BLOCK) + rng.normal(0.0, 0.05, (n, BLOCK, BLOCK))
        root = rng.normal(0.0, 0.002, (n, BLOCK, BLOCK))
        move = Move(F, root @ np.swapaxes(root, 1, 2))
        if self.anchor is not None:
            move = Move(F, move.Q, self.anchor, rng.normal(0.0, 1.0, 3), rng.normal(0.0, 1.0, 3))
        self.trail.moved(move)
        N = len(self.P)
        after = move.covariance(self.P)
        whole = move.onward(np.eye(N))
        self.rows = whole @ self.rows
        self._add_source(after - whole @ self.P @ whole.T, np.eye(N))
        self.P = after

    def learn(self) -> None:
        H, noise = self.rng.normal(0.0, 1.0, (2, len(self.P))), 1e-3
        S_inverse = np.linalg.inv(H @ self.P @ H.T + noise * np.eye(2))
        gain = self.P @ H.T @ S_inverse
        seen = self.rng.normal(0.0, 0.05, 2)
        # The big normal sees the whole residual, the filter what it has not foretold.
        self.H += list(H @ self.rows)
        self.noise += [noise, noise]
        self.y += seen.tolist()
        mean = self.mean_now(exclude=2)
        y = seen - H @ mean
        self.trail.events.append(Learned(H, gain, S_inverse, y))
        self.P = self.P - gain @ H @ self.P

    def mean_now(self, exclude: int) -> Floats:
        H, y = np.array(self.H)[: len(self.H) - exclude], np.array(self.y)[: len(self.y) - exclude]
        if not len(H):
            return np.zeros(len(self.P))
        S = H @ self.sources @ H.T + np.diag(self.noise[: len(H)])
        mean: Floats = self.rows @ self.sources @ H.T @ np.linalg.solve(S, y)
        return mean

    def tell(self) -> None:
        present = [Present(k, 0.0, True, 0.0) for k in range(self.n)]
        t_s = float(len(self.told))
        self.trail.events.append(Told.of(t_s, len(self.told), present, self.state, self.P, 0.0))
        self.told.append((self.mean_now(exclude=0), self.rows.copy()))

    def grow(self) -> None:
        by = self.rng.normal(0.0, 0.3, (BLOCK, len(self.P)))
        own = 1e-4 * np.eye(BLOCK)
        self.trail.events.append(Grown(by))
        T = np.concatenate((np.eye(len(self.P)), by))
        self.rows = T @ self.rows
        self._add_source(own, np.concatenate((np.zeros((len(self.P), BLOCK)), np.eye(BLOCK))))
        P = T @ self.P @ T.T
        P[-BLOCK:, -BLOCK:] += own
        self.P, self.n, self.state = P, self.n + 1, self.state.joined(still())

    def drop(self) -> None:
        kept = [k for k in range(self.n) if k != 1]
        chosen = blocks(kept)
        self.trail.events.append(Chosen(tuple(chosen), len(self.P)))
        self.P, self.rows = self.P[np.ix_(chosen, chosen)], self.rows[chosen]
        self.n, self.state = self.n - 1, self.state.chosen(kept)


@pytest.mark.parametrize("anchor", [None, 0])
def test_smoothing_conditions_each_state_on_all_that_was_seen(anchor: int | None) -> None:
    course = RandomCourse(3, anchor)
    for act in "tulstlsgtlslstlsdtlslst":
        {"t": course.tell, "u": course.learn, "l": course.learn, "s": course.step, "g": course.grow, "d": course.drop}[
            act
        ]()
    H, y = np.array(course.H), np.array(course.y)
    S = H @ course.sources @ H.T + np.diag(course.noise)
    told = list(course.trail.smoothed(len(course.P)))
    assert [one.stamp_ns for one, *_ in told] == list(range(len(course.told)))[::-1]
    for one, state, own in told:
        mean, rows = course.told[one.stamp_ns]
        across = rows @ course.sources @ H.T
        wanted = across @ np.linalg.solve(S, y) - mean
        covariance = rows @ course.sources @ rows.T - across @ np.linalg.solve(S, across.T)
        error = state.minus(one.state)
        for k in range(len(state)):
            part = slice(block(k).start, block(k).start + 9)
            assert error[part] == pytest.approx(wanted[part], abs=1e-6 * np.abs(wanted).max() + 1e-9)
            assert own[k] == pytest.approx(covariance[part, part], abs=1e-6 * np.abs(covariance).max())


def test_what_was_before_the_last_row_is_forgotten() -> None:
    course = RandomCourse(1, None)
    for act in range(6):
        course.tell()
        course.step()
        course.learn()
        course.trail.forget_before(float(act) - 1.0)
    assert [one.stamp_ns for one, *_ in course.trail.smoothed(len(course.P))] == [5, 4]
