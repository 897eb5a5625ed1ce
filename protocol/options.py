"""The command line: its errors are one line, and numbers are checked as argparse's `type`."""

from __future__ import annotations

import argparse
import math
from typing import Final, NoReturn

# No option of ours asks for more: 126 years in s, of which ns still fit into 64 bits.
MOST: Final = 4e9


class CommandParser(argparse.ArgumentParser):
    """A parser whose errors are one line: the option, what is wrong, and where to read more."""

    def error(self, message: str) -> NoReturn:
        """Say it on stderr, and end with status 2."""
        self.exit(2, f"{self.prog}: {message}; see `{self.prog} --help`\n")


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
