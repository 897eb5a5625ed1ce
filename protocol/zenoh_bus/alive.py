"""Which names are alive, by Zenoh's liveliness tokens: a token ends with its process or its link."""

from __future__ import annotations

from typing import Final

import zenoh
from buddyline.protocol.delivery import Delivery, FailureLatch
from buddyline.protocol.zenoh_bus.intake import INTAKE, Intake

# `**` does not match chunks that begin with @, so no subscriber takes a token for a message.
ALIVE: Final = "buddyline/@alive"


class ZenohWatch:
    """Tells one handler which names are alive. A token that is reported twice counts once."""

    missed = 0

    def __init__(self, session: zenoh.Session, delivery: Delivery[tuple[str, bool]], failures: FailureLatch) -> None:
        self._delivery = delivery
        self._processes: dict[str, set[str]] = {}
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(INTAKE)
        subscriber = session.liveliness().declare_subscriber(f"{ALIVE}/**", ring, history=True)
        self._intake = Intake("alive", subscriber, self._accept, failures)

    @property
    def dropped(self) -> int:
        """Number of changes dropped because the handler was too slow."""
        return self._delivery.dropped

    def close(self) -> None:
        """End the threads."""
        self._intake.close()
        self._delivery.close()

    def _accept(self, sample: zenoh.Sample) -> bool:
        token = str(sample.key_expr).removeprefix(f"{ALIVE}/")
        name, _, process = token.rpartition("/")
        processes = self._processes.setdefault(name, set())
        before = bool(processes)
        if sample.kind == zenoh.SampleKind.PUT:
            processes.add(process)
        else:
            processes.discard(process)
        if not processes:
            del self._processes[name]
        if before != bool(processes):
            self._delivery.offer((name, bool(processes)))
        return True
