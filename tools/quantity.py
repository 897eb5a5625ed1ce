"""Numbers on the command line."""

from __future__ import annotations

import argparse
import math


def above_zero(text: str) -> float:
    """Return a finite number above 0, as argparse's `type`."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: give a number above 0")
    return value
