"""Which of several solvers does which part of the work, without configuration: each finds out by itself, and all agree.

A task is one pair, or the network. Each solver is shown to the others by a name that is alive on the bus, and so is
each task that it holds; the names of a killed process vanish. Every task belongs to the solver that rendezvous hashing
gives it: one that joins or leaves moves only its own share. A solver takes up a task once nobody else holds it, and one
tick after it has claimed it: two that claim it at once see each other before either begins. Those that see each other
agree, whoever else has joined or left: of two, the one with the higher hash has the task, or neither.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, TypeAlias

Task: TypeAlias = tuple[str, ...]
"""A pair's two nodes, or NETWORK."""

NETWORK: Final[Task] = ()
ALIVE: Final = "solver"
SHARED: Final = "share"


@dataclass(frozen=True)
class Handover:
    """What to do now: tasks to let go, to claim, and to begin."""

    release: list[Task]
    claim: list[Task]
    begin: list[Task]


class Sharing:
    """One solver's view of those that share the work. instance: its own id; random if not given.

    strangers: solvers on this bus that do not share. cut_off: no name is alive any more, though some were: the link was
    lost, and nobody may see this solver.
    """

    def __init__(self, instance: str = "") -> None:
        self.instance = instance or os.urandom(8).hex()
        self.strangers: set[str] = set()
        self.begun: set[Task] = set()
        self.cut_off = False
        self._alive: set[str] = set()
        self._others: set[str] = set()
        self._held: dict[Task, set[str]] = {}
        self._claimed: set[Task] = set()

    @property
    def name(self) -> str:
        """The name by which the others see this solver."""
        return f"{ALIVE}/{SHARED}/{self.instance}"

    @property
    def alone(self) -> bool:
        """Whether no other solver shares the work now."""
        return not self._others

    @property
    def waits(self) -> bool:
        """Whether there are tasks that it has claimed and not begun."""
        return self._claimed != self.begun

    def task_name(self, task: Task) -> str:
        """Return the name by which the others see that this solver holds a task."""
        return "/".join((self.name, "pair", *task)) if task else f"{self.name}/net"

    def saw(self, name: str, alive: bool) -> None:
        """Note a name on the bus that has come alive, or is no longer."""
        kind, _, rest = name.partition("/")
        if not rest.startswith(f"{SHARED}/{self.instance}"):
            (self._alive.add if alive else self._alive.discard)(name)
            self.cut_off |= not self._alive
        if kind != ALIVE:
            return
        shared, _, rest = rest.partition("/")
        if shared != SHARED:
            (self.strangers.add if alive else self.strangers.discard)(name)
            return
        instance, _, what = rest.partition("/")
        if instance == self.instance:
            return
        if not what:
            (self._others.add if alive else self._others.discard)(instance)
            return
        holders = self._held.setdefault(_task_of(name), set())
        (holders.add if alive else holders.discard)(instance)

    def owner(self, task: Task) -> str:
        """Return the instance that a task belongs to: of all solvers the one with the highest hash with it."""
        return max(self._others | {self.instance}, key=lambda one: _weight(one, task))

    def plan(self, tasks: Iterable[Task]) -> Handover:
        """Return what to do at this tick, and take it as done. tasks: all that there are to do now."""
        mine = {task for task in tasks if self.owner(task) == self.instance}
        release = sorted(self._claimed - mine)
        begin = sorted(task for task in self._claimed & mine - self.begun if not self._held.get(task))
        claim = sorted(mine - self._claimed)
        self._claimed = mine
        self.begun = (self.begun & mine) | set(begin)
        return Handover(release, claim, begin)

    def unheld(self, tasks: Iterable[Task], names: Iterable[str]) -> list[Task]:
        """Return which of the tasks just begun no other holds; the rest is not begun.

        names: what is alive by the hub, asked after the claim: of two that claim at once the later sees the other's.
        """
        held = {_task_of(name) for name in names if name.startswith(f"{ALIVE}/{SHARED}/") and name.count("/") > 2}
        self.begun -= {task for task in tasks if task in held}
        return [task for task in tasks if task not in held]

    def let_go(self) -> list[Task]:
        """Give up all tasks, because the others may have taken them; return those that were held."""
        held, self._claimed, self.begun, self.cut_off = sorted(self._claimed), set(), set(), False
        return held


def _task_of(name: str) -> Task:
    """Return the task that a name such as solver/share/<instance>/pair/a/b shows to be held."""
    return tuple(name.split("/")[4:])


def _weight(instance: str, task: Task) -> bytes:
    return hashlib.blake2b("/".join((instance, *task)).encode(), digest_size=8).digest()
