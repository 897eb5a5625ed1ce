"""Which station each node stands at, rest after rest: by marks, by depths, by the procedure agreed on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

from tools.survey.averages import Floats
from tools.survey.rests import same_line

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
    for k, stop in enumerate(stops):
        problem = ""
        names.taken |= set(stop.named.values())
        if k == 0:
            moved = set(BOTH)
        else:
            moved, problem = _moved(stops[k - 1], stop, station, procedure, first, arrived)
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


def _moved(
    before: Stop,
    stop: Stop,
    station: dict[Who, str],
    procedure: Literal["leapfrog", "stay"],
    first: Who,
    arrived: dict[Who, int],
) -> tuple[set[Who], str]:
    """Return who moved between two stops, and what is wrong with that."""
    said: dict[Who, bool] = {who: stop.named[who] != station[who] for who in BOTH if who in stop.named}
    levels: dict[Who, bool] = {}
    for who in BOTH:
        old_m, new_m = before.depth_m[who], stop.depth_m[who]
        levels[who] = old_m is not None and new_m is not None and abs(new_m - old_m) > LEVEL_M
    same = same_line(before.line_m, stop.line_m)
    if same and not any(said.values()):
        return set(), ""
    moved: set[Who] = {who for who, has in said.items() if has}
    open_: list[Who] = [who for who in BOTH if who not in said]
    if len(open_) == 1:
        (who,) = open_
        if levels[who] or not moved:
            moved.add(who)
    elif len(open_) == 2:
        moved = {who for who in BOTH if levels[who]}
        if not moved:
            rear: Who = "a" if arrived["a"] < arrived["b"] else "b"
            moved = {rear if procedure == "leapfrog" else _other(first)}
    problem = ""
    for who, has in said.items():
        if not has and levels[who]:
            problem = f"marked at station {station[who]} again, but its depth has changed"
    if moved == set(BOTH) and not all(who in stop.named for who in BOTH):
        problem = "both nodes have moved since the last leg: nothing ties this one to it, unless by a mark"
    return moved, problem
