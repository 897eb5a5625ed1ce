"""Inertial units as boards of one or more chips: body frame, recovery, and rejection of impossible readings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, Protocol, Self

import numpy as np
from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.l3gd20h import GYRO_RADPS_PER_COUNT, L3gd20h, decode_gyro, decode_temperature
from buddyline.node.drivers.lis3mdl import Lis3mdl
from buddyline.node.drivers.lis3mdl import decode_mag as decode_lis3mdl
from buddyline.node.drivers.lsm6ds import Lsm6ds, Lsm6ds33, Lsm6dso
from buddyline.node.drivers.lsm303d import ACCEL_MPS2_PER_COUNT, Lsm303d, decode_accel
from buddyline.node.drivers.samples import DeviceError, ImuReading, ImuSample, SettlingError, Vector
from buddyline.node.drivers.st_chip import WHO_AM_I, StChip
from buddyline.node.drivers.watch import FROZEN_READINGS, FULL_SCALE_COUNTS, SensorWatch, SettingsWatch
from buddyline.protocol.clock import MS_NS, S_NS, Clock
from buddyline.protocol.errors import BuddylineError
from numpy.typing import NDArray

MAG_RETRY_NS: Final = S_NS
# The status, sent once a second, must not miss what lasts for one sample.
SHOWN_NS: Final = 2 * S_NS


class MotionSensor(Protocol):
    """Accelerometer and gyroscope, in the board's frame.

    chips: whose settings are to be checked. watches: what judges the accelerometer and the gyroscope. turn_ns,
    readings: as of an ImuDevice. lost: samples that are missing because they were read too late.
    """

    @property
    def chips(self) -> tuple[StChip, ...]: ...  # noqa: D102

    @property
    def watches(self) -> tuple[SensorWatch, SensorWatch]: ...  # noqa: D102

    @property
    def turn_ns(self) -> int: ...  # noqa: D102

    @property
    def readings(self) -> int: ...  # noqa: D102

    @property
    def lost(self) -> int: ...  # noqa: D102

    def start(self) -> None:
        """Check the identities and write the settings."""
        ...

    def wake_ns(self, instant_ns: int) -> int:
        """Return the best instant for a reading near this one."""
        ...

    def read_motion(self, clock: Clock) -> tuple[list[int], bytes]:
        """Return the stamps of the samples since the last reading, and the samples for `decode`."""
        ...

    def decode(self, data: bytes) -> tuple[Vector, Vector, float]:
        """Return specific force in m/s2 and angular rate in rad/s, (n, 3) each, and the gyroscope's degrees C."""
        ...


class Magnetometer(Protocol):
    """Magnetometer, in the board's frame."""

    def start(self) -> None:
        """Check the identity and write the settings."""
        ...

    def read_mag(self) -> bytes:
        """Return the newest reading, for `decode_mag`."""
        ...

    def decode_mag(self, data: bytes) -> Vector:
        """Return the magnetic field in T, (1, 3)."""
        ...


class MotionChipPair:
    """LSM303D and L3GD20H, the motion chips of the MinIMU-9 v3; their axes are parallel on the board.

    Their FIFOs are not used: each has a clock of its own, and is said to give a sample twice where it is emptied.
    """

    turn_ns = 10 * MS_NS
    # 50 ms: no later than the picture of the same instant has been read out and searched.
    readings = 5
    lost = 0

    def __init__(self, lsm303d: Lsm303d, l3gd20h: L3gd20h) -> None:
        self._lsm303d = lsm303d
        self._l3gd20h = l3gd20h
        self.chips: tuple[StChip, ...] = (lsm303d, l3gd20h)
        self.watches = (
            SensorWatch("LSM303D accelerometer", lsm303d, FULL_SCALE_COUNTS * ACCEL_MPS2_PER_COUNT),
            SensorWatch("L3GD20H gyroscope", l3gd20h, FULL_SCALE_COUNTS * GYRO_RADPS_PER_COUNT),
        )

    def start(self) -> None:
        """Check the identities and write the settings."""
        self._lsm303d.start()
        self._l3gd20h.start()

    def wake_ns(self, instant_ns: int) -> int:
        """Return the instant: any is as good."""
        return instant_ns

    def read_motion(self, clock: Clock) -> tuple[list[int], bytes]:
        """Return now, six bytes of the accelerometer and eight of the gyroscope."""
        stamp_ns = clock.now_ns()
        return [stamp_ns], self._lsm303d.read_accel() + self._l3gd20h.read_gyro()

    def decode(self, data: bytes) -> tuple[Vector, Vector, float]:
        """Return specific force in m/s2 and angular rate in rad/s, (1, 3) each, and the gyroscope's degrees C."""
        return decode_accel(data[:6]), decode_gyro(data[8:]), decode_temperature(data[6:])


class SoughtLis3mdl:
    """A LIS3MDL that is searched for at each start, because it may be absent when the node starts."""

    def __init__(self, bus: I2cBus) -> None:
        self._bus = bus
        self._chip: Lis3mdl | None = None

    def start(self) -> None:
        """Find the chip and write its settings; raise DeviceError if it does not answer."""
        self._chip = self._chip or Lis3mdl.find(self._bus)
        if self._chip is None:
            raise self._bus.error(
                Lis3mdl.ADDRESSES[0],
                WHO_AM_I,
                f"no magnetometer ({Lis3mdl.NAME}) answers: no heading; has the board none, set sensors.imu = 'lsm6ds'",
            )
        self._chip.start()

    def read_mag(self) -> bytes:
        """Return the newest reading, for `decode_mag`."""
        if self._chip is None:
            raise self._bus.error(Lis3mdl.ADDRESSES[0], WHO_AM_I, f"{Lis3mdl.NAME}: not started")
        return self._chip.read_mag()

    def decode_mag(self, data: bytes) -> Vector:
        """Return the magnetic field in T, (1, 3)."""
        return decode_lis3mdl(data)


class ImuBoard:
    """The chips of one board as one device in the body frame.

    R_body_chip: (3, 3), maps the board's axes to the body's (x forward, y right, z down). After any failure
    the chips are identified and set up again before the next reading counts, because a chip sleeps after a
    brown-out. Control registers are read back once a second, and at once where a sensor reads zero. The magnetometer is
    read for the last sample of a reading. One that fails, stands still, or is absent at the start, is named in
    `problem` and tried again once a second; samples continue.
    """

    def __init__(
        self,
        name: str,
        motion: MotionSensor,
        magnetometer: Magnetometer | None,
        R_body_chip: NDArray[np.float64],
        clock: Clock,
    ) -> None:
        self.name = name
        self._mag_problem = ""
        self._passing: dict[str, tuple[str, int]] = {}
        self._lost = 0
        self._told_ns = 0
        self._motion = motion
        self._accel_watch, self._gyro_watch = motion.watches
        self._settings = SettingsWatch(motion.chips)
        self._magnetometer = magnetometer
        self._R_body_chip = check_rotation(R_body_chip)
        self._clock = clock
        self._motion_ready = False
        self._mag_ready = False
        self._mag_retry_ns = 0
        self._last_mag, self._mag_repeats = b"", 0

    @property
    def problem(self) -> str:
        """What is wrong although samples come; "" if nothing."""
        return "; ".join(filter(None, (self._mag_problem, *(text for text, _ in self._passing.values()))))

    @property
    def turn_ns(self) -> int:
        """The time between two readings."""
        return self._motion.turn_ns

    @property
    def readings(self) -> int:
        """How many readings are decoded together."""
        return self._motion.readings

    def wake_ns(self, instant_ns: int) -> int:
        """Return the best instant for a reading near this one."""
        return self._motion.wake_ns(instant_ns)

    def start(self) -> None:
        """Check and set up the chips; raise DeviceError without a motion chip, report a missing magnetometer."""
        self._start_motion()
        if self._magnetometer is not None:
            try:
                self._magnetometer.start()
                self._mag_ready = True
            except DeviceError as error:
                self._lose_mag(self._clock.now_ns(), error)

    def _start_motion(self) -> None:
        self._motion.start()
        self._motion_ready = True
        now_ns = self._clock.now_ns()
        self._accel_watch.restart(now_ns)
        self._gyro_watch.restart(now_ns)

    def fetch(self) -> ImuReading:
        """Read the chips; raise DeviceError if they do not answer. The next call tries again."""
        try:
            if not self._motion_ready:
                self._start_motion()
            read_ns = self._clock.now_ns()
            stamps_ns, motion = self._motion.read_motion(self._clock)
            self._settings.look(read_ns)
        except SettlingError:
            raise
        except DeviceError:
            self._lose_motion()
            raise
        self._note_lost(read_ns)
        return ImuReading(stamps_ns, motion, self._read_mag(read_ns) if stamps_ns else None)

    def decode(self, reading: ImuReading) -> Iterator[ImuSample]:
        """Give the samples of a reading, in their order; raise DeviceError at one that the chips did not measure."""
        if not reading.stamps_ns:
            return
        accel_mps2, gyro_radps, temperature_degc = self._motion.decode(reading.motion)
        turned = self._R_body_chip.T
        forces, rates = accel_mps2 @ turned, gyro_radps @ turned
        last = len(reading.stamps_ns) - 1
        for i, stamp_ns in enumerate(reading.stamps_ns):
            try:
                accel_full = self._accel_watch.is_saturated(accel_mps2[i], stamp_ns)
                gyro_full = self._gyro_watch.is_saturated(gyro_radps[i], stamp_ns)
            except SettlingError:
                raise
            except DeviceError:
                self._lose_motion()
                raise
            self._note_saturation(accel_full, gyro_full, stamp_ns)
            mag_t = None
            if i == last and self._magnetometer is not None and reading.mag is not None:
                mag_t = (self._magnetometer.decode_mag(reading.mag) @ turned)[0]
            told_degc = self._told(temperature_degc, stamp_ns)
            yield ImuSample(stamp_ns, forces[i], rates[i], mag_t, accel_full or gyro_full, told_degc)

    def _told(self, temperature_degc: float, now_ns: int) -> float | None:
        """Return the temperature once a second, else None: it changes slowly."""
        if 0 <= now_ns - self._told_ns < S_NS:
            return None
        self._told_ns = now_ns
        return round(temperature_degc, 2)

    def _lose_motion(self) -> None:
        # The cause may have reset the board's other chips as well.
        self._motion_ready = self._mag_ready = False
        self._mag_retry_ns = 0

    def _note_saturation(self, accel_full: bool, gyro_full: bool, now_ns: int) -> None:
        if accel_full or gyro_full:
            names = ["accelerometer"] * accel_full + ["gyroscope"] * gyro_full
            self._passing["saturated"] = f"{' and '.join(names)} at full scale", now_ns
        elif self._passing:
            self._passing = {key: one for key, one in self._passing.items() if abs(now_ns - one[1]) < SHOWN_NS}

    def _note_lost(self, now_ns: int) -> None:
        if self._motion.lost != self._lost:
            self._lost = self._motion.lost
            self._passing["lost"] = f"read too late: {self._lost} samples lost so far", now_ns

    def _read_mag(self, now_ns: int) -> bytes | None:
        waiting = self._mag_retry_ns - MAG_RETRY_NS <= now_ns < self._mag_retry_ns
        if self._magnetometer is None or (not self._mag_ready and waiting):
            return None
        try:
            if not self._mag_ready:
                self._magnetometer.start()
                self._mag_ready = True
            data = self._magnetometer.read_mag()
            if not any(data):
                raise DeviceError(f"{self.name}: the magnetometer reads zero on all axes")
            self._mag_repeats = self._mag_repeats + 1 if data == self._last_mag else 0
            self._last_mag = data
            if self._mag_repeats >= FROZEN_READINGS:
                raise DeviceError(
                    f"{self.name}: the magnetometer gives the same reading again and again: it has stopped"
                )
        except DeviceError as error:
            self._lose_mag(now_ns, error)
            return None
        self._mag_problem = ""
        return data

    def _lose_mag(self, now_ns: int, error: DeviceError) -> None:
        self._mag_ready = False
        self._mag_retry_ns = now_ns + MAG_RETRY_NS
        self._mag_problem = str(error)


class MinImu9V3(ImuBoard):
    """Pololu MinIMU-9 v3: LSM303D and L3GD20H."""

    @classmethod
    def find(cls, name: str, bus: I2cBus, R_body_chip: NDArray[np.float64], clock: Clock) -> Self | None:
        """Return the unit if both chips answer, else None."""
        lsm303d, l3gd20h = Lsm303d.find(bus), L3gd20h.find(bus)
        if lsm303d is None or l3gd20h is None:
            return None
        return cls(name, MotionChipPair(lsm303d, l3gd20h), lsm303d, R_body_chip, clock)


class Lsm6dsBoard(ImuBoard):
    """A board with an LSM6DS chip, and with a LIS3MDL where MAGNETOMETER is set."""

    CHIPS: tuple[type[Lsm6ds], ...] = ()
    MAGNETOMETER = True

    @classmethod
    def find(cls, name: str, bus: I2cBus, R_body_chip: NDArray[np.float64], clock: Clock) -> Self | None:
        """Return the unit where its motion chip answers, else None; the magnetometer may answer later."""
        motion = next(filter(None, (chip.find(bus) for chip in cls.CHIPS)), None)
        if motion is None:
            return None
        return cls(name, motion, SoughtLis3mdl(bus) if cls.MAGNETOMETER else None, R_body_chip, clock)


class MinImu9V5(Lsm6dsBoard):
    """Pololu MinIMU-9 v5: LSM6DS33 and LIS3MDL."""

    CHIPS = (Lsm6ds33,)


class MinImu9V6(Lsm6dsBoard):
    """Pololu MinIMU-9 v6, and other boards with an LSM6DSO and a LIS3MDL on parallel axes."""

    CHIPS = (Lsm6dso,)


class Lsm6dsOnlyBoard(Lsm6dsBoard):
    """A board with an LSM6DS33 or LSM6DSO and no magnetometer: no heading."""

    CHIPS = (Lsm6ds33, Lsm6dso)
    MAGNETOMETER = False


def check_rotation(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R, (3, 3); raise BuddylineError if it is not a right-handed rotation."""
    matrix = np.asarray(R, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
        raise BuddylineError("mount of the IMU: not a rotation (orthonormal, right-handed)")
    return matrix
