"""The doctor: the facts it gathers from files, bus and devices, and the program as a diver runs it."""

import json
import sys
import threading
import time

import msgspec
import pytest
from buddyline.node.config import NodeConfig, PanelConfig, PowerConfig, load_node_config
from buddyline.node.drivers.samples import DeviceError
from buddyline.node.power.board import Throttled, temperature_degc
from buddyline.node.underwater.pins import PanelPins
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.topics import INFO, NODE_STATUS
from buddyline.tools.cli import main
from buddyline.tools.client import ClientConfig
from buddyline.tools.doctor import bus, diagnosis, machine, rig
from buddyline.tools.health.finding import Finding, status_of
from msgspec import UNSET

from tests.processes import PATIENCE_S
from tests.tools.test_health import CALIBRATION, EXAMPLES, INFO_A, REST, status


class SilentChips:
    """An inertial unit that says nothing is wrong."""

    name, problem, retries = "imu", "", 0

    def __init__(self, message):
        self._message = message

    def next_messages(self, stop):
        return None if stop.wait(0.01) else [self._message]

    def close(self):
        pass


@pytest.mark.parametrize(("mag_t", "level"), [(UNSET, "problem"), (REST.mag_t, "ok")])
@pytest.mark.parametrize(
    "calibrated",
    [
        {"magnetometer_offset_t": (1e-6, 0.0, 0.0)},
        {"magnetometer_matrix": ((1.1, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
    ],
)
def test_a_calibrated_magnetometer_that_is_silent_is_a_problem(calibrated, mag_t, level, monkeypatch):
    monkeypatch.setattr(rig, "LISTEN_S", 0.1)
    monkeypatch.setattr(rig, "open_sensors", lambda *_: [SilentChips(msgspec.structs.replace(REST, mag_t=mag_t))])
    sensors = msgspec.structs.replace(CALIBRATION.sensors, **calibrated)
    found = rig.check_sensors(msgspec.structs.replace(CALIBRATION, sensors=sensors))
    assert levels(found) == {"imu": "ok", "compass": level, "imu place": "warning"}


def test_the_pis_system_files_are_read(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert temperature_degc(tmp_path) is None
    assert Throttled(tmp_path).read() is None
    assert not machine.timesyncd(tmp_path)
    files = {
        "sys/class/thermal/thermal_zone0/temp": "48312\n",
        "sys/class/thermal/thermal_zone1/temp": "cold\n",
        "sys/class/hwmon/hwmon1/name": "rpi_volt\n",
        "sys/class/hwmon/hwmon1/in0_lcrit_alarm": "1\n",
        "run/systemd/timesync/synchronized": "",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert temperature_degc(tmp_path) == pytest.approx(48.312)
    assert Throttled(tmp_path).read() == 1
    assert machine.timesyncd(tmp_path)
    script = tmp_path / "vcgencmd"
    script.write_text("#!/bin/sh\necho throttled=0x50000\n")
    script.chmod(0o755)
    assert Throttled(tmp_path).read() == 0x50000
    firmware = tmp_path / "sys/devices/platform/soc/soc:firmware/get_throttled"
    firmware.parent.mkdir(parents=True)
    firmware.write_text("50005\n")
    assert Throttled(tmp_path).read() == 0x50005


def test_free_space_is_that_of_the_nearest_existing_folder(tmp_path):
    free_bytes, error = machine.space(tmp_path / "not" / "yet")
    assert free_bytes > 0
    assert error == ""
    (tmp_path / "file").write_text("")
    assert "cannot be written" in machine.space(tmp_path / "file")[1]


def levels(findings):
    return {finding.name: finding.level for finding in findings}


def test_hub_and_nodes_on_the_bus_are_judged():
    absent = bus.check_bus(bus.Seen(error="no hub at tcp/x", no_hub=True), "tcp/x", None)
    assert levels(absent) == {"hub": "warning", "nodes": "skipped"}
    refused = bus.check_bus(bus.Seen(error="certificate expired"), "tcp/x", None)
    assert levels(refused)["hub"] == "problem"
    seen = bus.Seen(infos={"a": INFO_A}, statuses={"a": status()}, alive={"node/a", "solver/a_b"})
    assert levels(bus.check_bus(seen, "tcp/x", None)) == {"hub": "ok", "node a": "ok"}
    assert levels(bus.check_bus(seen, "tcp/x", "a"))["nodes"] == "warning"
    seen = bus.Seen(infos={"a": INFO_A}, statuses={"a": status("camera: gone")}, alive={"node/a", "node/b"})
    assert levels(bus.check_bus(seen, "tcp/x", "a")) == {
        "hub": "ok",
        "node a": "problem",
        "node b": "problem",
        "solver": "warning",
    }


def test_each_node_of_a_team_is_judged_by_itself():
    infos = {node: msgspec.structs.replace(INFO_A, node=node) for node in "abd"}
    statuses = {node: msgspec.structs.replace(status("hot" if node == "b" else ""), node=node) for node in "abcd"}
    alive = {*(f"node/{node}" for node in "abcde"), "solver/share/0123"}
    found = {
        one.name: one for one in bus.check_bus(bus.Seen(infos=infos, statuses=statuses, alive=alive), "tcp/x", "a")
    }
    assert list(found) == ["hub", "node a", "node b", "node c", "node d", "node e"]
    assert {name: one.level for name, one in found.items() if one.level != "ok"} == {
        "node b": "problem",
        "node c": "problem",
        "node e": "problem",
    }
    assert "hot" in found["node b"].text
    assert "calibration is not known" in found["node c"].text


def test_the_bus_is_watched_for_the_given_time():
    network = LocalNetwork()
    with network.connect() as node, network.connect() as doctor:
        node.declare_alive("node/a")
        node.publisher(INFO, "a").put(INFO_A)
        node.publisher(NODE_STATUS, "a").put(status("hot"))
        node.publisher(NODE_STATUS, "b").put_bytes(b"{}")
        seen = bus.watch(doctor, 1.0)
    assert (seen.alive, seen.infos["a"].node, seen.statuses["a"].problem) == ({"node/a"}, "a", "hot")


def test_a_check_that_hangs_or_fails_is_named_and_hides_no_other(capsys, monkeypatch):
    monkeypatch.setattr(diagnosis, "SAY_AFTER_S", 0.05)
    forever = threading.Event()

    def fails():
        raise BuddylineError("the cable is out")

    findings = diagnosis.together(
        {
            "camera": lambda: [Finding("camera", "ok", str(forever.wait()))],
            "bus": fails,
            "disk": lambda: [Finding("disk", "ok", "x")],
        },
        time.monotonic() + 1.0,
    )
    forever.set()
    assert [(f.name, f.level) for f in findings] == [("camera", "problem"), ("bus", "problem"), ("disk", "ok")]
    assert findings[1].text == "the cable is out"
    assert "still looking at camera" in capsys.readouterr().err
    assert status_of(findings) == 1
    assert status_of(findings[2:]) == 0


@pytest.mark.parametrize("name", ["a", "b"])
def test_a_simulated_rig_has_no_problem(name, monkeypatch):
    monkeypatch.setattr(rig, "LISTEN_S", 1.0)
    # A loaded machine takes longer until the exposure is locked, and until all sensors are heard.
    monkeypatch.setattr(rig, "FRAMES_WITHIN_S", PATIENCE_S)
    monkeypatch.setattr(rig, "SENSE_S", PATIENCE_S)
    config = load_node_config(EXAMPLES / f"{name}.toml")
    with monkeypatch.context() as patched:
        # The other node swims: at this instant it is in view.
        patched.setattr(rig, "SystemClock", lambda: ManualClock(1_764_000_002 * S_NS))
        assert levels(rig.check_camera(config)) == {
            "camera": "ok",
            "exposure": "ok",
            "calibration": "ok",
            "lights": "ok",
        }
    assert levels(rig.check_sensors(config)) == {
        "attitude": "ok",
        "depth": "ok",
        "imu": "ok",
        "compass": "skipped",
        "imu place": "skipped",
    }


def test_on_a_pi_without_camera_and_sensors_each_is_a_problem(monkeypatch):
    monkeypatch.setattr(rig, "SENSE_S", 0.5)
    config = load_node_config(EXAMPLES / "pi.toml")
    config = msgspec.structs.replace(config, sensors=msgspec.structs.replace(config.sensors, i2c_bus=250))
    found = rig.check_camera(config)
    assert levels(found) == {"camera": "problem", "calibration": "warning", "lights": "skipped"}
    sensors = rig.check_sensors(config)
    assert levels(sensors) == {"imu": "problem", "depth": "problem", "compass": "warning", "imu place": "warning"}
    assert "no /dev/i2c-250" in sensors[0].text


def test_a_camera_without_frames_is_a_problem(monkeypatch):
    class Silent:
        problem = ""
        exposure_control = None

        def info(self):
            return INFO_A

        def next_frame(self, stop):
            stop.wait()

        def close(self):
            pass

    monkeypatch.setattr(rig, "open_camera", lambda *_: Silent())
    monkeypatch.setattr(rig, "FRAMES_WITHIN_S", 0.05)
    assert levels(rig.check_camera(NodeConfig(node="a")))["camera"] == "problem"


def test_a_node_that_runs_is_not_disturbed(monkeypatch):
    def refuse(_):
        raise AssertionError("its devices are in use")

    running = bus.Seen(infos={"a": INFO_A}, statuses={"a": status()}, alive={"node/a"})
    monkeypatch.setattr(diagnosis.bus, "look", lambda *_: running)
    monkeypatch.setattr(rig, "check_camera", refuse)
    found = diagnosis.diagnose(NodeConfig(node="a"), ClientConfig())
    assert found[-1].level == "skipped"
    assert "in use" in found[-1].text


def test_the_program(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(diagnosis.bus, "look", lambda *_: bus.Seen(error="no hub at tcp/x", no_hub=True))
    monkeypatch.setattr(diagnosis, "read_tracking", lambda: None)
    monkeypatch.setattr(rig, "LISTEN_S", 1.0)
    monkeypatch.chdir(tmp_path)
    assert main(["doctor", "--config", str(EXAMPLES / "a.toml")]) == 0
    assert "-> start it: buddyline hub" in capsys.readouterr().out
    status_ = main(["doctor", "--json"])
    said = json.loads(capsys.readouterr().out)
    assert said["status"] == status_
    assert {"clock", "disk", "temperature", "power", "hub"} <= {finding["name"] for finding in said["findings"]}
    (tmp_path / "viewer.toml").write_text('connect = "tcp/127.0.0.1:1"\n')
    assert diagnosis.load(str(tmp_path / "viewer.toml")) == (None, ClientConfig(connect="tcp/127.0.0.1:1"))
    (tmp_path / "bad.toml").write_text('node = "a"\nrate = 3\n')
    assert main(["doctor", "--config", str(tmp_path / "bad.toml")]) == 2
    assert "unknown key `rate`" in capsys.readouterr().err


def test_the_panels_pins_are_tried_and_left_dark(monkeypatch):
    mock = pytest.importorskip("gpiozero.pins.mock", reason="gpiozero is not installed")
    factory = mock.MockFactory()
    monkeypatch.setattr(rig, "PanelPins", lambda panel: PanelPins(panel, factory))
    panel = PanelConfig(button_pin=17, lamp_pin=27, leak_pin=24, shutdown_command=["no-such-program"])
    node = NodeConfig(node="a", panel=panel)
    assert "no-such-program" in rig.check_panel(node)[0].text
    assert not factory.pin(27).state
    factory.pin(24).drive_high()
    factory.pin(24)._set_pull = lambda value: None  # the probe is stronger than the Pi's pull-down
    assert levels(rig.check_panel(node)) == {"panel": "problem"}
    assert rig.check_panel(NodeConfig(node="a")) == []


def test_a_display_that_does_not_answer_is_a_problem(monkeypatch):
    monkeypatch.setitem(sys.modules, "luma.oled", None)
    found = rig.check_panel(NodeConfig(node="a", panel=PanelConfig(display="ssd1306")))
    assert levels(found) == {"panel": "problem"}
    assert "make install EXTRAS=display" in found[0].text


def test_a_gauge_that_is_not_there_is_a_problem_and_none_is_no_finding(monkeypatch):
    def opens(config):
        raise DeviceError("I2C bus 1: no /dev/i2c-1")

    monkeypatch.setattr("buddyline.node.power.watch.open_gauge", opens)
    (found,) = rig.check_battery(NodeConfig(node="a", power=PowerConfig(battery="ina219")))
    assert (found.level, "no /dev/i2c-1" in found.text) == ("problem", True)
    assert rig.check_battery(NodeConfig(node="a")) == []
