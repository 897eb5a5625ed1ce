"""One I2C bus: one lock, bounded retries, and errors that name bus, address and register."""

from __future__ import annotations

import errno
import threading
from fcntl import ioctl
from typing import Any, Final, Self

from buddyline.node.drivers.samples import DeviceError

# linux/i2c-dev.h: how long the adapter waits for a transfer, in units of 10 ms. With its default of one second,
# one chip that holds the bus down would silence the others for that long.
I2C_TIMEOUT: Final = 0x0702
TRANSFER_TIMEOUT_10MS: Final = 5

ATTEMPTS: Final = 3
# NACK, lost arbitration, and what some adapters report instead. A timeout is not repeated: it has waited already.
_PASSING: Final = frozenset({errno.EREMOTEIO, errno.EIO, errno.ENXIO, errno.EAGAIN})

_MEANING: Final = {
    errno.EREMOTEIO: "no answer: check the chip's wiring and power",
    errno.ETIMEDOUT: "the bus hangs: a chip or a short holds SCL or SDA down",
    errno.EBUSY: "claimed by a kernel driver: remove its overlay from config.txt",
}


class I2cBus:
    """Bus number /dev/i2c-<number>, shared by all its chips and by all threads.

    It is opened by `open` or the first transfer, so that a bus that is absent at the start can appear later.
    retries: transfers that were repeated; a growing count means a failing wire.
    """

    def __init__(self, number: int = 1) -> None:
        try:
            from smbus2 import SMBus, i2c_msg
        except ModuleNotFoundError as error:
            raise DeviceError(f"I2C bus {number}: needs smbus2: make install EXTRAS=pi") from error
        self.number = number
        self.retries = 0
        self._lock = threading.Lock()
        self._new_bus: Any = SMBus
        self._message: Any = i2c_msg
        self._bus: Any = None
        self._messages: dict[tuple[int, int, int], tuple[Any, ...]] = {}

    def open(self) -> None:
        """Open the adapter if it is not open; raise DeviceError if it cannot be. The next call tries again."""
        with self._lock:
            if self._bus is None:
                self._bus = self._open()

    def _open(self) -> Any:
        number = self.number
        try:
            bus = self._new_bus(number)
        except FileNotFoundError as error:
            raise DeviceError(
                f"I2C bus {number}: no /dev/i2c-{number}: add dtparam=i2c_arm=on to config.txt and reboot"
            ) from error
        except PermissionError as error:
            raise DeviceError(f"I2C bus {number}: not allowed: add this user to the group i2c") from error
        except OSError as error:
            raise DeviceError(f"I2C bus {number}: cannot be opened: {error.strerror}") from error
        try:
            ioctl(int(bus.fd or 0), I2C_TIMEOUT, TRANSFER_TIMEOUT_10MS)
        except OSError as error:
            bus.close()
            raise DeviceError(f"I2C bus {number}: cannot set its timeout: {error.strerror}") from error
        return bus

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the bus; a second call does nothing."""
        with self._lock:
            bus, self._bus = self._bus, None
            if bus is not None:
                bus.close()

    def read(self, address: int, register: int, count: int) -> bytes:
        """Read count bytes from a register on, in one transfer."""
        with self._lock:
            kept = self._kept(address, register, count)
            self._transfer(address, register, *kept)
            return bytes(kept[1])

    def write(self, address: int, register: int, *values: int) -> None:
        """Write a register, byte by byte, in one transfer."""
        with self._lock:
            self._transfer(address, register, self._message.write(address, [register, *values]))

    def command(self, address: int, command: int) -> None:
        """Send a command byte without data."""
        with self._lock:
            self._transfer(address, command, *self._kept(address, command, 0))

    def _kept(self, address: int, register: int, count: int) -> tuple[Any, ...]:
        """Return the messages of a transfer: making them costs more than the transfer; the reply is filled again."""
        key = address, register, count
        kept = self._messages.get(key)
        if kept is None:
            ask = self._message.write(address, [register])
            kept = self._messages[key] = (ask, self._message.read(address, count)) if count else (ask,)
        return kept

    def _transfer(self, address: int, register: int, *messages: object) -> None:
        """Transfer messages, with the lock held."""
        if self._bus is None:
            self._bus = self._open()
        for attempt in range(1, ATTEMPTS + 1):
            try:
                self._bus.i2c_rdwr(*messages)
                return
            except OSError as error:
                if error.errno in _PASSING and attempt < ATTEMPTS:
                    self.retries += 1
                    continue
                raise self.error(address, register, _explain(error)) from error

    def error(self, address: int, register: int, what: str) -> DeviceError:
        """Return an error that names where it happened."""
        return DeviceError(f"I2C bus {self.number}, address 0x{address:02x}, register 0x{register:02x}: {what}")


def _explain(error: OSError) -> str:
    meaning = _MEANING.get(error.errno or 0, error.strerror or "failed")
    return f"{meaning} (errno {error.errno})"
