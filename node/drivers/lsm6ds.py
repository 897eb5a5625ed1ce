"""LSM6DS33 and LSM6DSO: accelerometer and gyroscope of the MinIMU-9 v5 and v6 (ST DocID027423, DS12140, AN5192).

Both have a FIFO that keeps some seconds of samples. Its samples carry the chip's time at most, so that FifoClock stamps
them.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np
from buddyline.node.drivers.fifo_clock import FifoClock
from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.samples import STANDARD_GRAVITY_MPS2, DeviceError, SettlingError, Vector
from buddyline.node.drivers.st_chip import StChip
from buddyline.node.drivers.watch import FULL_SCALE_COUNTS, SETTLING_NS, SensorWatch
from buddyline.protocol.clock import MS_NS, S_NS, Clock

OUT_TEMPERATURE: Final = 0x20
FIFO_STATUS: Final = 0x3A
FIFO_MODE: Final = 0x0A  # FIFO_CTRL5 of the LSM6DS33, FIFO_CTRL4 of the LSM6DSO
BYPASS: Final = 0x00

ACCEL_MPS2_PER_COUNT: Final = 0.122e-3 * STANDARD_GRAVITY_MPS2  # +-4 g
GYRO_RADPS_PER_COUNT: Final = math.radians(17.50e-3)  # +-500 deg/s

PERIOD_S: Final = 1 / 104
# Some 4 samples: each is at most 50 ms old when it is read, and the depth sensor has converted meanwhile.
TURN_NS: Final = 40 * MS_NS
# In one transfer: 28 ms at 100 kHz, within the bus's time-out.
AT_ONCE: Final = 20
TEMPERATURE_BYTES: Final = 2


def decode_temperature(data: bytes, counts_per_degc: float) -> float:
    """Return the chip's temperature in degrees C, of its first two bytes; 0 counts are 25 degrees."""
    return 25.0 + int.from_bytes(data[:TEMPERATURE_BYTES], "little", signed=True) / counts_per_degc


class Lsm6ds(StChip):
    """Both at 208 Hz, +-4 g and +-500 deg/s; every second sample of both is put into the FIFO.

    Subclasses say how the FIFO is set up, told and read. SETTINGS end with the one that starts it.
    """

    ADDRESSES = (0x6B, 0x6A)
    COUNTS_PER_DEGC: ClassVar[float]
    COMMON: ClassVar[tuple[tuple[int, int], ...]] = (
        (0x12, 0x44),  # CTRL3_C: no update between low and high byte, addresses advance in a burst
        (0x10, 0x58),  # CTRL1_XL: 208 Hz, +-4 g
        (0x11, 0x54),  # CTRL2_G: 208 Hz, +-500 deg/s
    )
    readings = 1
    turn_ns = TURN_NS

    def __init__(self, bus: I2cBus, address: int) -> None:
        super().__init__(bus, address)
        self._fifo_clock = FifoClock(PERIOD_S)
        self._heard = False
        self._due_ns = 0
        self._warm_ns = 0
        self._warmth = b""

    @property
    def watches(self) -> tuple[SensorWatch, SensorWatch]:
        """Return what judges accelerometer and gyroscope."""
        return (
            SensorWatch(f"{self.NAME} accelerometer", self, FULL_SCALE_COUNTS * ACCEL_MPS2_PER_COUNT),
            SensorWatch(f"{self.NAME} gyroscope", self, FULL_SCALE_COUNTS * GYRO_RADPS_PER_COUNT),
        )

    @property
    def chips(self) -> tuple[StChip, ...]:
        """Return the chips whose settings are to be checked."""
        return (self,)

    @property
    def lost(self) -> int:
        """Return how many samples are missing because the FIFO was read too late."""
        return self._fifo_clock.lost

    def start(self) -> None:
        """Check the identity, empty the FIFO, write the settings and read them back."""
        self.bus.write(self.address, FIFO_MODE, BYPASS)
        super().start()
        self._fifo_clock.restart()
        self._warmth = b""
        self._heard, self._due_ns = False, 0

    def wake_ns(self, instant_ns: int) -> int:
        """Return the instant near this one at which a reading tells most of the chip's clock."""
        return self._fifo_clock.wake_ns(instant_ns)

    def read_motion(self, clock: Clock) -> tuple[list[int], bytes]:
        """Return the stamps of the samples in the FIFO; and, as bytes, the temperature and the samples."""
        before_ns = clock.now_ns()
        count, full = self._level()
        after_ns = clock.now_ns()
        if full:
            self.bus.write(self.address, FIFO_MODE, BYPASS)
            self.bus.write(self.address, *self.SETTINGS[-1])
            self._fifo_clock.lose()
            count = 0
        if not count:
            self._judge_empty(after_ns)
            return [], b""
        self._heard, self._due_ns = True, 0
        if not self._warmth or not 0 <= after_ns - self._warm_ns < S_NS:
            self._warmth = self.bus.read(self.address, OUT_TEMPERATURE, TEMPERATURE_BYTES)
            self._warm_ns = after_ns
        data = [self._warmth]
        for begun in range(0, count, AT_ONCE):
            data.append(self._take(min(AT_ONCE, count - begun)))
        return self._fifo_clock.stamps_ns(count, before_ns, after_ns), b"".join(data)

    def decode(self, data: bytes) -> tuple[Vector, Vector, float]:
        """Return specific force in m/s2 and angular rate in rad/s, (n, 3) each, and the temperature in degrees C."""
        rows = np.frombuffer(data, "<i2", offset=TEMPERATURE_BYTES).reshape(-1, 6).astype(np.float64)
        degc = decode_temperature(data, self.COUNTS_PER_DEGC)
        return rows[:, 3:] * ACCEL_MPS2_PER_COUNT, rows[:, :3] * GYRO_RADPS_PER_COUNT, degc

    def _level(self) -> tuple[int, bool]:
        """Return how many samples are in the FIFO, and whether it has run over."""
        raise NotImplementedError

    def _take(self, count: int) -> bytes:
        """Take samples out of the FIFO: three counts of the gyroscope and three of the accelerometer each."""
        raise NotImplementedError

    def _judge_empty(self, now_ns: int) -> None:
        """Raise DeviceError unless a chip that is well has no sample yet, or no further one."""
        self.check_settings()
        if not self._due_ns:
            self._due_ns = now_ns + SETTLING_NS
        if not self._due_ns - SETTLING_NS <= now_ns < self._due_ns:
            raise self.bus.error(self.address, FIFO_STATUS, f"{self.NAME}: gives no samples: the chip has stopped")
        if not self._heard:
            raise SettlingError(f"{self.NAME}: starts, no reading yet")

    def _out_of_order(self, what: str) -> DeviceError:
        self.check_settings()
        return self.bus.error(self.address, FIFO_STATUS, f"{self.NAME}: its FIFO is out of order: {what}")


class Lsm6ds33(Lsm6ds):
    """The chip of the MinIMU-9 v5. Its FIFO has 16-bit words in a fixed order, six to a sample."""

    NAME = "LSM6DS33"
    IDENTITIES = (0x69,)
    COUNTS_PER_DEGC = 16.0
    SETTINGS = (
        *Lsm6ds.COMMON,
        (0x08, 0x09),  # FIFO_CTRL3: gyroscope and accelerometer, not decimated
        (FIFO_MODE, 0x26),  # FIFO_CTRL5: 104 Hz, continuous
    )

    def _level(self) -> tuple[int, bool]:
        status = self.bus.read(self.address, FIFO_STATUS, 4)
        place, full = status[2] | (status[3] & 0x03) << 8, bool(status[1] & 0x40)
        if place and not full:
            raise self._out_of_order(f"word {place} of a sample is the next")
        return (status[0] | (status[1] & 0x0F) << 8) // 6, full

    def _take(self, count: int) -> bytes:
        return self.bus.read(self.address, 0x3E, 12 * count)


class Lsm6dso(Lsm6ds):
    """The chip of the MinIMU-9 v6. Its FIFO has words of a tag and three counts, two to a sample."""

    NAME = "LSM6DSO"
    IDENTITIES = (0x6C,)
    COUNTS_PER_DEGC = 256.0
    SETTINGS = (
        *Lsm6ds.COMMON,
        (0x09, 0x44),  # FIFO_CTRL3: gyroscope and accelerometer at 104 Hz
        (FIFO_MODE, 0x06),  # FIFO_CTRL4: continuous
    )
    GYRO_TAG: ClassVar = 1  # the accelerometer's is 2

    def _level(self) -> tuple[int, bool]:
        status = self.bus.read(self.address, FIFO_STATUS, 2)
        return (status[0] | (status[1] & 0x03) << 8) // 2, bool(status[1] & 0x48)

    def _take(self, count: int) -> bytes:
        words = bytearray(self.bus.read(self.address, 0x78, 14 * count))
        tags = words[::7]
        del words[::7]
        for gyro, accel in zip(tags[::2], tags[1::2], strict=True):
            # The kinds, and an instant's number, which both have.
            if (gyro & 0xFE) ^ (accel & 0xFE) != 0x18 or gyro >> 3 != self.GYRO_TAG:
                raise self._out_of_order(f"tags {tags.hex(' ')}")
        return bytes(words)
