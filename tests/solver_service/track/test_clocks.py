"""What a dive's track tells of two nodes' clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.track.clocks import MIN_FIXES, clocks_of, line_through
from buddyline.solver_service.track.parts import clock_off_by, parts_of
from buddyline.solver_service.track.records import last_ns
from buddyline.solver_service.track.state import CLOCK

from tests.solver_service.track.dives import Setting, filter_of, make
from tests.solver_service.track.test_track import bare_of


@pytest.mark.slow
@pytest.mark.parametrize("clock_s", [0.05, -0.02])
def test_the_offset_is_found_within_its_sigma(clock_s: float) -> None:
    dive = make(8, Setting(seconds=25.0, poor=True, clock_s=clock_s))
    found = clocks_of(dive.records, dive.fixes)
    assert found is not None
    assert found.sigma_s < 0.005
    assert abs(found.offset_s - clock_s) < 3.5 * found.sigma_s
    assert (found.drift, found.drift_sigma, found.stretches) == (None, None, 1)


def test_too_few_fixes_and_no_inertial_units_tell_nothing() -> None:
    dive = make(8, Setting(seconds=12.0))
    assert clocks_of(dive.records, dive.fixes[: MIN_FIXES - 1]) is None
    assert clocks_of(bare_of(dive), dive.fixes) is None
    assert clocks_of(dive.records, []) is None


def test_frames_of_one_node_alone_tell_nothing() -> None:
    dive = make(8, Setting(seconds=12.0))
    assert clocks_of((dive.records[0], replace(dive.records[1], frames=[])), dive.fixes) is None


def stretches(rng: np.random.Generator, drift: float, scatter: float) -> list[tuple[float, float, float, int]]:
    """Ten minutes of an offset of 20 ms at their middle, told within 1.5 ms by each."""
    times_s = 1e9 + 60.0 * np.arange(10)
    offsets_s = 0.02 + drift * (times_s - times_s.mean()) + scatter * 0.0015 * rng.normal(size=10)
    return [(float(t), float(c), 0.0015, 400) for t, c in zip(times_s, offsets_s, strict=True)]


@pytest.mark.parametrize("scatter", [1.0, 3.0])
def test_offset_and_drift_are_as_sure_as_they_say(scatter: float) -> None:
    rng = np.random.default_rng(4)
    off, drifts = [], []
    for _ in range(200):
        found = line_through(stretches(rng, 15e-6, scatter))
        assert found.drift is not None
        assert found.drift_sigma is not None
        assert found.at_ns == pytest.approx((1e9 + 270.0) * 1e9, abs=1e6)
        off.append((found.offset_s - 0.02) / found.sigma_s)
        drifts.append((found.drift - 15e-6) / found.drift_sigma)
    for normalized in (off, drifts):
        assert 0.6 < np.mean(np.square(normalized)) < 1.7


def test_a_drift_that_is_badly_told_is_not_said() -> None:
    two = stretches(np.random.default_rng(5), 15e-6, 1.0)[:2]
    found = line_through(two)
    assert found.drift is None
    assert found.drift_sigma == pytest.approx(0.0015 * np.sqrt(2.0) / 60.0)
    assert found.fixes == 800


def test_a_pair_at_rest_is_not_believed() -> None:
    """As a pair at rest told (ms, 1 sd): by 55 +- 14, then 109 +- 14, then 86 +- 16; others 300 and 50 ms apart."""
    dive = make(8, Setting(seconds=4.0))
    filtered = filter_of(dive.records, dive.fixes)
    filtered.advance(last_ns(dive.records))
    (part,) = parts_of(filtered)
    for offset_s, sigma_s, off in ((-0.055, 0.0143, False), (0.251, 0.0095, True), (0.05, 0.0015, True)):
        part.state = part.state.with_parts(clock_s=offset_s)
        part.covariance[CLOCK, CLOCK] = sigma_s**2
        assert clock_off_by(part, 0.005) == off
