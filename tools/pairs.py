"""Pairs of nodes on the command line, and the choice among the pairs of a dive."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.topics import parse_key

if TYPE_CHECKING:
    from buddyline.tools.dives import Dive

log = logging.getLogger(__name__)

Pair: TypeAlias = tuple[str, str]


def add_pair_argument(parser: argparse.ArgumentParser, default: str) -> None:
    """Declare --pair; default: what is taken without it, in words."""
    parser.add_argument(
        "--pair", type=parse_pair, metavar="A/B", help=f"which pair of nodes, such as a/b; default: {default}"
    )


def parse_pair(text: str) -> Pair:
    """Return the two node ids of `A/B` or `A,B`; raise BuddylineError otherwise."""
    parsed = parse_key(f"buddyline/pair/{text.replace(',', '/')}/pose")
    if parsed is None:
        raise BuddylineError(f"--pair {text}: give A/B, two node ids")
    return parsed[1][0], parsed[1][1]


def pair_words(pairs: Sequence[Pair]) -> str:
    """Return pairs as --pair takes them."""
    return ", ".join("/".join(pair) for pair in pairs) or "none"


def wanted_pair(wanted: Pair, pairs: Sequence[Pair], name: str) -> Pair:
    """Return the wanted pair in the node order that pairs has; raise BuddylineError, naming the dive."""
    for pair in (wanted, wanted[::-1]):
        if pair in pairs:
            return pair
    raise BuddylineError(f"{name}: nothing of pair {'/'.join(wanted)}; pairs: {pair_words(pairs)}")


def solved_pair(dive: Dive, wanted: Pair | None) -> Pair | None:
    """Return the wanted pair, or the first of which the dive has poses or rejections; None if it has none."""
    pairs = [(ids[0], ids[1]) for ids in dive.ids("pose", "rejected")]
    if wanted is not None:
        return wanted_pair(wanted, pairs, dive.name)
    if len(pairs) > 1:
        shown, *others = pairs
        log.warning("%s: shows pair %s; choose another with --pair: %s", dive.name, "/".join(shown), pair_words(others))
    return pairs[0] if pairs else None
