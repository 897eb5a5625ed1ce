"""Calibrate a magnetometer for hard and soft iron: map the ellipsoid of its readings to a sphere.

The readings of a rig that is turned in all directions lie on an ellipsoid. The rig's own magnetism (hard iron) shifts
it; soft iron and unequal axes deform it. Nine numbers describe it. They leave one rotation undetermined; the
accelerometer determines it, because the angle between the Earth's field and gravity is constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.tools.calibration.leastsquares import Floats, PoorCalibration, gauss_newton, jacobian, require
from numpy.typing import NDArray

APART_RAD: Final = np.radians(4.0)
OUTLIER_SIGMAS: Final = 4.0
GRAVITY_MPS2: Final = 9.80665
STILL_MPS2: Final = 0.5
LEAST_READINGS: Final = 60
LEAST_COVERAGE: Final = 0.5
MOST_RESIDUAL: Final = 0.04
MOST_HEADING_SIGMA_RAD: Final = np.radians(1.0)
CELLS: Final = 72
CELL_RAD: Final = np.radians(20.0)
NO_ELLIPSOID: Final = "the readings determine no ellipsoid: turn the rig in all directions, upside down as well"


@dataclass(frozen=True)
class EllipsoidFit:
    """field_t = matrix @ (reading - offset_t), body frame.

    residual: rms error of the field's strength, as a share of it. coverage: share of all directions with readings.
    heading_sigma_rad: error of a level rig's heading from the fit alone, 1 sd, at the worst heading.
    directions: (n, 3), unit vectors of the readings used. errors: (n,), of their strength, as a share. turned: whether
    the accelerometer has determined the open rotation.
    """

    offset_t: Floats
    matrix: Floats
    norm_t: float
    residual: float
    coverage: float
    heading_sigma_rad: float
    directions: Floats
    errors: Floats
    turned: bool


def spread_out(readings_t: Floats) -> NDArray[np.intp]:
    """Return the indices of readings, each at least APART_RAD from the kept reading before it."""
    middle_t = (readings_t.max(axis=0) + readings_t.min(axis=0)) / 2
    arms = readings_t - middle_t
    arms /= np.maximum(np.linalg.norm(arms, axis=1, keepdims=True), 1e-12)
    kept = [0]
    limit = np.cos(APART_RAD)
    for i in range(1, len(arms)):
        if arms[i] @ arms[kept[-1]] < limit:
            kept.append(i)
    return np.array(kept)


def fit(readings_t: Floats, accels_mps2: Floats, norm_t: float | None = None) -> EllipsoidFit:
    """Fit readings (n, 3), T, with the accelerometer's readings (n, 3) at the same times.

    norm_t: strength of the Earth's field, if known; None keeps the readings' mean scale.
    Raises PoorCalibration if the readings do not determine the ellipsoid well enough.
    """
    kept = spread_out(readings_t)
    readings_t, accels_mps2 = readings_t[kept], accels_mps2[kept]
    few = f"only {len(readings_t)} readings a few degrees apart, {LEAST_READINGS} are needed"
    require((len(readings_t) >= LEAST_READINGS, f"{few}: turn the rig slowly through all directions"))
    unit_t = float(np.linalg.norm(readings_t - readings_t.mean(axis=0), axis=1).mean()) or 1.0
    x = readings_t / unit_t
    used = np.ones(len(x), dtype=bool)
    for _ in range(3):
        state, J = _refined(x[used])
        offset, shape = _offset_and_shape(state)
        errors = _errors(x, state)
        spread = 1.4826 * np.median(np.abs(errors[used])) + 1e-9
        used = np.abs(errors) < OUTLIER_SIGMAS * spread
        if used.sum() < LEAST_READINGS:
            raise PoorCalibration(
                "the readings lie on no ellipsoid: iron moved beside the rig, or the field is not one"
            )
    field = (x[used] - offset) @ shape.T
    residual = float(np.sqrt((errors[used] ** 2).mean()))
    covariance = np.asarray(np.linalg.pinv(J.T @ J) * max(residual, 1e-6) ** 2, dtype=np.float64)
    turn = _turn(field, accels_mps2[used])
    if turn is not None:
        shape, field = turn @ shape, field @ turn.T
    scale_t = norm_t if norm_t is not None else unit_t / float(np.linalg.det(shape)) ** (1 / 3)
    directions = field / np.linalg.norm(field, axis=1, keepdims=True)
    found = EllipsoidFit(
        offset_t=offset * unit_t,
        matrix=shape * scale_t / unit_t,
        norm_t=scale_t,
        residual=residual,
        coverage=coverage(directions),
        heading_sigma_rad=_heading_sigma(directions, accels_mps2[used], state, covariance),
        directions=directions,
        errors=errors[used],
        turned=turn is not None,
    )
    require(
        (
            found.coverage >= LEAST_COVERAGE,
            f"only {found.coverage:.0%} of all directions were seen, {LEAST_COVERAGE:.0%} are needed: "
            "turn the rig on its sides and upside down as well",
        ),
        (
            found.residual <= MOST_RESIDUAL,
            f"the field's strength varies by {found.residual:.1%}, {MOST_RESIDUAL:.0%} at most: "
            "turn the rig away from steel, cars and buildings, with everything on it fixed",
        ),
        (
            found.heading_sigma_rad <= MOST_HEADING_SIGMA_RAD,
            f"headings would be known to {np.degrees(found.heading_sigma_rad):.1f} deg only, "
            f"{np.degrees(MOST_HEADING_SIGMA_RAD):.0f} deg at most: turn for longer, through all directions",
        ),
    )
    return found


def coverage(directions: Floats) -> float:
    """Return the share of evenly spread cells with one of the directions (n, 3) within 20 degrees of the centre."""
    i = np.arange(CELLS) + 0.5
    z, around = 1 - 2 * i / CELLS, np.pi * (1 + 5**0.5) * i
    flat = np.sqrt(1 - z * z)
    centres = np.column_stack([flat * np.cos(around), flat * np.sin(around), z])
    nearest = (centres @ directions.T).max(axis=1)
    return float((nearest > np.cos(CELL_RAD)).mean())


def _offset_and_shape(state: Floats) -> tuple[Floats, Floats]:
    """Return the centre (3,) and the symmetric shape (3, 3) of a state (9,): centre, then xx xy xz yy yz zz."""
    xx, xy, xz, yy, yz, zz = state[3:]
    return state[:3], np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _errors(x: Floats, state: Floats) -> Floats:
    """Return the radius minus 1, (n,), of readings (n, 3) after the mapping to the sphere."""
    offset, shape = _offset_and_shape(state)
    return np.asarray(np.linalg.norm((x - offset) @ shape, axis=1) - 1.0)


def _algebraic(x: Floats) -> Floats:
    """Return a first state (9,) from a linear least-squares fit of the quadric."""
    a, b, c = x.T
    design = np.column_stack([a * a, 2 * a * b, 2 * a * c, b * b, 2 * b * c, c * c, 2 * a, 2 * b, 2 * c])
    solution = np.linalg.lstsq(design, np.ones(len(x)), rcond=None)[0]
    _, A = _offset_and_shape(np.concatenate((np.zeros(3), solution[:6])))
    try:
        offset = -np.linalg.solve(A, solution[6:])
    except np.linalg.LinAlgError:
        raise PoorCalibration("the readings lie in a plane: turn the rig upside down as well") from None
    size = float(1.0 + offset @ A @ offset)
    values, axes = np.linalg.eigh(A / size) if abs(size) > 1e-12 else (np.full(3, -1.0), np.eye(3))
    require((bool((values > 0).all()), NO_ELLIPSOID))
    return np.concatenate((offset, ((axes * np.sqrt(values)) @ axes.T)[np.triu_indices(3)]))


def _refined(x: Floats) -> tuple[Floats, Floats]:
    """Return the state (9,) with the least squared errors of readings (n, 3), and the errors' Jacobian (n, 9) there."""
    state, J = gauss_newton(lambda state: _errors(x, state), _algebraic(x))
    _, shape = _offset_and_shape(state)
    require((bool(np.isfinite(shape).all() and (np.linalg.eigvalsh(shape) > 0).all()), NO_ELLIPSOID))
    return state, J


def _turn(field: Floats, accels_mps2: Floats) -> Floats | None:
    """Return the small rotation (3, 3) that makes the field's angle to gravity constant; None if not determined."""
    strength = np.linalg.norm(accels_mps2, axis=1)
    still = np.abs(strength - GRAVITY_MPS2) < STILL_MPS2
    if still.sum() < LEAST_READINGS:
        return None
    up, u = accels_mps2[still] / strength[still, None], field[still]
    # up . (u + r x u) = const, linear in r and the constant.
    design = np.column_stack([np.cross(u, up), -np.ones(len(u))])
    solution, _, _, singular = np.linalg.lstsq(design, -(up * u).sum(axis=1), rcond=None)
    if singular[-1] < 0.1 * singular[0]:
        return None
    x, y, z = solution[:3]
    q, _ = np.linalg.qr(np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]]))
    return np.asarray(q * np.sign(np.diag(q)), dtype=np.float64)


def _heading_sigma(directions: Floats, accels_mps2: Floats, state: Floats, covariance: Floats) -> float:
    """Return the heading's 1 sd, rad, of a level rig at the worst heading, from the fit's covariance (9, 9)."""
    up = accels_mps2 / np.maximum(np.linalg.norm(accels_mps2, axis=1, keepdims=True), 1e-9)
    sine = float(np.clip(np.median(-(directions * up).sum(axis=1)), -0.99, 0.99))
    cosine = np.sqrt(1 - sine * sine)
    heading = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    field = np.column_stack([cosine * np.cos(heading), -cosine * np.sin(heading), np.full(24, sine)])
    sides = np.column_stack([np.sin(heading), np.cos(heading), np.zeros(24)])
    offset, shape = _offset_and_shape(state)
    readings = np.linalg.solve(shape, field.T).T + offset

    def turned(other: Floats) -> Floats:
        """Return the change of the headings, rad, with another state."""
        offset, shape = _offset_and_shape(other)
        return np.asarray((sides * ((readings - offset) @ shape)).sum(axis=1) / cosine)

    J = jacobian(turned, state)
    return float(np.sqrt(np.einsum("ni,ij,nj->n", J, covariance, J).max()))
