"""Chips on the I2C bus as a node's sensors: two threads, one bus, and recovery from chips that fail."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

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
from msgspec import UNSET, UnsetType

log = logging.getLogger(__name__)

IMU_PERIOD_NS: Final = 10 * MS_NS
# So many readings are decoded, estimated, recorded and sent together, 50 ms: no later than the picture of the same
# instant has been read out and searched.
BLOCK: Final = 5
LONGEST_WAIT_NS: Final = 50 * MS_NS
REOPEN_NS: Final = 2 * S_NS


class Metronome:
    """Keeps a loop at a fixed period, also if its clock is set meanwhile."""

    def __init__(self, period_ns: int, clock: Clock) -> None:
        self._period_ns = period_ns
        self._clock = clock
        self._next_ns = clock.now_ns()

    def wait(self, stop: threading.Event) -> bool:
        """Wait for the next turn, at most a period; return True if stop is set."""
        now_ns = self._clock.now_ns()
        self._next_ns += self._period_ns
        if not now_ns <= self._next_ns <= now_ns + self._period_ns:
            self._next_ns = now_ns + self._period_ns
        return self._clock.wait_until_ns(self._next_ns, stop)


class ImuSource:
    """The inertial unit at 100 Hz, and the attitude estimated from it, BLOCK samples at a time."""

    name = "imu"

    def __init__(
        self,
        node: str,
        bus: I2cBus,
        open_device: Callable[[], ImuDevice],
        attitude: AttitudeEstimator,
        clock: Clock,
    ) -> None:
        self._node = node
        self._bus = bus
        self._open = open_device
        self._attitude = attitude
        self._clock = clock
        self._device: ImuDevice | None = None
        self._readings: list[ImuReading] = []
        self._turn = Metronome(IMU_PERIOD_NS, clock)
        self._health = DeviceHealth(self.name)
        self._compass = DeviceHealth("compass")
        self._told_ns = 0

    @property
    def problem(self) -> str:
        """What is wrong with it, "" if nothing is."""
        return "; ".join(filter(None, (self._health.problem, self._compass.problem)))

    @property
    def retries(self) -> int:
        """Transfers on the bus that had to be repeated, of all its chips."""
        return self._bus.retries

    def next_messages(self, stop: threading.Event) -> list[Message] | None:
        """Wait for the next block of samples; a failure ends it early."""
        while not self._turn.wait(stop):
            failed = self._fetch()
            if not failed and len(self._readings) < BLOCK:
                continue
            samples, problem = self._decode()
            self._health.update(failed or problem)
            if samples:
                return [message for sample in samples for message in self._messages(sample)]
            if self._device is None and self._clock.wait_until_ns(self._clock.now_ns() + REOPEN_NS, stop):
                return None
        samples, _ = self._decode()
        return [message for sample in samples for message in self._messages(sample)] or None

    def _fetch(self) -> str:
        """Take a reading; return why there is none, "" if there is."""
        try:
            if self._device is None:
                self._device = self._open()
            self._readings.append(self._device.fetch())
        except DeviceError as error:
            return str(error)
        return ""

    def _decode(self) -> tuple[list[ImuSample], str]:
        """Return the samples of the readings, and what is wrong with the device ("" if nothing)."""
        readings, self._readings = self._readings, []
        device, samples, settling = self._device, [], ""
        if device is None:
            return [], ""
        for reading in readings:
            try:
                samples.append(device.decode(reading))
                settling = ""
            except SettlingError as error:
                settling = str(error)
            except DeviceError as error:
                return samples, str(error)
        return samples, settling or device.problem

    def _messages(self, sample: ImuSample) -> list[Message]:
        # The attitude is to be the same from the log, which has no more than this.
        degc = self._temperature(sample)
        if degc != sample.temperature_degc:
            sample = replace(sample, temperature_degc=None if degc is UNSET else degc)
        messages: list[Message] = [
            Imu(
                node=self._node,
                stamp_ns=sample.stamp_ns,
                accel_mps2=_triple(sample.accel_mps2),
                gyro_radps=_triple(sample.gyro_radps),
                mag_t=UNSET if sample.mag_t is None else _triple(sample.mag_t),
                temperature_degc=degc,
            )
        ]
        estimate = self._attitude.update(sample)
        if estimate is not None:
            self._compass.update(estimate.problem)
            messages.append(estimate.message(self._node))
        return messages

    def _temperature(self, sample: ImuSample) -> float | UnsetType:
        """Return the temperature once a second: it changes slowly."""
        if sample.temperature_degc is None or 0 <= sample.stamp_ns - self._told_ns < S_NS:
            return UNSET
        self._told_ns = sample.stamp_ns
        return round(sample.temperature_degc, 2)

    def close(self) -> None:
        """Free the bus, for all of its sources."""
        self._bus.close()


class DepthSource:
    """The pressure sensor, and the depth computed from it once the surface is known."""

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
        self._bus = bus
        self._open = open_device
        self._density_kgpm3 = density_kgpm3
        self._zero_path = zero_path
        self._zero = SurfaceZero(load_zero(zero_path, clock.now_ns()))
        self._clock = clock
        self._device: DepthDevice | None = None
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
        while not self._wait(stop):
            try:
                if self._device is None:
                    self._device = self._open()
                sample = self._device.step(self._clock.now_ns())
            except DeviceError as error:
                self._health.update(str(error))
                if self._device is None and self._clock.wait_until_ns(self._clock.now_ns() + REOPEN_NS, stop):
                    return None
                continue
            if sample is None:
                continue
            self._health.update("")
            if self._find_zero(sample):
                return [self._message(sample)]
        return None

    def _wait(self, stop: threading.Event) -> bool:
        """Wait until the device is due, for at most LONGEST_WAIT_NS: the clock may be set."""
        if self._device is None:
            return stop.is_set()
        now_ns = self._clock.now_ns()
        return self._clock.wait_until_ns(min(self._device.next_due_ns, now_ns + LONGEST_WAIT_NS), stop)

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
    R_body_chip = quaternion_to_matrix(np.array([w, x, y, z]))
    sources: list[ImuSource | DepthSource] = []
    bus = I2cBus(sensors.i2c_bus)
    try:
        if sensors.imu != NONE:
            attitude = attitude_estimator(config, clock.now_ns())
            sources.append(
                ImuSource(config.node, bus, lambda: open_imu(bus, sensors.imu, R_body_chip, clock), attitude, clock)
            )
        if sensors.depth != NONE:
            zero_path = Path(config.record.directory) / f"{config.node}-surface.json"
            sources.append(
                DepthSource(
                    config.node,
                    bus,
                    lambda: open_depth(bus, sensors.depth, clock),
                    sensors.water_density_kgpm3,
                    zero_path,
                    clock,
                )
            )
    except BaseException:
        bus.close()
        raise
    return sources
