"""Exposures and tone curves."""

import numpy as np
import pytest
from buddyline.node.capture.exposure import Exposure, ExposureRange, inverse_tone_curve, srgb_to_linear
from hypothesis import given
from hypothesis import strategies as st

RANGE = ExposureRange(75_000, 25_000_000, 8.0, line_ns=18_904.0)


@pytest.mark.parametrize(
    ("amount", "time_ms", "gain"),
    [(1e-9, 0.0756, 1.0), (0.5, 0.5, 1.0), (20.0, 20.0, 1.0), (100.0, 25.0, 4.0), (1e9, 25.0, 8.0)],
)
def test_gain_comes_last(amount, time_ms, gain):
    exposure = RANGE.exposure(amount)
    assert exposure.time_ns / 1e6 == pytest.approx(time_ms, rel=0.02)
    assert exposure.gain == pytest.approx(gain, rel=0.01)


@given(st.floats(1e-3, 300.0), st.sampled_from([0.0, 8_333_333.0, 2_000_000.0, 100_000.0, 1e9]))
def test_exposures_keep_the_bounds_whatever_the_flicker_is(amount, flicker_ns):
    exposure = RANGE.exposure(amount, flicker_ns)
    assert 75_000 <= exposure.time_ns <= 25_000_000
    assert 1.0 <= exposure.gain <= 8.0
    if 0 < flicker_ns <= 25_000_000:
        periods = exposure.time_ns / flicker_ns
        assert periods > 0.9
        assert abs(periods - round(periods)) * flicker_ns <= 18_904


def test_bounds_of_a_configuration_stay_within_the_cameras():
    narrower = RANGE.within(4_000_000, 2.0)
    assert (narrower.longest_ns, narrower.gain_max) == (4_000_000, 2.0)
    assert RANGE.within(10, 100.0).longest_ns == 75_000
    wider = RANGE.within(10**12, 100.0)
    assert (wider.longest_ns, wider.gain_max) == (RANGE.longest_ns, RANGE.gain_max)


def test_tone_curves_are_undone():
    knots = [0, 0, 1024, 5040, 16384, 40642, 65535, 65535]
    linear = inverse_tone_curve(knots)
    grey = np.interp(linear, np.array(knots[::2]) / 65535, np.array(knots[1::2]) / 65535)
    np.testing.assert_allclose(grey, np.arange(256) / 255, atol=1e-9)
    assert srgb_to_linear()[[0, 255]].tolist() == [0.0, 1.0]
    assert srgb_to_linear()[128] == pytest.approx(0.2158605)  # published: grey 128 is 21.6 % of the light
    assert (np.diff(srgb_to_linear()) > 0).all()


@pytest.mark.parametrize("knots", [[], [0, 0], [0, 0, 1], [1, 0, 2, 2], [0, 0, 5, 5, 5, 6], [0, 0, 9, 9, 10, 8]])
def test_what_is_no_rising_curve_is_refused(knots):
    with pytest.raises(ValueError, match=r"tone curve|reshape"):
        inverse_tone_curve(knots)


def test_amount_is_time_times_gain():
    assert Exposure(4_000_000, 2.0).amount == 8.0
