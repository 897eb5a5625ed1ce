"""The nodes' clocks over a dive, from the beacons before, during and after it, or from a file of `align --json`."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import ConfigError, text_of
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import ClockBeacon, HeardClock
from buddyline.protocol.topics import CLOCK
from buddyline.solver_service.clock_curve import ClockCurve
from buddyline.tools.calibration.clock import LIMIT_S, OffsetEstimate, OneWayTimes, estimate, windows
from buddyline.tools.dives import Dive
from msgspec import UNSET
from msgspec.structs import replace
from numpy.typing import NDArray

log = logging.getLogger(__name__)

# A smaller offset moves a light by less than its noise, whatever its sigma.
LEAST_OFFSET_S: Final = 0.001
EVERY_NS: Final = 10 * S_NS
# The first and the last estimate tell the drift where they are at least this far apart.
MIN_SPAN_NS: Final = 60 * S_NS
# Beacons cover a dive that begins and ends less than this outside of them.
OUTSIDE_NS: Final = 120 * S_NS
# The name of `curves_text` in the metadata of a solved dive.
CURVES: Final = "clock_curves"
# The name of `apart_text` in the metadata of a solved dive.
APART: Final = "clocks_apart"
# A curve with more points is noted by so many, evenly spaced.
NOTED: Final = 101


@dataclass(frozen=True)
class BeaconCurve:
    """A node's clock minus the first node's. covers: whether there were beacons at both ends of the dive."""

    node: str
    curve: ClockCurve
    covers: bool


class Ties:
    """Instants at which both a node's stamp and its raw clock are known; nothing sets or slews the raw clock.

    Steady time is the raw clock, moved so that it equals the stamp at the last tie.
    """

    def __init__(self, stamps_ns: Sequence[int], raws_ns: Sequence[int]) -> None:
        order = np.argsort(np.array(stamps_ns, np.int64), kind="stable")
        self.stamps_ns = np.array(stamps_ns, np.int64)[order]
        raws_ns_ = np.array(raws_ns, np.int64)[order]
        rises = np.diff(self.stamps_ns)
        steps_ns = np.diff(raws_ns_)
        # A machine that was restarted counts anew: there the stamps are all that is known.
        steps_ns = np.where((steps_ns > 0) & (np.abs(steps_ns - rises) < rises // 5 + S_NS // 10), steps_ns, rises)
        since_ns = np.concatenate([np.cumsum((steps_ns - rises)[::-1])[::-1], [0]]) if len(self.stamps_ns) else rises
        # Steady time minus the stamp.
        self._left_ns = -since_ns.astype(float)
        self._first_ns = int(self.stamps_ns[0]) if len(self.stamps_ns) else 0
        self._since_ns = (self.stamps_ns - self._first_ns).astype(float)

    def steady_ns(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the steady times of stamps."""
        return stamps_ns + self._interpolated(self._since_ns, stamps_ns)

    def stamps_of(self, steadies_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the stamps of steady times."""
        return steadies_ns - self._interpolated(self._since_ns + self._left_ns, steadies_ns)

    def _interpolated(self, since_ns: NDArray[np.float64], wanted_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        if not len(since_ns):
            return np.zeros(len(wanted_ns), np.int64)
        found = np.interp((wanted_ns - self._first_ns).astype(float), since_ns, self._left_ns)
        return np.asarray(found.round().astype(np.int64))


def beacon_curves(dive: Dive, nodes: Sequence[str]) -> list[BeaconCurve]:
    """Return the clocks of all nodes but the first, as far as beacons tell them."""
    if not dive.nodes(CLOCK.name):
        return []
    beacons = [one for one in dive.all_of(CLOCK, ClockBeacon) if one.node in nodes]
    span_ns = dive.start_ns, dive.end_ns
    curves = (beacon_curve(beacons, nodes[0], node, span_ns) for node in nodes[1:])
    return [found for found in curves if found is not None]


def beacon_curve(
    beacons: Sequence[ClockBeacon], node_a: str, node_b: str, span_ns: tuple[int, int]
) -> BeaconCurve | None:
    """Return B's clock minus A's over a dive; None where their beacons do not tell it.

    The offset is interpolated between the times at which they heard each other, on clocks that nothing slews. So it
    does not matter that chrony brings the clocks together again as soon as the cable is in.
    """
    ties = {node: _ties_of(beacons, node) for node in (node_a, node_b)}
    ways = OneWayTimes()
    for beacon in beacons:
        if beacon.node in ties:
            ways.add(_steadied(beacon, ties))
    found = [estimate(part) for part in windows(ways.exchanges(node_a, node_b))]
    found = [one for one in found if one.sigma_s < LIMIT_S]
    if not found:
        return None
    stamps_ns = _grid_ns(ties[node_b].stamps_ns, span_ns)
    steadies_b_ns = ties[node_b].steady_ns(stamps_ns)
    steadies_a_ns = steadies_b_ns - _between(found, steadies_b_ns - _between(found, steadies_b_ns))
    offsets_ns = stamps_ns - ties[node_a].stamps_of(steadies_a_ns)
    first_ns, last_ns = (
        int(ties[node_a].stamps_of(np.array([one]))[0]) for one in (found[0].begin_ns, found[-1].end_ns)
    )
    return BeaconCurve(
        node_b,
        ClockCurve(stamps_ns, offsets_ns),
        covers=first_ns - span_ns[0] < OUTSIDE_NS and span_ns[1] - last_ns < OUTSIDE_NS,
    )


def _between(found: Sequence[OffsetEstimate], steadies_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the offset at steady times of A's: straight between the estimates, and on beyond them."""
    at_ns = np.array([one.stamp_ns for one in found], np.int64)
    offsets_ns = np.array([round(one.offset_s * S_NS) for one in found], np.int64)
    # Differences: a float cannot hold an offset of years to the nanosecond.
    since_ns, left_ns = (steadies_ns - at_ns[0]).astype(float), (offsets_ns - offsets_ns[0]).astype(float)
    line = np.interp(since_ns, (at_ns - at_ns[0]).astype(float), left_ns)
    if at_ns[-1] - at_ns[0] >= MIN_SPAN_NS:
        drift = left_ns[-1] / float(at_ns[-1] - at_ns[0])
        line += drift * (since_ns - since_ns.clip(0.0, float(at_ns[-1] - at_ns[0])))
    return np.asarray(offsets_ns[0] + line.round().astype(np.int64))


def _grid_ns(ties_ns: NDArray[np.int64], span_ns: tuple[int, int]) -> NDArray[np.int64]:
    """Return B's stamps at which to give the curve: everywhere where it may bend."""
    ends_ns = [span_ns[0] - EVERY_NS, span_ns[1] + EVERY_NS]
    even_ns = np.arange(ends_ns[0], ends_ns[1] + 1, EVERY_NS, dtype=np.int64)
    return np.unique(np.concatenate([even_ns, ties_ns]))


def _ties_of(beacons: Sequence[ClockBeacon], node: str) -> Ties:
    tied = [(one.stamp_ns, one.raw_ns) for one in beacons if one.node == node and one.raw_ns is not UNSET]
    return Ties([stamp_ns for stamp_ns, _ in tied], [int(raw_ns) for _, raw_ns in tied])


def _steadied(beacon: ClockBeacon, ties: dict[str, Ties]) -> ClockBeacon:
    own = ties[beacon.node]
    heard: list[HeardClock] = []
    for one in beacon.heard:
        if one.node in ties:
            sent_ns = _moved(ties[one.node], one.sent_ns)
            heard.append(replace(one, sent_ns=sent_ns, received_ns=_moved(own, one.received_ns)))
    return replace(beacon, stamp_ns=_moved(own, beacon.stamp_ns), heard=heard)


def _moved(ties: Ties, stamp_ns: int) -> int:
    return max(int(ties.steady_ns(np.array([stamp_ns], np.int64))[0]), 0)


def chosen_curves(
    dive: Dive, nodes: Sequence[str], clock_offset_s: float | None, clocks: str | None
) -> dict[str, ClockCurve]:
    """Return the curves with which to solve a dive: the given offset or file, or else what beacons tell.

    Beacons that tell less than LEAST_OFFSET_S change nothing.
    """
    if clock_offset_s is not None:
        return {nodes[1]: ClockCurve.constant(clock_offset_s)}
    if clocks is not None:
        return {nodes[1]: load_curve(clocks, (nodes[0], nodes[1]), dive)}
    curves = {}
    for found in beacon_curves(dive, nodes):
        if found.curve.largest_s > LEAST_OFFSET_S:
            where = "" if found.covers else ", taken for the whole dive: they did not hear each other at both its ends"
            log.info(
                "clocks: that of %s is %s from that of %s, by their beacons%s", found.node, found.curve.words, nodes[0],
                where,
            )  # fmt: skip
            curves[found.node] = found.curve
    return curves


def load_curve(path: str, pair: tuple[str, str], dive: Dive) -> ClockCurve:
    """Read a pair's clocks from a file of `buddyline align --json`; raise ConfigError naming the file."""
    try:
        told = json.loads(text_of(Path(path).read_bytes(), f"--clocks {path}", "what `buddyline align --json` writes"))
        a, b = told["node_a"], told["node_b"]
        offset_s, drift, at_ns = float(told["offset_s"]), float(told.get("drift") or 0.0), int(told.get("at_ns") or 0)
    except OSError as error:
        raise ConfigError(f"--clocks {path}: cannot be read: {error.strerror}") from error
    except KeyError as error:
        raise ConfigError(
            f"--clocks {path}: is not what `buddyline align --json` writes (it has no {error.args[0]})"
        ) from error
    except (ValueError, TypeError, AttributeError) as error:
        raise ConfigError(f"--clocks {path}: is not what `buddyline align --json` writes ({error})") from error
    if (a, b) != pair:
        raise ConfigError(f"--clocks {path}: is of nodes {a} and {b}, not of {pair[0]} and {pair[1]}")
    return ClockCurve.line(offset_s, at_ns, drift, dive.start_ns, dive.end_ns)


def curves_text(curves: Mapping[str, ClockCurve]) -> str:
    """Return the curves that a dive was solved with, as its metadata have them."""
    noted = {}
    for node, curve in curves.items():
        stamps_ns, offsets_ns = curve.stamps_ns.tolist(), curve.offsets_ns.tolist()
        if len(stamps_ns) > NOTED:
            first_ns, span_ns = stamps_ns[0], stamps_ns[-1] - stamps_ns[0]
            stamps_ns = [first_ns + span_ns * step // (NOTED - 1) for step in range(NOTED)]
            offsets_ns = [curve.offset_ns(stamp_ns) for stamp_ns in stamps_ns]
        noted[node] = {"stamps_ns": stamps_ns, "offsets_ns": offsets_ns}
    return json.dumps(noted)


def noted_curves(metadata: Mapping[str, str], name: str) -> dict[str, ClockCurve]:
    """Return the curves that a dive was solved with; empty for none. name: the log's, for an error."""
    try:
        told = json.loads(metadata.get(CURVES, "{}"))
        return {node: ClockCurve.of(one["stamps_ns"], one["offsets_ns"]) for node, one in told.items()}
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise BuddylineError(f"{name}: its metadata {CURVES} cannot be read ({error})") from error


def apart_text(apart_s: Mapping[tuple[str, str], float]) -> str:
    """Return by how much pairs' clocks are apart that their poses count, as a solved dive's metadata have it."""
    return json.dumps([[*pair, offset_s] for pair, offset_s in apart_s.items()])


def noted_apart(metadata: Mapping[str, str], name: str) -> dict[tuple[str, str], float]:
    """Return what `apart_text` has noted; empty for nothing. name: the log's, for an error."""
    try:
        return {(str(a), str(b)): float(offset_s) for a, b, offset_s in json.loads(metadata.get(APART, "[]"))}
    except (ValueError, TypeError) as error:
        raise BuddylineError(f"{name}: its metadata {APART} cannot be read ({error})") from error


def apart_problem(
    pair: tuple[str, str], offset_s: float, curves: Mapping[str, ClockCurve], at_ns: int, *, counted: bool
) -> str:
    """Say that a pair's clocks differ though curves were taken into account, what it does to poses, and what to do.

    counted: whether the poses count it.
    """
    node_a, node_b = pair
    ahead = "ahead of" if offset_s > 0.0 else "behind"
    told = (
        f"clock of {node_b} is {1e3 * abs(offset_s):.0f} ms {ahead} {node_a}'s: each pose is of pictures taken that "
        "far apart"
    )
    if not counted:
        return (
            f"{told}, and off by what the nodes moved meanwhile, which its sigmas do not count; synchronise the "
            "clocks, or solve with the whole dive's track, which tells the offset better, and whose poses count it"
        )
    known_ns = [curves[node].offset_ns(at_ns) if node in curves else 0 for node in pair]
    whole_s = offset_s + (known_ns[1] - known_ns[0]) / S_NS
    return (
        f"{told}, which its sigmas count; to pair pictures that are nearer in time, synchronise the clocks, or solve "
        f"again with --nodes {node_a} {node_b} --clock-offset {whole_s:.4f} (align tells a drift too)"
    )
