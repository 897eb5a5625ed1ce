"""Find the station of each node of a pair at each rest: from marks, depths, and the agreed procedure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Final, Literal

from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.rests import same_line

# A node that stays at its station, also one that turns round, changes its depth by less than this.
LEVEL_M: Final = 0.35

Procedure = Literal["leapfrog", "stay"]


@dataclass(frozen=True, eq=False)
class Stop:
    """The chain's input from one rest. By node: depth_m, None without a gauge; named, stations by marks.

    tagged: the nodes whose names are of tags that they have read.
    """

    line_m: Floats
    depth_m: dict[str, float | None]
    named: dict[str, str] = field(default_factory=dict)
    tagged: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Standing:
    """The stations of both nodes; `rear` came first, so the leg starts there. problem: in words, or empty."""

    station: dict[str, str]
    rear: str
    problem: str = ""


def find_standings(stops: list[Stop], procedure: Procedure, first: str, taken: Iterable[str] = ()) -> list[Standing]:
    """Return the stations of both nodes at each stop.

    Stations without a mark get the free numbers in order; a later mark by such a number means that station.
    first: the node at the first station; the pair's first, if it is none of them.
    """
    if not stops:
        return []
    nodes = list(stops[0].depth_m)
    first = first if first in nodes else nodes[0]
    in_use = set(taken)
    # Order of arrival at the present station: 0 and 1 at the beginning, later the stop's number plus one.
    arrived = {node: int(node != first) for node in nodes}
    station: dict[str, str] = {}
    marked: set[str] = set()
    result: list[Standing] = []
    for k, whole in enumerate(stops):
        stop, misread = _without_the_others_tag(whole, station)
        in_use |= set(stop.named.values())
        moved, problem = set(nodes), ""
        if k:
            guessed = _guessed(stops[k - 1], stop, procedure, first, arrived)
            for node, name in stop.named.items():
                if station[node] not in marked and name != station[node] and node not in guessed:
                    # The node has been there since before, under a number; now the station has a name.
                    result = [_renamed(standing, station[node], name) for standing in result]
                    station[node] = name
            moved, problem = _moved(stops[k - 1], stop, station, guessed)
        problem = problem or misread
        marked |= set(stop.named.values())
        for node in sorted(nodes, key=lambda one: arrived[one]):
            if node in moved:
                station[node] = stop.named.get(node) or _number(in_use)
                in_use.add(station[node])
                arrived[node] = k + 1 if k else arrived[node]
        if len(set(station.values())) == 1:
            problem = f"both nodes at station {station[nodes[0]]}: one of the marks is wrong"
        result.append(Standing(dict(station), _rear(arrived, first), problem))
    return result


def _without_the_others_tag(stop: Stop, station: dict[str, str]) -> tuple[Stop, str]:
    """Return a stop without the name of a tag that was read at the other node's station, in passing, and words on it.

    station: of each node before, where the other node still is.
    """
    for node in sorted(stop.tagged):
        name = stop.named[node]
        for other, at in station.items():
            if other != node and at == name and stop.named.get(other, name) == name:
                named = {one: given for one, given in stop.named.items() if one != node}
                words = f"node {node} has read tag {name} of the other node's station; mark its own"
                return replace(stop, named=named, tagged=stop.tagged - {node}), words
    return stop, ""


def _rear(arrived: dict[str, int], first: str) -> str:
    """Return the node that came first to its station; of two that came together, `first`."""
    return min(arrived, key=lambda node: (arrived[node], node != first))


def _number(in_use: set[str]) -> str:
    return next(str(number) for number in range(len(in_use) + 1) if str(number) not in in_use)


def _renamed(standing: Standing, old: str, new: str) -> Standing:
    station = {node: new if name == old else name for node, name in standing.station.items()}
    return Standing(station, standing.rear, standing.problem)


def _changed_depth(before: Stop, stop: Stop) -> set[str]:
    """Return the nodes whose depth has changed by more than turning round explains."""
    changed = set()
    for node, now_m in stop.depth_m.items():
        before_m = before.depth_m[node]
        if before_m is not None and now_m is not None and abs(now_m - before_m) > LEVEL_M:
            changed.add(node)
    return changed


def _guessed(before: Stop, stop: Stop, procedure: Procedure, first: str, arrived: dict[str, int]) -> set[str]:
    """Return who moved between two stops, as far as line, depths and procedure show it."""
    if same_line(before.line_m, stop.line_m):
        return set()
    rear = _rear(arrived, first)
    mover = {rear} if procedure == "leapfrog" else set(arrived) - {first}
    return _changed_depth(before, stop) or mover


def _moved(before: Stop, stop: Stop, station: dict[str, str], guessed: set[str]) -> tuple[set[str], str]:
    """Return who moved, by marks and by the guess, and the contradiction between them, if any."""
    changed = _changed_depth(before, stop)
    moved = {node for node, name in stop.named.items() if name != station[node]}
    silent = set(station) - set(stop.named)
    if len(silent) == len(station):
        moved = set(guessed)
    elif silent and guessed and (silent & changed or not moved):
        # One of them must have moved, and not the one whose mark repeats its station.
        moved |= silent
    problem = ""
    for node in stop.named:
        if stop.named[node] == station[node] and node in changed:
            problem = f"marked at station {station[node]} again, but its depth has changed"
    if moved == set(station) and silent:
        problem = "both nodes have moved since the last leg: nothing connects this leg to it; mark a station"
    return moved, problem
