"""The limits of health, and the columns of the topic table from which they are derived."""

import ast
import dataclasses
import re

from buddyline.protocol import health
from buddyline.protocol.health import SILENT_S, stale_after_s
from buddyline.protocol.topics import CANDIDATES, NODE_STATUS, TOPICS, Topic

from tests.imports import modules
from tests.processes import REPOSITORY


def test_a_stream_is_stale_by_its_topic_or_by_its_own_slow_period():
    assert stale_after_s(CANDIDATES) == stale_after_s(CANDIDATES, 0.1) == CANDIDATES.stale_s
    assert stale_after_s(CANDIDATES, 5.0) == 15.0


def test_a_stream_is_not_stale_within_one_period():
    for topic in TOPICS:
        if topic.stale_s and topic.rate_hz:
            assert topic.stale_s > 1.0 / topic.rate_hz, topic.name
    assert 1.0 / NODE_STATUS.rate_hz < SILENT_S < NODE_STATUS.stale_s


def attributes_read(path):
    return {
        node.attr for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Attribute)
    }


def test_every_column_of_the_topic_table_and_every_limit_is_read_by_someone():
    found = modules(REPOSITORY)
    read = set().union(*(attributes_read(path) for name, path in found.items() if not name.endswith("protocol.topics")))
    # The key's form is the table's own business.
    assert {field.name for field in dataclasses.fields(Topic)} - {"template", "schema_name"} <= read
    texts = [path.read_text(encoding="utf-8") for name, path in found.items() if not name.endswith("protocol.health")]
    for limit in (name for name in vars(health) if name.isupper() and name != "STALE_PERIODS"):
        assert any(re.search(rf"\b{limit}\b", text) for text in texts), limit
