"""The doctor: each judgement over given facts, the files they come from, and the program as a diver runs it."""

import json
import threading
import time

import msgspec
import numpy as np
import pytest
from buddyline.node.capture.exposure import Exposure
from buddyline.node.chrony import decode_tracking
from buddyline.node.config import NodeConfig, PanelConfig, PowerConfig, load_node_config
from buddyline.node.detect import Detection
from buddyline.node.drivers.samples import BatterySample, DeviceError
from buddyline.node.power.board import Throttled, temperature_degc
from buddyline.node.underwater.pins import PanelPins
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.messages import Attitude, Blob, Depth, Imu, NodeStatus
from buddyline.protocol.topics import INFO, NODE_STATUS
from buddyline.tools.cli import main
from buddyline.tools.client import ClientConfig
from buddyline.tools.doctor import bus, diagnosis, machine, rig
from buddyline.tools.health import machine as judge_machine
from buddyline.tools.health import rig as judge_rig
from buddyline.tools.health.finding import Finding, status_of
from buddyline.tools.health.pair import reported
from buddyline.tools.health.words import power_words
from msgspec import UNSET

from tests.node.test_chrony import FOLLOWS, LOST, SERVES
from tests.processes import REPOSITORY

EXAMPLES = REPOSITORY / "node" / "examples"
STAMP_NS = 1_764_000_000_000_000_000
CALIBRATION = load_node_config(EXAMPLES / "pi.toml")
INFO_A = CALIBRATION.node_info(STAMP_NS, "", "", 0)


def camera(**changes):
    return msgspec.structs.replace(INFO_A, camera=msgspec.structs.replace(INFO_A.camera, **changes))


@pytest.mark.parametrize(
    ("line", "error", "timesyncd", "stamps", "level"),
    [
        (FOLLOWS, "", False, True, "ok"),
        (SERVES, "", False, True, "ok"),
        (LOST, "", False, True, "problem"),
        (LOST, "", False, False, "warning"),
        (FOLLOWS.replace("0.000000683", "0.010"), "", False, True, "problem"),
        (FOLLOWS.replace("0.000000947", "0.010"), "", False, True, "problem"),
        (None, "chronyc gave no answer", False, True, "problem"),
        (None, "", True, True, "warning"),
        (None, "", False, True, "warning"),
    ],
)
def test_clock(line, error, timesyncd, stamps, level):
    tracking = None if line is None else decode_tracking(line)
    found = judge_machine.clock(tracking, error, timesyncd, stamps=stamps)
    assert found.level == level
    assert bool(found.advice) == (level != "ok")


@pytest.mark.parametrize(("degc", "level"), [(None, "skipped"), (45.0, "ok"), (72.0, "warning"), (80.0, "problem")])
def test_temperature(degc, level):
    assert judge_machine.temperature(degc).level == level


@pytest.mark.parametrize(
    ("bits", "level", "word"),
    [
        (None, "skipped", "not report"),
        (0, "ok", "no undervoltage"),
        (0x50005, "problem", "undervoltage now"),
        (0x40004, "problem", "slowed down now"),
        (0x50000, "warning", "undervoltage since"),
        (0x40000, "warning", "slowed down since"),
    ],
)
def test_power(bits, level, word):
    found = judge_machine.power(bits)
    assert (found.level, word in found.text) == (level, True)


@pytest.mark.parametrize(
    ("free_bytes", "rate_px", "error", "level"),
    [
        (60_000_000_000, 4e6, "", "ok"),
        (9_000_000_000, 4e6, "", "warning"),
        (100_000_000, 0.0, "", "problem"),
        (60_000_000_000, 0.0, "cannot be written: Read-only file system", "problem"),
    ],
)
def test_disk(free_bytes, rate_px, error, level):
    assert judge_machine.disk("/d", free_bytes, 200_000_000, rate_px, error).level == level


@pytest.mark.parametrize(
    ("info", "shape", "level", "word"),
    [
        (None, None, "problem", "none"),
        (INFO_A, (616, 820, 3), "problem", "1640x1232 pixels, the camera gives 820x616"),
        (camera(cx_px=400.0), None, "problem", "centre"),
        (camera(fx_px=200.0, fy_px=200.0), None, "problem", "focal"),
        (INFO_A, (1232, 1640), "warning", "without distortion"),
        (
            msgspec.structs.replace(INFO_A, light_left_m=(0.4, 0.0, 0.0), light_right_m=(-0.4, 0.0, 0.0)),
            None,
            "problem",
            "swapped",
        ),
    ],
)
def test_calibration(info, shape, level, word):
    found = judge_rig.calibration(CALIBRATION.calibration, info, shape)
    assert (found.level, word in found.text) == (level, True), found


def test_a_calibration_of_this_camera_is_accepted():
    assert judge_rig.calibration(None, INFO_A, (1232, 1640)).level == "ok"


@pytest.mark.parametrize(("grey", "level"), [(0, "warning"), (30, "ok"), (255, "warning")])
def test_picture(grey, level):
    assert judge_rig.picture(np.full((20, 30), grey, np.uint8)).level == level


@pytest.mark.parametrize(
    ("state", "had", "level", "word"),
    [
        ("locked", Exposure(80_000), "ok", "locked to the lamps: 0.08 ms, gain 1"),
        ("search", Exposure(80_000), "skipped", "no lamp was seen"),
        (None, Exposure(4_000_000, 2.0), "warning", "fixed: 4 ms, gain 2"),
        (None, None, "ok", "fixed: not told"),
    ],
)
def test_exposure(state, had, level, word):
    found = judge_rig.exposure(state, had)
    assert found.level == level
    assert word in found.text


def test_a_dark_or_bright_picture_is_no_reason_to_change_an_exposure_that_follows_the_lamps():
    assert "exposure_us" not in judge_rig.picture(np.zeros((9, 9), np.uint8), fixed=False).advice
    assert judge_rig.picture(np.full((9, 9), 255, np.uint8), fixed=False).level == "ok"


def detection(score):
    blob = Blob(u_px=1.0, v_px=1.0, sigma_px=1.0, area_px=9.0, peak=200.0, elongation=1.0, score=score)
    return Detection(blob=blob, outline_px=np.zeros((3, 2)), axis_px=np.zeros((2, 2)), why="")


@pytest.mark.parametrize(("scores", "level"), [([[0.9, 0.8]], "ok"), ([[0.9], [0.1, 0.9]], "warning"), ([], "warning")])
def test_lights(scores, level):
    assert judge_rig.lights([[detection(score) for score in frame] for frame in scores]).level == level


NODE = {"node": "a", "stamp_ns": STAMP_NS}
REST = Imu(**NODE, accel_mps2=(0.0, 0.1, -9.8), gyro_radps=(0.0, 0.0, 0.0), mag_t=(2e-5, 0.0, 4e-5))


@pytest.mark.parametrize(
    ("messages", "problem", "level", "word"),
    [
        ([REST], "", "ok", "9.80 m/s2, 45 uT"),
        ([REST], "the bus hangs", "problem", "hangs"),
        ([], "", "problem", "nothing"),
        ([msgspec.structs.replace(REST, accel_mps2=(0.0, 0.0, 0.0))], "", "problem", "not the Earth's"),
        ([msgspec.structs.replace(REST, mag_t=(0.0, 0.0, 0.0))], "", "problem", "not the Earth's"),
        ([Depth(**NODE, depth_m=-40.0, sigma_m=0.1)], "", "problem", "not where"),
        ([Depth(**NODE, depth_m=0.02, sigma_m=0.1)], "", "ok", "+0.02 m"),
        ([Attitude(**NODE, q_ned_body_xyzw=(0.0, 0.0, 0.0, 1.0), sigma_rad=(0.1, 0.1, 0.1))], "", "ok", "6 degrees"),
    ],
)
def test_sensor(messages, problem, level, word):
    found = judge_rig.sensor("imu", messages, problem)
    assert (found.level, word in found.text) == (level, True), found


class Chips:
    """An inertial unit that says nothing is wrong."""

    name, problem, retries = "imu", "", 0

    def __init__(self, message):
        self._message = message

    def next_messages(self, stop):
        return None if stop.wait(0.01) else [self._message]

    def close(self):
        pass


@pytest.mark.parametrize(("mag_t", "level"), [(UNSET, "problem"), (REST.mag_t, "ok")])
def test_a_calibrated_magnetometer_that_is_silent_is_a_problem(mag_t, level, monkeypatch):
    monkeypatch.setattr(rig, "LISTEN_S", 0.1)
    monkeypatch.setattr(rig, "open_sensors", lambda *_: [Chips(msgspec.structs.replace(REST, mag_t=mag_t))])
    sensors = msgspec.structs.replace(CALIBRATION.sensors, magnetometer_offset_t=(1e-6, 0.0, 0.0))
    found = rig.check_sensors(msgspec.structs.replace(CALIBRATION, sensors=sensors))
    assert levels(found) == {"imu": "ok", "compass": level, "imu place": "warning"}


def test_a_missing_place_of_the_inertial_unit_is_a_warning():
    entered = CALIBRATION.calibration
    assert judge_rig.imu_place(entered, chips=False).level == "skipped"
    missing = judge_rig.imu_place(entered, chips=True)
    assert (missing.level, "imu_m" in missing.advice) == ("warning", True)
    assert judge_rig.imu_place(msgspec.structs.replace(entered, imu_m=(0.0, -0.05, 0.1)), chips=True).level == "ok"


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


def status(problem=""):
    return NodeStatus(**NODE, boot="x", software="", uptime_s=5.0, rates_hz={}, drops={}, ages_s={}, problem=problem)


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
    assert "the cable is out" in findings[1].text
    assert "still looking at camera" in capsys.readouterr().err
    assert status_of(findings) == 1
    assert status_of(findings[2:]) == 0


@pytest.mark.parametrize("name", ["a", "b"])
def test_a_simulated_rig_has_no_problem(name, monkeypatch):
    monkeypatch.setattr(rig, "LISTEN_S", 1.0)
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


@pytest.mark.parametrize(
    ("facts", "level", "said"),
    [({}, "ok", "lamp GPIO 27"),
     ({"leak": True, "pressed": True}, "problem", "wet"), ({"pressed": True}, "warning", "held"),
     ({"absent": "halt"}, "problem", "halt"), ({"problems": ["lamp: GPIO 27: busy"]}, "problem", "busy")],
)  # fmt: skip
def test_the_panel_is_judged(facts, level, said):
    known = {"problems": [], "pressed": False, "leak": False, "absent": ""}
    found = judge_rig.panel({"lamp_pin": 27}, **{**known, **facts})
    assert (found.level, said in found.text) == (level, True)


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


@pytest.mark.parametrize(
    ("sample", "cells", "level", "said"),
    [(BatterySample(11.8, 0.83), 3, "ok", "11.8 V, 0.83 A"), (BatterySample(10.4), 3, "warning", "10.4 V"),
     (BatterySample(9.5), 3, "problem", "9.5 V"), (BatterySample(9.5), None, "ok", "9.5 V"),
     (None, 3, "problem", "no answer")],
)  # fmt: skip
def test_the_battery_is_judged(sample, cells, level, said):
    found = judge_machine.battery(sample, cells, "" if sample else "no answer")
    assert (found.level, found.text) == (level, said)


def test_a_gauge_that_is_not_there_is_a_problem_and_none_is_no_finding(monkeypatch):
    def opens(config):
        raise DeviceError("I2C bus 1: no /dev/i2c-1")

    monkeypatch.setattr("buddyline.node.power.watch.open_gauge", opens)
    (found,) = rig.check_battery(NodeConfig(node="a", power=PowerConfig(battery="ina219")))
    assert (found.level, "no /dev/i2c-1" in found.text) == ("problem", True)
    assert rig.check_battery(NodeConfig(node="a")) == []


@pytest.mark.parametrize(
    ("fields", "said"),
    [({"throttled_bits": 0x50000, "temperature_degc": 50.0}, ["undervoltage since the start"]),
     ({"throttled_bits": 1}, []), ({"battery_cell_v": 3.4}, ["3.40 V"]), ({"battery_cell_v": 3.9}, []),
     ({"battery_cell_v": 3.0}, [])],
)  # fmt: skip
def test_what_deserves_a_warning_is_read_from_the_status(fields, said):
    found = reported("node a", msgspec.structs.replace(status(), **fields))
    assert [finding.level for finding in found] == ["warning"] * len(said)
    assert all(words in finding.text for words, finding in zip(said, found, strict=True))


def test_power_is_shown_in_words():
    known = {"temperature_degc": 76.4, "battery_v": 11.24, "battery_a": 0.8, "throttled_bits": 1, "load": "half_rate"}
    assert power_words(msgspec.structs.replace(status(), **known)) == [
        "76 °C", "battery 11.2 V, 0.80 A", "undervoltage", "load lowered: no pictures, half the rate"
    ]  # fmt: skip
    assert power_words(status()) == []
