"""Detectors of other distributions: found by entry point, made as our own are, refused where they are none."""

import numpy as np
import pytest
from buddyline.node.detect import GROUP, make_detector
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.cli import main

CODE = """
import numpy as np
from buddyline.node.detect import Detection
from buddyline.protocol.messages import Blob

class Corner:
    VALUES = {"inset_px": 2.0}

    def __init__(self, values, focal_px):
        self.at = {**self.VALUES, **values}["inset_px"]

    def detect(self, image):
        blob = Blob(u_px=self.at, v_px=self.at, sigma_px=1.0, area_px=1.0, peak=255.0, elongation=1.0, score=0.5)
        return [Detection(blob, np.zeros((3, 2)), np.zeros((2, 2)), "always there")]

nothing = 3
"""


@pytest.fixture(autouse=True)
def distribution(tmp_path, monkeypatch):
    """Install a tiny distribution with three entry points, one of them sound."""
    (tmp_path / "corner_detector.py").write_text(CODE)
    info = tmp_path / "corner_detector-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: corner-detector\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        f"[{GROUP}]\ncorner = corner_detector:Corner\nnumber = corner_detector:nothing\ngone = corner_detector:Gone\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))


def test_a_detector_of_another_distribution_is_made_by_name():
    image = np.zeros((20, 30), np.uint8)
    assert make_detector("corner").detect(image)[0].blob.u_px == 2.0
    assert make_detector("corner", overrides={"inset_px": 5.0}).detect(image)[0].blob.v_px == 5.0


def test_what_it_does_not_know_is_refused():
    with pytest.raises(BuddylineError, match="corner has inset_px"):
        make_detector("corner", overrides={"outset_px": 5.0})
    # It adapts by itself: every water is the same to it.
    assert make_detector("corner", "lake").detect(np.zeros((308, 410), np.uint8))
    with pytest.raises(BuddylineError, match="source, paper, corner"):
        make_detector("edge")


@pytest.mark.parametrize(("name", "says"), [("number", "is no detector"), ("gone", "Gone")])
def test_an_entry_point_that_names_no_detector_is_named(name, says):
    with pytest.raises(BuddylineError, match=rf"\'{name}\' \(corner_detector:.*corner-detector\).*{says}"):
        make_detector(name)


def test_commands_take_it_by_name(tmp_path, capsys):
    import cv2

    cv2.imwrite(str(tmp_path / "p.png"), np.zeros((20, 30), np.uint8))
    assert main(["detect", str(tmp_path / "p.png"), "--method", "corner"]) == 0
    assert '"u_px":2' in capsys.readouterr().out
