"""Power and heat of a running node: read once a second, judged, and answered by a lower load."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from buddyline.node.config import NodeConfig
from buddyline.node.drivers.health import DeviceHealth
from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.registry import open_gauge
from buddyline.node.drivers.samples import BatterySample, DeviceError, GaugeDevice
from buddyline.node.power.board import ROOT, Throttled, temperature_degc
from buddyline.node.power.load import WORDS, NodeLoad, next_load
from buddyline.protocol.clock import trigger_index
from buddyline.protocol.health import BATTERY_EMPTY_CELL_V, SLOWED_NOW, UNDERVOLTAGE_NOW

log = logging.getLogger(__name__)

EVERY_S: Final = 1.0
REOPEN_S: Final = 2.0


class BatteryGauge:
    """The configured gauge; one that is silent is named and tried again, and has no reading meanwhile."""

    def __init__(self, config: NodeConfig, opens: Callable[[], tuple[I2cBus, GaugeDevice]] | None = None) -> None:
        self.absent = config.power.battery == "none"
        self.sample: BatterySample | None = None
        self._opens = opens or (lambda: open_gauge(config))
        self._bus: I2cBus | None = None
        self._device: GaugeDevice | None = None
        self._health = DeviceHealth("battery")
        self._tried_s = float("-inf")

    @property
    def problem(self) -> str:
        """What is wrong with it; "" if nothing."""
        return self._health.problem

    def look(self, now_s: float) -> None:
        """Set the chip up if that is due, else take a reading."""
        if self.absent or (self._device is None and now_s - self._tried_s < REOPEN_S):
            return
        try:
            if self._device is None:
                self._tried_s = now_s
                self._bus, self._device = self._opens()
                self._device.start()
                # Its first conversion takes up to 136 ms; until then it would read 0 V.
                return
            self.sample = self._device.read()
        except DeviceError as error:
            self.sample = None
            self.close()
            self._health.update(str(error))
        else:
            self._health.update("")

    def close(self) -> None:
        """Free its bus."""
        bus, self._bus, self._device = self._bus, None, None
        if bus is not None:
            bus.close()


class PowerWatch:
    """Runs in a thread of its own. root: of the kernel's files."""

    def __init__(self, config: NodeConfig, gauge: BatteryGauge | None = None, root: Path = ROOT) -> None:
        self.gauge = gauge or BatteryGauge(config)
        self._cells = config.power.cells
        self._trigger_period_ns = config.trigger_period_ns
        # A computer that simulates, or reads stored pictures, is no node in a housing.
        self._lowers = config.power.lower_load and config.camera.name not in ("simulated", "stored")
        self._root = root
        self._throttled = Throttled(root)
        self._bits: int | None = None
        self._temperature_degc: float | None = None
        self._load = NodeLoad()

    @property
    def takes_pictures(self) -> bool:
        """Whether pictures are to be recorded and shown."""
        return self._load.level == "full"

    def skips(self, stamp_ns: int) -> bool:
        """Return whether the frame of this stamp is to be left out: two nodes at half their rate keep the same ones."""
        return self._load.level == "half_rate" and trigger_index(stamp_ns, self._trigger_period_ns) % 2 == 1

    def run(self, stop: threading.Event) -> None:
        """Look once a second until stop is set."""
        while True:
            self.look(time.monotonic())
            if stop.wait(EVERY_S):
                return

    def look(self, now_s: float) -> None:
        """Read everything once, and set the load by it."""
        self._temperature_degc = temperature_degc(self._root)
        self._bits = self._throttled.read()
        self.gauge.look(now_s)
        if self._lowers:
            before, self._load = self._load, next_load(self._load, self._temperature_degc, self._bits, now_s)
            if before.level != self._load.level:
                log.warning("load: %s -> %s", before.level, self._load.level)

    def status_fields(self) -> dict[str, Any]:
        """Return the fields of the node's status that are known."""
        battery, known = self.gauge.sample, {"temperature_degc": self._temperature_degc, "throttled_bits": self._bits}
        fields: dict[str, Any] = {name: value for name, value in known.items() if value is not None}
        if self._lowers:
            fields["load"] = self._load.level
        if battery is not None:
            fields["battery_v"] = battery.voltage_v
            if battery.current_a is not None:
                fields["battery_a"] = battery.current_a
            if self._cells is not None:
                fields["battery_cell_v"] = battery.voltage_v / self._cells
        return fields

    @property
    def problems(self) -> list[str]:
        """What is wrong and needs the diver to act, in words. What deserves a warning is judged in tools/health."""
        found, bits, fields = [], self._bits or 0, self.status_fields()
        if bits & UNDERVOLTAGE_NOW:
            found.append("power: undervoltage now")
        if bits & SLOWED_NOW:
            found.append("power: the processor is slowed down now")
        if self._load.level != "full":
            found.append(f"load: lowered because of heat or undervoltage: {WORDS[self._load.level]}")
        if self.gauge.problem:
            found.append(f"battery: {self.gauge.problem}")
        if "battery_cell_v" in fields and fields["battery_cell_v"] <= BATTERY_EMPTY_CELL_V:
            found.append("battery: empty")
        return found

    def close(self) -> None:
        """Free the gauge's bus."""
        self.gauge.close()
