"""What an estimate has gone through, kept for a while, and what later pictures say of it: the network's smoother.

The modified Bryson-Frazier form (Bierman, 1973) of a fixed-interval smoother. Backwards in time it carries the adjoint
mu (N,) and its information L (N, N), with which any earlier state x and covariance P become

    x_s = x.plus(P mu),    P_s = P - P L P

A step with F turns them into F^T mu and F^T L F; an update with residual y, gain K and S = H P H^T + R into
H^T S^-1 y + (1 - K H)^T mu and H^T S^-1 H + (1 - K H)^T L (1 - K H). No covariance is inverted: that of the network is
singular, because fixed nodes do not move, and the frame may move with a node. A member that joins or leaves changes N.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.network.motion import Move
from buddyline.solver_service.network.state import POSED, NetState, block

Adjoint: TypeAlias = tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class Moved:
    """A step of all members."""

    move: Move

    def back(self, mu: Floats, L: Floats) -> Adjoint:
        """Give the adjoint before it."""
        return self.move.backward(mu[:, None])[:, 0], self.move.backward(self.move.backward(L).T)


@dataclass(frozen=True, eq=False)
class Learned:
    """An update by residuals y (m,): H (m, N), gain (N, m), and the inverse of the residuals' covariance (m, m)."""

    H: Floats
    gain: Floats
    S_inverse: Floats
    y: Floats

    def back(self, mu: Floats, L: Floats) -> Adjoint:
        """Give the adjoint before it."""
        H, K = self.H, self.gain
        across = L @ K
        turned = H.T @ across.T
        return (
            mu + H.T @ (self.S_inverse @ self.y - K.T @ mu),
            L - turned - turned.T + H.T @ (self.S_inverse + K.T @ across) @ H,
        )


@dataclass(frozen=True, eq=False)
class Grown:
    """A member joined, behind all others: its errors by those before (BLOCK, N)."""

    by: Floats

    def back(self, mu: Floats, L: Floats) -> Adjoint:
        """Give the adjoint before it."""
        N = self.by.shape[1]
        if not N:
            return np.zeros(0), np.zeros((0, 0))
        T = np.concatenate((np.eye(N), self.by))
        return T.T @ mu, T.T @ L @ T


@dataclass(frozen=True, eq=False)
class Chosen:
    """Some errors were kept, of so many."""

    kept: tuple[int, ...]
    size: int

    def back(self, mu: Floats, L: Floats) -> Adjoint:
        """Give the adjoint before it."""
        before, information = np.zeros(self.size), np.zeros((self.size, self.size))
        if self.kept:
            before[list(self.kept)] = mu
            information[np.ix_(self.kept, self.kept)] = L
        return before, information


@dataclass(frozen=True)
class Present:
    """A member at a row's time. since_s: when it became one. asked: whether the row is of it."""

    node: int
    since_s: float
    confirmed: bool
    age_s: float
    asked: bool = True


@dataclass(frozen=True, eq=False)
class Told:
    """The members at a row's time; covariance (9 n, N): of place, velocity and attitude of each with all errors.

    north_doubt: as of the belief.
    """

    t_s: float
    stamp_ns: int
    members: tuple[Present, ...]
    state: NetState
    covariance: Floats
    north_doubt: float

    @classmethod
    def of(
        cls, t_s: float, stamp_ns: int, members: Sequence[Present], state: NetState, P: Floats, north_doubt: float
    ) -> Told:
        """Take what a row needs."""
        return cls(t_s, stamp_ns, tuple(members), state, P[_posed(len(state))], north_doubt)

    def smoothed(self, mu: Floats, L: Floats) -> tuple[NetState, Floats]:
        """Give the state by all pictures, and the covariances (n, 9, 9) of each member's place, velocity, attitude."""
        n, posed = len(self.state), _posed(len(self.state))
        error = np.zeros(len(mu))
        error[posed] = self.covariance @ mu
        own = self.covariance.reshape(n, POSED, -1)
        prior = np.stack([own[i][:, block(i)][:, :POSED] for i in range(n)])
        return self.state.plus(error), prior - own @ L @ own.swapaxes(1, 2)


Event: TypeAlias = Moved | Learned | Grown | Chosen | Told


class NetTrail:
    """The events of one estimate, in their order."""

    def __init__(self, events: list[Event] | None = None) -> None:
        self.events: list[Event] = events or []

    def copied(self) -> NetTrail:
        """Give a trail that goes its own way from here."""
        return NetTrail(list(self.events))

    def moved(self, move: Move) -> None:
        """Note a step."""
        # What it adds to the covariance is in the states already.
        self.events.append(Moved(replace(move, Q=move.Q[:0])))

    def smoothed(self, size: int) -> Iterator[tuple[Told, NetState, Floats]]:
        """Give each row with its smoothed state and covariances, the newest first. size: of the present error."""
        mu, L = np.zeros(size), np.zeros((size, size))
        for event in reversed(self.events):
            if isinstance(event, Told):
                yield event, *event.smoothed(mu, L)
            else:
                mu, L = event.back(mu, L)
                # What rounding leaves unsymmetric would grow from event to event.
                L = 0.5 * (L + L.T)

    def forget_before(self, t_s: float) -> None:
        """Drop what was before the last row at or before t_s."""
        for index in range(len(self.events) - 1, -1, -1):
            event = self.events[index]
            if isinstance(event, Told) and event.t_s <= t_s:
                del self.events[:index]
                return


def _posed(n: int) -> list[int]:
    return [index for i in range(n) for index in range(block(i).start, block(i).start + POSED)]
