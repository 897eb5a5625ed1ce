"""Attitude in NED from inertial samples: VQF gives tilt and gyroscope bias, a gated compass gives the heading.

Laidig and Seel, "VQF: Highly accurate IMU orientation estimation with bias estimation and magnetic disturbance
rejection", Information Fusion 91 (2023). VQF's own disturbance rejection uses only the field's strength and dip.
The heading therefore comes from node.heading.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from buddyline.node.drivers.samples import ImuSample, Vector
from buddyline.node.geomagnetism import EarthField, MagnetometerCalibration
from buddyline.node.heading import HeadingFilter, wrap
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Attitude, Imu
from msgspec import UNSET
from numpy.typing import NDArray

SAMPLE_S: Final = 0.01
# Longer than a swell's period, so that swell averages out. Only a well known bias allows the longer one.
RESTED_TILT_TAU_S: Final = 5.0
MOVING_TILT_TAU_S: Final = 3.0

REST_S: Final = 3.0
REST_GYRO_RADPS: Final = math.radians(0.6)
REST_ACCEL_MPS2: Final = 0.15
GIVE_UP_REST_S: Final = 20.0
REST_BIAS_SIGMA_DPS: Final = 0.03
MOVING_BIAS_SIGMA_DPS: Final = 1.0
MAX_BIAS_DPS: Final = 5.0
# VQF caps the bias's sigma at its initial value. A cap at the rest's value would freeze the bias.
MAX_BIAS_SIGMA_DPS: Final = 0.5
# Time in which the bias moves by 0.1 deg/s: 0.05 deg/s per K, 25 K from deck to water, time constant 120 s.
BIAS_FORGETTING_S: Final = 10.0
# Weight of a new temperature in the smoothed one: a chip that counts whole degrees must not step the bias.
WARMTH_SHARE: Final = 0.2
GAP_S: Final = 0.2
LONG_GAP_S: Final = 5.0
GAP_TURN_RADPS: Final = math.radians(10.0)
SATURATED_TURN_RADPS: Final = math.radians(100.0)

# The tilt that an accelerometer offset of 20 mg causes; the mount adds as much.
TILT_SIGMA_RAD: Final = math.radians(1.4)
SWELL_SIGMA_RAD: Final = math.radians(0.5)
RESTED_TILT_SIGMA_RAD: Final = math.radians(1.0)
MOVING_TILT_SIGMA_RAD: Final = math.radians(6.0)

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class AttitudeEstimate:
    """Rotation from body to NED, true north. sigma_rad: of roll, pitch, yaw.

    problem: why the heading is not trusted; "" if it is trusted.
    """

    stamp_ns: int
    q_ned_body_xyzw: tuple[float, float, float, float]
    sigma_rad: tuple[float, float, float]
    problem: str = ""

    def message(self, node: str) -> Attitude:
        """Return it as a node's message."""
        return Attitude(
            node=node,
            stamp_ns=self.stamp_ns,
            q_ned_body_xyzw=self.q_ned_body_xyzw,
            sigma_rad=self.sigma_rad,
        )


class AttitudeEstimator(Protocol):
    """Estimates attitudes from samples given in order of time."""

    def update(self, sample: ImuSample) -> AttitudeEstimate | None:
        """Take a sample; return None during the start."""
        ...


def rows_of(q_wxyz: NDArray[np.float64]) -> tuple[Triple, Triple, Triple]:
    """Return the rows of the rotation matrix of a unit quaternion in VQF's order w, x, y, z."""
    w, x, y, z = q_wxyz.tolist()
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def quaternion_to_matrix(q_wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix, (3, 3), of a unit quaternion in VQF's order w, x, y, z."""
    return np.array(rows_of(q_wxyz))


def cross(a: Sequence[float], b: Sequence[float]) -> Triple:
    """Return the cross product of two vectors."""
    (ax, ay, az), (bx, by, bz) = a, b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def seen_before(vector: Sequence[float], turned_rad: Sequence[float]) -> Triple:
    """Return how a body saw a vector half a turn before: what it sees now, plus its cross product with that half."""
    (x, y, z), (cx, cy, cz) = vector, cross(vector, turned_rad)
    return x + cx / 2, y + cy / 2, z + cz / 2


def ned_of_enu(q_enu_body_wxyz: NDArray[np.float64], turn_rad: float) -> tuple[float, float, float, float]:
    """Return q_ned_body as x, y, z, w of q_enu_body as w, x, y, z, turned about down by turn_rad.

    q_ned_enu is half a turn about the line between x and y: (x, y, z, w) = (1, 1, 0, 0) / sqrt(2).
    """
    w, x, y, z = q_enu_body_wxyz.tolist()
    h = math.sqrt(0.5)
    nx, ny, nz, nw = h * (w + z), h * (w - z), h * (y - x), -h * (x + y)
    c, s = math.cos(turn_rad / 2), math.sin(turn_rad / 2)
    return c * nx - s * ny, c * ny + s * nx, c * nz + s * nw, c * nw - s * nz


def attitudes(samples: Iterable[Imu], estimator: AttitudeEstimator) -> Iterator[Attitude]:
    """Yield one node's attitudes from its inertial samples, in order of time, live or from a log.

    Imu.mag_t is the uncalibrated reading, so that a log gives better attitudes with a later calibration. With the
    dive's own calibration they equal the recorded ones, except after a saturation, which a log does not contain.
    """
    for message in samples:
        mag_t = None if message.mag_t is UNSET else np.array(message.mag_t)
        sample = ImuSample(
            message.stamp_ns,
            np.array(message.accel_mps2),
            np.array(message.gyro_radps),
            mag_t,
            temperature_degc=None if message.temperature_degc is UNSET else message.temperature_degc,
        )
        estimate = estimator.update(sample)
        if estimate is not None:
            yield estimate.message(message.node)


class _RestWatch:
    """Detects a rest at the start and measures the gyroscope's bias in it."""

    def __init__(self) -> None:
        self._window: deque[ImuSample] = deque()
        self._began_ns: int | None = None
        self._count = 0

    def update(self, sample: ImuSample) -> tuple[Vector, float] | None:
        """Return the bias in rad/s, (3,), and its sigma in deg/s; None while still waiting for a rest."""
        self._window.append(sample)
        self._count += 1
        if self._began_ns is None:
            self._began_ns = sample.stamp_ns
        while sample.stamp_ns - self._window[0].stamp_ns > REST_S * S_NS:
            self._window.popleft()
        waited_s = (sample.stamp_ns - self._began_ns) / S_NS
        # Every tenth sample is enough for a window of three seconds.
        if waited_s < REST_S or self._count % 10:
            return None
        gyro = np.array([s.gyro_radps for s in self._window])
        accel = np.array([s.accel_mps2 for s in self._window])
        still = gyro.std(axis=0).max() < REST_GYRO_RADPS and accel.std(axis=0).max() < REST_ACCEL_MPS2
        if still:
            bias: Vector = gyro.mean(axis=0)
            return bias, REST_BIAS_SIGMA_DPS
        return (np.zeros(3), MOVING_BIAS_SIGMA_DPS) if waited_s > GIVE_UP_REST_S else None


class _Warmth:
    """The part of the gyroscope's bias that comes from its temperature since the first sample."""

    def __init__(self, slope_radps_per_k: Vector) -> None:
        self.bias_radps = np.zeros(3)
        self._slope = slope_radps_per_k
        self._first_degc: float | None = None
        self._smooth_degc = 0.0

    def update(self, sample: ImuSample) -> None:
        """Take a sample; one a second has a temperature."""
        degc = sample.temperature_degc
        if degc is None:
            return
        if self._first_degc is None:
            self._first_degc = self._smooth_degc = degc
        self._smooth_degc += WARMTH_SHARE * (degc - self._smooth_degc)
        self.bias_radps = self._slope * (self._smooth_degc - self._first_degc)

    def turn_back(self) -> None:
        """Go on backward in time: every bias is the opposite."""
        self._slope, self.bias_radps = -self._slope, -self.bias_radps


class VqfAttitude:
    """Estimates tilt and gyroscope bias with VQF, and heading with the gated compass.

    calibration: of the magnetometer. field: the Earth's field at the dive site, with its declination; None: the
    field's strength and dip are learned. declination_rad: used without a field. gyro_bias_radps_per_k: (3,), how the
    gyroscope's bias moves with its temperature; what is left of it is estimated. A gap in the samples increases
    sigma_rad; a gap longer than LONG_GAP_S restarts the tilt with the bias known so far.
    """

    def __init__(
        self,
        calibration: MagnetometerCalibration,
        field: EarthField | None = None,
        declination_rad: float = 0.0,
        gyro_bias_radps_per_k: Vector | None = None,
    ) -> None:
        try:
            from vqf import VQF
        except ModuleNotFoundError as error:
            raise BuddylineError("attitude needs the package vqf: make install EXTRAS=pi") from error
        self._new_filter: Any = VQF
        self._calibration = calibration
        self._declination_rad = field.declination_rad if field else declination_rad
        self._heading = HeadingFilter(field, not calibration.is_none)
        self._rest: _RestWatch | None = _RestWatch()
        self._vqf: Any = None
        self._bias_radps = np.zeros(3)
        self._warmth = _Warmth(np.zeros(3) if gyro_bias_radps_per_k is None else gyro_bias_radps_per_k)
        self._last_ns = 0
        self._tilt_tau_s = MOVING_TILT_TAU_S
        self._transient_rad = 0.0
        self._turned_rad: Sequence[float] = (0.0, 0.0, 0.0)
        self._yaw_rad = 0.0
        self._unread_s = 0.0

    def update(self, sample: ImuSample) -> AttitudeEstimate | None:
        """Take a sample; return None during the start."""
        self._warmth.update(sample)
        if self._rest is not None:
            found = self._rest.update(sample)
            if found is None:
                return None
            self._rest = None
            rested = found[1] <= REST_BIAS_SIGMA_DPS
            self._tilt_tau_s = RESTED_TILT_TAU_S if rested else MOVING_TILT_TAU_S
            self._transient_rad = RESTED_TILT_SIGMA_RAD if rested else MOVING_TILT_SIGMA_RAD
            self._begin(sample, *found)
        dt_s = (sample.stamp_ns - self._last_ns) / S_NS
        if dt_s == 0:
            return None
        if sample.saturated:
            # The true rate was beyond full scale by an unknown amount.
            self._transient_rad += SAMPLE_S * SATURATED_TURN_RADPS
            self._heading.widen(SAMPLE_S * SATURATED_TURN_RADPS)
        if not 0 < dt_s <= GAP_S:
            self._bridge(sample, abs(dt_s))
            dt_s = SAMPLE_S
        self._last_ns = sample.stamp_ns
        return self._advance(sample, dt_s)

    def turn_back(self, ends_ns: int) -> None:
        """Go on backward in time: with samples whose rate is the opposite, stamped ends_ns minus their stamp.

        Attitude, field and what is known of them stay; rates and biases are the opposite from now on.
        """
        if self._vqf is None:
            return
        state = self._vqf.state
        for name in ("bias", "motionBiasEstBiasLpState", "restLastGyrLp", "restGyrLpState"):
            state[name] = -np.asarray(state[name])
        self._vqf.state = state
        self._bias_radps = -self._bias_radps
        self._warmth.turn_back()
        self._last_ns = ends_ns - self._last_ns
        self._heading.turn_back()

    def _begin(self, sample: ImuSample, bias_radps: Vector, bias_sigma_dps: float) -> None:
        self._bias_radps = bias_radps
        self._vqf = self._new_filter(
            SAMPLE_S,
            tauAcc=self._tilt_tau_s,
            biasSigmaInit=MAX_BIAS_SIGMA_DPS,
            biasForgettingTime=BIAS_FORGETTING_S,
            biasClip=MAX_BIAS_DPS,
            magDistRejectionEnabled=False,
        )
        self._vqf.setBiasEstimate(np.zeros(3), math.radians(bias_sigma_dps))
        self._last_ns = sample.stamp_ns - round(SAMPLE_S * S_NS)

    def _bridge(self, sample: ImuSample, gap_s: float) -> None:
        """Continue after missing samples or a clock step; the rotation in between is unknown."""
        turned_rad = gap_s * GAP_TURN_RADPS
        if gap_s < LONG_GAP_S:
            self._transient_rad = math.hypot(self._transient_rad, turned_rad)
        else:
            bias_radps, sigma_radps = self._vqf.getBiasEstimate()
            self._begin(sample, self._bias_radps + np.asarray(bias_radps), math.degrees(sigma_radps))
            self._transient_rad = MOVING_TILT_SIGMA_RAD
        self._heading.widen(turned_rad)

    def _advance(self, sample: ImuSample, dt_s: float) -> AttitudeEstimate | None:
        # Plain numbers: for three of them, numpy takes twice the time.
        vqf = self._vqf
        rate_radps = sample.gyro_radps - self._bias_radps - self._warmth.bias_radps
        # A sample means the interval before it. A turn's axis moves within that, and what is seen from the turning
        # body is as it was half a turn before (Bortz 1971; Miller 1983, with one sample an interval).
        tx, ty, tz = turned_rad = (dt_s * rate_radps).tolist()
        cx, cy, cz = cross(self._turned_rad, turned_rad)
        self._turned_rad = turned_rad
        # VQF assumes a fixed sample time; scaling the rate keeps the rotation between two samples right.
        scaled_radps = (tx + cx / 12) / SAMPLE_S, (ty + cy / 12) / SAMPLE_S, (tz + cz / 12) / SAMPLE_S
        vqf.update(np.array(scaled_radps), np.array(seen_before(sample.accel_mps2.tolist(), turned_rad)))
        q_level_body = vqf.getQuat6D()
        R_level_body = rows_of(q_level_body)
        bias_sigma_radps = float(vqf.getBiasEstimate()[1])
        self._transient_rad *= math.exp(-dt_s / self._tilt_tau_s)
        tilt_sigma_rad = math.sqrt(
            TILT_SIGMA_RAD**2 + SWELL_SIGMA_RAD**2 + (bias_sigma_radps * self._tilt_tau_s) ** 2 + self._transient_rad**2
        )
        self._heading.predict(dt_s, bias_sigma_radps)
        self._unread_s = min(self._unread_s + dt_s, GAP_S)
        if sample.mag_t is not None:
            yaw_rad = math.atan2(R_level_body[1][0], R_level_body[0][0])
            x, y, z = seen_before(self._calibration.apply(sample.mag_t).tolist(), turned_rad)
            field_t = [rx * x + ry * y + rz * z for rx, ry, rz in R_level_body]
            self._heading.update(self._unread_s, field_t, wrap(yaw_rad - self._yaw_rad))
            self._yaw_rad, self._unread_s = yaw_rad, 0.0
        return AttitudeEstimate(
            sample.stamp_ns,
            ned_of_enu(q_level_body, self._declination_rad - self._heading.delta_rad),
            (tilt_sigma_rad, tilt_sigma_rad, self._heading.sigma_rad(tilt_sigma_rad)),
            self._heading.problem,
        )
