"""What options on the command line are given, checked."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Iterator

from buddyline.protocol.config import ConfigError
from buddyline.protocol.topics import check_node_id


def above_zero(text: str) -> float:
    """Return a finite number above 0, as argparse's `type`."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: give a number above 0")
    return value


def node_files(option: str, given: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield the node and the file's name of each NODE=FILE of an option; raise ConfigError where one is not that."""
    for text in given:
        node, equals, path = text.partition("=")
        if not equals:
            raise ConfigError(f"{option} {text}: give NODE=FILE")
        yield check_node_id(node), path
