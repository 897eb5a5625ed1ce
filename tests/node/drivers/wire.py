"""Chips at the level of the wire, under smbus2's own os.open, os.close and ioctl.

smbus2 runs unmodified: it opens a device file, fills the kernel's structures and calls ioctl. What answers is
an adapter that behaves like the kernel's (NACK: errno 121; a bus held down: errno 110 after the adapter's
timeout) with chips that know bytes and time, nothing else.
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
from collections.abc import Callable
from typing import Any

import buddyline.node.drivers.i2c as i2c_module
import numpy as np
import pytest
import smbus2.smbus2 as smbus2_module
from buddyline.protocol.clock import ManualClock

I2C_TIMEOUT, I2C_SLAVE, I2C_FUNCS, I2C_RDWR = 0x0702, 0x0703, 0x0705, 0x0707
I2C_M_RD = 0x0001
DEFAULT_TIMEOUT_NS = 1_000_000_000


class NackError(Exception):
    """The chip does not acknowledge."""


class HangError(Exception):
    """The chip holds the clock line down."""


class Chip:
    """A chip on the wire. nacks, hangs: how many of the next transfers fail so; absent: all of them NACK."""

    def __init__(self) -> None:
        self.absent = False
        self.nacks = 0
        self.hangs = 0
        self.transfers = 0

    def begin(self) -> None:
        """Be addressed."""
        self.transfers += 1
        if self.hangs:
            self.hangs -= 1
            raise HangError
        if self.absent or self.nacks:
            self.nacks = max(0, self.nacks - 1)
            raise NackError

    def write(self, data: bytes) -> None:
        raise NotImplementedError

    def read(self, n: int) -> bytes:
        raise NotImplementedError


class StWire(Chip):
    """An ST chip: a register file with a pointer, power-down until it is told to run.

    marks: whether bit 7 of the register's address is what makes the pointer advance (else CTRL3_C does).
    outputs: register of the first of six bytes -> counts (3,) and whether that sensor runs.
    """

    def __init__(self, identity: int, defaults: dict[int, int], marks: bool) -> None:
        super().__init__()
        self.identity = identity
        self.marks = marks
        self.defaults = defaults
        self.outputs: dict[int, tuple[Callable[[], tuple[int, int, int]], Callable[[], bool]]] = {}
        self.power_cycle()

    def power_cycle(self) -> None:
        """Come back as after a brown-out."""
        self.registers = {0x0F: self.identity, **self.defaults}
        self._pointer = 0
        self._advances = False

    def write(self, data: bytes) -> None:
        first = data[0]
        self._advances = bool(first & 0x80) if self.marks else bool(self.registers.get(0x12, 0) & 0x04)
        self._pointer = first & 0x7F if self.marks else first
        for value in data[1:]:
            if self._pointer != 0x0F:
                self.registers[self._pointer] = value
            self._advance()

    def read(self, n: int) -> bytes:
        for start, (counts, runs) in self.outputs.items():
            if runs() and self._pointer <= start + 5 and self._pointer + n > start:
                self.registers.update((start + i, byte) for i, byte in enumerate(struct.pack("<3h", *counts())))
        data = bytearray()
        for _ in range(n):
            data.append(self.registers.get(self._pointer, 0))
            self._advance()
        return bytes(data)

    def _advance(self) -> None:
        self._pointer += self._advances


class Sky:
    """What the chips feel: counts that a test sets; a little noise in the last bits, as real chips have.

    accel: counts at +-2 g. A chip set to another range reads fewer, and clips as a real one does. silent: sensors
    that give zeros. frozen: that give the same again and again.
    """

    def __init__(self) -> None:
        self.accel = (0, 0, -16384)
        self.gyro = (0, 0, 0)
        self.mag = (1250, 0, 2700)
        self.noisy = True
        self.silent: set[str] = set()
        self.frozen: set[str] = set()
        self._rng = np.random.default_rng(1)

    def counts(self, what: str, scale: Callable[[], int] = lambda: 1) -> Callable[[], tuple[int, int, int]]:
        def read() -> tuple[int, int, int]:
            noise = self._rng.integers(-2, 3, 3) if self.noisy and what not in self.frozen else np.zeros(3, dtype=int)
            if what in self.silent:
                return 0, 0, 0
            felt = np.array(getattr(self, what)) // scale() + noise
            x, y, z = np.clip(felt, -32768, 32767).tolist()
            return x, y, z

        return read


def lsm303d(sky: Sky) -> StWire:
    chip = StWire(0x49, {0x20: 0x07, 0x24: 0x18, 0x25: 0x20, 0x26: 0x01}, marks=True)
    chip.outputs[0x28] = (
        sky.counts("accel", lambda: (1, 2, 3, 4, 8)[chip.registers.get(0x21, 0) >> 3 & 7]),
        lambda: chip.registers.get(0x20, 0) >> 4 > 0,
    )
    chip.outputs[0x08] = (sky.counts("mag"), lambda: chip.registers.get(0x26, 3) & 3 == 0)
    return chip


def l3gd20h(sky: Sky) -> StWire:
    chip = StWire(0xD7, {0x20: 0x07}, marks=True)
    chip.outputs[0x28] = (sky.counts("gyro"), lambda: bool(chip.registers.get(0x20, 0) & 0x08))
    return chip


class Lsm6dsWire(StWire):
    """An LSM6DS33 or LSM6DSO with its FIFO; only the rate of 104 Hz is known, and only when both sensors run.

    rate_error: how much faster its clock is. taken_ns: when each sample that is in the FIFO, or was, was taken.
    """

    START_NS = 70_000_000
    STATUS = 0x3A

    def __init__(self, sky: Sky, identity: int, clock: ManualClock, rate_error: float = 0.0) -> None:
        self.clock = clock
        self.rate_error = rate_error
        self.taken_ns: list[int] = []
        self.stopped = False
        self._gyro = sky.counts("gyro")
        self._accel = sky.counts("accel", lambda: (1, 8, 2, 4)[self.registers.get(0x10, 0) >> 2 & 3])
        self._tagged = identity == 0x6C
        self._data, self._capacity = (0x78, 512 * 7) if self._tagged else (0x3E, 4096 * 2)
        self._fifo = bytearray()
        self._taken_bytes = 0
        self._overrun = False
        self._next_ns: float | None = None
        super().__init__(identity, {0x12: 0x04}, marks=False)

    def power_cycle(self) -> None:
        super().power_cycle()
        self._empty()
        self._next_ns = None

    def write(self, data: bytes) -> None:
        self._fill()
        super().write(data)
        if self.registers.get(0x0A, 0) & 0x07 == 0:
            self._empty()

    def read(self, n: int) -> bytes:
        self._fill()
        if self._pointer == self._data:
            data = bytes(self._fifo[:n]).ljust(n, b"\x00")
            del self._fifo[:n]
            self._taken_bytes += n
            return data
        self.registers.update(zip(range(self.STATUS, self.STATUS + 4), self._status(), strict=True))
        if self._pointer <= self.STATUS + 1 < self._pointer + n:
            self._overrun = False
        return super().read(n)

    def _empty(self) -> None:
        self._fifo.clear()
        self._taken_bytes = 0
        self._overrun = False

    def _kinds(self) -> tuple[bool, bool]:
        """Whether gyroscope and accelerometer are put into the FIFO."""
        third, fifth = self.registers.get(0x08, 0), self.registers.get(0x09, 0)
        return (fifth >> 4 == 4, fifth & 0x0F == 4) if self._tagged else (third >> 3 & 7 == 1, third & 7 == 1)

    def _fill(self) -> None:
        mode = self.registers.get(0x0A, 0)
        rates = self.registers.get(0x11, 0) >> 4, self.registers.get(0x10, 0) >> 4
        if not any(rates):
            self._next_ns = None
            return
        runs = mode & 0x07 == 6 and (self._tagged or mode >> 3 == 4) and not self.stopped
        now_ns = self.clock.now_ns()
        if self._next_ns is None:
            self._next_ns = now_ns + self.START_NS
        while self._next_ns <= now_ns:
            if runs:
                self._put(round(self._next_ns), rates)
            self._next_ns += 1e9 / 104 / (1 + self.rate_error)

    def _put(self, at_ns: int, rates: tuple[int, int]) -> None:
        self.taken_ns.append(at_ns)
        for tag, kept, rate, counts in zip((1, 2), self._kinds(), rates, (self._gyro, self._accel), strict=True):
            if self._tagged and kept and rate:
                self._fifo += bytes([tag << 3 | (len(self.taken_ns) & 3) << 1])
            if kept and (rate or not self._tagged):
                self._fifo += struct.pack("<3h", *(counts() if rate else (0, 0, 0)))
        while len(self._fifo) > self._capacity:
            self._overrun = True
            word = 7 if self._tagged else 2
            del self._fifo[:word]
            self._taken_bytes += word

    def _status(self) -> tuple[int, int, int, int]:
        word = 7 if self._tagged else 2
        level = len(self._fifo) // word
        full = level * word == self._capacity
        if self._tagged:
            mark = self.registers.get(0x07, 0) | (self.registers.get(0x08, 0) & 1) << 8
            flags = (0 < mark <= level) << 7 | self._overrun << 6 | full << 5 | self._overrun << 3
            return level & 0xFF, flags | level >> 8 & 0x03, 0, 0
        mark = self.registers.get(0x06, 0) | (self.registers.get(0x07, 0) & 0x0F) << 8
        flags = (0 < mark <= level) << 7 | self._overrun << 6 | full << 5 | (not level) << 4
        return level & 0xFF, flags | level >> 8 & 0x0F, self._taken_bytes // 2 % 6, 0


def lsm6ds(sky: Sky, identity: int, clock: ManualClock, rate_error: float = 0.0) -> Lsm6dsWire:
    return Lsm6dsWire(sky, identity, clock, rate_error)


def lis3mdl(sky: Sky) -> StWire:
    chip = StWire(0x3D, {0x20: 0x10, 0x22: 0x03}, marks=True)
    chip.outputs[0x28] = (sky.counts("mag"), lambda: chip.registers.get(0x22, 3) & 3 == 0)
    return chip


class Ms5837Wire(Chip):
    """The pressure sensor: commands, a PROM, and conversions that take their time and are given once."""

    CONVERSION_NS = (600_000, 1_170_000, 2_280_000, 4_540_000, 9_040_000, 18_080_000)

    def __init__(self, clock: ManualClock, words: tuple[int, ...], d1: int, d2: int) -> None:
        super().__init__()
        self.clock = clock
        self.words = list(words)
        self.d1, self.d2 = d1, d2
        self.resets = 0
        self.conversions = 0
        self._reset_done_ns = 0
        self._command = 0
        self._result = 0
        self._ready_ns = 0

    def write(self, data: bytes) -> None:
        (self._command,) = data
        now_ns = self.clock.now_ns()
        if self._command == 0x1E:
            self.resets += 1
            self._reset_done_ns = now_ns + 10_000_000
            self._result = 0
        elif 0x40 <= self._command <= 0x5A:
            self.conversions += 1
            self._result = self.d1 if self._command < 0x50 else self.d2
            self._ready_ns = now_ns + self.CONVERSION_NS[(self._command & 0x0F) // 2]

    def read(self, n: int) -> bytes:
        now_ns = self.clock.now_ns()
        if now_ns < self._reset_done_ns:
            raise NackError
        if 0xA0 <= self._command <= 0xAC:
            return self.words[(self._command - 0xA0) // 2].to_bytes(2, "big")[:n].ljust(n, b"\xff")
        if self._command == 0x00 and now_ns >= self._ready_ns:
            value, self._result = self._result, 0
            return value.to_bytes(3, "big")[:n].ljust(n, b"\xff")
        self._result = 0
        return bytes(n)


class Adapter:
    """The kernel's side of one bus. bit_hz: 0 takes no time, else every byte moves the clock on."""

    FD = 1000

    def __init__(self, clock: ManualClock, number: int = 1, bit_hz: int = 0) -> None:
        self.clock = clock
        self.number = number
        self.bit_hz = bit_hz
        self.chips: dict[int, Chip] = {}
        self.opened = 0
        self.timeout_ns = DEFAULT_TIMEOUT_NS
        self.open_error: OSError | None = None
        self._slave = 0

    def open(self, path: str, flags: int) -> int:
        assert flags == os.O_RDWR
        if path != f"/dev/i2c-{self.number}":
            raise FileNotFoundError(errno.ENOENT, "No such file or directory", path)
        if self.open_error is not None:
            raise self.open_error
        self.opened += 1
        return self.FD

    def close(self, fd: int) -> None:
        assert fd == self.FD
        self.opened -= 1

    def ioctl(self, fd: int, request: int, argument: Any) -> int:
        assert fd == self.FD
        assert self.opened > 0
        if request == I2C_FUNCS:
            argument.value = 0x0EFF0009
        elif request == I2C_TIMEOUT:
            self.timeout_ns = argument * 10_000_000
        elif request == I2C_SLAVE:
            self._slave = argument
        elif request == I2C_RDWR:
            self._transfer([argument.msgs[i] for i in range(argument.nmsgs)])
        else:
            raise OSError(errno.ENOTTY, "Inappropriate ioctl for device")
        return 0

    def _transfer(self, messages: list[Any]) -> None:
        for message in messages:
            chip = self.chips.get(message.addr)
            try:
                if chip is None:
                    raise NackError
                if message is messages[0]:
                    chip.begin()
                self._spend(message.len + 1)
                if message.flags & I2C_M_RD:
                    data = chip.read(message.len)
                    ctypes.memmove(message.buf, data, len(data))
                else:
                    chip.write(ctypes.string_at(message.buf, message.len))
            except NackError:
                self._spend(1)
                raise OSError(errno.EREMOTEIO, "Remote I/O error") from None
            except HangError:
                self.clock.set_ns(self.clock.now_ns() + self.timeout_ns)
                raise OSError(errno.ETIMEDOUT, "Connection timed out") from None

    def _spend(self, n_bytes: int) -> None:
        if self.bit_hz:
            self.clock.set_ns(self.clock.now_ns() + n_bytes * 9 * 1_000_000_000 // self.bit_hz)

    def attach(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Stand under smbus2 and under our own call of ioctl."""

        class Os:
            O_RDWR = os.O_RDWR
            open = staticmethod(self.open)
            close = staticmethod(self.close)

        monkeypatch.setattr(smbus2_module, "os", Os)
        monkeypatch.setattr(smbus2_module, "ioctl", self.ioctl)
        monkeypatch.setattr(i2c_module, "ioctl", self.ioctl)


WORDS_30BA = (0x9340, 34982, 36352, 20328, 22354, 26646, 26146)
D1_30BA, D2_30BA = 4958179, 6815414
