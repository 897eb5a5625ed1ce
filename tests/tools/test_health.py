"""The one judge: each judgement over given facts, of a machine, a rig and a node's status."""

import msgspec
import numpy as np
import pytest
from buddyline.node.capture.exposure import Exposure
from buddyline.node.chrony import decode_tracking
from buddyline.node.config import load_node_config
from buddyline.node.detect import Detection
from buddyline.node.drivers.samples import BatterySample
from buddyline.protocol.messages import Attitude, Blob, Depth, Imu, NodeStatus
from buddyline.tools.health import machine as judge_machine
from buddyline.tools.health import rig as judge_rig
from buddyline.tools.health.pair import reported
from buddyline.tools.health.words import power_words

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


@pytest.mark.parametrize(
    ("kept", "stamps", "level"), [(True, True, "ok"), (False, True, "warning"), (False, False, "skipped")]
)
def test_clock_chip(kept, stamps, level):
    assert judge_machine.clock_chip(kept=kept, stamps=stamps).level == level


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


def test_a_missing_place_of_the_inertial_unit_is_a_warning():
    entered = CALIBRATION.calibration
    assert judge_rig.imu_place(entered, chips=False).level == "skipped"
    missing = judge_rig.imu_place(entered, chips=True)
    assert (missing.level, "imu_m" in missing.advice) == ("warning", True)
    assert judge_rig.imu_place(msgspec.structs.replace(entered, imu_m=(0.0, -0.05, 0.1)), chips=True).level == "ok"


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


@pytest.mark.parametrize(
    ("sample", "cells", "level", "said"),
    [(BatterySample(11.8, 0.83), 3, "ok", "11.8 V, 0.83 A"), (BatterySample(10.4), 3, "warning", "10.4 V"),
     (BatterySample(9.5), 3, "problem", "9.5 V"), (BatterySample(9.5), None, "ok", "9.5 V"),
     (None, 3, "problem", "no answer")],
)  # fmt: skip
def test_the_battery_is_judged(sample, cells, level, said):
    found = judge_machine.battery(sample, cells, "" if sample else "no answer")
    assert (found.level, found.text) == (level, said)


def status(problem=""):
    return NodeStatus(**NODE, boot="x", software="", uptime_s=5.0, rates_hz={}, drops={}, ages_s={}, problem=problem)


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
