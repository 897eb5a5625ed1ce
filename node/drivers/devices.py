"""Chips on the I2C bus as a node's sensors: one bus, one thread, and recovery from chips that fail."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final, Generic, TypeVar

import numpy as np
from buddyline.node.attitude import AttitudeEstimator, quaternion_to_matrix
from buddyline.node.attitude_again import attitude_estimator
from buddyline.node.config import NodeConfig
from buddyline.node.drivers.depth import SurfaceZero, depth_m, load_zero, save_zero
from buddyline.node.drivers.health import DeviceHealth
from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.registry import NONE, check_names, open_depth, open_imu
from buddyline.node.drivers.samples import (
    DepthDevice,
    DepthSample,
    DeviceError,
    ImuDevice,
    ImuReading,
    ImuSample,
    SettlingError,
    Vector,
)
from buddyline.protocol.clock import MS_NS, S_NS, Clock
from buddyline.protocol.messages import Depth, Imu, Message, Vector3
from msgspec import UNSET

log = logging.getLogger(__name__)

# Without an inertial unit.
TURN_NS: Final = 10 * MS_NS
ATTITUDE_EVERY: Final = 2
REOPEN_NS: Final = 2 * S_NS

D = TypeVar("D", ImuDevice, DepthDevice)


class Metronome:
    """Keeps a loop at its period, also if its clock is set meanwhile."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._next_ns = clock.now_ns()

    def wait(self, stop: threading.Event, period_ns: int, wake_ns: Callable[[int], int] = lambda at_ns: at_ns) -> bool:
        """Wait for the next turn, hardly more than a period; return True if stop is set.

        wake_ns: chooses an instant near it, at most an eighth of the period away.
        """
        now_ns = self._clock.now_ns()
        self._next_ns += period_ns
        if not now_ns <= self._next_ns <= now_ns + period_ns + period_ns // 8:
            self._next_ns = now_ns + period_ns
        return self._clock.wait_until_ns(wake_ns(self._next_ns), stop)


class Opener(Generic[D]):
    """Opens a device at its first use. One that cannot be opened is tried again every REOPEN_NS."""

    def __init__(self, open_device: Callable[[], D], clock: Clock) -> None:
        self._open: Callable[[], D] = open_device
        self._clock = clock
        self._tried_ns = -REOPEN_NS
        self._error = ""
        self.device: D | None = None

    def get(self) -> D:
        """Return the device; raise DeviceError while there is none."""
        if self.device is None:
            now_ns = self._clock.now_ns()
            if 0 <= now_ns - self._tried_ns < REOPEN_NS:
                raise DeviceError(self._error)
            self._tried_ns = now_ns
            try:
                self.device = self._open()
            except DeviceError as error:
                self._error = str(error)
                raise
        return self.device


class ImuSource:
    """The inertial unit at 100 Hz or so, and the attitudes estimated from it, some samples at a time.

    beside: a pressure sensor on the same bus. It is read in the same turns, because to wake a thread of its own would
    cost more than to read it, and its samples come with the block that they end.
    """

    name = "imu"
    read_by = ""

    def __init__(
        self,
        node: str,
        bus: I2cBus,
        open_device: Callable[[], ImuDevice],
        attitude: AttitudeEstimator,
        clock: Clock,
        beside: DepthSource | None = None,
    ) -> None:
        self._node = node
        self._bus = bus
        self._opener = Opener(open_device, clock)
        self._attitude = attitude
        self._beside = beside
        self._readings: list[ImuReading] = []
        self._turn = Metronome(clock)
        self._health = DeviceHealth(self.name)
        self._compass = DeviceHealth("compass")
        if beside is not None:
            beside.read_by = self.name

    @property
    def problem(self) -> str:
        """What is wrong with it, "" if nothing is."""
        return "; ".join(filter(None, (self._health.problem, self._compass.problem)))

    @property
    def retries(self) -> int:
        """Transfers on the bus that had to be repeated, of all its chips."""
        return self._bus.retries

    def next_messages(self, stop: threading.Event) -> list[Message] | None:
        """Wait for the next block of samples; a failure, or a sample of the sensor beside it, ends it early."""
        while not self._wait(stop):
            failed = self._fetch()
            beside = [] if self._beside is None else self._beside.step()
            device = self._opener.device
            if not failed and not beside and device is not None and len(self._readings) < device.readings:
                continue
            samples, problem = self._decode()
            self._health.update(failed or problem)
            if samples or beside:
                return self._messages(samples) + beside
        samples, _ = self._decode()
        return self._messages(samples) or None

    def _wait(self, stop: threading.Event) -> bool:
        device = self._opener.device
        if device is None:
            return self._turn.wait(stop, TURN_NS)
        return self._turn.wait(stop, device.turn_ns, device.wake_ns)

    def _fetch(self) -> str:
        """Take a reading; return why there is none, "" if there is."""
        try:
            self._readings.append(self._opener.get().fetch())
        except DeviceError as error:
            return str(error)
        return ""

    def _decode(self) -> tuple[list[ImuSample], str]:
        """Return the samples of the readings, and what is wrong with the device ("" if nothing)."""
        readings, self._readings = self._readings, []
        device, settling = self._opener.device, ""
        samples: list[ImuSample] = []
        if device is None:
            return [], ""
        for reading in readings:
            try:
                # Those before one that fails stay.
                samples.extend(device.decode(reading))
                settling = ""
            except SettlingError as error:
                settling = str(error)
            except DeviceError as error:
                return samples, str(error)
        return samples, settling or device.problem

    def _messages(self, samples: list[ImuSample]) -> list[Message]:
        """Return each sample as Imu, and the attitude at the last one and at every second before it.

        All attitudes can be computed again from the Imu messages, and turning is smooth over 20 ms.
        """
        messages: list[Message] = []
        for left, sample in zip(reversed(range(len(samples))), samples, strict=True):
            messages.append(self._imu(sample))
            estimate = self._attitude.update(sample)
            if estimate is not None:
                self._compass.update(estimate.problem)
                if left % ATTITUDE_EVERY == 0:
                    messages.append(estimate.message(self._node))
        return messages

    def _imu(self, sample: ImuSample) -> Imu:
        return Imu(
            node=self._node,
            stamp_ns=sample.stamp_ns,
            accel_mps2=_triple(sample.accel_mps2),
            gyro_radps=_triple(sample.gyro_radps),
            mag_t=UNSET if sample.mag_t is None else _triple(sample.mag_t),
            temperature_degc=UNSET if sample.temperature_degc is None else sample.temperature_degc,
        )

    def close(self) -> None:
        """Free the bus, for all of its sources."""
        self._bus.close()


class DepthSource:
    """The pressure sensor, and the depth computed from it once the surface is known.

    read_by: the source that calls `step`; "" where `next_messages` does.
    """

    name = "depth"

    def __init__(
        self,
        node: str,
        bus: I2cBus,
        open_device: Callable[[], DepthDevice],
        density_kgpm3: float,
        zero_path: Path,
        clock: Clock,
    ) -> None:
        self._node = node
        self.read_by = ""
        self._bus = bus
        self._opener = Opener(open_device, clock)
        self._density_kgpm3 = density_kgpm3
        self._zero_path = zero_path
        self._zero = SurfaceZero(load_zero(zero_path, clock.now_ns()))
        self._clock = clock
        self._turn = Metronome(clock)
        self._health = DeviceHealth(self.name)

    @property
    def problem(self) -> str:
        """What is wrong with it, "" if nothing is."""
        return "; ".join(filter(None, (self._health.problem, self._zero.problem)))

    @property
    def retries(self) -> int:
        """Transfers on the bus that had to be repeated, of all its chips."""
        return self._bus.retries

    def next_messages(self, stop: threading.Event) -> list[Message] | None:
        """Wait for the next sample."""
        while not self._turn.wait(stop, TURN_NS):
            messages = self.step()
            if messages:
                return messages
        return None

    def step(self) -> list[Message]:
        """Take the sensor's next step if one is due; return its sample if one is complete."""
        try:
            sample = self._opener.get().step(self._clock.now_ns())
        except DeviceError as error:
            self._health.update(str(error))
            return []
        if sample is None:
            return []
        self._health.update("")
        return [self._message(sample)] if self._find_zero(sample) else []

    def _find_zero(self, sample: DepthSample) -> bool:
        """Return whether the search for the surface is over."""
        zero = self._zero
        before = zero.complete, zero.surface_pa
        if not zero.update(sample):
            return False
        if before == (zero.complete, zero.surface_pa):
            return True
        if zero.problem:
            log.warning("%s: %s", self.name, zero.problem)
        if zero.measured:
            log.info("%s: surface at %.0f Pa", self.name, zero.surface_pa)
            try:
                save_zero(self._zero_path, sample.stamp_ns, zero.surface_pa)
            except OSError as error:
                log.warning("%s: surface not kept for a restart: %s", self.name, error)
        elif not zero.problem:
            log.warning("%s: not in calm air: the day's surface is kept, %.0f Pa", self.name, zero.surface_pa)
        return True

    def _message(self, sample: DepthSample) -> Depth:
        depth = depth_m(sample.pressure_pa, self._zero.surface_pa, self._density_kgpm3)
        return Depth(
            node=self._node,
            stamp_ns=sample.stamp_ns,
            depth_m=depth,
            sigma_m=self._zero.sigma_m(depth),
            pressure_pa=sample.pressure_pa,
            temperature_degc=sample.temperature_degc,
        )

    def close(self) -> None:
        """Free the bus, for all of its sources."""
        self._bus.close()


def _triple(vector: Vector) -> Vector3:
    x, y, z = vector.tolist()
    return x, y, z


def open_sensors(config: NodeConfig, clock: Clock) -> list[ImuSource | DepthSource]:
    """Return the sensors on the bus; "none" leaves one out.

    A bus that cannot be opened, or a chip that does not answer, is reported and tried again every two seconds. An
    unknown name is an error.
    """
    sensors = config.sensors
    check_names(sensors.imu, sensors.depth)
    x, y, z, w = sensors.mount_xyzw
    R_body_chip = quaternion_to_matrix(np.array([w, x, y, z]) / np.linalg.norm((w, x, y, z)))
    bus = I2cBus(sensors.i2c_bus)
    imu: ImuSource | None = None
    depth: DepthSource | None = None
    try:
        if sensors.depth != NONE:
            depth = DepthSource(
                config.node,
                bus,
                lambda: open_depth(bus, sensors.depth, clock),
                sensors.water_density_kgpm3,
                Path(config.record.directory) / f"{config.node}-surface.json",
                clock,
            )
        if sensors.imu != NONE:
            imu = ImuSource(
                config.node,
                bus,
                lambda: open_imu(bus, sensors.imu, R_body_chip, clock),
                attitude_estimator(config, clock.now_ns()),
                clock,
                depth,
            )
    except BaseException:
        bus.close()
        raise
    return [source for source in (imu, depth) if source is not None]
