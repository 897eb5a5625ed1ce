"""The table of topics is consistent with itself and with the protocol."""

import json

import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CompressedImage, FoxgloveTime
from buddyline.protocol.schemas import json_schema
from buddyline.protocol.topics import CANDIDATES, POSE, TOPICS, key_of, parse_key


def test_keys_parse_to_their_topic_and_ids():
    for topic in TOPICS:
        ids = ("alpha_1", "b")[: len(topic.id_fields)]
        assert parse_key(topic.key(*ids)) == (topic, ids)
    assert parse_key("buddyline/node/a/candidates\n") is None
    assert parse_key("buddyline/node/a/b/candidates") is None


@pytest.mark.parametrize("bad", ["a/b", "", "A", "x" * 33, "ü", "a b", "*"])
def test_bad_node_ids_are_refused(bad):
    with pytest.raises(BuddylineError, match="node id"):
        CANDIDATES.key(bad)


def test_a_wrong_number_of_ids_is_refused():
    with pytest.raises(ValueError, match="2 node ids"):
        POSE.key("a")


def test_an_images_node_comes_from_its_frame_id():
    image = CompressedImage(timestamp=FoxgloveTime(sec=1, nsec=2), frame_id="b_camera", data=b"x", format="jpeg")
    assert key_of(image) == "buddyline/node/b/image"
    assert image.stamp_ns == 1_000_000_002


def test_json_schemas_are_flat():
    for topic in TOPICS:
        text = json_schema(topic.schema)
        schema = json.loads(text)
        assert schema["type"] == "object"
        assert set(schema["required"]) <= set(schema["properties"])
        for word in ("$ref", "$defs", "anyOf", "prefixItems"):
            assert word not in text.decode()
