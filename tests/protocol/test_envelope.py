"""Decoding: a message is valid and of its key's node, or it is refused, counted and reported."""

import logging

import pytest
from buddyline.protocol.bus import Received
from buddyline.protocol.codec import encode
from buddyline.protocol.divelog import Record
from buddyline.protocol.envelope import MAX_NAMED_KEYS, Refusals, open_envelope
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import CompressedImage, Depth, FoxgloveTime, Mark, Rejected, Truth
from buddyline.protocol.topics import DEPTH, REJECTED

DEPTH_A = Depth(node="a", stamp_ns=5, depth_m=3.0, sigma_m=0.1, pressure_pa=2e5, temperature_degc=9.0)
DEPTH_KEY = "buddyline/node/a/depth"


def test_an_envelope_has_the_topic_and_ids_of_its_key():
    payload = encode(DEPTH_A)
    envelope = open_envelope(DEPTH_KEY, payload, 7)
    assert (envelope.key, envelope.topic, envelope.ids, envelope.node) == (DEPTH_KEY, DEPTH, ("a",), "a")
    assert (envelope.message, envelope.payload, envelope.time_ns) == (DEPTH_A, payload, 7)
    rejected = Rejected(node_a="a", node_b="b", stamp_ns=1, trigger=1, reason="late")
    envelope = open_envelope("buddyline/pair/a/b/rejected", encode(rejected))
    assert (envelope.topic, envelope.ids, envelope.message) == (REJECTED, ("a", "b"), rejected)


def test_messages_of_bus_and_log_are_decoded_alike():
    payload = encode(DEPTH_A)
    received = Received(DEPTH_KEY, payload, 9, "application/json;buddyline.Depth")
    assert received.open() == Record(DEPTH_KEY, "buddyline.Depth", 9, 5, payload).open()


def test_a_message_on_another_senders_key_is_refused():
    with pytest.raises(MessageError, match="node 'a' on key buddyline/node/b/mark"):
        open_envelope("buddyline/node/b/mark", encode(Mark(node="a", stamp_ns=1)))
    rejected = encode(Rejected(node_a="a", node_b="b", stamp_ns=1, trigger=1, reason="late"))
    with pytest.raises(MessageError, match="node_a 'a', node_b 'b' on key"):
        open_envelope("buddyline/pair/b/a/rejected", rejected)
    # Truth says nothing of its pair: its key does.
    truth = encode(Truth(stamp_ns=1, t_a_b_m=(1.0, 0.0, 0.0), q_a_b_xyzw=(0.0, 0.0, 0.0, 1.0)))
    assert open_envelope("buddyline/pair/a/b/truth", truth).ids == ("a", "b")


def test_a_picture_of_another_node_is_refused_and_a_frame_of_any_other_name_is_not():
    def image(frame_id):
        time = FoxgloveTime(sec=1, nsec=0)
        return encode(CompressedImage(timestamp=time, frame_id=frame_id, data=b"", format="jpeg"))

    assert open_envelope("buddyline/node/a/image", image("a_camera")).node == "a"
    assert open_envelope("buddyline/node/a/image", image("front")).node == "a"
    with pytest.raises(MessageError, match="frame_id 'b' on key buddyline/node/a/image"):
        open_envelope("buddyline/node/a/image", image("b_camera"))


@pytest.mark.parametrize("key", ["", "buddyline/node/a/unknown", "buddyline/node/A/depth", "elsewhere/node/a/depth"])
def test_an_unknown_key_is_refused(key):
    with pytest.raises(MessageError, match="not a Buddyline topic"):
        open_envelope(key, encode(DEPTH_A))


def test_refusals_are_counted_by_key_and_logged_less_and_less_often(caplog):
    refusals = Refusals("test")
    sound = Received(DEPTH_KEY, encode(DEPTH_A), 1, "")
    with caplog.at_level(logging.WARNING):
        for i in range(100):
            assert refusals.open(Received("buddyline/node/b/depth", encode(DEPTH_A) if i == 0 else b"{", 1, "")) is None
            assert refusals.open(sound) == sound.open()
    assert refusals.count == 100
    assert len(caplog.records) == 7  # the 1st, 2nd, 4th ... 64th
    assert "bad message on buddyline/node/b/depth" in caplog.text
    assert refusals.lines() == [
        "buddyline/node/b/depth: 100 refused, the first: buddyline.Depth: node 'a' on key buddyline/node/b/depth"
    ]


def test_refusals_of_many_keys_take_bounded_memory(caplog):
    refusals = Refusals()
    for i in range(1000):
        refusals.open(Received(f"buddyline/node/n{i}/depth", b"{", 1, ""))
    assert refusals.count == 1000
    assert len(refusals.lines()) == MAX_NAMED_KEYS + 1
    assert not caplog.records


def test_a_strangers_text_is_logged_short_and_without_control_characters(caplog):
    refusals = Refusals("test")
    key = "elsewhere/\x1b]0;title\x07/" + "q" * 5000
    assert refusals.open(Received(key, b"{}", 0, "")) is None
    for said in (caplog.text, *refusals.lines()):
        assert "elsewhere/?]0;title?/qqq" in said
        assert len(said) < 1100
        assert "\x1b" not in said
