"""An I2C bus whose chips answer from memory: a MinIMU-9 v6 at rest, with noise, and a Bar30 in air.

The drivers and smbus2's messages above it are a node's own. The kernel's transfer is replaced, and takes no time.
"""

from __future__ import annotations

import ctypes
import time
from typing import Any, Final

import numpy as np
from buddyline.node.drivers.i2c import I2cBus

MOTION, COMPASS, PRESSURE = 0x6B, 0x1E, 0x76
# The counts of a unit at rest, as words of the FIFO with their tags, and of the compass.
ACCEL_COUNTS: Final = (0, 0, -8192)
COMPASS_COUNTS: Final = (1500, 0, 3000)
FIFO_LEVEL, FIFO_DATA, COMPASS_DATA = 0x3A, 0x78, 0xA8
PERIOD_NS: Final = 1_000_000_000 // 104
IDENTITIES: Final = {MOTION: 0x6C, COMPASS: 0x3D}
WHO_AM_I: Final = 0x0F
BURSTS: Final = 1000
NOISE_COUNTS: Final = 4
# Coefficients and temperature of the data sheet's example (MS5837-30BA); the pressure is 1013 mbar.
PROM: Final = (0x9340, 34982, 36352, 20328, 22354, 26646, 26146)
PRESSURE_COUNTS: Final = 4_510_350
TEMPERATURE_COUNTS: Final = 6_815_414


class PreparedBus(I2cBus):
    """Opens the chips in memory in place of an adapter."""

    def _open(self) -> Any:
        return _Chips()


class _Chips:
    """The part of smbus2's SMBus that a bus uses."""

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self._registers: dict[tuple[int, int], int] = {}
        noise = rng.integers(-NOISE_COUNTS, NOISE_COUNTS + 1, (BURSTS, 9))
        rows = (noise + np.array((0, 0, 0, *ACCEL_COUNTS, *COMPASS_COUNTS))).astype("<i2")
        self._samples = [b"\x08" + row[:3].tobytes() + b"\x10" + row[3:6].tobytes() for row in rows]
        self._fields: list[bytes] = [row[6:].tobytes() for row in rows]
        self._number = 0
        self._taken_ns = time.monotonic_ns()
        self._command = 0

    def i2c_rdwr(self, request: Any, reply: Any = None) -> None:
        """Take what is written; fill the reply."""
        data = ctypes.string_at(request.buf, request.len)
        if request.addr == PRESSURE:
            if reply is None and data[0] >> 4 in (4, 5):
                self._command = data[0]
        elif reply is None:
            self._registers[request.addr, data[0]] = data[1]
        if reply is not None:
            ctypes.memmove(reply.buf, self._answer(request.addr, data[0], reply.len), reply.len)

    def close(self) -> None:
        """Nothing to free."""

    def _answer(self, address: int, register: int, count: int) -> bytes:
        if address == PRESSURE:
            if register:
                return PROM[(register - 0xA0) // 2].to_bytes(2, "big")
            return (PRESSURE_COUNTS if self._command < 0x50 else TEMPERATURE_COUNTS).to_bytes(3, "big")
        if address == MOTION and register == FIFO_LEVEL:
            words = min(2 * ((time.monotonic_ns() - self._taken_ns) // PERIOD_NS), 255)
            return bytes([words, 0])
        if address == MOTION and register == FIFO_DATA:
            samples = count // 14
            self._taken_ns += samples * PERIOD_NS
            self._number += samples
            return b"".join(self._samples[(self._number + i) % BURSTS] for i in range(samples))
        if address == COMPASS and register == COMPASS_DATA:
            self._number += 1
            return self._fields[self._number % BURSTS]
        if register == WHO_AM_I and address in IDENTITIES:
            return bytes([IDENTITIES[address]])
        return bytes([self._registers.get((address, register), 0)] * count)
