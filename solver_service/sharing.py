"""Which of several solvers does which part of the work, without configuration: each finds out by itself, and all agree.

A task is one pair, or the network. Each solver is shown to the others by a name that is alive on the bus, and so is
each task that it holds; the names of a killed process vanish. Every task belongs to the solver that rendezvous hashing
gives it: one that joins or leaves moves only its own share. A solver takes up a task once nobody else holds it, and one
tick after it has claimed it: two that claim it at once see each other before either begins.
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

    strangers: solvers on this bus that do not share.
    """

    def __init__(self, instance: str = "") -> None:
        self.instance = instance or os.urandom(8).hex()
        self.strangers: set[str] = set()
        self.begun: set[Task] = set()
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

    def task_name(self, task: Task) -> str:
        """Return the name by which the others see that this solver holds a task."""
        return "/".join((self.name, "pair", *task)) if task else f"{self.name}/net"

    def saw(self, name: str, alive: bool) -> None:
        """Note a name on the bus that has come alive, or is no longer."""
        kind, _, rest = name.partition("/")
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
        holders = self._held.setdefault(tuple(what.split("/")[1:]), set())
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

    def let_go(self) -> list[Task]:
        """Give up all tasks, because the others may have taken them; return those that were held."""
        held, self._claimed, self.begun = sorted(self._claimed), set(), set()
        return held


def _weight(instance: str, task: Task) -> bytes:
    return hashlib.blake2b("/".join((instance, *task)).encode(), digest_size=8).digest()
