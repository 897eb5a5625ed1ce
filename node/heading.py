"""Heading: a compass corrects the gyroscope's drift, and is used only where it is plausible.

Iron near the rig turns a compass by tens of degrees, often without a change of the field's strength or dip. A Kalman
filter with two states therefore weighs the compass against the gyroscope: the angle from the gyroscope's frame to
magnetic north, and the gyroscope's drift. A reading that contradicts strength, dip or the filter's prediction counts
little: iron on the rig turns the compass this way and that as the rig turns, and for long as long as it does not.

A field that stays the same while the node turns is the Earth's; a field that turns with the node is the rig's. The
former confirms what was learned at the start, and ends a disagreement that the gyroscope caused. Without a known place
and before that, the strength and dip of the last steady twenty seconds are expected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from buddyline.node.geomagnetism import EarthField

# The field in a room without a magnet changes by 8 % within a metre.
NORM_TOLERANCE: Final = 0.1
DIP_TOLERANCE_RAD: Final = math.radians(8.0)
GATE_SIGMAS: Final = 3.0

COMPASS_SIGMA_RAD: Final = math.radians(2.0)
# Tilt errors turn the compass, for two time constants of the tilt; iron does while the rig looks one way.
COMPASS_CORRELATION_S: Final = 10.0
SMOOTHING_S: Final = 0.5
# On a turning rig a disturbance sometimes points along the Earth's field; that does not end it.
PROBATION_S: Final = 8.0
GYRO_WALK_RAD: Final = math.radians(0.02)  # after one second
DRIFT_CORRELATION_S: Final = 60.0

# What averaging does not remove: calibration, mount and declination together.
RESIDUAL_SIGMA_RAD: Final = math.radians(2.0)
UNCONFIRMED_SIGMA_RAD: Final = math.radians(15.0)
UNCALIBRATED_SIGMA_RAD: Final = math.radians(30.0)
UNKNOWN_SIGMA_RAD: Final = math.pi / math.sqrt(3.0)  # of an angle that can be anything

STEADY_S: Final = 20.0
STEADY_TURN_RAD: Final = math.radians(60.0)
STEADY_HEADING_RAD: Final = math.radians(5.0)
STEADY_NORM: Final = 0.03
STEADY_DIP_RAD: Final = math.radians(3.0)


def wrap(angle_rad: float) -> float:
    """Return an angle within -pi..pi."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


class _Steady:
    """Detects a field that stays the same while the node turns.

    seconds: how long it has. norm_t, dip_rad, delta_rad: its mean over that time.
    """

    def __init__(self) -> None:
        self._restart(math.nan, math.nan, math.nan)

    def _restart(self, norm_t: float, dip_rad: float, delta_rad: float) -> None:
        self.seconds = 0.0
        self._low_rad = self._high_rad = self._turned_rad = 0.0
        self.norm_t, self.dip_rad, self.delta_rad = norm_t, dip_rad, delta_rad

    def update(self, dt_s: float, turn_rad: float, norm_t: float, dip_rad: float, delta_rad: float) -> bool:
        """Take a reading; return True once the field was the same for long enough, over enough of a turn."""
        alike = (
            abs(norm_t - self.norm_t) <= STEADY_NORM * self.norm_t
            and abs(dip_rad - self.dip_rad) <= STEADY_DIP_RAD
            and abs(wrap(delta_rad - self.delta_rad)) <= STEADY_HEADING_RAD
        )
        if not alike:
            self._restart(norm_t, dip_rad, delta_rad)
        self.seconds += dt_s
        self._turned_rad += turn_rad
        self._low_rad = min(self._low_rad, self._turned_rad)
        self._high_rad = max(self._high_rad, self._turned_rad)
        share = dt_s / self.seconds
        self.norm_t += share * (norm_t - self.norm_t)
        self.dip_rad += share * (dip_rad - self.dip_rad)
        self.delta_rad += share * wrap(delta_rad - self.delta_rad)
        return self.seconds >= STEADY_S and self._high_rad - self._low_rad >= STEADY_TURN_RAD


class HeadingFilter:
    """Estimates delta: the angle, about up, from the gyroscope's level frame to the magnetic one (y north).

    reference: the expected field; None learns its strength and dip. problem: why the compass is doubted; "" if it is
    not.
    """

    def __init__(self, reference: EarthField | None = None, calibrated: bool = True) -> None:
        self.problem = ""
        self.delta_rad = 0.0
        self._norm_t = reference.norm_t if reference else math.nan
        self._dip_rad = reference.dip_rad if reference else math.nan
        self._known = reference is not None
        self._calibrated = calibrated
        self._started = False
        self._confirmed = False
        self._sound_s = PROBATION_S
        self._doubt_rad = 0.0
        self._drift_radps = 0.0
        self._p = (UNKNOWN_SIGMA_RAD**2, 0.0, 0.0)  # angle's variance, covariance, drift's variance
        self._smooth_t: Sequence[float] | None = None
        self._steady = _Steady()

    def predict(self, dt_s: float, bias_sigma_radps: float) -> None:
        """Predict over dt_s. bias_sigma_radps: present 1 sd of the gyroscope's bias."""
        p00, p01, p11 = self._p
        if not self._started:
            p11 = bias_sigma_radps**2
        p00 += dt_s * (2 * p01 + dt_s * p11) + GYRO_WALK_RAD**2 * dt_s
        p01 += dt_s * p11
        p11 += max(0.0, bias_sigma_radps**2 - p11) * 2 * dt_s / DRIFT_CORRELATION_S
        self._p = (p00, p01, p11)
        self.delta_rad = wrap(self.delta_rad + self._drift_radps * dt_s)

    def update(self, dt_s: float, mag_level_t: Sequence[float], turn_rad: float) -> None:
        """Update with one reading of the compass.

        mag_level_t: calibrated field, x, y, z, in the gyroscope's level frame (z up). turn_rad: turned about up
        since the last reading.
        """
        if self._smooth_t is None:
            self._smooth_t = mag_level_t
        share = min(1.0, dt_s / SMOOTHING_S)
        x, y, z = self._smooth_t = [
            old + share * (new - old) for old, new in zip(self._smooth_t, mag_level_t, strict=True)
        ]
        horizontal_t = math.hypot(x, y)
        norm_t, dip_rad, delta_rad = math.hypot(horizontal_t, z), math.atan2(-z, horizontal_t), math.atan2(x, y)
        if math.isnan(self._norm_t):
            self._norm_t, self._dip_rad = norm_t, dip_rad
        if self._steady.update(dt_s, turn_rad, norm_t, dip_rad, delta_rad):
            self._adopt()
        elif self._steady.seconds >= STEADY_S and not self._known and not self._confirmed:
            # Twenty steady seconds are a better reference than the first reading, which may be of a deck.
            self._norm_t, self._dip_rad = self._steady.norm_t, self._steady.dip_rad
        self.problem = self._strange(norm_t, dip_rad) or self._off(delta_rad)
        self._sound_s = 0.0 if self.problem else self._sound_s + dt_s
        if not self.problem and self._sound_s < PROBATION_S:
            self.problem = "magnetic field disturbed until just now"
        if self._started:
            self._weigh(dt_s, delta_rad)
        elif not self.problem:
            self._start_at(delta_rad)
        doubtful = self._started and self.problem and not self._confirmed
        self._doubt_rad = abs(wrap(delta_rad - self.delta_rad)) if doubtful else 0.0

    def turn_back(self) -> None:
        """Go on backward in time: the drift is the opposite."""
        p00, p01, p11 = self._p
        self._p = (p00, -p01, p11)
        self._drift_radps = -self._drift_radps

    def widen(self, turned_rad: float) -> None:
        """Add an unobserved rotation with this standard deviation."""
        p00, p01, p11 = self._p
        self._p = (p00 + turned_rad**2, p01, p11)
        self._smooth_t = None
        if turned_rad >= UNKNOWN_SIGMA_RAD:
            self._started = self._confirmed = False

    def _strange(self, norm_t: float, dip_rad: float) -> str:
        if (
            abs(norm_t - self._norm_t) <= NORM_TOLERANCE * self._norm_t
            and abs(dip_rad - self._dip_rad) <= DIP_TOLERANCE_RAD
        ):
            return ""
        return (
            f"magnetic field disturbed: {norm_t * 1e6:.0f} uT, dip {math.degrees(dip_rad):.0f} deg; "
            f"here {self._norm_t * 1e6:.0f} uT, {math.degrees(self._dip_rad):.0f} deg"
        )

    def _adopt(self) -> None:
        """Take the steady field as the Earth's, unless the place is known and contradicts it."""
        steady = self._steady
        strange = self._strange(steady.norm_t, steady.dip_rad)
        if strange and self._known:
            return
        if strange:
            self._norm_t, self._dip_rad = steady.norm_t, steady.dip_rad
        if strange or self.problem:
            self._start_at(steady.delta_rad)
            self._sound_s = PROBATION_S
        self._confirmed = True

    def _start_at(self, delta_rad: float) -> None:
        self.delta_rad = delta_rad
        self._p = (COMPASS_SIGMA_RAD**2, 0.0, self._p[2])
        self._started = True

    def _off(self, delta_rad: float) -> str:
        """Return a text if the compass is further from its prediction than the gate allows, else ""."""
        if not self._started:
            return ""
        off_rad = abs(wrap(delta_rad - self.delta_rad))
        expected = self._p[0] + COMPASS_SIGMA_RAD**2 + (0.0 if self._confirmed else UNCONFIRMED_SIGMA_RAD**2)
        if off_rad <= GATE_SIGMAS * math.sqrt(expected):
            return ""
        return f"compass and gyroscope differ by {math.degrees(off_rad):.0f} deg"

    def _weigh(self, dt_s: float, delta_rad: float) -> None:
        """Correct by a reading. A doubtful one has as large a standard deviation as it is off."""
        p00, p01, p11 = self._p
        off_rad = wrap(delta_rad - self.delta_rad)
        sigma_rad = max(COMPASS_SIGMA_RAD, abs(off_rad)) if self.problem else COMPASS_SIGMA_RAD
        s = p00 + sigma_rad**2 * max(1.0, COMPASS_CORRELATION_S / dt_s)
        k0, k1 = p00 / s, p01 / s
        self.delta_rad = wrap(self.delta_rad + k0 * off_rad)
        self._drift_radps += k1 * off_rad
        self._p = (p00 - k0 * p00, p01 - k0 * p01, p11 - k1 * p01)

    def sigma_rad(self, tilt_sigma_rad: float) -> float:
        """Return the heading's standard deviation. tilt_sigma_rad: a tilt adds a part of the vertical field."""
        if not self._started:
            return UNKNOWN_SIGMA_RAD
        total = self._p[0] + RESIDUAL_SIGMA_RAD**2 + (tilt_sigma_rad * math.tan(self._dip_rad)) ** 2
        total += self._doubt_rad**2
        if not self._confirmed:
            total += UNCONFIRMED_SIGMA_RAD**2
        if not self._calibrated:
            total += UNCALIBRATED_SIGMA_RAD**2
        return min(math.sqrt(total), UNKNOWN_SIGMA_RAD)
