"""The messages: an invalid field is refused and named."""

import json
import math

import pytest
from buddyline.protocol.codec import decode
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import Attitude, Candidates, Expect, NodeInfo

ATTITUDE = {
    "node": "a",
    "stamp_ns": 1_764_000_000_000_000_001,
    "q_ned_body_xyzw": [0.0, 0.0, 0.0, 1.0],
    "sigma_rad": [0.02, 0.02, 0.08],
}
CANDIDATES = {
    "node": "a",
    "stamp_ns": 5,
    "trigger": 0,
    "seq": 0,
    "boot": "x",
    "width_px": 820,
    "height_px": 616,
    "blobs": [
        {"u_px": 1.0, "v_px": 2.0, "sigma_px": 0.5, "area_px": 9.0, "peak": 255.0, "elongation": 1.0, "dt_ns": 0}
    ],
}
CAMERA = {"model": "pinhole", "fx_px": 900.0, "fy_px": 900.0, "cx_px": 409.5, "cy_px": 307.5, "distortion": [0.0] * 5}
INFO = {
    "node": "a",
    "stamp_ns": 0,
    "width_px": 820,
    "height_px": 616,
    "camera": CAMERA,
    "light_left_m": [-0.44, 0.0, 0.0],
    "light_right_m": [0.44, 0.0, 0.0],
    "sigma_px": 0.7,
    "trigger_period_ns": 100_000_000,
}


LIGHT = {
    "side": "left",
    "u_px": 450.0,
    "v_px": 307.0,
    "covariance_px2": [9.0, 1.0, 16.0],
    "rate_pxps": [-20.0, 3.0],
    "sigma_rate_pxps": 100.0,
}
EXPECT = {"node": "a", "seen": "b", "stamp_ns": 5, "valid_ns": 500_000_000, "lights": [LIGHT]}


def dumps(message: object) -> bytes:
    return json.dumps(message).encode()


@pytest.mark.parametrize(
    ("schema", "sound", "change", "named"),
    [
        (Attitude, ATTITUDE, {"node": "a/b"}, "node"),
        (Attitude, ATTITUDE, {"node": "a\n"}, "node"),
        (Attitude, ATTITUDE, {"stamp_ns": -1}, "stamp_ns"),
        (Attitude, ATTITUDE, {"stamp_ns": 1.5}, "stamp_ns"),
        (Attitude, ATTITUDE, {"stamp_ns": True}, "stamp_ns"),
        (Attitude, ATTITUDE, {"q_ned_body_xyzw": [0.0, 0.0, 0.0, 1.01]}, "q_ned_body_xyzw"),
        (Attitude, ATTITUDE, {"q_ned_body_xyzw": [0.0, 0.0, 1.0]}, "q_ned_body_xyzw"),
        (Attitude, ATTITUDE, {"sigma_rad": [math.nan, 0.1, 0.1]}, "sigma_rad"),
        (Attitude, ATTITUDE, {"sigma_rad": [0.1, math.inf, 0.1]}, "sigma_rad"),
        (Attitude, ATTITUDE, {"sigma_rad": [0.1, "0.1", 0.1]}, "sigma_rad"),
        (Candidates, CANDIDATES, {"blobs": [dict(CANDIDATES["blobs"][0], u_px=820.0)]}, "blobs[0].u_px"),
        (Candidates, CANDIDATES, {"elsewhere": -1}, "elsewhere"),
        (Expect, EXPECT, {"valid_ns": 0}, "valid_ns"),
        (Expect, EXPECT, {"lights": [LIGHT] * 3}, "lights"),
        (Expect, EXPECT, {"lights": [dict(LIGHT, side="top")]}, "side"),
        (Expect, EXPECT, {"lights": [dict(LIGHT, v_px=math.nan)]}, "v_px"),
        (Expect, EXPECT, {"lights": [dict(LIGHT, sigma_rate_pxps=-1.0)]}, "sigma_rate_pxps"),
        (Expect, EXPECT, {"lights": [dict(LIGHT, covariance_px2=[9.0, 12.0, 16.0])]}, "covariance_px2"),
        (Candidates, CANDIDATES, {"blobs": [dict(CANDIDATES["blobs"][0], v_px=-0.6)]}, "blobs[0].v_px"),
        (Candidates, CANDIDATES, {"blobs": [dict(CANDIDATES["blobs"][0], sigma_px=0.0)]}, "sigma_px"),
        (Candidates, CANDIDATES, {"blobs": [dict(CANDIDATES["blobs"][0], lasting_s=-0.1)]}, "lasting_s"),
        (Candidates, CANDIDATES, {"blobs": [dict(CANDIDATES["blobs"][0], lasting_s=1e308)]}, "lasting_s"),
        (Candidates, CANDIDATES, {"blobs": CANDIDATES["blobs"] * 65}, "blobs"),
        (NodeInfo, INFO, {"camera": dict(CAMERA, distortion=[0.0] * 4)}, "distortion"),
        (NodeInfo, INFO, {"light_left_m": [0.44, 0.0, 0.0]}, "light_left_m"),
        (NodeInfo, INFO, {"trigger_period_ns": 0}, "trigger_period_ns"),
        (NodeInfo, INFO, {"role": "tripod"}, "role"),
        (NodeInfo, INFO, {"fixed": {"p_m": [0.0, 0.0, 1.0], "q_xyzw": [0.0, 0.0, 0.0, 1.1]}}, "fixed"),
        (NodeInfo, INFO, {"fixed": {"p_m": [0.0, math.nan, 1.0], "q_xyzw": [0.0, 0.0, 0.0, 1.0]}}, "p_m"),
    ],
)
def test_an_invalid_field_is_refused_and_named(schema, sound, change, named):
    decode(dumps(sound), schema)
    with pytest.raises(MessageError) as refused:
        decode(dumps(sound | change), schema)
    assert named in str(refused.value)


@pytest.mark.parametrize("field", sorted(ATTITUDE))
def test_a_missing_field_is_named(field):
    with pytest.raises(MessageError, match=field):
        decode(dumps({name: value for name, value in ATTITUDE.items() if name != field}), Attitude)
