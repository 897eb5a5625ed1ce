"""The ellipsoid fit against rigs whose iron is known, and its refusals."""

from __future__ import annotations

import argparse
import tomllib

import cv2
import numpy as np
import pytest
from buddyline.node.config import SensorsConfig
from buddyline.node.geomagnetism import MagnetometerCalibration
from buddyline.protocol.codec import encode
from buddyline.protocol.config import parse_config
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Imu
from buddyline.protocol.topics import IMU
from buddyline.tools.calibration import command as calibrate
from buddyline.tools.calibration.ellipsoid import coverage, fit
from buddyline.tools.calibration.leastsquares import PoorCalibration

FIELD_T = 48e-6
DIP_RAD = np.radians(62.0)
SOFT_IRON = np.array([[1.12, 0.04, -0.02], [0.03, 0.93, 0.05], [-0.04, 0.02, 1.03]])
HARD_IRON_T = np.array([18e-6, -25e-6, 9e-6])


def turned_rig(tilt_deg: float = 180.0, n: int = 3000, seed: int = 0, noise_t: float = 0.4e-6):
    """Return readings (n, 3) and accelerations (n, 3) of a rig turned about, tilted by up to tilt_deg."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 60, n)
    yaw, tilt, around = t * 1.3 + np.sin(t / 3), np.radians(tilt_deg) * np.sin(t * 0.7 + 0.3), t * 0.37
    axis = np.stack([np.cos(around), np.sin(around), np.zeros(n)], -1)
    zero = np.zeros(n)
    K = np.stack(
        [
            np.stack([zero, zero, axis[:, 1]], -1),
            np.stack([zero, zero, -axis[:, 0]], -1),
            np.stack([-axis[:, 1], axis[:, 0], zero], -1),
        ],
        1,
    )
    tilted = np.eye(3) + np.sin(tilt)[:, None, None] * K + (1 - np.cos(tilt))[:, None, None] * (K @ K)
    c, s = np.cos(yaw), np.sin(yaw)
    about = np.stack([np.stack([c, -s, zero], -1), np.stack([s, c, zero], -1), np.stack([zero, zero, zero + 1], -1)], 1)
    R_ned_body = about @ tilted
    field = FIELD_T * np.array([np.cos(DIP_RAD), 0.0, np.sin(DIP_RAD)])
    readings = np.einsum("nji,j->ni", R_ned_body, field) @ SOFT_IRON.T + HARD_IRON_T
    accels = np.einsum("nji,j->ni", R_ned_body, np.array([0.0, 0.0, -9.80665]))
    return readings + rng.normal(0, noise_t, (n, 3)), accels + rng.normal(0, 0.05, (n, 3))


def heading_errors_deg(offset_t, matrix) -> np.ndarray:
    """Errors of a level rig's heading, all around, after the calibration."""
    heading = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    level = FIELD_T * np.stack(
        [np.cos(DIP_RAD) * np.cos(heading), -np.cos(DIP_RAD) * np.sin(heading), np.full(36, np.sin(DIP_RAD))], -1
    )
    field = MagnetometerCalibration(np.asarray(offset_t), np.asarray(matrix)).apply(level @ SOFT_IRON.T + HARD_IRON_T)
    return (np.degrees(np.arctan2(-field[:, 1], field[:, 0]) - heading) + 180) % 360 - 180


def test_uncalibrated_headings_are_far_off():
    assert np.abs(heading_errors_deg(np.zeros(3), np.eye(3))).max() > 30


@pytest.mark.parametrize(("tilt_deg", "limit_deg"), [(180.0, 0.5), (90.0, 1.0), (65.0, 1.5)])
@pytest.mark.parametrize("seed", [0, 1])
def test_hard_and_soft_iron_are_removed(tilt_deg, limit_deg, seed):
    found = fit(*turned_rig(tilt_deg, seed=seed), norm_t=FIELD_T)
    assert np.abs(heading_errors_deg(found.offset_t, found.matrix)).max() < limit_deg
    assert found.norm_t == FIELD_T
    assert found.offset_t == pytest.approx(HARD_IRON_T, abs=0.5e-6 if tilt_deg > 90 else 2e-6)
    assert found.turned


def test_strength_follows_the_given_field():
    readings, accels = turned_rig()
    found = fit(readings, accels, norm_t=FIELD_T)
    calibrated = (readings - found.offset_t) @ found.matrix.T
    assert np.linalg.norm(calibrated, axis=1).mean() == pytest.approx(FIELD_T, rel=0.002)
    free = fit(readings, accels)
    assert 0.8 < np.linalg.det(free.matrix) < 1.2


@pytest.mark.parametrize("tilt_deg", [0.0, 10.0, 20.0, 40.0])
def test_thin_coverage_is_refused(tilt_deg):
    with pytest.raises(PoorCalibration, match="turn"):
        fit(*turned_rig(tilt_deg))


def test_a_rig_at_rest_is_refused():
    readings, accels = turned_rig()
    with pytest.raises(PoorCalibration, match="turn the rig"):
        fit(readings[:1] + np.random.default_rng(1).normal(0, 0.3e-6, (500, 3)), accels[:500])


def test_a_passing_car_is_left_out_and_a_parking_place_is_refused():
    readings, accels = turned_rig()
    passing = readings.copy()
    passing[1000:1060] += [20e-6, 0.0, 0.0]
    found = fit(passing, accels, norm_t=FIELD_T)
    assert np.abs(heading_errors_deg(found.offset_t, found.matrix)).max() < 0.6
    parking = readings + 12e-6 * np.sin(np.arange(len(readings)) / 40)[:, None] * [1.0, 0.5, -0.5]
    with pytest.raises(PoorCalibration, match="steel"):
        fit(parking, accels)


def test_coverage_counts_directions():
    rng = np.random.default_rng(0)
    everywhere = rng.normal(size=(2000, 3))
    everywhere /= np.linalg.norm(everywhere, axis=1, keepdims=True)
    assert coverage(everywhere) == 1.0
    half = everywhere[everywhere[:, 2] > 0]
    assert 0.45 < coverage(half) < 0.75
    assert coverage(everywhere[:1]) < 0.1


def arguments(*text: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    calibrate.add_arguments(parser)
    return parser.parse_args(text)


@pytest.fixture
def logged(tmp_path):
    """Return a function that writes a log with readings of node a."""

    def write(readings, accels, name="a.mcap") -> str:
        path = tmp_path / name
        with DiveLogWriter(path) as writer:
            for i, (mag, accel) in enumerate(zip(readings, accels, strict=True)):
                stamp_ns = 1_764_000_000_000_000_000 + i * 20_000_000
                imu = Imu(
                    node="a", stamp_ns=stamp_ns, accel_mps2=tuple(accel), gyro_radps=(0.0, 0.0, 0.0), mag_t=tuple(mag)
                )
                writer.write(IMU.key("a"), encode(imu), stamp_ns, stamp_ns)
        return str(path)

    return write


def test_command_prints_what_the_node_takes(logged, tmp_path, capsys):
    log = logged(*turned_rig(n=1500))
    picture = tmp_path / "m.png"
    assert calibrate.run(arguments("magnetometer", log, "--picture", str(picture))) == 0
    text = capsys.readouterr().out
    sensors = parse_config("\n".join(line for line in text.splitlines() if "=" in line), SensorsConfig, "printed")
    assert np.abs(heading_errors_deg(sensors.magnetometer_offset_t, sensors.magnetometer_matrix)).max() < 0.7
    assert tomllib.loads(text)["sensors"]["magnetometer_matrix"]
    assert cv2.imread(str(picture)) is not None


def test_command_keeps_a_picture_that_is_there(logged, tmp_path):
    (tmp_path / "p.png").write_text("precious")
    with pytest.raises(BuddylineError, match=r"p\.png: exists"):
        calibrate.run(arguments("magnetometer", logged(*turned_rig(n=300)), "--picture", str(tmp_path / "p.png")))
    assert (tmp_path / "p.png").read_text() == "precious"


def test_command_refuses_a_rig_that_was_hardly_tilted(logged, tmp_path):
    log = logged(*turned_rig(20.0, n=1500))
    with pytest.raises(PoorCalibration):
        calibrate.run(arguments("magnetometer", log, "--picture", str(tmp_path / "m.png")))
    assert not (tmp_path / "m.png").exists()


def test_command_names_a_node_that_is_not_there(logged, tmp_path):
    log = logged(*turned_rig(n=300))
    with pytest.raises(BuddylineError, match="choose one with --node"):
        calibrate.run(arguments("magnetometer", log, "--node", "b"))


@pytest.mark.parametrize(
    ("words", "missing"),
    [(("magnetometer",), "inertial samples"), (("gyroscope",), "inertial samples"), (("camera",), "pictures")],
)
def test_command_says_that_a_log_has_none_of_what_it_needs(tmp_path, words, missing):
    with DiveLogWriter(tmp_path / "bare.mcap"):
        pass
    with pytest.raises(BuddylineError, match=rf"bare\.mcap: no {missing} of any node"):
        calibrate.run(arguments(*words, str(tmp_path / "bare.mcap")))
