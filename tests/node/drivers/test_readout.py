"""Times of rows, lines and clocks: pure arithmetic against hand-made cases."""

from __future__ import annotations

import logging

import pytest
from buddyline.node.drivers.readout import LineTimer, Readout, boottime_ns, clock_offset_ns, first_line_ns

FULL = (0, 0, 3280, 2464)


def test_line_time_of_the_imx219s_binned_mode():
    """41.85 frames a second of 1232 + 32 lines."""
    assert first_line_ns("imx219", 23_895, 1232) == pytest.approx(18_904, abs=1)


@pytest.mark.parametrize("exposure_us", [1000, 4000, 20_000])
@pytest.mark.parametrize("error", [-0.04, -0.013, 0.0, 0.013, 0.04])
def test_durations_of_whole_lines_determine_the_line_time(exposure_us, error):
    """IMX708's binned mode: 1296 + 40 lines of 13.365 us; durations in whole microseconds, as libcamera gives them."""
    true_ns = 13_365.1
    timer = LineTimer(true_ns * (1 + error))
    timer.update(int(1336 * true_ns / 1000))
    timer.update(int(exposure_us * 1000 // true_ns * true_ns / 1000))
    for lines in (7482, 9104, 7483, 6011, 8257, 5555):
        timer.update(int(lines * true_ns / 1000))
    assert timer.measured
    assert timer.line_ns == pytest.approx(true_ns, abs=1.0)


def test_a_duration_that_is_no_whole_number_of_lines_is_left_out():
    timer = LineTimer(18_904.0)
    timer.update(23_895)
    timer.update(9)
    assert timer.line_ns == pytest.approx(18_904, abs=5)


def test_an_unknown_sensor_is_good_to_a_few_percent_and_is_logged(caplog):
    with caplog.at_level(logging.WARNING):
        assert first_line_ns("imx999", 23_895, 1232) == pytest.approx(18_904, rel=0.04)
    assert "imx999" in caplog.text


def test_middle_of_exposure_is_before_the_end_of_the_rows_exposure():
    """Line 0's exposure ends at SensorTimestamp; half an exposure earlier is its middle."""
    one_line = Readout(0.0, 1.0, 20_000.0)
    assert one_line.middle_ns(1_000_000_000, 4000) == 1_000_000_000 - 2_000_000
    whole = Readout(0.0, 1001.0, 20_000.0)
    assert whole.middle_ns(1_000_000_000, 4000) == 1_000_000_000 + 500 * 20_000 - 2_000_000


def test_a_global_shutter_has_no_rows():
    readout = Readout.of_crop(FULL, FULL, 1232, 0.0)
    assert readout.row_time_ns(616) == 0.0
    assert readout.middle_ns(10_000_000, 1000) == 10_000_000 - 500_000


def test_a_picture_scaled_by_two_has_rows_of_two_lines():
    readout = Readout.of_crop(FULL, FULL, 1232, 18_904.0)
    assert readout.row_time_ns(616) == pytest.approx(2 * 18_904)


def test_a_crop_starts_later_and_is_shorter():
    """The middle half of the sensor, in full pixels, of a mode binned by two."""
    readout = Readout.of_crop((820, 616, 1640, 1232), FULL, 1232, 10_000.0)
    assert readout.first_line == 308.0
    assert readout.lines == 616.0
    whole = Readout.of_crop(FULL, FULL, 1232, 10_000.0)
    assert readout.middle_ns(0, 0) == whole.middle_ns(0, 0)


class Ticking:
    """Two clocks read in turn; each reading takes the given time."""

    def __init__(self, costs_ns: list[int]) -> None:
        self.now_ns = 1_000_000
        self._costs_ns = costs_ns

    def boottime(self) -> int:
        self.now_ns += self._costs_ns.pop(0) if self._costs_ns else 1000
        return self.now_ns

    def wall(self) -> int:
        self.now_ns += 1000
        return self.now_ns + 7_000_000_000


def test_offset_is_taken_from_the_tightest_bracket():
    """An interruption of a millisecond before the second reading would put the offset off by half of that."""
    calm = Ticking([])
    assert clock_offset_ns(calm.boottime, calm.wall) == 7_000_000_000
    interrupted = Ticking([1000, 1_000_000])
    assert abs(clock_offset_ns(interrupted.boottime, interrupted.wall) - 7_000_000_000) < 1000


def test_a_machine_that_is_always_interrupted_still_gets_an_answer():
    busy = Ticking([100_000] * 20)
    assert abs(clock_offset_ns(busy.boottime, busy.wall) - 7_000_000_000) < 100_000


def test_boottime_advances():
    assert 0 < boottime_ns() <= boottime_ns()
