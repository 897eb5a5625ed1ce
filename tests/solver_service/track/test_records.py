"""What nodes recorded, in columns and in order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import rotation_exp
from buddyline.solver_service.track.inputs import Attitudes, AttitudeSeen
from buddyline.solver_service.track.records import NodeRecord, between, parted

from tests.solver_service.track.dives import Setting, make


def seen(stamp_ns: int) -> AttitudeSeen:
    return AttitudeSeen(stamp_ns, rotation_exp(np.array((1e-3 * stamp_ns, 0.0, 0.0))), np.full(3, 1e-4 * stamp_ns))


def same(one: AttitudeSeen, other: AttitudeSeen) -> bool:
    values = (one.R_ned_body, other.R_ned_body), (one.sigma_rad, other.sigma_rad)
    return one.stamp_ns == other.stamp_ns and all(np.array_equal(*both) for both in values)


@pytest.mark.parametrize("stamps_ns", [(10, 20, 30, 40), (30, 10, 40, 20)])
def test_attitudes_in_columns_are_those_that_were_seen_in_order(stamps_ns: tuple[int, ...]) -> None:
    given = [seen(stamp_ns) for stamp_ns in stamps_ns]
    for pieces in ([given], [given[:1], Attitudes.joined([given[1:3]]), [], given[3:]]):
        columns = Attitudes.joined(pieces)
        assert [one.stamp_ns for one in columns] == [10, 20, 30, 40]
        assert all(same(one, seen(one.stamp_ns)) for one in columns)
        assert same(columns[-1], seen(40))
        assert [one.stamp_ns for one in between(columns, 15, 40)] == [20, 30]


def test_no_attitudes_are_no_columns() -> None:
    assert not Attitudes.joined([()])
    assert list(Attitudes.joined([(), []])) == []


def test_attitudes_of_one_stamp_stay_in_the_order_that_they_came_in() -> None:
    first, second = (AttitudeSeen(10, np.eye(3), np.full(3, sigma)) for sigma in (0.1, 0.2))
    for pieces in ([[first, second], [seen(5)]], [[first], [second], [seen(5)]]):
        assert [one.sigma_rad[0] for one in Attitudes.joined(pieces)][1:] == [0.1, 0.2]


def test_what_is_left_out_does_not_spoil_the_fast_part_of_samples_about_it() -> None:
    rng = np.random.default_rng(3)
    stamps_ns = 10_000_000 * np.arange(600)
    shaken = 0.3 * np.sin(2.0 * np.pi * 4.0 * stamps_ns * 1e-9)[:, None] + rng.normal(0.0, 0.01, (600, 3))
    node = make(1, Setting(seconds=0.5)).records[0].node
    record = NodeRecord(node, (), stamps_ns, np.array((0.0, 0.0, -9.8)) + shaken, 0.1 * shaken)
    harmed = replace(record, accel_mps2=record.accel_mps2.copy(), gyro_radps=record.gyro_radps.copy())
    harmed.accel_mps2[200], harmed.accel_mps2[300, 1], harmed.gyro_radps[400] = 60.0, np.nan, 9.0
    one, other = parted(record).fast, parted(harmed).fast
    assert one is not None
    assert other is not None
    sound = np.delete(np.arange(600), (200, 300, 400))
    assert np.abs(one[sound, :3]).max() > 0.2
    np.testing.assert_allclose(other[sound, :6], one[sound, :6], atol=0.02)
