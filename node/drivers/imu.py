"""One inertial unit made of several chips: body frame, recovery, and rejection of impossible readings."""

from __future__ import annotations

from typing import Final, Protocol, Self

import numpy as np
from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.l3gd20h import L3gd20h
from buddyline.node.drivers.lis3mdl import Lis3mdl
from buddyline.node.drivers.lsm6ds import Lsm6ds, Lsm6ds33, Lsm6dso
from buddyline.node.drivers.lsm303d import Lsm303d
from buddyline.node.drivers.samples import DeviceError, ImuSample, Vector
from buddyline.node.drivers.st_chip import WHO_AM_I
from buddyline.protocol.clock import S_NS, Clock
from buddyline.protocol.errors import BuddylineError
from numpy.typing import NDArray

# Noise always moves the last bits. A few readings may repeat while the chip is slower than the loop;
# ten in a row mean that the chip has stopped, as after a brown-out.
FROZEN_READINGS: Final = 10
MAG_RETRY_NS: Final = S_NS


class MotionSensor(Protocol):
    """Accelerometer and gyroscope, in the board's frame."""

    def start(self) -> None:
        """Check the identities and write the settings."""
        ...

    def read_motion(self) -> tuple[Vector, Vector]:
        """Return specific force in m/s2 and angular rate in rad/s, (3,) each."""
        ...


class Magnetometer(Protocol):
    """Magnetometer, in the board's frame."""

    def start(self) -> None:
        """Check the identity and write the settings."""
        ...

    def read_mag(self) -> Vector:
        """Return the magnetic field in T, (3,)."""
        ...


class Lsm303dL3gd20h:
    """The two motion chips of the MinIMU-9 v3; their axes are parallel on the board."""

    def __init__(self, lsm303d: Lsm303d, l3gd20h: L3gd20h) -> None:
        self._lsm303d = lsm303d
        self._l3gd20h = l3gd20h

    def start(self) -> None:
        """Check the identities and write the settings."""
        self._lsm303d.start()
        self._l3gd20h.start()

    def read_motion(self) -> tuple[Vector, Vector]:
        """Return specific force in m/s2 and angular rate in rad/s, (3,) each."""
        return self._lsm303d.read_accel(), self._l3gd20h.read_gyro()


class SoughtLis3mdl:
    """A LIS3MDL that is searched for at each start, because it may be absent when the node starts."""

    def __init__(self, bus: I2cBus) -> None:
        self._bus = bus
        self._chip: Lis3mdl | None = None

    def start(self) -> None:
        """Find the chip and write its settings; raise DeviceError where it does not answer."""
        self._chip = self._chip or Lis3mdl.find(self._bus)
        if self._chip is None:
            raise self._bus.error(
                Lis3mdl.ADDRESSES[0],
                WHO_AM_I,
                f"no magnetometer ({Lis3mdl.NAME}) answers: no heading; has the board none, set sensors.imu = 'lsm6ds'",
            )
        self._chip.start()

    def read_mag(self) -> Vector:
        """Return the magnetic field in T, (3,)."""
        if self._chip is None:
            raise self._bus.error(Lis3mdl.ADDRESSES[0], WHO_AM_I, f"{Lis3mdl.NAME}: not started")
        return self._chip.read_mag()


class ChipImu:
    """Several chips as one device in the body frame.

    R_body_chip: (3, 3), maps the board's axes to the body's (x forward, y right, z down). After any failure
    the chips are identified and set up again before the next reading counts, because a chip sleeps after a
    brown-out. A magnetometer that fails, or is absent at the start, is named in `problem` and tried again once a
    second; motion goes on without it.
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
        self.problem = ""
        self._motion = motion
        self._magnetometer = magnetometer
        self._R_body_chip = check_rotation(R_body_chip)
        self._clock = clock
        self._motion_ready = False
        self._mag_ready = False
        self._mag_retry_ns = 0
        self._last = np.full(6, np.nan)
        self._repeats = 0

    def start(self) -> None:
        """Check and set up the chips; raise DeviceError where motion is absent, name an absent magnetometer."""
        self._motion.start()
        self._motion_ready = True
        if self._magnetometer is not None:
            try:
                self._magnetometer.start()
                self._mag_ready = True
            except DeviceError as error:
                self._lose_mag(self._clock.now_ns(), error)

    def read(self) -> ImuSample:
        """Return the newest sample; raise DeviceError where there is none. The next call tries again."""
        try:
            if not self._motion_ready:
                self._motion.start()
                self._motion_ready = True
            stamp_ns = self._clock.now_ns()
            accel_mps2, gyro_radps = self._motion.read_motion()
            self._check_alive(np.concatenate((accel_mps2, gyro_radps)))
        except DeviceError:
            # The cause may have reset the board's other chips as well.
            self._motion_ready = self._mag_ready = False
            self._mag_retry_ns = 0
            raise
        mag_t = self._read_mag(stamp_ns)
        R = self._R_body_chip
        return ImuSample(stamp_ns, R @ accel_mps2, R @ gyro_radps, None if mag_t is None else R @ mag_t)

    def _check_alive(self, reading: NDArray[np.float64]) -> None:
        if not reading.any():
            raise DeviceError(f"{self.name}: all six axes read zero: the chip sleeps or SDA is held down")
        self._repeats = self._repeats + 1 if np.array_equal(reading, self._last) else 0
        self._last = reading
        if self._repeats >= FROZEN_READINGS:
            self._repeats = 0
            raise DeviceError(f"{self.name}: the same reading {FROZEN_READINGS} times over: the chip has stopped")

    def _read_mag(self, now_ns: int) -> Vector | None:
        waiting = self._mag_retry_ns - MAG_RETRY_NS <= now_ns < self._mag_retry_ns
        if self._magnetometer is None or (not self._mag_ready and waiting):
            return None
        try:
            if not self._mag_ready:
                self._magnetometer.start()
                self._mag_ready = True
            mag_t = self._magnetometer.read_mag()
            if not mag_t.any():
                raise DeviceError(f"{self.name}: the magnetometer reads zero on all axes")
        except DeviceError as error:
            self._lose_mag(now_ns, error)
            return None
        self.problem = ""
        return mag_t

    def _lose_mag(self, now_ns: int, error: DeviceError) -> None:
        self._mag_ready = False
        self._mag_retry_ns = now_ns + MAG_RETRY_NS
        self.problem = str(error)


class MinImu9V3(ChipImu):
    """Pololu MinIMU-9 v3: LSM303D and L3GD20H."""

    @classmethod
    def find(cls, name: str, bus: I2cBus, R_body_chip: NDArray[np.float64], clock: Clock) -> Self | None:
        """Return the unit where both chips answer, else None."""
        lsm303d, l3gd20h = Lsm303d.find(bus), L3gd20h.find(bus)
        if lsm303d is None or l3gd20h is None:
            return None
        return cls(name, Lsm303dL3gd20h(lsm303d, l3gd20h), lsm303d, R_body_chip, clock)


class Lsm6dsImu(ChipImu):
    """An LSM6DS chip, with a LIS3MDL beside it where MAGNETOMETER is set."""

    CHIP: type[Lsm6ds] = Lsm6ds
    MAGNETOMETER = True

    @classmethod
    def find(cls, name: str, bus: I2cBus, R_body_chip: NDArray[np.float64], clock: Clock) -> Self | None:
        """Return the unit where its motion chip answers, else None; the magnetometer may answer later."""
        motion = cls.CHIP.find(bus)
        if motion is None:
            return None
        return cls(name, motion, SoughtLis3mdl(bus) if cls.MAGNETOMETER else None, R_body_chip, clock)


class MinImu9V5(Lsm6dsImu):
    """Pololu MinIMU-9 v5: LSM6DS33 and LIS3MDL."""

    CHIP = Lsm6ds33


class MinImu9V6(Lsm6dsImu):
    """Pololu MinIMU-9 v6, and other boards with an LSM6DSO and a LIS3MDL on parallel axes."""

    CHIP = Lsm6dso


class Lsm6dsAlone(Lsm6dsImu):
    """An LSM6DS33 or LSM6DSO without a magnetometer: no heading."""

    MAGNETOMETER = False


def check_rotation(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R, (3, 3); raise BuddylineError where it is not a right-handed rotation."""
    matrix = np.asarray(R, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
        raise BuddylineError("mount of the IMU: not a rotation (orthonormal, right-handed)")
    return matrix
