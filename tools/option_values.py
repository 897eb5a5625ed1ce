"""What options on the command line are given, checked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from buddyline.protocol.config import ConfigError
from buddyline.protocol.topics import check_node_id


def node_files(option: str, given: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield the node and the file's name of each NODE=FILE of an option; raise ConfigError where one is not that."""
    for text in given:
        node, equals, path = text.partition("=")
        if not equals:
            raise ConfigError(f"{option} {text}: give NODE=FILE")
        yield check_node_id(node), path
