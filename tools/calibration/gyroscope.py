"""How a gyroscope's bias moves with its temperature, from a log in which the node lies still and warms or cools."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.node.attitude import REST_ACCEL_MPS2, REST_GYRO_RADPS
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Imu
from buddyline.tools.calibration.leastsquares import Floats, require
from msgspec import UNSET

WINDOW_NS: Final = 10 * S_NS
MIN_SAMPLES: Final = 200
MIN_RESTS: Final = 6
MIN_SPAN_K: Final = 5.0
# A slope that leaves more of the bias than this, rms, is no line: something else has moved it.
MAX_LEFT_RADPS: Final = np.radians(0.05)


@dataclass(frozen=True, eq=False)
class GyroscopeFit:
    """slope_radps_per_k, sigma_radps_per_k: (3,), body frame. left_radps: rms that the line leaves. rests: how many.

    span_k: from the coldest to the warmest rest.
    """

    slope_radps_per_k: Floats
    sigma_radps_per_k: Floats
    left_radps: float
    rests: int
    span_k: float


def fit(samples: Sequence[Imu]) -> GyroscopeFit:
    """Fit a line to bias over temperature; raise PoorCalibration, saying what is missing, where it is not good enough.

    samples: of one node, in order of time. Only windows in which the node lies still count.
    """
    degc, bias = _rests(samples)
    few = f"{len(degc)} rests of {WINDOW_NS // S_NS} s, at least {MIN_RESTS} are needed: let the node lie still"
    require((len(degc) >= MIN_RESTS, few))
    span_k = float(degc.max() - degc.min())
    changed = f"the temperature changed by {span_k:.1f} K only, at least {MIN_SPAN_K:g} are needed"
    require((span_k >= MIN_SPAN_K, f"{changed}: start with a node that comes out of a refrigerator"))
    lever = degc - degc.mean()
    slope = lever @ bias / (lever @ lever)
    left = bias - bias.mean(0) - lever[:, None] * slope
    left_radps = float(np.sqrt((left**2).mean()))
    leaves = f"a line leaves {np.degrees(left_radps):.3f} deg/s of the bias, rms"
    require((bool(left_radps <= MAX_LEFT_RADPS), f"{leaves}: the node was turned, or its chip is heated from one side"))
    sigma = np.sqrt((left**2).sum(0) / (len(degc) - 2) / (lever @ lever))
    return GyroscopeFit(slope, sigma, left_radps, len(degc), span_k)


def _rests(samples: Sequence[Imu]) -> tuple[Floats, Floats]:
    """Return temperatures (N,) and biases (N, 3) of the windows in which the node lay still."""
    degc: list[float] = []
    bias: list[Floats] = []
    window: list[Imu] = []
    for sample in samples:
        if window and not 0 <= sample.stamp_ns - window[0].stamp_ns < WINDOW_NS:
            _close(window, degc, bias)
            window = []
        window.append(sample)
    _close(window, degc, bias)
    return np.array(degc), np.array(bias).reshape(-1, 3)


def _close(window: Sequence[Imu], degc: list[float], bias: list[Floats]) -> None:
    told = [one.temperature_degc for one in window if one.temperature_degc is not UNSET]
    if len(window) < MIN_SAMPLES or not told:
        return
    gyro = np.array([one.gyro_radps for one in window])
    accel = np.array([one.accel_mps2 for one in window])
    if gyro.std(axis=0).max() < REST_GYRO_RADPS and accel.std(axis=0).max() < REST_ACCEL_MPS2:
        degc.append(float(np.mean(told)))
        bias.append(gyro.mean(axis=0))
