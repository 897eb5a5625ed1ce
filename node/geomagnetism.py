"""The Earth's magnetic field at the dive's place, and the calibration that removes the rig's own field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Years of the first World Magnetic Model that pygeomag has, and of the newest.
FIRST_MODEL: Final = 2010
NEWEST_MODEL: Final = 2025


@dataclass(frozen=True, slots=True)
class EarthField:
    """The Earth's magnetic field at one place and time.

    declination_rad: from true north to magnetic north, east positive. dip_rad: below the horizontal, down positive.
    norm_t: its strength.
    """

    declination_rad: float
    dip_rad: float
    norm_t: float


def earth_field(latitude_deg: float, longitude_deg: float, stamp_ns: int) -> EarthField:
    """Return the World Magnetic Model's field at sea level.

    Before the first and after the newest model's five years it is extrapolated: the declination then errs by tenths
    of a degree a year.
    Raises BuddylineError if pygeomag is missing, or the position is out of range.
    """
    if not (-90 <= latitude_deg <= 90 and -180 <= longitude_deg <= 180):
        raise BuddylineError(f"position {latitude_deg:g}, {longitude_deg:g}: latitude and longitude in degrees")
    try:
        from pygeomag import GeoMag
    except ModuleNotFoundError as error:
        raise BuddylineError("declination from a position needs pygeomag: make install EXTRAS=pi") from error
    moment = datetime.fromtimestamp(stamp_ns // S_NS, UTC)
    # Each model is of five years; the first is of 2010.
    model = GeoMag(base_year=datetime(min(max(moment.year, FIRST_MODEL), NEWEST_MODEL), 1, 1, tzinfo=UTC))
    start = datetime(moment.year, 1, 1, tzinfo=UTC)
    length = datetime(moment.year + 1, 1, 1, tzinfo=UTC) - start
    field = model.calculate(
        glat=latitude_deg,
        glon=longitude_deg,
        alt=0.0,
        time=moment.year + (moment - start) / length,
        allow_date_outside_lifespan=True,
    )
    return EarthField(math.radians(field.d), math.radians(field.i), field.f * 1e-9)


@dataclass(frozen=True, slots=True, eq=False)
class MagnetometerCalibration:
    """Corrects readings for the rig's own magnetism: field = matrix @ (reading - offset_t), body frame.

    offset_t: (3,), hard iron. matrix: (3, 3), soft iron, scale and misalignment.
    """

    offset_t: Vector
    matrix: Matrix

    @classmethod
    def none(cls) -> MagnetometerCalibration:
        """Return the calibration that changes nothing."""
        return cls(np.zeros(3), np.eye(3))

    @property
    def is_none(self) -> bool:
        """Whether this calibration changes nothing: the magnetometer is not calibrated."""
        return not self.offset_t.any() and np.array_equal(self.matrix, np.eye(3))

    def apply(self, mag_t: Vector) -> Vector:
        """Return the Earth's field from readings (3,) or (n, 3), T, body frame."""
        field_t: Vector = (mag_t - self.offset_t) @ self.matrix.T
        return field_t
