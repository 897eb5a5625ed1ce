"""Outlines on rings: known shapes, and what lies outside the picture."""

import cv2
import numpy as np
import pytest
from buddyline.node.detect.lights import _rims, distinct
from buddyline.node.detect.rings import elongation, find_shapes, geometric_radii, luminance, sample_rings

SHARES = np.linspace(0.0, 1.0, 120, dtype=np.float32)


def outlined(image, place, threshold=128.0):
    radius = geometric_radii(np.array([1.0]), np.array([90.0]), SHARES)
    rings = sample_rings(image, np.array([place], np.float32), radius)
    level = luminance(rings.pixels)[None]
    return rings, find_shapes(level, rings, np.full((1, 1, 1), threshold, np.float32))


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 135.0])
def test_an_ellipse_has_its_middle_area_and_axes(angle_deg):
    image = np.zeros((240, 320), np.uint8)
    cv2.ellipse(image, (150, 120), (40, 20), angle_deg, 0, 360, 255, cv2.FILLED)
    _, shapes = outlined(image, (154.0, 118.0))
    u, v, radius = shapes.circle_px[0, 0, 0]
    assert (u, v) == pytest.approx((-4.0, 2.0), abs=0.3)
    assert radius == pytest.approx(np.sqrt(40.0 * 20.0), rel=0.03)
    assert elongation(shapes.edge_px[0, 0], shapes.circle_px[0, 0])[0] == pytest.approx(2.0, rel=0.04)


def test_rays_that_find_no_edge_end_at_the_last_ring_and_those_that_leave_the_picture_at_its_border():
    image = np.full((240, 320), 200, np.uint8)
    rings, shapes = outlined(image, (160.0, 120.0))
    assert rings.inside is None
    assert shapes.edge_px == pytest.approx(90.0)
    rings, shapes = outlined(image, (20.0, 120.0))
    leftward = shapes.edge_px.shape[-1] // 2
    assert rings.inside is not None
    assert shapes.edge_px[0, 0, 0, leftward] == pytest.approx(20.5, abs=1.0)
    assert shapes.edge_px[0, 0, 0, 0] == pytest.approx(90.0)


def test_a_place_that_overlaps_an_earlier_one_is_left_out():
    centre_px = np.array([[100.0, 100.0], [104.0, 100.0], [120.0, 100.0], [100.0, 130.0], [200.0, 200.0]])
    radius_px = np.array([10.0, 1.0, 1.0, 50.0, 1.0])
    assert distinct(centre_px, radius_px, 9) == [0, 2, 4]
    assert distinct(centre_px, radius_px, 2) == [0, 2]


def test_the_rim_of_a_faint_light_is_not_the_outline_of_its_noise():
    """A lamp's face of 3.6 px in turbid water, a bright speckle beside its middle, and it 7 times brighter."""
    circle_px = np.array([[[1.6, 0.0, 0.7]], [[1.3, 0.0, 1.4]], [[0.1, 0.0, 3.0]], [[0.1, 0.0, 4.0]]])
    (faint_px,), (faint_radius_px,) = _rims(circle_px, np.array([14.0]))
    assert np.hypot(*faint_px) < 0.2
    assert 3.0 < faint_radius_px < 4.0
    _, (bright_radius_px,) = _rims(circle_px, np.array([98.0]))
    assert bright_radius_px < 1.5
