"""Nonlinear least squares for small problems, and the error for measurements that do not determine the result."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias

import numpy as np
from buddyline.protocol.errors import BuddylineError
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

ROUNDS: Final = 30
STEP: Final = 1e-6
CONVERGED: Final = 1e-9


class PoorCalibration(BuddylineError):  # noqa: N818
    """The measurements do not determine the result well enough; the text says what to do."""


def require(*conditions: tuple[bool, str]) -> None:
    """Raise PoorCalibration with the text of the first condition that does not hold."""
    for holds, text in conditions:
        if not holds:
            raise PoorCalibration(text)


def jacobian(function: Callable[[Floats], Floats], x: Floats) -> Floats:
    """Return the derivatives (n, k) of a function (n,) of x (k,), by central differences; x is of the order of 1."""
    steps = STEP * np.eye(len(x))
    return np.stack([(function(x + step) - function(x - step)) / (2 * STEP) for step in steps], axis=-1)


def gauss_newton(residuals: Callable[[Floats], Floats], x: Floats) -> tuple[Floats, Floats]:
    """Return the x (k,) with the least sum of squared residuals (n,), and their Jacobian (n, k) there.

    x: the initial guess. If the residuals are in sigmas, the covariance of the result is inv(J^T J).
    """
    for _ in range(ROUNDS):
        step = np.linalg.lstsq(jacobian(residuals, x), -residuals(x), rcond=None)[0]
        x = np.asarray(x + step, dtype=np.float64)
        if np.abs(step).max() < CONVERGED:
            break
    return x, jacobian(residuals, x)
