"""The inverse camera model against the forward model, which the tests have of their own."""

import math

import numpy as np
import pytest
from buddyline.solver_service.geometry.camera import Camera

from tests.solver_service.scenes import HD, project

CAMERAS = {
    "ideal": HD,
    "barrel": Camera("pinhole", 820, 616, 640.0, 645.0, 400.0, 310.0, (-0.28, 0.09, 8e-4, -5e-4, -0.012)),
    "pincushion": Camera("pinhole", 820, 616, 904.0, 900.0, 415.0, 300.0, (0.3, 0.2, -1e-3, 1e-3, 0.1)),
    "fisheye": Camera("fisheye", 820, 616, 330.0, 331.0, 409.0, 307.0, (-0.02, 0.006, -0.003, 0.0004)),
    "fisheye_plain": Camera("fisheye", 820, 616, 260.0, 260.0, 409.5, 307.5, (0.0, 0.0, 0.0, 0.0)),
}


@pytest.fixture(params=CAMERAS, ids=list(CAMERAS))
def camera(request):
    return CAMERAS[request.param]


def grid(camera):
    u, v = np.meshgrid(np.linspace(0, camera.width_px - 1, 17), np.linspace(0, camera.height_px - 1, 13))
    return np.stack((u.ravel(), v.ravel()), axis=1)


def test_bearings_project_back_to_their_pixels(camera):
    pixels = grid(camera)
    bearings = camera.bearings(pixels)
    np.testing.assert_allclose(np.linalg.norm(bearings, axis=1), 1, atol=1e-14)
    np.testing.assert_allclose(project(camera, 7.0 * bearings), pixels, atol=1e-8)


def test_the_optical_axis_is_straight_ahead(camera):
    bearing, tangent = camera.rays(np.array([[camera.cx_px, camera.cy_px]]))
    np.testing.assert_allclose(bearing[0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(tangent[0], [[camera.fx_px, 0, 0], [0, camera.fy_px, 0]], rtol=1e-12, atol=1e-9)


def test_tangents_are_the_derivative_of_the_projection(camera):
    pixels = grid(camera)
    bearings, tangents = camera.rays(pixels)
    rng = np.random.default_rng(0)
    for _ in range(3):
        q = bearings + 1e-5 * rng.standard_normal(bearings.shape)
        predicted = (tangents @ q[:, :, None])[:, :, 0] / (q * bearings).sum(1, keepdims=True)
        np.testing.assert_allclose(predicted, project(camera, q) - pixels, atol=2e-5)


def test_the_area_per_solid_angle_is_that_which_the_tangents_span(camera):
    frames, px2_per_sr = camera.frames(grid(camera))
    # Bearing and tangents are the edges of a block as high as one.
    np.testing.assert_allclose(px2_per_sr, np.linalg.det(frames), rtol=1e-12)


def test_a_fisheye_sees_behind_itself():
    camera = CAMERAS["fisheye_plain"]
    bearing = camera.bearings(np.array([[camera.cx_px + camera.fx_px * 2.0, camera.cy_px]]))[0]
    np.testing.assert_allclose(bearing, [math.sin(2.0), 0, math.cos(2.0)], atol=1e-12)


def test_pixels_that_no_scene_point_reaches_have_no_bearing():
    folded = Camera("pinhole", 2000, 2000, 500.0, 500.0, 999.5, 999.5, (-0.4, 0.0, 0.0, 0.0, 0.0))
    with np.errstate(all="ignore"):
        bearings = folded.bearings(np.array([[1100.0, 1000.0], [1990.0, 1990.0]]))
    assert np.isfinite(bearings[0]).all()
    assert not np.isfinite(bearings[1]).all()


def test_solid_angle_of_a_known_pyramid():
    """A square pinhole picture of half-angle 45 degrees covers a sixth of the sphere."""
    camera = Camera("pinhole", 1000, 1000, 500.0, 500.0, 499.5, 499.5)
    assert camera.solid_angle_sr == pytest.approx(4 * math.pi / 6, rel=1e-3)
