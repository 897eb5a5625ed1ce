"""The panel's pins over gpiozero: each opened, and tried again, by itself."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from buddyline.node.config import PanelConfig
from buddyline.node.drivers.health import DeviceHealth

RETRY_S: Final = 2.0


class GpioPin:
    """One pin. A pin that cannot be opened, or fails, is named and tried again every two seconds.

    name: its field in [panel], without `_pin`. opens: makes its gpiozero device.
    """

    def __init__(self, name: str, number: int, opens: Callable[[int], Any]) -> None:
        self.name = name
        self._number = number
        self._opens = opens
        self._device: Any = None
        self._health = DeviceHealth(f"panel: {name}")
        self._tried_s: float | None = None
        self._value = False

    @property
    def problem(self) -> str:
        """What is wrong with it; "" if nothing."""
        return self._health.problem

    def read(self) -> bool | None:
        """Return whether an input is active; None where it cannot be read."""
        return self._use(lambda device: bool(device.value))

    def write(self, on: bool) -> None:
        """Switch an output."""
        if self._device is not None and on == self._value:
            return

        def switch(device: Any) -> bool:
            device.value = on
            return on

        if self._use(switch) is not None:
            self._value = on

    def _use(self, act: Callable[[Any], bool]) -> bool | None:
        if self._device is None and self._tried_s is not None and time.monotonic() - self._tried_s < RETRY_S:
            return None
        try:
            if self._device is None:
                self._tried_s = time.monotonic()
                self._device = self._opens(self._number)
            value = act(self._device)
        except ModuleNotFoundError as error:
            self._health.update(f"needs {error.name}: make install EXTRAS=pi")
        except ImportError:  # gpiozero's BadPinFactory; its warnings on stderr have the reasons
            self._health.update(
                f"GPIO {self._number}: cannot be reached: apt install python3-lgpio, and the group gpio"
            )
        except Exception as error:  # the back ends of gpiozero have errors of their own, such as lgpio.error
            self._drop()
            self._health.update(f"GPIO {self._number}: {error or type(error).__name__}")
        else:
            self._health.update("")
            return value
        return None

    def close(self) -> None:
        """Free the pin; an output is switched off first."""
        if self._value:
            self.write(False)
        self._drop()

    def _drop(self) -> None:
        device, self._device, self._value = self._device, None, False
        if device is not None:
            # A pin that has failed may fail again here, with an error of its back end.
            with contextlib.suppress(Exception):
                device.close()


def output(number: int, factory: Any = None) -> Any:
    """Open a pin as an output. factory: gpiozero's own by default."""
    from gpiozero import DigitalOutputDevice

    return DigitalOutputDevice(number, pin_factory=factory)


class PanelPins:
    """The pins that [panel] names; None for each of the others. factory: gpiozero's own by default."""

    def __init__(self, config: PanelConfig, factory: Any = None) -> None:
        def pin(name: str, number: int | None, opens: Callable[[int], Any]) -> GpioPin | None:
            return None if number is None else GpioPin(name, number, opens)

        def contact(number: int, *, pull_up: bool) -> Any:
            from gpiozero import DigitalInputDevice

            return DigitalInputDevice(number, pull_up=pull_up, pin_factory=factory)

        def switch(number: int) -> Any:
            return output(number, factory)

        self.button = pin("button", config.button_pin, partial(contact, pull_up=True))
        self.leak = pin("leak", config.leak_pin, partial(contact, pull_up=False))
        self.lamp = pin("lamp", config.lamp_pin, switch)
        self.buzzer = pin("buzzer", config.buzzer_pin, switch)
        self.lights = pin("lights", config.lights_pin, switch)
        self.all = [one for one in (self.button, self.leak, self.lamp, self.buzzer, self.lights) if one is not None]

    def close(self) -> None:
        """Free all pins."""
        for one in self.all:
            one.close()
