"""chronyc's reports as chrony 4.3 prints them, and other outputs of a program of that name."""

import pytest
from buddyline.node.chrony import ChronyError, decode_tracking, read_tracking

FOLLOWS = (
    "7F000001,127.0.0.1,9,1795238696.487130714,0.000000683,0.000000048,0.000000947,"
    "-0.054,0.002,0.074,0.000001474,0.000001024,0.3,Normal"
)
SERVES = (
    "7F7F0101,,8,1795238690.278773907,0.000000000,0.000000000,0.000000000,"
    "0.000,0.000,0.000,0.000000000,0.000000000,0.0,Normal"
)
LOST = (
    "00000000,,0,0.000000000,0.000000000,0.000000000,0.000000000,"
    "0.000,0.000,0.000,1.000000000,1.000000000,0.0,Not synchronised"
)


@pytest.fixture
def chronyc(tmp_path, monkeypatch):
    """Put a `chronyc` of these shell lines onto an otherwise usual PATH."""

    def install(*lines):
        script = tmp_path / "chronyc"
        script.write_text("\n".join(["#!/bin/sh", *lines]) + "\n")
        script.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")

    return install


def test_figures_of_a_synchronised_clock_are_read(chronyc):
    chronyc('[ "$*" = "-n -c tracking" ] || exit 9', f"echo '{FOLLOWS}'")
    tracking = read_tracking(10.0)
    assert (tracking.source, tracking.stratum, tracking.synchronised, tracking.local) == ("127.0.0.1", 9, True, False)
    # chronyc(1) calls this one "0.000000683 seconds slow" and "0.054 ppm slow".
    assert tracking.offset_s == pytest.approx(-6.83e-7)
    assert tracking.frequency_ppm == pytest.approx(-0.054)
    assert tracking.bound_s == pytest.approx(6.83e-7 + 1.024e-6 + 0.737e-6)
    assert tracking.status_fields() == {
        "clock_offset_s": tracking.offset_s,
        "clock_rms_s": 9.47e-7,
        "clock_bound_s": tracking.bound_s,
        "clock_frequency_ppm": -0.054,
        "clock_source": "127.0.0.1",
    }


@pytest.mark.parametrize(("line", "source", "synchronised"), [(SERVES, "local", True), (LOST, "", False)])
def test_an_unsynchronised_clock_has_no_offset(line, source, synchronised):
    tracking = decode_tracking(line)
    assert tracking.synchronised is synchronised
    assert tracking.status_fields() == {"clock_source": source}


@pytest.mark.parametrize(
    "line",
    ["", "garbage", FOLLOWS.rpartition(",")[0], FOLLOWS.replace("0.000000947", "nan"), FOLLOWS.replace(",9,", ",x,")],
)
def test_garbage_is_refused_and_quoted(line):
    with pytest.raises(ChronyError, match="chronyc said"):
        decode_tracking(line)


def test_a_chronyd_that_does_not_run_is_named(chronyc):
    chronyc("echo '506 Cannot talk to daemon'", "exit 1")
    with pytest.raises(ChronyError, match=r"506 Cannot talk to daemon: chronyd does not run \(systemctl"):
        read_tracking(10.0)


def test_a_chronyc_that_fails_without_output_is_an_error(chronyc):
    chronyc("exit 3")
    with pytest.raises(ChronyError, match="status 3"):
        read_tracking(10.0)


def test_output_that_is_no_text_is_an_error(chronyc):
    chronyc("printf '\\377\\376\\000'")
    with pytest.raises(ChronyError, match="chronyc said"):
        read_tracking(10.0)


def test_a_chronyc_that_hangs_is_given_up(chronyc):
    chronyc("exec sleep 60")
    with pytest.raises(ChronyError, match=r"no answer for 0\.1 s"):
        read_tracking(0.1)


def test_without_chrony_there_are_no_figures(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert read_tracking() is None


def test_a_chronyc_that_may_not_be_run_is_an_error(chronyc, tmp_path, monkeypatch):
    chronyc("exit 0")
    (tmp_path / "chronyc").write_bytes(b"\x00not a program")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ChronyError, match="cannot be run"):
        read_tracking()
