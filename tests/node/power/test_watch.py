"""Power and heat of a node: the kernel's files below a root of their own, a gauge on the wire, the status."""

import threading
import time

import pytest
from buddyline.node.config import CameraConfig, NodeConfig, PowerConfig, load_node_config
from buddyline.node.drivers.samples import BatterySample, DeviceError
from buddyline.node.power import board
from buddyline.node.power.watch import BatteryGauge, PowerWatch
from buddyline.protocol.config import ConfigError

PI = CameraConfig(name="picamera2")


class Kernel:
    """The files of a Pi's kernel."""

    def __init__(self, root):
        self.root = root
        self.set(48.0, 0)

    def set(self, degc, bits):
        for name, text in (
            ("sys/class/thermal/thermal_zone0/temp", f"{degc * 1000:.0f}\n"),
            ("sys/devices/platform/soc/soc:firmware/get_throttled", f"{bits:x}\n"),
        ):
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            (self.root / name).write_text(text)


@pytest.fixture
def kernel(tmp_path):
    return Kernel(tmp_path)


def watch(kernel, gauge=None, **config):
    config = NodeConfig(node="a", **{"camera": PI, **config})
    return PowerWatch(config, gauge, kernel.root)


def test_temperature_and_bits_are_in_the_status(kernel):
    power = watch(kernel)
    assert power.status_fields() == {"load": "full"}
    kernel.set(61.5, 0x50005)
    power.look(0.0)
    assert power.status_fields() == {"temperature_degc": 61.5, "throttled_bits": 0x50005, "load": "no_pictures"}
    assert power.problems == [
        "power: undervoltage now",
        "power: the processor is slowed down now",
        "load: lowered because of heat or undervoltage: no pictures are recorded or shown",
    ]
    kernel.set(61.5, 0x50000)
    power.look(1.0)
    assert len(power.problems) == 1


def test_a_hot_node_takes_no_pictures_then_leaves_out_every_second_trigger_and_says_so(kernel):
    power = watch(kernel, rate_hz=10.0)
    kernel.set(79.0, 0)
    power.look(0.0)
    assert not power.takes_pictures
    assert not any(power.skips(k * 100_000_000) for k in range(10))
    power.look(60.0)
    assert [power.skips(k * 100_000_000) for k in range(4)] == [False, True, False, True]
    assert "every second trigger is left out" in power.problems[0]
    kernel.set(50.0, 0)
    for now_s in (61.0, 200.0, 201.0, 400.0):
        power.look(now_s)
    assert power.takes_pictures
    assert power.problems == []


@pytest.mark.parametrize("config", [{"power": PowerConfig(lower_load=False)}, {"camera": CameraConfig()}])
def test_a_load_that_must_not_be_lowered_is_not(kernel, config):
    power = watch(kernel, **config)
    kernel.set(95.0, 0)
    power.look(0.0)
    assert power.takes_pictures
    assert "load" not in power.status_fields()


def test_a_machine_without_these_files_has_no_such_fields(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    power = PowerWatch(NodeConfig(node="a"), root=tmp_path)
    power.look(0.0)
    assert power.status_fields() == {}
    assert power.problems == []


def test_the_firmwares_program_is_asked_seldom(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(board, "_ask_firmware", lambda: asked.append(1) or 0x4)
    bits = board.Throttled(tmp_path)
    assert [bits.read() for _ in range(50)] == [4] * 50
    assert len(asked) == 1
    monkeypatch.setattr(board, "COMMAND_EVERY_S", 0.0)
    bits.read()
    assert len(asked) == 2


def test_the_firmwares_program_is_never_asked_where_there_is_a_file(kernel, monkeypatch):
    monkeypatch.setattr(board, "_ask_firmware", lambda: pytest.fail("a process per look"))
    assert board.Throttled(kernel.root).read() == 0


class Gauge:
    """A gauge that can be taken off the bus; also its bus."""

    def __init__(self):
        self.there, self.voltage_v, self.starts, self.closed = True, 11.1, 0, 0

    def start(self):
        self.starts += 1
        self.read()

    def read(self):
        if not self.there:
            raise DeviceError("I2C bus 1, address 0x40, register 0x00: no answer")
        return BatterySample(self.voltage_v, 0.5)

    def close(self):
        self.closed += 1


def test_the_battery_is_in_the_status_and_an_empty_one_is_a_problem(kernel):
    config, chip = NodeConfig(node="a", camera=PI, power=PowerConfig(battery="ina219", cells=3)), Gauge()
    power = PowerWatch(config, BatteryGauge(config, lambda: (chip, chip)), kernel.root)
    power.look(0.0)
    assert "battery_v" not in power.status_fields()
    power.look(1.0)
    fields = power.status_fields()
    assert (fields["battery_v"], fields["battery_a"], fields["battery_cell_v"]) == (11.1, 0.5, pytest.approx(3.7))
    assert power.problems == []
    chip.voltage_v = 9.5
    power.look(2.0)
    assert power.problems == ["battery: empty"]


def test_a_gauge_that_falls_silent_is_named_has_no_reading_and_is_set_up_again():
    config, chip = NodeConfig(node="a", power=PowerConfig(battery="ina219")), Gauge()
    gauge = BatteryGauge(config, lambda: (chip, chip))
    gauge.look(0.0)
    gauge.look(1.0)
    assert gauge.sample == BatterySample(11.1, 0.5)
    chip.there = False
    for now_s in (2.0, 3.0, 4.0, 5.0):
        gauge.look(now_s)
    assert (gauge.sample, "no answer" in gauge.problem) == (None, True)
    assert chip.closed > 0
    chip.there = True
    gauge.look(7.0)
    gauge.look(8.0)
    assert (gauge.sample, gauge.problem) == (BatterySample(11.1, 0.5), "")
    gauge.close()


def test_it_runs_until_it_is_stopped(kernel, monkeypatch):
    monkeypatch.setattr("buddyline.node.power.watch.EVERY_S", 0.01)
    power, stop = watch(kernel), threading.Event()
    thread = threading.Thread(target=power.run, args=(stop,))
    thread.start()
    deadline_s = time.monotonic() + 30.0
    while "temperature_degc" not in power.status_fields():
        assert time.monotonic() < deadline_s
    stop.set()
    thread.join(30.0)
    assert not thread.is_alive()
    power.close()


@pytest.mark.parametrize(
    ("lines", "said"),
    [("battery = 'ina219'\naddress = 0x50", "power.address = 0x50: battery = 'ina219' takes 0x40 to 0x4f"),
     ("battery = 'ads1115'\naddress = 0x4c", "power.address = 0x4c: .* takes 0x48 to 0x4b"),
     ("address = 0x40", "takes no address"), ("battery = 'ina226'", "power.battery = 'ina226'"),
     ("shunt_ohm = 0.0", "power.shunt_ohm = 0.0"), ("channel = 4", "power.channel = 4"),
     ("divider = 0.5", "power.divider = 0.5"), ("cells = 0", "power.cells = 0"), ("cell = 3", "did you mean `cells`")],
)  # fmt: skip
def test_a_supply_that_cannot_be_is_refused_with_file_field_and_value(tmp_path, lines, said):
    path = tmp_path / "a.toml"
    path.write_text(f'node = "a"\n[power]\n{lines}\n')
    with pytest.raises(ConfigError, match=f"a.toml: .*{said}"):
        load_node_config(path)


def test_the_gauges_address_is_the_chips_first_or_the_configured():
    assert PowerConfig(battery="ina219").gauge_address == 0x40
    assert PowerConfig(battery="ads1115").gauge_address == 0x48
    assert PowerConfig(battery="ads1115", address=0x4A).gauge_address == 0x4A
