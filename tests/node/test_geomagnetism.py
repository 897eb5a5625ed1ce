"""Declination, dip and strength of the Earth's field, and the removal of the rig's own field."""

from __future__ import annotations

import sys
from datetime import UTC, datetime

import numpy as np
import pytest
from buddyline.node.geomagnetism import MagnetometerCalibration, earth_field
from buddyline.protocol.errors import BuddylineError

NOV_2025_NS = 1_764_000_000_000_000_000


@pytest.mark.parametrize(
    ("moment", "latitude", "longitude", "declination_deg"),
    [
        # Test values published with WMM2025, at sea level, given to 0.01 deg.
        (datetime(2025, 1, 1, tzinfo=UTC), 80.0, 0.0, 1.28),
        (datetime(2025, 1, 1, tzinfo=UTC), 0.0, 120.0, -0.16),
        (datetime(2025, 1, 1, tzinfo=UTC), -80.0, -120.0, 68.78),
        (datetime(2027, 7, 2, 12, tzinfo=UTC), 80.0, 0.0, 2.59),
        (datetime(2027, 7, 2, 12, tzinfo=UTC), 0.0, 120.0, -0.24),
        (datetime(2027, 7, 2, 12, tzinfo=UTC), -80.0, -120.0, 68.49),
    ],
)
def test_the_field_matches_the_models_published_values(moment, latitude, longitude, declination_deg):
    pytest.importorskip("pygeomag", reason="pygeomag is not installed: make install EXTRAS=pi")
    field = earth_field(latitude, longitude, int(moment.timestamp()) * 10**9)
    assert np.degrees(field.declination_rad) == pytest.approx(declination_deg, abs=0.011)
    assert 22e-6 < field.norm_t < 67e-6
    assert np.sign(field.dip_rad) == (1 if latitude > 0 else -1)


def test_declination_changes_with_the_date_also_after_the_models_end():
    pytest.importorskip("pygeomag", reason="pygeomag is not installed: make install EXTRAS=pi")
    year_ns = 31_557_600 * 10**9
    one, two, far = (earth_field(59.9, 10.75, NOV_2025_NS + n * year_ns).declination_rad for n in (0, 1, 6))
    assert 0.1 < np.degrees(two - one) < 0.4
    assert 0.6 < np.degrees(far - one) < 2.4


@pytest.mark.parametrize(("latitude", "longitude"), [(91.0, 0.0), (0.0, 200.0), (float("nan"), 0.0)])
def test_a_position_out_of_range_is_refused(latitude, longitude):
    with pytest.raises(BuddylineError, match="position"):
        earth_field(latitude, longitude, NOV_2025_NS)


def test_without_pygeomag_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygeomag", None)
    with pytest.raises(BuddylineError, match="make install EXTRAS=pi"):
        earth_field(60.0, 10.0, NOV_2025_NS)


def test_calibration_undoes_the_rigs_magnetism():
    rng = np.random.default_rng(2)
    A = np.eye(3) + rng.normal(0, 0.05, (3, 3))
    offset_t = rng.normal(0, 10e-6, 3)
    field_t = rng.normal(0, 30e-6, (20, 3))
    calibration = MagnetometerCalibration(offset_t, np.linalg.inv(A))
    readings_t = field_t @ A.T + offset_t
    assert calibration.apply(readings_t) == pytest.approx(field_t, abs=1e-12)
    assert calibration.apply(readings_t[0]) == pytest.approx(field_t[0], abs=1e-12)
    assert not calibration.is_none


def test_the_empty_calibration_changes_nothing():
    none = MagnetometerCalibration.none()
    assert none.is_none
    assert none.apply(np.array([1e-5, 2e-5, 3e-5])) == pytest.approx([1e-5, 2e-5, 3e-5])
