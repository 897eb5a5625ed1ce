"""Numbers as arrays without axes, which numpy makes of a Python float at each use: a third of a small operation."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats


def scalar(value: float) -> Floats:
    """Make an array () of a number, for good."""
    array = np.array(value)
    array.flags.writeable = False
    return array


ZERO: Final = scalar(0.0)
EIGHTH: Final = scalar(0.125)
QUARTER: Final = scalar(0.25)
HALF: Final = scalar(0.5)
ONE: Final = scalar(1.0)
TWO: Final = scalar(2.0)
MINUS_TWO: Final = scalar(-2.0)
FOUR: Final = scalar(4.0)
PI: Final = scalar(math.pi)
TURN: Final = scalar(2.0 * math.pi)
