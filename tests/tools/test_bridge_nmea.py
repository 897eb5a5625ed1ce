"""`bridge --nmea`: what chart plotters read, and what a boat's receiver says."""

from __future__ import annotations

import math
from datetime import UTC, datetime

import pytest
from buddyline.protocol.clock import S_NS
from buddyline.tools.bridge.nmea import angle, checksum, place_of, sentences
from buddyline.tools.bridge.place import on_earth
from buddyline.tools.bridge.placed import euler_rad

from tests.tools.bridged import P_NED, PLACE, R_NED_A, V_NED, placed_of


class TestNmea:
    def test_checksums_are_the_standard_s(self) -> None:
        assert checksum("GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,") == "47"

    def test_angles_never_show_sixty_minutes(self) -> None:
        assert angle(47.99999999999, "NS") == "4800.000000,N"
        assert angle(-9.5, "EW") == "00930.000000,W"

    def test_a_plotter_reads_what_was_meant(self) -> None:
        pynmea2 = pytest.importorskip("pynmea2")
        placed = placed_of(declination_rad=0.0)
        earth = on_earth(placed, PLACE)
        read = {line[1:6]: pynmea2.parse(line, check=True) for line in sentences(placed, earth)}
        assert set(read) == {"GPGGA", "GPGST", "RATLL", "RATTM", "HEHDT"}
        assert read["GPGGA"].latitude == pytest.approx(earth.latitude_deg, abs=1e-8)
        assert read["GPGGA"].longitude == pytest.approx(earth.longitude_deg, abs=1e-8)
        assert float(read["GPGGA"].altitude) == -12.5
        stamp = datetime.fromtimestamp(placed.stamp_ns / S_NS, UTC)
        assert read["GPGGA"].timestamp.replace(microsecond=0) == stamp.timetz().replace(microsecond=0)
        assert float(read["GPGST"].std_dev_latitude) == pytest.approx(earth.sigma_north_m, abs=1e-3)
        assert float(read["GPGST"].std_dev_longitude) == pytest.approx(earth.sigma_east_m, abs=1e-3)
        ttm = read["RATTM"].data
        assert float(ttm[1]) == pytest.approx(math.hypot(*P_NED[:2]) / 1e3, abs=1e-5)
        assert float(ttm[2]) == pytest.approx(math.degrees(math.atan2(P_NED[1], P_NED[0])) % 360, abs=0.06)
        assert ttm[3] == "T"
        assert float(ttm[4]) == pytest.approx(3.6 * math.hypot(*V_NED[:2]), abs=0.01)
        assert float(read["HEHDT"].heading) == pytest.approx(math.degrees(placed.yaw_rad), abs=0.06)

    def test_magnetic_headings_are_not_called_true(self) -> None:
        placed = placed_of()
        read = {line[1:6]: line.split(",") for line in sentences(placed, None)}
        assert set(read) == {"RATTM", "HCHDM"}
        assert read["RATTM"][4] == "R"
        bearing = math.atan2(P_NED[1], P_NED[0]) - euler_rad(R_NED_A)[2]
        assert float(read["RATTM"][3]) == pytest.approx(math.degrees(bearing) % 360, abs=0.06)

    def test_a_boat_s_place_comes_from_whole_valid_sentences_alone(self) -> None:
        good = "$GPGGA,123519,4807.038,N,01131.000,W,1,08,0.9,545.4,M,46.9,M,,*55"
        place = place_of(good)
        assert place is not None
        assert (place.latitude_deg, place.longitude_deg) == pytest.approx((48.1173, -11.516667), abs=1e-5)
        assert place.sigma_m == pytest.approx(0.9 * 2.5 / math.sqrt(2))
        for bad in (
            good.replace("4807", "4808"),
            good[:30],
            "",
            line("GPGGA,123519,,,,,0,00,,,M,,M,,"),
            line("GPGGA,123519,9907.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"),
            line("GPGGA,123519,4807.038,N,01131.000,W,1,08,1e308,545.4,M,46.9,M,,"),
            line("GPGGA,123519,4807.038,N,01131.000,W,1,08,-1,545.4,M,46.9,M,,"),
            line("GPRMC,123519,V,4807.038,N,01131.000,E,0,0,230394,,"),
        ):
            assert place_of(bad) is None, bad
        assert place_of(line("GPRMC,123519,A,4807.038,N,01131.000,E,0,0,230394,,")) is not None


def line(body: str) -> str:
    return f"${body}*{checksum(body)}"
