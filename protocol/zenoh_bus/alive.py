"""Which names are alive, by Zenoh's liveliness tokens: a token ends with its process or its link."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Final

import zenoh
from buddyline.protocol.delivery import Delivery, FailureLatch
from buddyline.protocol.rate_limit import RateLimit
from buddyline.protocol.zenoh_bus.intake import INTAKE, Intake
from buddyline.protocol.zenoh_bus.narrowing import Narrowing

# `**` does not match chunks that begin with @, so no subscriber takes a token for a message.
ALIVE: Final = "buddyline/@alive"
EVERY_TOKEN: Final = f"{ALIVE}/**"
# To the limit of rate a change is a message of this size: of an owner 1000 at once, then 100 a second.
CHANGE_BYTES: Final = 10_000
# Of all owners, and the length of each.
MAX_TOKENS: Final = 4096
MAX_TOKEN_LENGTH: Final = 256


class ZenohWatch:
    """Tells one handler which names are alive. A token that is reported twice counts once.

    An owner of tokens whose processes come and go without end is shut out for ten seconds at a time, as one that sends
    too many messages is: the hub then says nothing more of it. limit: counts and names what was left out.
    """

    missed = 0

    def __init__(self, session: zenoh.Session, delivery: Delivery[tuple[str, bool]], failures: FailureLatch) -> None:
        self.limit = RateLimit()
        self._session = session
        self._delivery = delivery
        self._failures = failures
        self._processes: dict[str, set[str]] = {}
        self._count = 0
        self._left_out: set[str] = set()
        self._lock = threading.Lock()
        self._narrowing = Narrowing(
            [(EVERY_TOKEN, self._accept)], self._intake, self.limit, set[str], failures, _tokens_of_owners
        )
        self._narrowing.begin([self._intake(EVERY_TOKEN, self._accept)])

    @property
    def dropped(self) -> int:
        """Number of changes dropped because the handler was too slow, or there were too many."""
        return self._delivery.dropped + sum(self.limit.dropped.values())

    @property
    def waiting(self) -> int:
        """Number of changes that wait for the handler."""
        return self._delivery.waiting

    def close(self) -> None:
        """End the threads."""
        self._narrowing.close()
        self._delivery.close()

    def _intake(self, key_expr: str, accept: Callable[[zenoh.Sample], bool]) -> Intake:
        if key_expr == EVERY_TOKEN:
            self._forget_shut_out()
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(INTAKE)
        subscriber = self._session.liveliness().declare_subscriber(key_expr, ring, history=True)
        return Intake("alive", subscriber, accept, self._failures)

    def _accept(self, sample: zenoh.Sample) -> bool:
        token = str(sample.key_expr).removeprefix(f"{ALIVE}/")
        if not self.limit.admits(_owner_of(token), CHANGE_BYTES):
            self._left_out.add(_owner_of(token))
            self._narrowing.watch()
            return False
        name, _, process = token.rpartition("/")
        with self._lock:
            processes = self._processes.get(name, set())
            before = bool(processes)
            if sample.kind != zenoh.SampleKind.PUT:
                self._count -= process in processes
                processes.discard(process)
            elif process not in processes and self._count < MAX_TOKENS and len(token) <= MAX_TOKEN_LENGTH:
                self._count += 1
                processes.add(process)
                self._processes[name] = processes
            self._tell(name, before)
        return True

    def _tell(self, name: str, before: bool) -> None:
        """Tell of a name if it has come alive or is no longer; the lock is held."""
        alive = bool(self._processes.get(name))
        if not alive:
            self._processes.pop(name, None)
        if alive != before:
            self._delivery.offer((name, alive))

    def _forget_shut_out(self) -> None:
        """Forget the tokens of those that were shut out, because their ends were not seen; what lives is said anew."""
        with self._lock:
            owners, self._left_out = self._left_out, set()
            for name in [name for name in self._processes if _owner_of(f"{name}/") in owners]:
                self._count -= len(self._processes[name])
                self._processes[name] = set()
                self._tell(name, before=True)


def _owner_of(token: str) -> str:
    """Return who may declare a token, written as the owner of messages: a node, or all processes of another kind."""
    kind, _, rest = token.partition("/")
    return f"buddyline/{kind}/{rest.partition('/')[0]}" if kind == "node" else f"buddyline/{kind}"


def _tokens_of_owners(_: str, owners: Sequence[str]) -> list[str]:
    return [f"{ALIVE}/{owner.removeprefix('buddyline/')}/**" for owner in owners]
