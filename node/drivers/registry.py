"""Sensors by name, and the search for those on the bus."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any, Final

import numpy as np
from buddyline.node.config import NodeConfig
from buddyline.node.drivers.ads1115 import Ads1115
from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.ina219 import Ina219
from buddyline.node.drivers.samples import DepthDevice, DeviceError, GaugeDevice, ImuDevice
from buddyline.protocol.clock import Clock, SystemClock
from buddyline.protocol.errors import BuddylineError
from numpy.typing import NDArray

AUTO: Final = "auto"
NONE: Final = "none"

IMUS: Final[Mapping[str, str]] = {
    "minimu9_v3": "buddyline.node.drivers.imu:MinImu9V3",
    "minimu9_v5": "buddyline.node.drivers.imu:MinImu9V5",
    "minimu9_v6": "buddyline.node.drivers.imu:MinImu9V6",
    "lsm6ds": "buddyline.node.drivers.imu:Lsm6dsOnlyBoard",
}

# `auto` never chooses a board without a magnetometer: one that does not answer would be taken for a missing one.
SEARCHED_IMUS: Final = ("minimu9_v3", "minimu9_v5", "minimu9_v6")

DEPTHS: Final[Mapping[str, tuple[str, str | None]]] = {
    AUTO: ("buddyline.node.drivers.ms5837:Ms5837", None),
    "ms5837_30ba": ("buddyline.node.drivers.ms5837:Ms5837", "30ba"),
    "ms5837_02ba": ("buddyline.node.drivers.ms5837:Ms5837", "02ba"),
}


def open_imu(
    bus: I2cBus,
    name: str = AUTO,
    R_body_chip: NDArray[np.float64] | None = None,
    clock: Clock | None = None,
) -> ImuDevice:
    """Open the IMU of that name, or the first of SEARCHED_IMUS that `auto` finds by identity.

    R_body_chip: (3, 3), maps the board's axes to the body's; default: identity.
    Raises DeviceError if no motion chip answers. A magnetometer may be absent (ImuDevice.problem names it).
    """
    _check_name("sensors.imu", name, (AUTO, *IMUS))
    bus.open()
    R = np.eye(3) if R_body_chip is None else R_body_chip
    candidates = SEARCHED_IMUS if name == AUTO else (name,)
    for candidate in candidates:
        device: Any = _load(IMUS[candidate]).find(candidate, bus, R, clock or SystemClock())
        if device is not None:
            device.start()
            found: ImuDevice = device
            return found
    raise DeviceError(
        f"I2C bus {bus.number}: no {' or '.join(candidates)} answers: "
        f"check power and wiring (i2cdetect -y {bus.number})"
    )


def open_depth(bus: I2cBus, name: str = AUTO, clock: Clock | None = None) -> DepthDevice:
    """Open the depth sensor of that name; `auto` reads the model from its PROM.

    Returns once the PROM has been read, after 10 ms. Raises DeviceError if it cannot be.
    """
    _check_name("sensors.depth", name, tuple(DEPTHS))
    target, model = DEPTHS[name]
    device: DepthDevice = _load(target).open(bus, model, clock or SystemClock())
    return device


def open_gauge(config: NodeConfig) -> tuple[I2cBus, GaugeDevice]:
    """Return the battery gauge of [power], not yet started, and the bus it is on, opened for it alone.

    Transfers of several users of one bus take turns in the kernel. Raises DeviceError if the bus cannot be opened.
    """
    power = config.power
    bus = I2cBus(config.sensors.i2c_bus)
    bus.open()
    if power.battery == "ina219":
        return bus, Ina219(bus, power.gauge_address, power.shunt_ohm)
    return bus, Ads1115(bus, power.gauge_address, power.channel, power.divider)


def check_names(imu: str, depth: str) -> None:
    """Raise BuddylineError for an unknown name; NONE leaves the sensor out."""
    _check_name("sensors.imu", imu, (AUTO, *IMUS, NONE))
    _check_name("sensors.depth", depth, (*DEPTHS, NONE))


def _check_name(kind: str, name: str, known: tuple[str, ...]) -> None:
    if name not in known:
        raise BuddylineError(f"{kind} = {name!r}: known are {', '.join(known)}")


def _load(target: str) -> Any:
    module, _, attribute = target.partition(":")
    return getattr(import_module(module), attribute)
