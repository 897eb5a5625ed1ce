"""Attitude in simulated swell, with truth: tilt, heading, their sigmas, and disturbances."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pytest
from buddyline.node.attitude import VqfAttitude, attitudes, ned_of_enu, quaternion_to_matrix
from buddyline.node.drivers.samples import ImuSample
from buddyline.node.geomagnetism import EarthField, MagnetometerCalibration
from buddyline.protocol.errors import BuddylineError

from tests.node import swell

pytest.importorskip("vqf", reason="vqf is not installed: make install EXTRAS=pi")

HERE = EarthField(0.0, float(swell.DIP_RAD), swell.FIELD_T)
SOUND = MagnetometerCalibration(np.full(3, 1e-12), np.eye(3))  # calibrated, and nothing to correct


@dataclass(frozen=True)
class Run:
    """Estimates compared with truth: errors in NED, rad, (n, 3); sigmas (n, 3)."""

    times_s: np.ndarray
    errors_rad: np.ndarray
    sigmas_rad: np.ndarray
    problems: list[str]
    disturbed: np.ndarray

    def tilt_rms_deg(self, since_s: float = 10.0) -> float:
        errors = self.errors_rad[self.times_s > since_s, :2]
        return float(np.degrees(np.sqrt((errors**2).sum(axis=1).mean())))

    def heading_rms_deg(self, which: np.ndarray) -> float:
        return float(np.degrees(np.sqrt((self.errors_rad[which, 2] ** 2).mean())))


def matrix(q_xyzw: tuple[float, float, float, float]) -> np.ndarray:
    x, y, z, w = q_xyzw
    return quaternion_to_matrix(np.array([w, x, y, z]))


def estimate(dive: swell.SwellDive, estimator: VqfAttitude) -> Run:
    found = [(i, out) for i, s in enumerate(dive.samples) if (out := estimator.update(s)) is not None]
    index = [i for i, _ in found]
    R = np.array([matrix(out.q_ned_body_xyzw) for _, out in found])
    return Run(
        dive.times_s[index],
        swell.matrix_to_vector(np.einsum("nij,nkj->nik", R, dive.R_ned_body[index])),
        np.array([out.sigma_rad for _, out in found]),
        [out.problem for _, out in found],
        dive.disturbed[index],
    )


@lru_cache
def calm_run(seed: int = 1) -> Run:
    return estimate(swell.simulate(40.0, seed=seed), VqfAttitude(SOUND, HERE))


@lru_cache
def disturbed_run(seed: int = 1, every: int = 1) -> Run:
    dive = swell.simulate(58.0, seed=seed, disturbances=((34.0, 46.0, 15e-6),))
    return estimate(with_compass(dive, every), VqfAttitude(SOUND, HERE))


def with_compass(dive: swell.SwellDive, every: int) -> swell.SwellDive:
    """Leave the compass out of all samples but some."""
    return replace(dive, samples=[s if i % every == 0 else replace(s, mag_t=None) for i, s in enumerate(dive.samples)])


def test_ned_of_enu_maps_axes():
    """Level and facing north: the body's x is north. Facing east: it is east, in both frames."""
    level_north = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])  # body x forward, z down, in ENU
    assert quaternion_to_matrix(level_north) @ [1, 0, 0] == pytest.approx([0, 1, 0], abs=1e-12)
    assert matrix(ned_of_enu(level_north, 0.0)) == pytest.approx(np.eye(3), abs=1e-12)
    turned = matrix(ned_of_enu(level_north, np.pi / 2))
    assert turned @ [1, 0, 0] == pytest.approx([0, 1, 0], abs=1e-12)


def test_ned_of_enu_is_the_change_of_axes_for_any_attitude():
    rng = np.random.default_rng(3)
    R_ned_enu = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    for _ in range(50):
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        assert matrix(ned_of_enu(q, 0.0)) == pytest.approx(R_ned_enu @ quaternion_to_matrix(q), abs=1e-12)


def test_the_filter_starts_within_five_seconds_at_rest():
    assert 3.0 <= calm_run().times_s[0] <= 5.0


@pytest.mark.parametrize("seed", [1, 2])
def test_tilt_and_heading_in_swell(seed):
    """Half a metre of swell: tilt 0.2 deg, heading 0.3 deg; the bounds leave twice that."""
    run = calm_run(seed)
    assert run.tilt_rms_deg() < 0.4
    assert run.heading_rms_deg(run.times_s > 10) < 0.7
    assert not any(run.problems)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_compass_with_every_fourth_sample_does_as_well(seed):
    """As where a FIFO gives four samples for one reading of the compass."""
    dive = swell.simulate(40.0, seed=seed)
    dense, sparse = (estimate(with_compass(dive, every), VqfAttitude(SOUND, HERE)) for every in (1, 4))
    later = dense.times_s > 10
    assert sparse.heading_rms_deg(later) < 0.7
    # But where a field is confirmed a reading later.
    assert np.isclose(sparse.sigmas_rad[later, 2], dense.sigmas_rad[later, 2], rtol=0.05).mean() > 0.99
    assert not any(sparse.problems)


@pytest.mark.parametrize("every", [1, 4])
def test_a_disturbance_is_flagged_and_hardly_turns_the_heading(every):
    """15 uT fixed to the rig, a third of a horizontal field of 22 uT, turns a bare compass by up to 40 deg."""
    run = disturbed_run(1, every)
    flagged = np.array([bool(problem) for problem in run.problems])
    assert flagged[run.disturbed].mean() > 0.85
    assert not flagged[run.times_s < 34].any()
    assert not flagged[run.times_s > 57].any()
    assert run.heading_rms_deg(run.disturbed) < 1.5
    assert any("differ" in p or "uT" in p for p in run.problems)


@pytest.mark.parametrize("which", [calm_run, disturbed_run])
def test_sigmas_cover_the_errors(which):
    """Sensor offsets are part of the sigmas and not of this simulation: errors are to be well inside."""
    run = which()
    assert (np.abs(run.errors_rad) < 3 * run.sigmas_rad).all()
    assert np.degrees(run.sigmas_rad[-1]) == pytest.approx([1.5, 1.5, 4.0], abs=1.0)


def test_heading_sigma_shrinks_once_a_turn_has_confirmed_the_field():
    run = calm_run()
    assert np.degrees(run.sigmas_rad[0, 2]) > 10
    assert np.degrees(run.sigmas_rad[-1, 2]) < 5


def test_without_a_magnetometer_the_heading_may_be_any_angle():
    dive = swell.simulate(12.0)
    estimator = VqfAttitude(SOUND, HERE)
    out = None
    for s in dive.samples:
        out = estimator.update(ImuSample(s.stamp_ns, s.accel_mps2, s.gyro_radps))
    assert out is not None
    assert out.sigma_rad[2] > 1.8
    assert out.sigma_rad[0] < 0.05


def test_an_uncalibrated_magnetometer_is_hardly_trusted():
    dive = swell.simulate(6.0)
    estimator = VqfAttitude(MagnetometerCalibration.none(), HERE)
    outs = [estimator.update(s) for s in dive.samples]
    assert np.degrees(outs[-1].sigma_rad[2]) > 30


def test_calibration_is_applied():
    """The same dive through a distorting rig and its calibration; without it the heading is off."""
    dive = swell.simulate(8.0, calibrated=False)
    A = np.array([[1.1, 0.03, 0.0], [0.03, 0.95, -0.02], [0.0, -0.02, 1.04]])
    sound = MagnetometerCalibration(np.array([8e-6, -12e-6, 5e-6]), np.linalg.inv(A))
    right = estimate(dive, VqfAttitude(sound, HERE))
    assert np.degrees(np.abs(right.errors_rad[:, 2]).max()) < 3
    bare = estimate(dive, VqfAttitude(MagnetometerCalibration.none()))
    assert np.degrees(np.abs(bare.errors_rad[:, 2]).min()) > 4


def test_a_log_gives_right_headings_with_a_later_calibration():
    dive = swell.simulate(8.0, calibrated=False)
    A = np.array([[1.1, 0.03, 0.0], [0.03, 0.95, -0.02], [0.0, -0.02, 1.04]])
    later = MagnetometerCalibration(np.array([8e-6, -12e-6, 5e-6]), np.linalg.inv(A))
    found = list(attitudes(swell.log_of(dive), VqfAttitude(later, HERE)))
    assert {message.node for message in found} == {"a"}
    R = np.array([matrix(message.q_ned_body_xyzw) for message in found])
    errors = swell.matrix_to_vector(np.einsum("nij,nkj->nik", R, dive.R_ned_body[-len(found) :]))
    assert np.degrees(np.abs(errors[:, 2]).max()) < 3


@pytest.mark.parametrize("declination_deg", [-20.0, 15.0])
def test_declination_turns_to_true_north(declination_deg):
    """Declination east: true heading = magnetic heading + declination."""
    dive = swell.simulate(4.0)
    field = EarthField(np.radians(declination_deg), HERE.dip_rad, HERE.norm_t)
    for estimator in (VqfAttitude(SOUND, field), VqfAttitude(SOUND, declination_rad=field.declination_rad)):
        run = estimate(dive, estimator)
        assert np.degrees(run.errors_rad[-1, 2]) == pytest.approx(declination_deg, abs=1.5)


def test_a_gyroscope_bias_of_five_degrees_a_second_is_removed():
    run = estimate(swell.simulate(20.0, gyro_bias_radps=np.radians(5.0)), VqfAttitude(SOUND, HERE))
    assert run.times_s[0] < 5
    assert run.tilt_rms_deg() < 0.5


@pytest.mark.parametrize("cooling_dps", [0.25, 1.25])
def test_a_gyroscope_that_cools_after_a_rested_start_is_followed(cooling_dps):
    """0.05 deg/s per K and 5 or 25 K, with a time constant of two minutes, on all three axes.

    A bias frozen at its value at rest gives a heading that is 72 deg off at 1.25 deg/s, with a stated 4 deg.
    """
    cooling_radps = np.radians(cooling_dps) * np.array([1.0, -1.0, 1.0])
    run = estimate(swell.simulate(150.0, cooling_radps=cooling_radps), VqfAttitude(SOUND, HERE))
    assert run.tilt_rms_deg() < 1.0
    assert run.heading_rms_deg(run.times_s > 10) < 3.0
    assert (np.abs(run.errors_rad) < 1.5 * run.sigmas_rad).all()
    assert not any(run.problems)


@pytest.mark.parametrize("steps_k", [0.01, 1.0])
def test_a_known_slope_over_the_temperature_keeps_the_heading_while_the_gyroscope_cools(steps_k):
    """By 25 K in two minutes; a chip that counts whole degrees does almost as well."""
    slope = np.radians(0.05) * np.array([1.0, -1.0, 1.0])
    dive = swell.simulate(90.0, cooling_radps=-25.0 * slope)
    cooled_k = -25.0 * (1 - np.exp(-np.clip(dive.times_s - 6.0, 0.0, None) / swell.COOLING_TAU_S))
    told = np.round((30.0 + cooled_k) / steps_k) * steps_k
    samples = [
        replace(s, temperature_degc=float(told[i]) if i % 100 == 0 else None) for i, s in enumerate(dive.samples)
    ]
    unknown = estimate(dive, VqfAttitude(SOUND, HERE))
    known = estimate(replace(dive, samples=samples), VqfAttitude(SOUND, HERE, gyro_bias_radps_per_k=slope))
    late = known.times_s > 10
    assert known.heading_rms_deg(late) < 0.35 * unknown.heading_rms_deg(late)
    assert known.tilt_rms_deg() < unknown.tilt_rms_deg()
    assert (np.abs(known.errors_rad) < 1.5 * known.sigmas_rad).all()


def test_without_rest_the_filter_starts_late_with_a_large_sigma():
    run = estimate(swell.simulate(30.0, rest_s=0.0), VqfAttitude(SOUND, HERE))
    assert 20 < run.times_s[0] < 21
    assert np.degrees(run.sigmas_rad[0, 0]) > 4
    assert (np.abs(run.errors_rad) < 3 * run.sigmas_rad).all()


@pytest.mark.parametrize("step_s", [-1.0, 1.0, -0.5, 3.0])
def test_a_clock_that_steps_widens_sigma_and_keeps_the_attitude(step_s):
    dive = swell.simulate(16.0)
    estimator = VqfAttitude(SOUND, HERE)
    before = after = None
    for i, s in enumerate(dive.samples):
        shift_ns = int(step_s * 1e9) if i >= 1200 else 0
        out = estimator.update(ImuSample(s.stamp_ns + shift_ns, s.accel_mps2, s.gyro_radps, s.mag_t))
        if i == 1199:
            before = out
        if i == 1200:
            after = out
        if i > 1200:
            error = swell.matrix_to_vector((matrix(out.q_ned_body_xyzw) @ dive.R_ned_body[i].T)[None])[0]
            assert np.degrees(np.abs(error).max()) < 3
    assert after.sigma_rad[0] > before.sigma_rad[0]
    assert after.sigma_rad[2] > before.sigma_rad[2]


def test_saturated_samples_widen_sigma():
    """Full scale for half a second: the rate beyond it is not known."""
    dive = swell.simulate(12.0)
    ends = []
    for saturated in (False, True):
        estimator = VqfAttitude(SOUND, HERE)
        for i, s in enumerate(dive.samples):
            out = estimator.update(replace(s, saturated=saturated and i >= len(dive.samples) - 50))
        ends.append(np.degrees(out.sigma_rad))
    assert (ends[1] > ends[0] + 1.0).all()


def test_samples_missing_for_seconds_are_survived():
    dive = swell.simulate(22.0)
    kept = [s for i, s in enumerate(dive.samples) if not 900 < i < 1600]
    where = [i for i in range(len(dive.samples)) if not 900 < i < 1600]
    estimator = VqfAttitude(SOUND, HERE)
    for i, s in zip(where, kept, strict=True):
        out = estimator.update(s)
        if out is not None:
            error = swell.matrix_to_vector((matrix(out.q_ned_body_xyzw) @ dive.R_ned_body[i].T)[None])[0]
            assert (np.abs(error) < 3 * np.array(out.sigma_rad)).all(), i
    assert np.degrees(out.sigma_rad[0]) < 5


def test_uneven_and_missing_samples_do_not_lose_the_rotation():
    """Every fifth sample missing and the rest up to 3 ms late, as on a busy Pi."""
    dive = swell.simulate(24.0)
    rng = np.random.default_rng(5)
    estimator = VqfAttitude(SOUND, HERE)
    errors = []
    for i, s in enumerate(dive.samples):
        if i % 5 == 3:
            continue
        late_ns = int(rng.uniform(0, 3e6))
        out = estimator.update(ImuSample(s.stamp_ns + late_ns, s.accel_mps2, s.gyro_radps, s.mag_t))
        if out is not None and i > 1000:
            errors.append(swell.matrix_to_vector((matrix(out.q_ned_body_xyzw) @ dive.R_ned_body[i].T)[None])[0])
    assert np.degrees(np.abs(errors).max()) < 2.5


def test_a_repeated_stamp_is_skipped():
    dive = swell.simulate(4.0)
    estimator = VqfAttitude(SOUND, HERE)
    for s in dive.samples:
        estimator.update(s)
    assert estimator.update(dive.samples[-1]) is None


def test_without_vqf_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "vqf", None)
    with pytest.raises(BuddylineError, match="make install EXTRAS=pi"):
        VqfAttitude(SOUND)


def test_a_rig_that_is_swung_fast_keeps_its_heading():
    """Twice a second by 35 deg about two axes: a filter without the coning within a sample is 2.9 deg off."""
    parts, seconds = 10, 40.0
    t = np.arange(int(seconds * swell.RATE_HZ) * parts + 1) / (swell.RATE_HZ * parts)
    swing = 0.6 * np.clip((t - 5.0) / 3.0, 0.0, 1.0)
    phase = 2 * np.pi * 2.0 * t
    R = swell.euler_to_matrix(swing * np.sin(phase), swing * np.cos(phase), 0.5 * swing * np.sin(0.7 * t))
    turned = swell.matrix_to_vector(np.einsum("nji,njk->nik", R[:-1], R[1:])) * swell.RATE_HZ * parts
    seen = [np.einsum("nji,j->ni", R[1:], v) for v in (np.array([0.0, 0.0, -swell.GRAVITY_MPS2]), swell.field_ned_t())]
    gyro, accel, mag = (each.reshape(-1, parts, 3).mean(axis=1) for each in (turned, *seen))
    times_s = t[parts::parts]
    samples = [ImuSample(swell.START_NS + round(s * 1e9), accel[i], gyro[i], mag[i]) for i, s in enumerate(times_s)]
    truth = swell.SwellDive(times_s, R[parts::parts], samples, np.zeros(len(times_s), dtype=bool))
    run = estimate(truth, VqfAttitude(SOUND, HERE))
    assert run.heading_rms_deg(run.times_s > 10.0) < 0.3
    assert not any(run.problems)
