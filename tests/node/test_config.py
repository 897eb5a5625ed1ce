"""A node's configuration: a calibration of pictures of another size is refused."""

import pytest
from buddyline.node.config import CalibrationConfig, CameraConfig, NodeConfig
from buddyline.protocol.config import ConfigError
from buddyline.protocol.messages import CameraModel
from msgspec.structs import replace

CAMERA = CameraModel(model="pinhole", fx_px=1808.0, fy_px=1808.0, cx_px=830.0, cy_px=600.0, distortion=[0.0] * 5)


def config(camera, width_px, height_px):
    calibration = CalibrationConfig(camera=camera, light_left_m=(-0.44, 0.0, 0.0), light_right_m=(0.44, 0.0, 0.0))
    return NodeConfig(node="a", camera=CameraConfig(width_px=width_px, height_px=height_px), calibration=calibration)


def test_a_calibration_of_these_pictures_is_taken():
    info = config(CAMERA, 1640, 1232).node_info(1, "", "", 0)
    assert (info.width_px, info.camera.cx_px) == (1640, 830.0)


@pytest.mark.parametrize("size", [(820, 616), (3280, 2464), (1640, 922), (1232, 1640)])
def test_a_calibration_of_another_resolution_is_refused(size):
    with pytest.raises(ConfigError, match=r"calibration\.camera\.c[xy]_px = \d+ .*calibrate in the mode that dives"):
        config(CAMERA, *size).node_info(1, "", "", 0)


def test_a_principal_point_a_little_off_is_a_lens():
    assert config(replace(CAMERA, cx_px=900.0), 1640, 1232).node_info(1, "", "", 0)
