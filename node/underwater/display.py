"""A small display in the housing, over luma.oled: the words of the lamp's code, the node's figures and problems."""

from __future__ import annotations

import contextlib
import textwrap
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

from buddyline.node.config import PanelConfig
from buddyline.node.drivers.health import DeviceHealth

# Of luma's 128x64 points, in Pillow's own font.
LINES: Final = 5
CHARACTERS: Final = 21
# A picture takes a tenth of a second of a bus of 100 kHz, in transfers of 32 bytes between those of the sensors.
PERIOD_S: Final = 1.0
RETRY_S: Final = 2.0


class Display:
    """Shows lines of text, in a thread of its own. A display that fails is named and tried again every two seconds.

    opens: makes luma's device.
    """

    def __init__(self, config: PanelConfig, bus: int, opens: Callable[[PanelConfig, int], Any] | None = None) -> None:
        self._config = config
        self._bus = bus
        self._opens = opens or open_display
        self._device: Any = None
        self._wanted: list[str] = []
        self._drawn: list[str] | None = None
        self._health = DeviceHealth("panel: display")
        self._tried_s: float | None = None

    @property
    def lines(self) -> list[str]:
        """What is to be shown, the uppermost line first."""
        return self._wanted

    @property
    def problem(self) -> str:
        """What is wrong with it; "" if nothing."""
        return self._health.problem

    def show(self, paragraphs: Sequence[str]) -> None:
        """Take what is to be shown; what does not fit is left out."""
        self._wanted = [line for text in paragraphs for line in textwrap.wrap(text, CHARACTERS)][:LINES]

    def run(self, stop: threading.Event) -> None:
        """Draw what has changed until stop is set."""
        while not stop.wait(PERIOD_S):
            self.turn(time.monotonic())

    def turn(self, now_s: float) -> None:
        """Draw what has changed. now_s: of the monotonic clock."""
        lines = self._wanted
        if lines == self._drawn or (
            self._device is None and self._tried_s is not None and now_s - self._tried_s < RETRY_S
        ):
            return
        try:
            if self._device is None:
                self._tried_s = now_s
                self._device = self._opens(self._config, self._bus)
            draw(self._device, lines)
        except ModuleNotFoundError as error:
            self._health.update(f"needs {error.name}: make install EXTRAS=display")
        except Exception as error:  # luma has errors of its own, and those of smbus2 below it
            self.close()
            self._health.update(f"{self._config.display}: {error or type(error).__name__}")
        else:
            self._drawn = lines
            self._health.update("")

    def close(self) -> None:
        """Switch it off and free it."""
        device, self._device, self._drawn = self._device, None, None
        if device is not None:
            # A display that has failed may fail again here.
            with contextlib.suppress(Exception):
                device.cleanup()


def open_display(config: PanelConfig, bus: int) -> Any:
    """Return luma's device for the configured chip."""
    from luma.core.interface.serial import i2c
    from luma.oled import device

    return getattr(device, config.display)(i2c(port=bus, address=config.display_address))


def draw(device: Any, lines: Sequence[str]) -> None:
    """Draw lines of text, the uppermost first."""
    from luma.core.render import canvas

    with canvas(device) as picture:
        for i, line in enumerate(lines):
            picture.text((0, i * device.height // LINES), line, fill="white")
