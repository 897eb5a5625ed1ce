"""Every example runs as it stands, over the golden dives and over loopback, and says what it should."""

import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import cv2
import pytest

from tests.golden.logs import read_log
from tests.processes import PATIENCE_S, REPOSITORY, Process, free_endpoint

pytestmark = pytest.mark.slow
EXAMPLES = REPOSITORY / "examples"
DATA = REPOSITORY / "tests" / "data" / "golden"
LIVE = ("09_live_poses.py", "10_warn_when_far.py")


def run(name, *words, folder=None):
    """Run an example in a folder of its own; return stdout."""
    done = subprocess.run(
        # What the tests were told to overlook comes later, and counts.
        [sys.executable, "-W", "error", *(f"-W{one}" for one in sys.warnoptions), EXAMPLES / name, *map(str, words)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": ""},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def picture(tmp_path_factory):
    """A picture out of a golden dive."""
    import base64

    image = next(entry for entry in read_log(DATA / "night_reef_pictures.mcap") if entry.topic == "image")
    path = tmp_path_factory.mktemp("pictures") / "picture.jpg"
    path.write_bytes(base64.b64decode(image.message["data"]))
    assert cv2.imread(str(path)) is not None
    return path


def test_each_example_is_short_and_tested():
    names = sorted(path.name for path in EXAMPLES.glob("*.py"))
    text = Path(__file__).read_text()
    assert 6 <= len(names) <= 12
    for name in names:
        assert name in text, f"{name} has no test"
        assert 10 <= len((EXAMPLES / name).read_text().splitlines()) <= 36, name


def test_solve_a_dive():
    out = run("01_solve_a_dive.py", DATA / "cavern.mcap")
    assert out.startswith("nodes a and b: 1")
    assert "unmatched" in out


def test_solve_two_logs():
    assert "poses" in run("01_solve_a_dive.py", DATA / "night_reef_a.mcap", DATA / "night_reef_b.mcap")


def test_error_against_truth():
    lines = run("02_error_against_truth.py", DATA / "cavern.mcap").splitlines()
    assert len(lines) >= 4
    assert all(float(line.split()[4]) < 100 for line in lines)


def test_plot_depths(tmp_path):
    pytest.importorskip("matplotlib")
    run("03_plot_depths.py", DATA / "cavern.mcap", tmp_path / "depths.png")
    assert cv2.imread(str(tmp_path / "depths.png")).shape[0] > 100


def test_attitudes_to_csv():
    lines = run("04_attitudes_to_csv.py", "a", DATA / "cavern.mcap").splitlines()
    assert lines[0] == "stamp_ns,roll_deg,pitch_deg,heading_deg"
    assert len(lines) == 701
    assert all(0 <= float(line.split(",")[3]) <= 360 for line in lines[1:])


def test_detect_in_a_picture(picture):
    lines = run("05_detect_in_a_picture.py", picture).splitlines()
    assert len(lines) >= 2
    assert all("1 sd" in line for line in lines)


def test_read_a_calibration():
    out = run("06_read_a_calibration.py", DATA / "cavern.mcap")
    assert "820x616 px, pinhole, 49 degrees across" in out


def test_other_calibration():
    out = run("07_other_calibration.py", DATA / "survey.mcap")
    assert "ranges grow by 2.00 %" in out


def test_own_candidates():
    assert run("08_own_candidates.py").startswith("range 4.000 m")


def test_poses_and_track(tmp_path):
    pytest.importorskip("matplotlib")
    out = run("11_poses_and_track.py", DATA / "cavern.mcap", tmp_path / "range.png")
    assert " rows of track; longest without a light " in out
    assert cv2.imread(str(tmp_path / "range.png")).shape[0] > 100


@pytest.fixture(scope="module")
def hub():
    endpoint = free_endpoint()
    with Process("hub", "--listen", endpoint) as process:
        process.wait_for("listens")
        yield endpoint


class Example:
    """An example that runs beside the test."""

    def __init__(self, name, *words):
        self._child = subprocess.Popen(
            [sys.executable, EXAMPLES / name, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def first_line(self):
        return self._child.stdout.readline()

    def end(self):
        """Wait for its end; return the rest of stdout."""
        out, errors = self._child.communicate(timeout=PATIENCE_S)
        assert self._child.returncode == 0, errors
        return out

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._child.kill()
        # It closes its pipes, also where the child has ended by itself.
        self._child.communicate()


def test_live_examples_follow_the_solver(hub):
    with (
        Process("solver", "--connect", hub),
        Process("play", DATA / "cavern.mcap", "--connect", hub, "--loop", "--speed", "4") as player,
        ExitStack() as stack,
    ):
        # It ends after two seconds without a pose, which a loaded machine may well need until the first.
        for _ in range(10):
            far = stack.enter_context(Example("10_warn_when_far.py", hub))
            if " m away" in (line := far.first_line()):
                break
        assert " m away" in line
        # On a loaded machine two seconds may pass without a pose.
        for seconds in ("2", "30"):
            with Example("09_live_poses.py", hub, seconds) as live:
                lines = live.end().splitlines()
            if lines:
                break
        assert lines
        assert all(line.startswith("a/b 17640000") for line in lines)
        player.end()
        assert far.end().endswith("no pose for two seconds\n")
