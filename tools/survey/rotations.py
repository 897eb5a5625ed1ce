"""Quaternions (x, y, z, w) of a whole dive at once, as matrices."""

from __future__ import annotations

import numpy as np
from buddyline.tools.survey.averages import Floats


def matrices_of(q_xyzw: Floats) -> Floats:
    """Return the matrices (..., 3, 3) of quaternions (..., 4) of any length but zero."""
    q = q_xyzw / np.linalg.norm(q_xyzw, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
