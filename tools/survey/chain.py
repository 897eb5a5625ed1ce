"""Which station each node stands at, rest after rest: by marks, by depths, by the procedure agreed on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.rests import same_line

# Who has not moved is at the depth it was at; a node that is turned about on its station is so within this.
LEVEL_M: Final = 0.35

Who = Literal["a", "b"]
BOTH: Final[tuple[Who, Who]] = ("a", "b")


@dataclass(frozen=True, eq=False)
class Stop:
    """One rest as the chain sees it. named: stations by marks. depth_m: None where a node has no gauge."""

    line_m: Floats
    depth_m: dict[Who, float | None]
    named: dict[Who, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Standing:
    """Where both nodes stand; `rear` came first, so that the leg goes from it. problem: in words, or empty."""

    station: dict[Who, str]
    rear: Who
    problem: str = ""


def stand(stops: list[Stop], procedure: Literal["leapfrog", "stay"], first: Who) -> list[Standing]:
    """Return where both nodes stand at each stop; stations without a mark are numbered in their order."""
    names = _Names()
    result: list[Standing] = []
    arrived: dict[Who, int] = {first: 0, _other(first): 1}
    station: dict[Who, str] = {}
    marked: set[str] = set()
    for k, stop in enumerate(stops):
        problem = ""
        names.taken |= set(stop.named.values())
        if k == 0:
            moved = set(BOTH)
        else:
            guessed = _guessed(stops[k - 1], stop, procedure, first, arrived)
            for who, name in stop.named.items():
                if station[who] not in marked and name != station[who] and who not in guessed:
                    # It has stood there since before, under a number: now it has a name.
                    result = [_renamed(standing, station[who], name) for standing in result]
                    station[who] = name
            moved, problem = _moved(stops[k - 1], stop, station, guessed)
        marked |= set(stop.named.values())
        for who in sorted(moved, key=lambda one: arrived[one]):
            station[who] = stop.named.get(who) or names.next()
            if k:
                arrived[who] = k + 1
        if station["a"] == station["b"]:
            problem = f"both nodes at station {station['a']}: one of the marks is wrong"
        rear: Who = "a" if arrived["a"] < arrived["b"] else "b"
        if arrived["a"] == arrived["b"]:
            rear = first
        result.append(Standing(dict(station), rear, problem))
    return result


class _Names:
    """Numbers for stations that no mark has named so far: a later mark by such a number means that station."""

    def __init__(self) -> None:
        self.taken: set[str] = set()

    def next(self) -> str:
        number = 0
        while str(number) in self.taken:
            number += 1
        self.taken.add(str(number))
        return str(number)


def _other(who: Who) -> Who:
    return "b" if who == "a" else "a"


def _renamed(standing: Standing, old: str, new: str) -> Standing:
    station = {who: new if name == old else name for who, name in standing.station.items()}
    return Standing(station, standing.rear, standing.problem)


def _levels(before: Stop, stop: Stop) -> dict[Who, bool]:
    """Tell for each node whether its depth has changed by more than turning about does."""
    changed: dict[Who, bool] = {}
    for who in BOTH:
        old_m, new_m = before.depth_m[who], stop.depth_m[who]
        changed[who] = old_m is not None and new_m is not None and abs(new_m - old_m) > LEVEL_M
    return changed


def _guessed(
    before: Stop, stop: Stop, procedure: Literal["leapfrog", "stay"], first: Who, arrived: dict[Who, int]
) -> set[Who]:
    """Return who moved between two stops as far as line, depths and procedure tell."""
    if same_line(before.line_m, stop.line_m):
        return set()
    moved: set[Who] = {who for who, changed in _levels(before, stop).items() if changed}
    if moved:
        return moved
    rear: Who = "a" if arrived["a"] < arrived["b"] else "b"
    return {rear if procedure == "leapfrog" else _other(first)}


def _moved(before: Stop, stop: Stop, station: dict[Who, str], guessed: set[Who]) -> tuple[set[Who], str]:
    """Return who moved by marks and guess, and what is wrong with that."""
    said: dict[Who, bool] = {who: stop.named[who] != station[who] for who in BOTH if who in stop.named}
    levels = _levels(before, stop)
    moved: set[Who] = {who for who, has in said.items() if has}
    silent: list[Who] = [who for who in BOTH if who not in said]
    if len(silent) == 2:
        moved = guessed
    elif len(silent) == 1 and guessed and (levels[silent[0]] or not moved):
        # One of them must have moved, and it is not the one that is said to stand where it stood.
        moved.add(silent[0])
    problem = ""
    for who, has in said.items():
        if not has and levels[who]:
            problem = f"marked at station {station[who]} again, but its depth has changed"
    if moved == set(BOTH) and not all(who in stop.named for who in BOTH):
        problem = "both nodes have moved since the last leg: nothing ties this one to it, unless by a mark"
    return moved, problem
