"""Numbers given on the command line, checked as argparse's `type`."""

from __future__ import annotations

import argparse
import math
from typing import Final

# No option of ours asks for more: 126 years in s, of which ns still fit into 64 bits.
MOST: Final = 4e9


def finite(text: str) -> float:
    """Return a number that is not NaN, not infinite, and not absurdly large."""
    value = _number(text)
    if not -MOST <= value <= MOST:
        raise argparse.ArgumentTypeError(f"{text}: give a number from -4e9 to 4e9")
    return value


def above_zero(text: str) -> float:
    """Return a number above 0, as `finite` does."""
    value = _number(text)
    if not 0.0 < value <= MOST:
        raise argparse.ArgumentTypeError(f"{text}: give a number above 0, up to 4e9")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
