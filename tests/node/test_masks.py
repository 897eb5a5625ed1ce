"""Masks: what lies in them is never found, and takes no other light's place."""

import numpy as np
import pytest
from buddyline.node.choices import DETECTORS
from buddyline.node.config import DetectorConfig
from buddyline.node.detect import GuidedDetector, Region, make_detector
from buddyline.node.detect.masks import Masks
from buddyline.protocol.errors import BuddylineError

from tests.node.rendered import lamp_picture

LAMPS = [(100.0, 80.0), (300.0, 200.0)]
SIZE = 410, 308
RIGHT_HALF = [(0.5, 0.0), (1.0, 1.0)]


def found_at(detections, place):
    return [d for d in detections if np.hypot(d.blob.u_px - place[0], d.blob.v_px - place[1]) < 3.0]


@pytest.mark.parametrize("method", DETECTORS)
def test_a_masked_lamp_is_not_found_and_the_other_is(method):
    picture = lamp_picture(LAMPS, size=SIZE)
    plain = make_detector(method).detect(picture)
    assert all(found_at(plain, lamp) for lamp in LAMPS)
    masked = make_detector(method, masks=[RIGHT_HALF]).detect(picture)
    assert found_at(masked, LAMPS[0])
    assert not found_at(masked, LAMPS[1])


def test_a_masked_lamp_is_not_found_in_a_region_either():
    detector = make_detector(masks=[RIGHT_HALF])
    assert isinstance(detector, GuidedDetector)
    picture = lamp_picture(LAMPS, size=SIZE)
    detector.detect(picture)
    found = detector.detect_near(picture, [Region(lamp, 10.0, 3.0) for lamp in LAMPS])
    assert found_at(found, LAMPS[0])
    assert not found_at(found, LAMPS[1])


def test_a_masked_clock_takes_no_lights_place():
    digits = [(220.0 + 12.0 * (i % 15), 180.0 + 14.0 * (i // 15)) for i in range(105)]
    lamp = 60.0, 60.0
    picture = lamp_picture([*digits, lamp], size=SIZE, core_px=1.2)
    picture[:150] = lamp_picture([lamp], size=SIZE, core=40.0, core_px=2.0)[:150]
    plain = make_detector().detect(picture)
    masked = make_detector(masks=[[(0.5, 0.5), (1.0, 1.0)]]).detect(picture)
    assert len(plain) > len(masked)
    assert not found_at(plain, lamp)
    assert found_at(masked, lamp)


def test_a_polygon_hides_what_is_in_it():
    triangle = Masks([[(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]])
    at_px = np.array([(10.0, 10.0), (400.0, 300.0), (300.0, 20.0), (200.0, 200.0)])
    assert triangle.hide(at_px, *SIZE).tolist() == [True, False, True, False]
    # Places outside of the picture count as on its edge.
    assert triangle.hide(np.array([(-5.0, -5.0), (1e6, 1e6)]), *SIZE).tolist() == [True, False]
    # Another size of picture has the same masks.
    assert triangle.hide(at_px * 4.0, 1640, 1232).tolist() == [True, False, True, False]


@pytest.mark.parametrize(
    ("mask", "named"),
    [([(0.1, 0.1)], "corners"), ([(0.0, 0.0), (820.0, 616.0)], "820"), ([(0.0, -0.1), (1, 1)], "-0.1")],
)
def test_a_mask_that_is_none_is_refused(mask, named):
    with pytest.raises(BuddylineError, match=named):
        make_detector(masks=[[(0.0, 0.0), (0.5, 0.5)], mask])
    assert DetectorConfig().masks == []
