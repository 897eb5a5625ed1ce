"""A node's configuration: what of its calibration goes into NodeInfo, and what is refused."""

import pytest
from buddyline.node.config import CalibrationConfig, CameraConfig, FixedConfig, NodeConfig, load_node_config
from buddyline.protocol.codec import decode, encode
from buddyline.protocol.config import ConfigError
from buddyline.protocol.messages import CameraModel, NodeInfo
from msgspec import UNSET
from msgspec.structs import replace

from tests.processes import REPOSITORY

CAMERA = CameraModel(model="pinhole", fx_px=1808.0, fy_px=1808.0, cx_px=830.0, cy_px=600.0, distortion=[0.0] * 5)


def config(camera, width_px, height_px):
    calibration = CalibrationConfig(camera=camera, light_left_m=(-0.44, 0.0, 0.0), light_right_m=(0.44, 0.0, 0.0))
    return NodeConfig(node="a", camera=CameraConfig(width_px=width_px, height_px=height_px), calibration=calibration)


def test_a_calibration_of_this_picture_size_is_accepted():
    info = config(CAMERA, 1640, 1232).node_info(1, "", "", 0)
    assert (info.width_px, info.camera.cx_px) == (1640, 830.0)


@pytest.mark.parametrize("size", [(820, 616), (3280, 2464), (1640, 922), (1232, 1640)])
def test_a_calibration_of_another_resolution_is_refused(size):
    with pytest.raises(ConfigError, match=r"calibration\.camera\.c[xy]_px = \d+ .*calibrate in the mode that dives"):
        config(CAMERA, *size).node_info(1, "", "", 0)


def test_a_principal_point_slightly_off_centre_is_accepted():
    assert config(replace(CAMERA, cx_px=900.0), 1640, 1232).node_info(1, "", "", 0)


def test_the_inertial_units_place_and_delay_go_into_node_info():
    plain = config(CAMERA, 1640, 1232)
    assert plain.node_info(1, "", "", 0).imu_m is UNSET
    assert plain.node_info(1, "", "", 0).imu_delay_ns is UNSET
    calibration = replace(plain.calibration, imu_m=(0.03, -0.06, -0.08), imu_delay_ns=7_000_000)
    info = decode(encode(replace(plain, calibration=calibration).node_info(1, "", "", 0)), NodeInfo)
    assert (info.imu_m, info.imu_delay_ns) == ((0.03, -0.06, -0.08), 7_000_000)


@pytest.mark.parametrize("line", ["imu_delay_ns = 7_000_000_000", "imu_m = [0.1, 0.2]", "imu_m = 'left'"])
def test_an_absurd_place_or_delay_is_refused_with_its_name(tmp_path, line):
    path = tmp_path / "a.toml"
    example = (REPOSITORY / "node/examples/pi.toml").read_text()
    path.write_text(example.replace("sigma_px = 0.7", f"sigma_px = 0.7\n{line}"))
    with pytest.raises(ConfigError, match=line.split()[0]):
        load_node_config(path)


@pytest.mark.parametrize(
    ("table", "line", "named"),
    [
        ("calibration", "light_left_m = [0.44, 0.0, 0.0]", r"\[calibration\] light_left_m, light_right_m: less than"),
        ("calibration", "light_left_m = [-440.0, 0.0, 0.0]", "440.44 m apart; are they in millimetres"),
        ("calibration", "light_left_m = [nan, 0.10, 0.00]", r"a\.toml: calibration\.light_left_m\[0\] = nan: not"),
        ("calibration", "q_body_camera_xyzw = [0.0, 0.0, 0.0, 0.0]", r"calibration\.q_body_camera_xyzw: norm 0"),
        ("sensors", "mount_xyzw = [1.0, 1.0, 0.0, 0.0]", r"sensors\.mount_xyzw: norm 1\.41421"),
    ],
)
def test_a_rig_that_cannot_be_is_refused_with_its_name(tmp_path, table, line, named):
    path = tmp_path / "a.toml"
    lines = (REPOSITORY / "node/examples/pi.toml").read_text().splitlines()
    lines = [each for each in lines if each.split(" ")[0] != line.split(" ")[0]]
    lines.insert(lines.index(f"[{table}]") + 1, line)
    path.write_text("\n".join(lines))
    with pytest.raises(ConfigError, match=named):
        load_node_config(path)


def test_role_and_fixed_place_go_into_node_info():
    plain = config(CAMERA, 1640, 1232)
    info = plain.node_info(1, "", "", 0)
    assert (plain.in_net(info).role, plain.in_net(info).fixed) == (UNSET, UNSET)
    fixed = FixedConfig(p_m=(1.0, 2.0, 3.0), q_xyzw=(0.5, 0.5, 0.5, 0.5), sigma_m=0.01)
    info = decode(encode(replace(plain, role="camera", fixed=fixed).in_net(info)), NodeInfo)
    assert (info.role, info.has_lights, info.has_camera) == ("camera", False, True)
    assert (info.fixed.net, info.fixed.p_m, info.fixed.sigma_m) == ("main", (1.0, 2.0, 3.0), 0.01)


@pytest.mark.parametrize(
    ("table", "named"),
    [
        ("p_m = [0.0, 0.0, 1.0]\nq_xyzw = [0.5, 0.5, 0.5, 0.9]", r"a\.toml: fixed\.q_xyzw: norm"),
        ("p_m = [0.0, 1.0]\nq_xyzw = [0.5, 0.5, 0.5, 0.5]", "fixed.p_m"),
        ("q_xyzw = [0.5, 0.5, 0.5, 0.5]", "p_m"),
        ("p_m = [0.0, 0.0, 1.0]\nq_xyzw = [0.5, 0.5, 0.5, 0.5]\nnet = 'Main'", "fixed.net"),
    ],
)
def test_a_place_that_is_none_is_refused_with_its_name(tmp_path, table, named):
    path = tmp_path / "a.toml"
    path.write_text(f"node = 'a'\n[fixed]\n{table}\n")
    with pytest.raises(ConfigError, match=named):
        load_node_config(path)
