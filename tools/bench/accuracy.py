"""The solver's accuracy on simulated triggers: errors over the Cramer-Rao bound, and the choice of the four lights.

Errors: the bound is that of the eight image coordinates, from numeric derivatives of the projection. OpenCV's solvePnP
and SQPnP are compared, on A's picture alone. Two lights are too few for them, so they get four: the corners of a square
on B. Choice: the share of triggers with the right four lights, by number of false candidates in each picture. It is
measured for the range gap alone (the paper's test: the pairs whose ranges agree best), for pictures alone, and with
attitude and depth. Wrong poses are more than 10 % of the range off.
"""

from __future__ import annotations

import argparse
import math
from typing import Any, Final

import cv2
import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.solver_service.geometry.closed_form import closed_form
from buddyline.solver_service.geometry.rotation import matrix_to_quat, quat_to_matrix, rotation_exp, rotation_log
from buddyline.solver_service.geometry.trigger import Fix, Settings
from buddyline.tools.bench.triggers import CAMERA, INFO, RIG, Trigger, simulate
from buddyline.tools.bound import pose_bounds
from buddyline.tools.evaluation.poses import WRONG_SHARE
from buddyline.tools.measure.tables import cells_of, text_table
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RANGES_M: Final = (1.5, 2.0, 4.0, 6.0, 10.0, 15.0, 20.0)
SIGMAS_PX: Final = (0.3, 1.0)
PNP: Final = {"solvePnP": cv2.SOLVEPNP_ITERATIVE, "SQPnP": cv2.SOLVEPNP_SQPNP}
METHODS: Final = ("refined", "exact", "paper", "paper_midpoint", "paper_literal")
BANDS_M: Final = ((1.5, 4.0), (4.0, 10.0), (10.0, 20.0))
FALSE: Final = (1, 2, 4, 8, 16)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmark's arguments."""
    parser.add_argument("--triggers", type=int, default=200, metavar="N", help="of each kind")


def measure(args: argparse.Namespace) -> dict[str, list[dict[str, Any]]]:
    """Return the errors over the bound by range and noise, and the choices by range and false candidates."""
    if args.triggers < 1:
        raise BuddylineError("--triggers: at least 1")
    return {
        "errors": [over_bound(range_m, sigma_px, args.triggers) for range_m in RANGES_M for sigma_px in SIGMAS_PX],
        "choices": [choice(band_m, false, args.triggers) for band_m in BANDS_M for false in FALSE],
    }


def over_bound(range_m: float, sigma_px: float, count: int) -> dict[str, Any]:
    """Return each method's RMSE over the bound, of position and rotation, and the NEES per dimension of `refined`."""
    rng = np.random.default_rng(round(100 * range_m))
    bound, squares, nees = np.zeros(2), {method: np.zeros(2) for method in (*METHODS, *PNP)}, []
    for _ in range(count):
        trigger = simulate(rng, (range_m, range_m), sigma_px=sigma_px)
        covariance = pose_bounds(trigger.t_a_b_m[None], matrix_to_quat(trigger.R_a_b)[None], INFO, INFO, sigma_px)[0]
        bound += np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])
        for method in METHODS:
            # All of these triggers' exposures are of one instant.
            settings = Settings(method=method, min_probability=0.0, range_max_m=60.0, stamp_sigma_s=0.0)
            fix = trigger.solve(settings, sensors=False)
            if not isinstance(fix, Fix):
                raise BuddylineError(f"{method} finds no pose at {range_m:g} m: {fix.detail}")
            error = error_of(trigger, fix.t_a_b_m, quat_to_matrix(fix.q_a_b_xyzw))
            squares[method] += error[:3] @ error[:3], error[3:] @ error[3:]
            if method == "refined":
                nees.append(float(error @ np.linalg.solve(fix.covariance, error)) / 6.0)
        for name, (t_a_b_m, R_a_b) in one_view(trigger, sigma_px, rng).items():
            error = error_of(trigger, t_a_b_m, R_a_b)
            squares[name] += error[:3] @ error[:3], error[3:] @ error[3:]
    return {
        "range_m": range_m,
        "sigma_px": sigma_px,
        "bound_m": math.sqrt(bound[0] / count),
        "bound_rad": math.sqrt(bound[1] / count),
        "over_bound": {name: np.sqrt(square / bound).tolist() for name, square in squares.items()},
        "nees": float(np.mean(nees)),
    }


def error_of(trigger: Trigger, t_a_b_m: Floats, R_a_b: Floats) -> Floats:
    """Return the error (6,): position (m), then the small rotation (rad)."""
    return np.concatenate((trigger.t_a_b_m - t_a_b_m, rotation_log(trigger.R_a_b @ R_a_b.T)))


def one_view(trigger: Trigger, sigma_px: float, rng: np.random.Generator) -> dict[str, tuple[Floats, Floats]]:
    """Return t_a_b_m and R_a_b by OpenCV from A's picture of four lights at the corners of a square on B."""
    left, right = RIG.lights_m
    up = np.array([0.0, 0.5 * RIG.length_m, 0.0])
    corners_m = np.array((left - up, right - up, right + up, left + up))
    points_m = corners_m @ trigger.R_a_b.T + trigger.t_a_b_m
    matrix = np.array(((CAMERA.fx_px, 0.0, CAMERA.cx_px), (0.0, CAMERA.fy_px, CAMERA.cy_px), (0.0, 0.0, 1.0)))
    pixels = (points_m / points_m[:, 2:] @ matrix.T)[:, :2] + sigma_px * rng.standard_normal((4, 2))
    poses = {}
    for name, flag in PNP.items():
        _, turn, t_a_b_m = cv2.solvePnP(corners_m, pixels[:, None], matrix, None, flags=flag)
        poses[name] = np.asarray(t_a_b_m, np.float64).ravel(), rotation_exp(np.asarray(turn, np.float64).ravel())
    return poses


def choice(band_m: tuple[float, float], false: int, count: int) -> dict[str, Any]:
    """Return the shares of right choices, and of wrong poses among all poses."""
    rng = np.random.default_rng(false)
    row: dict[str, Any] = {"range_m": list(band_m), "false": false, "range_gap_alone": 0.0}
    tally = {name: [0, 0, 0] for name in ("pictures", "sensors")}
    for _ in range(count):
        trigger = simulate(rng, band_m, false)
        row["range_gap_alone"] += trigger_by_range_gap(trigger) / count
        for name, counts in tally.items():
            fix = trigger.solve(Settings(), sensors=name == "sensors")
            if isinstance(fix, Fix):
                off = float(np.linalg.norm(fix.t_a_b_m - trigger.t_a_b_m) / np.linalg.norm(trigger.t_a_b_m))
                counts[0] += trigger.right(fix)
                counts[1] += off > WRONG_SHARE
                counts[2] += 1
    for name, (right, wrong, poses) in tally.items():
        row[name] = right / count
        row[f"{name}_wrong"] = wrong / poses if poses else 0.0
    return row


def trigger_by_range_gap(trigger: Trigger) -> bool:
    """Return whether the pairs whose ranges agree best are right. In a picture B's right light is on the left side."""
    pairs, rays = [], []
    for view in trigger.views:
        first, second = np.triu_indices(len(view.pixels), 1)
        swap = view.pixels[first, 0] < view.pixels[second, 0]
        left, right = np.where(swap, second, first), np.where(swap, first, second)
        bearings = CAMERA.bearings(view.pixels)
        pairs.append((left, right))
        rays.append((bearings[left].T, bearings[right].T))
    a, b = (grid.ravel() for grid in np.meshgrid(*(np.arange(len(left)) for left, _ in pairs), indexing="ij"))
    ends = [np.stack((rays[0][end][:, a], rays[1][end][:, b])) for end in (0, 1)]
    range_m = closed_form(ends[0], ends[1], RIG, RIG, "paper").range_m
    inside = (range_m.mean(0) > Settings().range_min_m) & (range_m.mean(0) < Settings().range_max_m)
    best = int(np.where(inside, np.abs(range_m[0] - range_m[1]), np.inf).argmin())
    chosen = [(int(left[k]), int(right[k])) for (left, right), k in zip(pairs, (a[best], b[best]), strict=True)]
    return chosen == [trigger.pair_a, trigger.pair_b]


def table(figures: dict[str, list[dict[str, Any]]]) -> str:
    """Return both tables as text."""
    errors = {
        "range": "{range_m:.1f} m",
        "sigma": "{sigma_px:.1f} px",
        "bound": "{bound_mm:.1f} mm {bound_deg:.3f} deg",
        **{name: f"{{over_bound[{name}][0]:.3f}}/{{over_bound[{name}][1]:.3f}}" for name in (*METHODS, *PNP)},
        "NEES": "{nees:.3f}",
    }
    choices = {
        "range": "{range_m[0]:.1f}-{range_m[1]:.1f} m",
        "false": "{false}",
        "range gap alone": "{range_gap_alone:.3f}",
        "pictures (wrong)": "{pictures:.3f} ({pictures_wrong:.4f})",
        "with sensors (wrong)": "{sensors:.3f} ({sensors_wrong:.4f})",
    }
    scaled = [
        row | {"bound_mm": 1e3 * row["bound_m"], "bound_deg": math.degrees(row["bound_rad"])}
        for row in figures["errors"]
    ]
    return (
        f"RMSE over the bound, position / rotation\n{text_table(cells_of(scaled, errors))}\n\n"
        f"right lights, and wrong poses of all poses\n{text_table(cells_of(figures['choices'], choices))}"
    )
