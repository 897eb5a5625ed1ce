"""A gyro that turns otherwise than its node's attitudes is named, a sound one never, and the track does without it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp
from buddyline.solver_service.track.dive import smooth
from buddyline.solver_service.track.gyros import (
    FAULTY,
    WELL,
    GyroFault,
    TurningTold,
    faulty_spans,
    gyro_fault,
    gyro_faults,
    turns_of,
)
from buddyline.solver_service.track.inputs import Attitudes
from buddyline.solver_service.track.records import NodeRecord, judged

from tests.solver_service.track.dives import EPOCH_NS, KnownDive, Setting, filter_of, make, score

S_NS = 1_000_000_000


@cache
def dive_of(seed: int, *, poor: bool = False) -> KnownDive:
    """A dive of 24 s."""
    return make(seed, Setting(seconds=24.0, poor=poor))


def told_by(record: NodeRecord, lag_s: float = 0.0) -> TurningTold:
    """What a record tells of its node's turning; its gyro lag_s late."""
    attitudes = Attitudes.joined([record.attitudes])
    return TurningTold(
        (attitudes.stamps_ns - EPOCH_NS) * 1e-9,
        attitudes.R_ned_body,
        attitudes.sigma_rad,
        (record.imu_stamps_ns - EPOCH_NS) * 1e-9 + lag_s,
        record.gyro_radps,
    )


def about_z(deg: float) -> Floats:
    """The samples of a unit that is turned about its vertical axis are these times the true ones."""
    return rotation_exp(np.array((0.0, 0.0, math.radians(deg))))


def remounted(record: NodeRecord, M: Floats) -> NodeRecord:
    """A record with force and rate times M, in the body frame."""
    return replace(record, accel_mps2=record.accel_mps2 @ M.T, gyro_radps=record.gyro_radps @ M.T)


def gains(told: TurningTold) -> list[float]:
    """By how much each check calls a gyro faulty."""
    return [fault.gain for _, _, fault in gyro_faults(told)]


@pytest.mark.parametrize("lag_s", [0.0, 0.05, -0.05, 0.3])
@pytest.mark.parametrize(("seed", "poor"), [(3, False), (4, True), (5, False), (6, True)])
def test_a_sound_gyro_is_never_near_a_fault(seed: int, poor: bool, lag_s: float) -> None:
    for record in dive_of(seed, poor=poor).records:
        assert max(gains(told_by(record, lag_s))) < 0.5 * FAULTY


@pytest.mark.parametrize(
    ("M", "said"),
    [
        (about_z(90.0), "mounted some 90 deg about the vertical"),
        (about_z(-90.0), "mounted some 90 deg about the vertical"),
        (np.eye(3)[[1, 0, 2]], "the order or the signs of its axes are wrong"),
        (np.eye(3) * np.degrees(1.0), "deg/s in place of rad/s"),
    ],
)
def test_a_faulty_gyro_is_named(M: Floats, said: str) -> None:
    for record in dive_of(3).records:
        told = told_by(record)
        *_, (_, _, fault) = gyro_faults(replace(told, rate_radps=told.rate_radps @ M.T))
        assert fault.gain > FAULTY
        assert said in fault.of("a")


@pytest.mark.parametrize(
    ("pitching", "said"), [(0.0, "it shows hardly any turn"), (0.5, "its samples are another unit's")]
)
def test_a_gyro_that_shows_no_turn_or_anothers_is_named(pitching: float, said: str) -> None:
    # Rolling by 30 degrees every 4 s; the gyro shows noise, or pitching.
    attitude_s, gyro_s = np.arange(0.0, 10.0, 0.02), np.arange(0.0, 10.0, 0.01)
    R = rotation_exp(np.sin(0.5 * np.pi * attitude_s)[:, None] * np.array((np.radians(30.0), 0.0, 0.0)))
    rate = np.random.default_rng(1).normal(0.0, 0.004, (len(gyro_s), 3))
    rate[:, 1] += pitching * np.sin(2.6 * gyro_s)
    turns = turns_of(TurningTold(attitude_s, R, np.tile(np.radians((1.0, 1.0, 4.0)), (len(R), 1)), gyro_s, rate))
    assert turns is not None
    fault = gyro_fault(turns)
    assert fault.gain > FAULTY
    assert said in fault.said


def test_attitudes_that_stand_still_are_not_the_gyros_fault() -> None:
    told = told_by(dive_of(3).records[1])
    assert max(gains(replace(told, R_ned_body=np.repeat(told.R_ned_body[:1], len(told.attitude_s), axis=0)))) <= 0.0


def test_a_heading_that_iron_deflects_is_not_the_gyros_fault() -> None:
    told = told_by(dive_of(3).records[1])
    near_iron = (told.attitude_s > 9.0) & (told.attitude_s < 11.0)
    off = rotation_exp(near_iron[:, None] * np.array((0.0, 0.0, math.radians(40.0))))
    assert max(gains(replace(told, R_ned_body=off @ told.R_ned_body))) < 0.5 * FAULTY


def test_where_too_little_is_told_nothing_is_said() -> None:
    told = told_by(dive_of(3).records[0])
    assert turns_of(told.between(0.0, 1.0)) is None
    assert turns_of(replace(told, gyro_s=told.gyro_s[:0], rate_radps=told.rate_radps[:0])) is None
    assert turns_of(replace(told, gyro_s=told.gyro_s[::10], rate_radps=told.rate_radps[::10])) is None


def test_a_fault_lasts_from_when_the_unit_was_last_well_until_it_is_again() -> None:
    well, bad, worse, untold = (GyroFault(gain, str(gain)) for gain in (-2 * WELL, 2 * FAULTY, 3 * FAULTY, 0.0))
    judged_as = [well, untold, bad, worse, untold, well, well, bad, untold]
    spans = faulty_spans([(2.0 * k - 10.0, 2.0 * k, fault) for k, fault in enumerate(judged_as)])
    assert spans == [(0.0, 6.0, worse), (12.0, math.inf, bad)]
    assert faulty_spans([(0.0, 10.0, bad)]) == [(-math.inf, math.inf, bad)]


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_a_dive_with_a_unit_turned_about_the_vertical_has_a_track_without_it(seed: int) -> None:
    dive = dive_of(seed)
    a, b = dive.records
    found = smooth((a, remounted(b, about_z(90.0))), dive.fixes, dive.stamps_ns)
    told = score(dive, found.rows)
    assert [problem for problem in found.problems if "node b: the gyro turns otherwise" in problem] == found.problems
    assert told.wrong == 0
    assert told.covered > 0.9


def test_a_live_track_begins_anew_without_a_unit_turned_about_the_vertical() -> None:
    dive = dive_of(3)
    a, b = dive.records
    track = filter_of((a, remounted(b, about_z(90.0))), dive.fixes)
    rows = track.advance(EPOCH_NS + 24 * S_NS, dive.stamps_ns)
    assert any("node b: the gyro turns otherwise" in problem for problem in track.problems)
    late = score(dive, [row for row in rows if row.stamp_ns > EPOCH_NS + 10 * S_NS])
    assert late.wrong == 0
    assert late.rows > 200


def frozen_after(record: NodeRecord, seconds: float, stuck: str) -> NodeRecord:
    """A record whose accelerometer's, gyro's or all inertial samples do not change after some seconds."""
    late = record.imu_stamps_ns > EPOCH_NS + round(seconds * S_NS)
    accel, gyro = record.accel_mps2.copy(), record.gyro_radps.copy()
    if stuck != "gyro's":
        accel[late] = accel[late][0]
    if stuck != "accelerometer's":
        gyro[late] = gyro[late][0]
    return replace(record, accel_mps2=accel, gyro_radps=gyro)


@pytest.mark.parametrize("stuck", ["accelerometer's", "gyro's", "inertial"])
def test_a_unit_that_freezes_is_named_and_not_used(stuck: str) -> None:
    dive = dive_of(3)
    a, b = dive.records
    b = frozen_after(b, 5.0, stuck)
    track = filter_of((a, b), dive.fixes)
    track.advance(EPOCH_NS + 9 * S_NS)
    assert any(f"node b: the {stuck} samples do not change" in problem for problem in track.problems)
    assert not track.samples[1].trusted
    # Of the whole dive: from when it froze.
    faults = judged(b).faults
    assert faults is not None
    assert {(start_ns - EPOCH_NS) // 10_000_000 for start_ns, _, said in faults if "do not change" in said} == {501}


@pytest.mark.slow
def test_a_stored_dive_with_a_unit_that_freezes_has_a_track() -> None:
    dive = dive_of(3)
    found = smooth((dive.records[0], frozen_after(dive.records[1], 15.0, "inertial")), dive.fixes, dive.stamps_ns)
    told = score(dive, found.rows)
    assert any("samples do not change" in problem for problem in found.problems)
    assert told.wrong == 0
    assert told.covered > 0.9


def test_sound_units_of_a_dive_have_no_faults() -> None:
    assert [judged(record).faults for record in dive_of(3).records] == [[], []]
