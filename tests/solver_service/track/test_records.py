"""What nodes recorded, in columns and in order."""

from __future__ import annotations

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import rotation_exp
from buddyline.solver_service.track.inputs import Attitudes, AttitudeSeen
from buddyline.solver_service.track.records import between


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
