"""MS5837-30BA and -02BA, the pressure sensors of Bar30 and Bar02 (TE Connectivity, MS5837 data sheets).

The arithmetic is the data sheets', in integers with floor shifts.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, Literal, Self

from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.samples import DepthSample
from buddyline.protocol.clock import MS_NS, Clock
from buddyline.protocol.errors import BuddylineError

ADDRESS: Final = 0x76
RESET: Final = 0x1E
PROM: Final = 0xA0
CONVERT_PRESSURE: Final = 0x40
CONVERT_TEMPERATURE: Final = 0x50
READ_ADC: Final = 0x00

RESET_NS: Final = 10 * MS_NS
RETRY_NS: Final = 200 * MS_NS
# With a turn every 10 or 40 ms, a conversion begins every 40 ms, four of five for a pressure: 20 Hz. Turns are not
# quite as regular as that.
PERIOD_NS: Final = 32 * MS_NS
OVERSAMPLING: Final = 5  # of 0..5: 8192 samples, 0.2 mbar of noise on the 30BA
# A temperature that is wrong by a degree moves the pressure by 1.5 mbar at the surface and by 5 at 40 bar. In the
# 0.2 s between two temperatures the chip warms by a fraction of that.
TEMPERATURE_EVERY: Final = 4
CONVERSION_NS: Final = (600_000, 1_170_000, 2_280_000, 4_540_000, 9_040_000, 18_080_000)
# A conversion begins once its command is on the wire, and the thread can be interrupted before that.
TRANSFERS_NS: Final = MS_NS

Model = Literal["30ba", "02ba"]

# Word 0 does not distinguish the ranges: 30BA parts with the 02BA01's type 0 are sold. Their sensitivity at
# 20 degC (C1) does (production figures given by TE in ArduPilot pull request 29122).
TYPES: Final[dict[int, Model]] = {0x1A: "30ba", 0x15: "02ba"}
SENSITIVITY: Final[dict[Model, range]] = {"30ba": range(26_000, 37_001), "02ba": range(37_001, 49_001)}

# What the chips can measure, in Pa and degC; anything else is a failed transfer.
PRESSURE_PA: Final[dict[Model, tuple[float, float]]] = {"30ba": (0.0, 3.1e6), "02ba": (1e4, 2.1e5)}
TEMPERATURE_DEGC: Final = (-20.0, 85.0)


def crc4(words: Sequence[int]) -> int:
    """Return the four-bit checksum of the seven PROM words, which word 0 has in bits 15:12."""
    remainder = 0
    for word in (words[0] & 0x0FFF, *words[1:7], 0):
        for byte in word.to_bytes(2, "big"):
            remainder ^= byte
            for _ in range(8):
                remainder = (remainder << 1) ^ 0x3000 if remainder & 0x8000 else remainder << 1
            remainder &= 0xFFFF
    return remainder >> 12


def decode_prom(words: Sequence[int]) -> tuple[int, ...]:
    """Return C1..C6 of seven PROM words; raise BuddylineError if the checksum fails."""
    stored, computed = words[0] >> 12, crc4(words)
    if not any(words) or stored != computed:
        raise BuddylineError(f"PROM checksum {computed}, stored {stored}: bad contact or a damaged chip")
    return tuple(words[1:7])


def decode_model(words: Sequence[int]) -> Model:
    """Return which chip it is; raise BuddylineError if type and sensitivity disagree or are unknown."""
    kind, sensitivity = words[0] >> 5 & 0x7F, words[1]
    model = next((model for model, known in SENSITIVITY.items() if sensitivity in known), None)
    if model is None or TYPES.get(kind, model) != model:
        raise BuddylineError(
            f"cannot tell 30BA from 02BA (type 0x{kind:02x}, C1 {sensitivity}): name the depth sensor "
            "ms5837_30ba or ms5837_02ba"
        )
    return model


@dataclass(frozen=True, slots=True)
class FirstOrder:
    """First-order terms: difference to the reference temperature, 0.01 degC, offset, sensitivity."""

    dt: int
    temp: int
    off: int
    sens: int


def first_order_30ba(c: Sequence[int], d2: int) -> FirstOrder:
    """Return the first-order terms of C1..C6 and the raw temperature."""
    dt = d2 - (c[4] << 8)
    return FirstOrder(dt, 2000 + (dt * c[5] >> 23), (c[1] << 16) + (c[3] * dt >> 7), (c[0] << 15) + (c[2] * dt >> 8))


def first_order_02ba(c: Sequence[int], d2: int) -> FirstOrder:
    """Return the first-order terms of C1..C6 and the raw temperature."""
    dt = d2 - (c[4] << 8)
    return FirstOrder(dt, 2000 + (dt * c[5] >> 23), (c[1] << 17) + (c[3] * dt >> 6), (c[0] << 16) + (c[2] * dt >> 7))


def second_order_30ba(terms: FirstOrder) -> tuple[int, int, int]:
    """Return Ti, OFFi and SENSi."""
    dt, t = terms.dt, terms.temp - 2000
    if t >= 0:
        return 2 * dt * dt >> 37, t * t >> 4, 0
    ti, offi, sensi = 3 * dt * dt >> 33, 3 * t * t >> 1, 5 * t * t >> 3
    cold = terms.temp + 1500
    if cold < 0:
        offi += 7 * cold * cold
        sensi += 4 * cold * cold
    return ti, offi, sensi


def second_order_02ba(terms: FirstOrder) -> tuple[int, int, int]:
    """Return Ti, OFFi and SENSi."""
    dt, t = terms.dt, terms.temp - 2000
    if t >= 0:
        return 0, 0, 0
    return 11 * dt * dt >> 35, 31 * t * t >> 3, 63 * t * t >> 5


def compensate_30ba(c: Sequence[int], d1: int, d2: int) -> tuple[int, int]:
    """Return pressure in 0.1 mbar and temperature in 0.01 degC of C1..C6 and both raw values."""
    terms = first_order_30ba(c, d2)
    ti, offi, sensi = second_order_30ba(terms)
    return (d1 * (terms.sens - sensi) >> 21) - (terms.off - offi) >> 13, terms.temp - ti


def compensate_02ba(c: Sequence[int], d1: int, d2: int) -> tuple[int, int]:
    """Return pressure in 0.01 mbar and temperature in 0.01 degC of C1..C6 and both raw values."""
    terms = first_order_02ba(c, d2)
    ti, offi, sensi = second_order_02ba(terms)
    return (d1 * (terms.sens - sensi) >> 21) - (terms.off - offi) >> 15, terms.temp - ti


class _Phase(Enum):
    LOST = 0
    RESETTING = 1
    IDLE = 2
    PRESSURE = 3
    TEMPERATURE = 4


class Ms5837:
    """The sensor as a state machine: each step is at most one command and one short read.

    model: None reads it from the PROM. After any failure the chip is reset and its PROM read again.
    """

    def __init__(self, bus: I2cBus, model: Model | None = None) -> None:
        self.model = model
        self.next_due_ns = 0
        self._bus = bus
        self._phase = _Phase.LOST
        self._since_ns = 0
        self._c: tuple[int, ...] = ()
        self._d1 = self._d2 = 0
        self._since_temperature = TEMPERATURE_EVERY

    @classmethod
    def open(cls, bus: I2cBus, model: Model | None, clock: Clock) -> Self:
        """Return the sensor once its PROM has been read; raise DeviceError if it cannot be."""
        device, never = cls(bus, model), threading.Event()
        while not device.ready:
            clock.wait_until_ns(device.next_due_ns, never)
            device.step(clock.now_ns())
        return device

    @property
    def name(self) -> str:
        """What it is called in the configuration."""
        return f"ms5837_{self.model}" if self.model else "ms5837"

    @property
    def ready(self) -> bool:
        """Whether the PROM has been read and conversions run."""
        return self._phase not in (_Phase.LOST, _Phase.RESETTING)

    def step(self, now_ns: int) -> DepthSample | None:
        """Take the step that is due at now_ns; return a sample if one is complete.

        If the clock is set back, the conversion is repeated. If it is set forward, the chip is read too early and
        returns 0, which is an error. Raises DeviceError; the chip is tried again RETRY_NS later.
        """
        if self._since_ns <= now_ns < self.next_due_ns:
            return None
        backwards = now_ns < self._since_ns
        try:
            return self._advance(now_ns, backwards)
        except BuddylineError:
            self._enter(_Phase.LOST, now_ns, RETRY_NS)
            raise

    def _advance(self, now_ns: int, backwards: bool) -> DepthSample | None:
        if self._phase is _Phase.LOST:
            self._bus.command(ADDRESS, RESET)
            self._enter(_Phase.RESETTING, now_ns, RESET_NS)
        elif backwards:
            self._convert(now_ns)
        elif self._phase is _Phase.RESETTING:
            self._read_prom()
            self._since_temperature = TEMPERATURE_EVERY
            self._enter(_Phase.IDLE, now_ns, 0)
        elif self._phase is _Phase.IDLE:
            self._convert(now_ns)
        elif self._phase is _Phase.PRESSURE:
            self._d1 = self._read_adc()
            sample = self._compensate(self._since_ns + CONVERSION_NS[OVERSAMPLING] // 2)
            self._since_temperature += 1
            self._go_on(now_ns)
            return sample
        else:
            self._d2 = self._read_adc()
            self._since_temperature = 0
            self._go_on(now_ns)
        return None

    def _go_on(self, now_ns: int) -> None:
        """Begin the next conversion if it is due."""
        wait_ns = self._since_ns + PERIOD_NS - now_ns
        if wait_ns > 0:
            self._enter(_Phase.IDLE, now_ns, wait_ns)
        else:
            self._convert(now_ns)

    def _enter(self, state: _Phase, now_ns: int, wait_ns: int) -> None:
        self._phase = state
        self._since_ns = now_ns
        self.next_due_ns = now_ns + wait_ns

    def _convert(self, now_ns: int) -> None:
        """Begin a conversion: of the temperature after every fourth pressure, and first of all."""
        is_pressure = self._since_temperature < TEMPERATURE_EVERY
        self._bus.command(ADDRESS, (CONVERT_PRESSURE if is_pressure else CONVERT_TEMPERATURE) + 2 * OVERSAMPLING)
        phase = _Phase.PRESSURE if is_pressure else _Phase.TEMPERATURE
        self._enter(phase, now_ns, CONVERSION_NS[OVERSAMPLING] + TRANSFERS_NS)

    def _read_prom(self) -> None:
        words = [int.from_bytes(self._bus.read(ADDRESS, PROM + 2 * i, 2), "big") for i in range(7)]
        try:
            self._c = decode_prom(words)
            if self.model is None:
                self.model = decode_model(words)
        except BuddylineError as error:
            raise self._bus.error(ADDRESS, PROM, f"{self.name}: {error}") from error

    def _read_adc(self) -> int:
        value = int.from_bytes(self._bus.read(ADDRESS, READ_ADC, 3), "big")
        if value == 0:
            raise self._bus.error(ADDRESS, READ_ADC, f"{self.name}: read 0: no conversion was ready")
        return value

    def _compensate(self, stamp_ns: int) -> DepthSample:
        if self.model == "02ba":
            pressure, temperature = compensate_02ba(self._c, self._d1, self._d2)
            pressure_pa = float(pressure)
        else:
            pressure, temperature = compensate_30ba(self._c, self._d1, self._d2)
            pressure_pa = 10.0 * pressure
        temperature_degc = temperature / 100.0
        low_pa, high_pa = PRESSURE_PA[self.model or "30ba"]
        if not low_pa < pressure_pa < high_pa or not (TEMPERATURE_DEGC[0] < temperature_degc < TEMPERATURE_DEGC[1]):
            raise self._bus.error(
                ADDRESS, READ_ADC, f"{self.name}: {pressure_pa:.0f} Pa, {temperature_degc:.2f} degC: out of its range"
            )
        return DepthSample(stamp_ns, pressure_pa, temperature_degc)
