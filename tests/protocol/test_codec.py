"""Bytes and messages: every decoded message is valid, and no invalid message is encoded."""

import contextlib
import math

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
