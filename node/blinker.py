"""Switches a node's lamp by its code, at the borders between the trigger clock's slots."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from buddyline.node.config import BlinkConfig
from buddyline.node.underwater.pins import GpioPin, output
from buddyline.protocol.blinking import lit, next_slot_ns
from buddyline.protocol.clock import Clock
from buddyline.protocol.messages import Blink


class Blinker:
    """Runs in a thread of its own. shines: whether the diver wants light. factory: gpiozero's own by default."""

    def __init__(
        self, config: BlinkConfig, slot_ns: int, clock: Clock, shines: Callable[[], bool], factory: Any = None
    ) -> None:
        self._blink = Blink(code=config.code, lamp=config.lamp, slot_ns=slot_ns)
        self._clock = clock
        self._shines = shines
        self._pin = GpioPin("blink", config.pin, lambda number: output(number, factory))

    @property
    def problem(self) -> str:
        """What is wrong with the pin; "" if nothing."""
        return self._pin.problem

    def run(self, stop: threading.Event) -> None:
        """Switch the lamp until stop is set."""
        while True:
            # The clock may have been set since the last slot.
            now_ns = self._clock.now_ns()
            self.switch(now_ns)
            if self._clock.wait_until_ns(next_slot_ns(self._blink, now_ns), stop):
                return

    def switch(self, now_ns: int) -> None:
        """Set the lamp as it is to be in the slot of this instant."""
        # `lit` calls a lamp that does not blink lit. So all are lit when the one that blinks is lit.
        self._pin.write(self._shines() and all(lit(self._blink, now_ns)))

    def close(self) -> None:
        """Free the pin: the lamp goes out."""
        self._pin.close()
