"""A node's connection to the hub: tried until it works, and kept until the node stops."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from buddyline.node.clock_sync import ClockSync
from buddyline.node.config import NodeConfig
from buddyline.node.guide import Guide
from buddyline.node.log_desk import LogDesk
from buddyline.node.outlet import Outlet
from buddyline.protocol.clock import Clock
from buddyline.protocol.config import ConfigError
from buddyline.protocol.security import RefusedError, SecurityError, check_identity, node_name
from buddyline.protocol.topics import EXPECT, LOG, MARK

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, Received

log = logging.getLogger(__name__)

REFUSED_RETRY_S: Final = 5.0


class HubConnection:
    """Runs in a thread of its own, while the node records anyway.

    guide: takes the solver's expectations; None: they are not used. hear_mark: takes the marks of this node.
    """

    def __init__(
        self,
        config: NodeConfig,
        outlet: Outlet,
        clock: Clock,
        clock_sync: ClockSync,
        guide: Guide | None,
        hear_mark: Callable[[Received], None],
    ) -> None:
        self._refusal = ""
        self._bus: Bus | None = None
        self._clock = clock
        self._config = config
        self._outlet = outlet
        self._clock_sync = clock_sync
        self._guide = guide
        self._desk = LogDesk(Path(config.record.directory), config.node)
        self._hear_mark = hear_mark

    @property
    def problem(self) -> str:
        """Why hub and node do not accept each other, or what a slow link leaves out; "" if nothing."""
        return self._refusal or (self._bus.link_problem() if self._bus is not None else "")

    @property
    def shed(self) -> dict[str, int]:
        """How many messages of each topic a slow link has left out; the log has them."""
        return self._bus.shed if self._bus is not None else {}

    def run(self, stop: threading.Event, on_failure: Callable[[BaseException], None]) -> None:
        """Connect, and stay connected until stop is set. on_failure: takes an error of the bus's own threads.

        Raises ConfigError if another node has this node's id.
        """
        config = self._config
        bus = self._open(stop)
        if bus is None:
            return
        with bus:
            bus.on_failure(on_failure)
            if bus.is_alive(f"node/{config.node}"):
                raise ConfigError(
                    f"another node with the id {config.node!r} is on the bus at {config.connect}; "
                    "give each its own `node`"
                )
            bus.declare_alive(f"node/{config.node}")
            self._outlet.connect(bus)
            self._bus = bus
            log.info("node %s: connected to %s", config.node, config.connect)
            if self._guide is not None:
                # Without history: an old expectation says nothing of the next picture.
                bus.subscribe(EXPECT.key(config.node), self._guide.hear, history=False)
                bus.watch_alive(self._guide.saw_process)
            bus.subscribe(MARK.key(config.node), self._hear_mark, history=False)
            self._clock_sync.listen(bus)
            bus.answer(LOG.format(node=config.node), self._desk.answer)
            stop.wait()
            self._outlet.disconnect()

    def _open(self, stop: threading.Event) -> Bus | None:
        """Return the open bus; None once stop is set. A refusal may be mended at the hub, so it is tried again."""
        from buddyline.protocol.zenoh_bus import connect

        config = self._config
        while not stop.is_set():
            try:
                if config.tls is not None:
                    check_identity(config.tls, node_name(config.node))
                bus = connect(
                    config.connect,
                    namespace=config.namespace or None,
                    clock=self._clock,
                    stop=stop,
                    on_wait=lambda text: log.info("node %s: %s; recording meanwhile", config.node, text),
                    tls=config.tls,
                )
            except (SecurityError, RefusedError) as error:
                if self._refusal != str(error):
                    log.error("node %s: not on the bus: %s; recording meanwhile", config.node, error)
                self._refusal = str(error)
                stop.wait(REFUSED_RETRY_S)
            else:
                self._refusal = ""
                return bus
        return None
