"""The bus: what it says when something fails, how often it tries, and how long a hang lasts."""

from __future__ import annotations

import errno
import sys
import threading

import pytest
from buddyline.node.drivers.i2c import ATTEMPTS, I2cBus
from buddyline.node.drivers.samples import DeviceError
from buddyline.protocol.clock import ManualClock

from tests.node.drivers.conftest import START_NS
from tests.node.drivers.wire import Adapter, Sky, l3gd20h, lis3mdl

CHIP = 0x6B


@pytest.fixture
def gyro(adapter: Adapter):
    chip = adapter.chips[CHIP] = l3gd20h(Sky())
    return chip


def test_registers_go_over_real_smbus2(bus: I2cBus, gyro):
    bus.write(CHIP, 0x23, 0x90)
    assert gyro.registers[0x23] == 0x90
    assert bus.read(CHIP, 0x23, 1) == b"\x90"
    assert bus.read(CHIP, 0x0F, 1) == b"\xd7"


def test_without_the_auto_increment_bit_a_burst_stays_on_one_register(bus: I2cBus, gyro):
    bus.write(CHIP, 0x20, 0x6F)
    low = bus.read(CHIP, 0x20, 3)
    assert low == b"\x6f\x6f\x6f"
    bus.write(CHIP, 0x21, 0x12)
    assert bus.read(CHIP, 0x20 | 0x80, 2) == b"\x6f\x12"


def test_an_absent_chip_is_named(bus: I2cBus, adapter: Adapter):
    with pytest.raises(DeviceError, match=r"bus 1, address 0x76, register 0x1e: no answer.*errno 121"):
        bus.command(0x76, 0x1E)


@pytest.mark.parametrize("nacks", range(ATTEMPTS + 2))
def test_retries_are_bounded_and_counted(bus: I2cBus, gyro, nacks: int):
    gyro.nacks = nacks
    if nacks < ATTEMPTS:
        assert bus.read(CHIP, 0x0F, 1) == b"\xd7"
    else:
        with pytest.raises(DeviceError):
            bus.read(CHIP, 0x0F, 1)
    assert bus.retries == min(nacks, ATTEMPTS - 1)
    assert gyro.transfers == min(nacks + 1, ATTEMPTS)


def test_a_hang_is_short_and_not_repeated(bus: I2cBus, gyro, clock: ManualClock):
    gyro.hangs = 5
    with pytest.raises(DeviceError, match=r"hangs.*errno 110"):
        bus.read(CHIP, 0x0F, 1)
    assert clock.now_ns() - START_NS <= 50_000_000
    assert gyro.transfers == 1


def test_a_chip_that_hangs_leaves_the_others_reachable(bus: I2cBus, adapter: Adapter, gyro):
    adapter.chips[0x1E] = lis3mdl(Sky())
    gyro.hangs = 1
    with pytest.raises(DeviceError):
        bus.read(CHIP, 0x0F, 1)
    assert bus.read(0x1E, 0x0F, 1) == b"\x3d"


@pytest.mark.parametrize(
    ("error", "advice"),
    [
        (FileNotFoundError(errno.ENOENT, "No such file"), "dtparam=i2c_arm=on"),
        (PermissionError(errno.EACCES, "Permission denied"), "group i2c"),
    ],
)
def test_a_bus_that_cannot_be_opened_says_what_to_do(adapter: Adapter, error: OSError, advice: str):
    adapter.open_error = error
    bus = I2cBus(1)
    with pytest.raises(DeviceError, match=advice):
        bus.open()
    assert adapter.opened == 0
    adapter.open_error = None
    bus.open()
    bus.open()
    assert adapter.opened == 1
    bus.close()
    bus.close()
    assert adapter.opened == 0


def test_an_adapter_that_refuses_its_timeout_is_closed_again(adapter: Adapter, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object) -> int:
        raise OSError(errno.ENOTTY, "Inappropriate ioctl for device")

    monkeypatch.setattr("buddyline.node.drivers.i2c.ioctl", refuse)
    with pytest.raises(DeviceError, match="timeout"):
        I2cBus(1).open()
    assert adapter.opened == 0


def test_without_smbus2_the_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "smbus2", None)
    with pytest.raises(DeviceError, match="make install EXTRAS=pi"):
        I2cBus(1)


def test_transfers_of_two_threads_never_mix(bus: I2cBus, adapter: Adapter, gyro, monkeypatch: pytest.MonkeyPatch):
    """A transfer in the middle of another one finds the adapter taken."""
    adapter.chips[0x1E] = lis3mdl(Sky())
    inside = threading.Lock()
    plain = adapter.ioctl

    def guarded(fd: int, request: int, argument: object) -> int:
        assert inside.acquire(blocking=False)
        try:
            turn.wait(1e-4)  # gives the interpreter to the others
            return plain(fd, request, argument)
        finally:
            inside.release()

    monkeypatch.setattr("smbus2.smbus2.ioctl", guarded)
    turn = threading.Event()
    wrong: list[bytes] = []

    def read(address: int, expected: bytes) -> None:
        for _ in range(50):
            try:
                data = bus.read(address, 0x0F, 1)
            except AssertionError:
                data = b"mixed"
            if data != expected:
                wrong.append(data)

    threads = [threading.Thread(target=read, args=args) for args in ((CHIP, b"\xd7"), (0x1E, b"\x3d"), (CHIP, b"\xd7"))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert wrong == []
