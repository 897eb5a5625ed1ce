"""The part of the work that one of several solvers does: it takes up pairs and the network, and lets them go.

Nothing is answered twice: who takes up a pair knows what was answered by what it has heard, by what the hub holds, and
by the journals. Nothing is left out: the frames of the last minute are in the windows of every solver.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Final

import msgspec
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import Message
from buddyline.solver_service.answered import HANDED_OVER_NS, Answer, Answered
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.pair_core import PairId
from buddyline.solver_service.sharing import NETWORK, Sharing, Task

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus

# A solver that joins, or comes back to the hub, first hears for so long who else is there.
SETTLE_S: Final = 0.5
# From a claim to the start: what the one before has said last is still under way. A new one, which some of the others
# may not see yet, waits longer.
CLAIM_S: Final = 0.1
NEW_CLAIM_S: Final = 0.25
NEW_S: Final = 2.0
# One that stood still for so long may have lost its tasks: the hub gives a silent client up after three seconds.
FROZEN_S: Final = 2.5

TWICE: Final = "another solver on this hub does not share the work, and triggers are answered twice"


class SharedWork:
    """What this solver does of the shared work. Hold the service's lock for each call but `pulse`.

    now_s: a clock that nobody sets.
    """

    def __init__(self, core: SolverCore, answered: Answered, now_s: Callable[[], float] = time.monotonic) -> None:
        self.sharing = Sharing()
        self._core = core
        self._answered = answered
        self._now_s = now_s
        self._pulse_s = now_s()
        self._stood_still = False
        self._settled_s = self._pulse_s + SETTLE_S
        self._planned_s = -math.inf
        self._hub: str | None = None
        self._shown: set[str] = set()
        self._heard: dict[PairId, Answer] = {}
        self._decoder = msgspec.json.Decoder(Answer)

    @property
    def problems(self) -> list[str]:
        """What is wrong with the sharing."""
        return [TWICE] if self.sharing.strangers else []

    @property
    def may_speak(self) -> bool:
        """Whether the tasks are still this solver's: not if the process stood still, until the next tick."""
        return not self._stood_still and self._now_s() - self._pulse_s < FROZEN_S

    def pulse(self) -> None:
        """Note that the process runs; to be called often, by a thread that never waits for the service's lock."""
        now_s = self._now_s()
        self._stood_still |= now_s - self._pulse_s > FROZEN_S
        self._pulse_s = now_s

    def hear(self, payload: bytes) -> bool:
        """Note an outcome on the bus; return whether it is another solver's and the network here needs it.

        Raises MessageError.
        """
        try:
            one = self._decoder.decode(payload)
        except msgspec.DecodeError as error:
            raise MessageError(str(error)) from error
        if one.in_order:
            self._heard[one.node_a, one.node_b] = one
        return self._core.network is not None and (one.node_a, one.node_b) not in self._core.pairs

    def tick(self, hub: str | None) -> list[Task]:
        """Let tasks go; return those to begin now, by `begin`. hub: the hub's id; None while there is none."""
        now_s = self._now_s()
        self.pulse()
        if hub is None or hub != self._hub or self._stood_still or self.sharing.cut_off:
            # The others could not see this solver, or it could not see them.
            self._settled_s = now_s + SETTLE_S
            self._release(self.sharing.let_go())
        self._hub, self._stood_still = hub, False
        pause_s = CLAIM_S if now_s > self._settled_s + NEW_S else NEW_CLAIM_S
        if now_s < max(self._settled_s, self._planned_s + pause_s):
            return []
        self._planned_s = now_s
        plan = self.sharing.plan([*self._core.possible_pairs(), NETWORK])
        self._release(plan.release)
        self._shown |= {self.sharing.name, *map(self.sharing.task_name, plan.claim)}
        return plan.begin

    def declare(self, bus: Bus, shown: set[str]) -> set[str]:
        """Show on the bus what this solver holds, and no longer what it does not; return all that is shown now."""
        wanted = set(self._shown)
        for name in shown - wanted:
            bus.withdraw_alive(name)
        for name in wanted - shown:
            bus.declare_alive(name)
        return wanted

    def begin(self, task: Task, said: Iterable[Answer], receive_ns: int) -> Sequence[Message]:
        """Take up a task; return what is to be published. said: the last answers that hub or journals know."""
        if task not in self.sharing.begun:
            return []
        if task == NETWORK:
            self._core.adopt_network()
            return []
        node_a, node_b = task
        known = [one for one in said if (one.node_a, one.node_b) == task]
        heard = self._heard.get((node_a, node_b))
        known += [] if heard is None else [heard]
        said_ns = self._answered.take_over((node_a, node_b), known)
        return self._core.adopt((node_a, node_b), max(said_ns - HANDED_OVER_NS, 0), said_ns, receive_ns)

    def _release(self, tasks: Iterable[Task]) -> None:
        for task in tasks:
            self._shown.discard(self.sharing.task_name(task))
            if task == NETWORK:
                self._core.release_network()
            elif task in self._core.pairs:
                self._core.release((task[0], task[1]))
