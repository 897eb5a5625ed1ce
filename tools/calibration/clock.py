"""The offset between two nodes' clocks, from their beacons: one-way times in both directions, weighted by quickness.

B's clock minus A's is half the difference of the one-way times from A to B and back, as stamped. Its error is at most
half their sum, the round trip, however unequal the true one-way times are (Mills, RFC 5905, section 8).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import ClockBeacon
from numpy.typing import NDArray

# A beacon there and one back within this time form an exchange. Clocks that drift by 40 ppm move by 40 us meanwhile.
APART_NS: Final = 1 * S_NS
# Fastest drift: two crystals, each off by 50 ppm, and slewed by chrony. A faster change shows that a clock was set.
FASTEST: Final = 200e-6
SLACK_S: Final = 50e-6
GAP_S: Final = 10.0
WINDOW_S: Final = 60.0
MIN_EXCHANGES: Final = 8
# 1 sd of the quickest exchange, because the threads that take the stamps wait for each other.
QUICKEST_SIGMA_S: Final = 20e-6
NEXT_FEW: Final = 3
MIN_DRIFT_SPAN_S: Final = 5.0
# At a turn rate of 0.5 rad/s a light moves by about a candidate's noise in this time.
LIMIT_S: Final = 2e-3


@dataclass(frozen=True, slots=True)
class Exchanges:
    """Pairs of a beacon there and one back, sorted by time.

    stamp_ns: (N,) int64, A's clock. offset_s: (N,), B's clock minus A's. round_trip_s: (N,).
    """

    stamp_ns: NDArray[np.int64]
    offset_s: NDArray[np.float64]
    round_trip_s: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def part(self, begin: int, end: int) -> Exchanges:
        """Return the exchanges from index begin to before index end."""
        return Exchanges(self.stamp_ns[begin:end], self.offset_s[begin:end], self.round_trip_s[begin:end])


@dataclass(frozen=True, slots=True)
class OffsetEstimate:
    """B's clock minus A's at stamp_ns (A's clock), from the exchanges between begin_ns and end_ns.

    sigma_s: 1 sd, including unequal one-way times. scatter_s: 1 sd without them. bound_s: half the quickest round trip,
    the greatest possible error. drift: of B's clock against A's, s/s; None if the time was too short.
    """

    stamp_ns: int
    begin_ns: int
    end_ns: int
    offset_s: float
    sigma_s: float
    scatter_s: float
    bound_s: float
    drift: float | None
    drift_sigma: float | None
    exchanges: int


class OneWayTimes:
    """Collects the one-way times between nodes from their beacons, each once."""

    def __init__(self) -> None:
        self._ways: dict[tuple[str, str], dict[int, int]] = {}

    def add(self, beacon: ClockBeacon) -> None:
        """Take a beacon."""
        for heard in beacon.heard:
            if heard.node != beacon.node:
                self._ways.setdefault((heard.node, beacon.node), {})[heard.sent_ns] = heard.received_ns

    def pairs(self) -> list[tuple[str, str]]:
        """Return the pairs of nodes that hear each other, each once, sorted."""
        return sorted((a, b) for a, b in self._ways if a < b and (b, a) in self._ways)

    def exchanges(self, node_a: str, node_b: str) -> Exchanges:
        """Pair each beacon back with the nearest beacon there. Only A's clock is compared: B's may be off by years."""
        there = np.array(sorted(self._ways.get((node_a, node_b), {}).items()), np.int64).reshape(-1, 2)
        back = np.array(sorted(self._ways.get((node_b, node_a), {}).items(), key=lambda way: way[1]), np.int64)
        back = back.reshape(-1, 2)
        if not len(there) or not len(back):
            return Exchanges(np.empty(0, np.int64), np.empty(0), np.empty(0))
        after = np.searchsorted(there[:, 0], back[:, 1]).clip(1, max(len(there) - 1, 1))
        before = after - 1
        after = after.clip(max=len(there) - 1)
        nearer = np.abs(there[after, 0] - back[:, 1]) < np.abs(there[before, 0] - back[:, 1])
        chosen = there[np.where(nearer, after, before)]
        near = np.abs(chosen[:, 0] - back[:, 1]) <= APART_NS
        chosen, back = chosen[near], back[near]
        way_there_ns, way_back_ns = chosen[:, 1] - chosen[:, 0], back[:, 1] - back[:, 0]
        return Exchanges(back[:, 1], (way_there_ns - way_back_ns) / (2 * S_NS), (way_there_ns + way_back_ns) / S_NS)


def steps(exchanges: Exchanges) -> list[int]:
    """Return the indices of exchanges before which a clock was set: their offset is impossible after their neighbour's.

    A negative round trip is impossible too.
    """
    passed_s = np.diff(exchanges.stamp_ns) / S_NS
    bounds_s = np.abs(exchanges.round_trip_s) / 2
    moved_s = np.abs(np.diff(exchanges.offset_s))
    allowed_s = bounds_s[1:] + bounds_s[:-1] + FASTEST * passed_s + SLACK_S
    impossible = (exchanges.round_trip_s < -SLACK_S)[1:]
    return [int(i) + 1 for i in np.flatnonzero((moved_s > allowed_s) | impossible)]


def windows(exchanges: Exchanges) -> list[Exchanges]:
    """Split exchanges at gaps, where a clock was set, and after a minute; leave out parts with too few exchanges."""
    gaps = np.flatnonzero(np.diff(exchanges.stamp_ns) > GAP_S * S_NS) + 1
    cuts = sorted({0, len(exchanges), *gaps.tolist(), *steps(exchanges)})
    found = []
    for begin, end in pairwise(cuts):
        if end - begin < MIN_EXCHANGES:
            continue
        span_s = float(exchanges.stamp_ns[end - 1] - exchanges.stamp_ns[begin]) / S_NS
        count = min(max(math.ceil(span_s / WINDOW_S), 1), (end - begin) // MIN_EXCHANGES)
        edges = np.linspace(begin, end, count + 1).round().astype(int)
        found += [exchanges.part(int(first), int(last)) for first, last in pairwise(edges)]
    return found


def estimate(exchanges: Exchanges) -> OffsetEstimate:
    """Fit offset and drift to exchanges without a step; raise ValueError if there are none.

    An exchange weighs less, the longer it took beyond the quickest one: half of the difference may be its error. The
    asymmetry of the quickest one cannot be observed; sigma_s assumes a uniform distribution over its round trip.
    """
    if not len(exchanges):
        raise ValueError("no exchanges")
    quickest_s = max(float(exchanges.round_trip_s.min()), 0.0)
    # The delay of the quickest exchange itself is estimated from the spread of the next few.
    next_s = float(np.sort(exchanges.round_trip_s)[: NEXT_FEW + 1][-1]) - quickest_s
    sigmas_s = QUICKEST_SIGMA_S + (next_s + (exchanges.round_trip_s - quickest_s).clip(0)) / 2
    weights = sigmas_s**-2.0
    weights /= weights.sum()
    first_ns = int(exchanges.stamp_ns[0])
    times_s = (exchanges.stamp_ns - first_ns) / S_NS
    middle_s = float(weights @ times_s)
    offset_s = float(weights @ exchanges.offset_s)
    lever_s = times_s - middle_s
    spread_s2 = float(weights @ lever_s**2)
    drift: float | None = None
    drift_sigma: float | None = None
    residuals_s = exchanges.offset_s - offset_s
    if times_s[-1] >= MIN_DRIFT_SPAN_S and len(exchanges) >= MIN_EXCHANGES and spread_s2 > 0:
        drift = float(weights @ (lever_s * exchanges.offset_s)) / spread_s2
        residuals_s = residuals_s - drift * lever_s
        drift_sigma = _spread(weights * lever_s, residuals_s, sigmas_s) / spread_s2
    scatter_s = _spread(weights, residuals_s, sigmas_s)
    return OffsetEstimate(
        stamp_ns=first_ns + round(middle_s * S_NS),
        begin_ns=first_ns,
        end_ns=int(exchanges.stamp_ns[-1]),
        offset_s=offset_s,
        sigma_s=math.hypot(scatter_s, quickest_s / math.sqrt(12)),
        scatter_s=scatter_s,
        bound_s=quickest_s / 2,
        drift=drift,
        drift_sigma=drift_sigma,
        exchanges=len(exchanges),
    )


def _spread(weights: NDArray[np.float64], residuals_s: NDArray[np.float64], sigmas_s: NDArray[np.float64]) -> float:
    """Return the sd of a weighted sum: from the residuals or from the expected sigmas, whichever is greater."""
    return math.sqrt(max(float(weights**2 @ residuals_s**2), float(weights**2 @ sigmas_s**2)))


def drift_between(first: OffsetEstimate, last: OffsetEstimate) -> tuple[float, float]:
    """Return the drift from one estimate to a later one, and its sd, s/s.

    An equal asymmetry of the one-way times cancels. The difference of the quickest round trips may add to it.
    """
    passed_s = (last.stamp_ns - first.stamp_ns) / S_NS
    longer_s = (first.bound_s - last.bound_s) / math.sqrt(3)
    sigma_s = math.hypot(first.scatter_s, last.scatter_s, longer_s)
    return (last.offset_s - first.offset_s) / passed_s, sigma_s / passed_s
