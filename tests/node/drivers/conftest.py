"""An adapter with chips on the wire, our bus over unmodified smbus2, and a camera's sensor behind picamera2."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest
from buddyline.node.drivers.i2c import I2cBus
from buddyline.protocol.clock import ManualClock

from tests.node.drivers import picamera2_rig
from tests.node.drivers import standin_picamera2 as standin
from tests.node.drivers.wire import Adapter

START_NS = 1_764_000_000_000_000_000


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock(START_NS)


@pytest.fixture
def adapter(clock: ManualClock, monkeypatch: pytest.MonkeyPatch) -> Adapter:
    adapter = Adapter(clock)
    adapter.attach(monkeypatch)
    return adapter


@pytest.fixture
def bus(adapter: Adapter) -> Iterator[I2cBus]:
    with I2cBus(1) as bus:
        yield bus
    assert adapter.opened == 0


@pytest.fixture
def sensor(monkeypatch: pytest.MonkeyPatch) -> standin.Sensor:
    sensor = standin.Sensor(ManualClock(picamera2_rig.START_NS))
    for name, module in standin.modules(sensor).items():
        monkeypatch.setitem(sys.modules, name, module)
    return sensor
