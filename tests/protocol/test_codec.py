"""Bytes and messages: every decoded message is valid, and no invalid message is encoded."""

import contextlib
import json
import math
import re

import numpy as np
import pytest
from buddyline.protocol.codec import decode, encode, payload_stamp_ns
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import Attitude, Blob, Candidates, CompressedImage, Depth, FoxgloveTime, NodeInfo
from hypothesis import given
from hypothesis import strategies as st


@pytest.mark.parametrize("payload", [b"", b"\xff\xfe", b"null", b"[" * 100_000, b"{" * 50, b"{}", b'{"node":'])
def test_malformed_payloads_are_refused(payload):
    with pytest.raises(MessageError):
        decode(payload, Attitude)


def test_unknown_fields_are_ignored():
    payload = b'{"node":"a","stamp_ns":7,"depth_m":3.0,"sigma_m":1.0,"mood":"calm"}'
    assert decode(payload, Depth) == Depth(node="a", stamp_ns=7, depth_m=3.0, sigma_m=1.0)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"sigma_m": -3.0}, "Depth: sigma_m = -3.0: Expected `float` >"),
        ({"depth_m": "deep\n"}, 'Depth: depth_m = "deep\\n": Expected `float`, got `str`'),
        ({"stamp_ns": -1}, "Depth: stamp_ns = -1: Expected `int` >= 0"),
        # A long value is left out, and a missing field has none.
        ({"node": "x" * 100}, "Depth: Expected `str` matching regex '^[a-z0-9_]{1,32}\\\\Z' - at `$.node`"),
        ({"node": None}, "Depth: node = null: Expected `str`, got `null`"),
    ],
)
def test_a_refused_field_is_named_with_its_value(changed, says):
    message = {"node": "a", "stamp_ns": 7, "depth_m": 3.0, "sigma_m": 1.0} | changed
    with pytest.raises(MessageError) as refused:
        decode(json.dumps(message).encode(), Depth)
    assert str(refused.value).startswith(says)


def test_a_refused_value_within_lists_is_named_in_its_place():
    blob = Blob(u_px=1.0, v_px=1.0, sigma_px=0.5, area_px=3.0, peak=200, elongation=1.0)
    frame = Candidates(
        node="a", stamp_ns=0, trigger=0, seq=0, boot="x", width_px=820, height_px=616, blobs=[blob, blob]
    )
    payload = json.loads(encode(frame))
    payload["blobs"][1]["sigma_px"] = 0.0
    with pytest.raises(MessageError, match=re.escape("Candidates: blobs[1].sigma_px = 0.0: Expected `float` > 0.0")):
        decode(json.dumps(payload).encode(), Candidates)
    # Nothing reads a huge message again for the value.
    payload["mood"] = "x" * 300_000
    with pytest.raises(MessageError, match=r"^Candidates: Expected"):
        decode(json.dumps(payload).encode(), Candidates)


def test_no_invalid_message_is_encoded():
    with pytest.raises(MessageError, match="depth_m"):
        encode(Depth(node="a", stamp_ns=0, depth_m=math.nan, sigma_m=0.02))
    with pytest.raises(MessageError, match="node"):
        encode(Depth(node="A", stamp_ns=0, depth_m=1.0, sigma_m=0.02))


def test_floats_stay_floats_and_unset_fields_are_left_out():
    out = encode(Depth(node="a", stamp_ns=7, depth_m=np.float64(3), sigma_m=1))
    assert out == b'{"node":"a","stamp_ns":7,"depth_m":3.0,"sigma_m":1.0}'


@given(
    st.lists(
        st.tuples(st.floats(-0.5, 819.5), st.floats(-0.5, 615.5), st.floats(1e-3, 50.0), st.floats(0.0, 255.0)),
        max_size=64,
    )
)
def test_messages_survive_encoding_and_decoding(values):
    blobs = [
        Blob(u_px=u, v_px=v, sigma_px=s, area_px=1.0, peak=p, elongation=1.0, score=p / 255.0) for u, v, s, p in values
    ]
    message = Candidates(node="b", stamp_ns=9, trigger=1, seq=3, boot="y", width_px=820, height_px=616, blobs=blobs)
    assert decode(encode(message), Candidates) == message


@given(st.binary(max_size=200))
def test_any_bytes_decode_or_are_refused(payload):
    for schema in (Attitude, Candidates, NodeInfo):
        with contextlib.suppress(MessageError):
            assert isinstance(decode(payload, schema), schema)


def test_every_message_type_has_its_stamp():
    depth = Depth(node="a", stamp_ns=1_764_000_000_000_000_001, depth_m=3.0, sigma_m=1.0)
    time = FoxgloveTime(sec=1_764_000_000, nsec=2)
    image = CompressedImage(timestamp=time, frame_id="a_camera", data=b"x", format="jpeg")
    assert payload_stamp_ns(encode(depth)) == depth.stamp_ns
    assert payload_stamp_ns(encode(image)) == image.stamp_ns == 1_764_000_000_000_000_002


@pytest.mark.parametrize("payload", [b"", b"\xff", b"[" * 100_000, b"null", b"{}", b'{"stamp_ns":"7"}'])
def test_a_payload_without_a_stamp_has_none(payload):
    assert payload_stamp_ns(payload) is None
