"""How fast the solver is: milliseconds per trigger, nanoseconds per hypothesis, growth with the candidates.

A hypothesis is one pair of candidates in A's picture with one in B's; which of a pair is left and which right makes
four assignments of each. Beside it, in the same run: Eq. 1 alone, once per hypothesis, in C and in numpy.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from shutil import which
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from protocol.errors import BuddylineError
from solver_service.geometry.closed_form import eq1_range_m
from solver_service.geometry.rotation import quaternion_of
from solver_service.geometry.trigger import Camera, Fix, Rig, Sensed, Settings, View, solve_trigger

Floats = NDArray[np.float64]

COUNTS: Final = (2, 4, 8, 16, 32, 64)
TRIGGERS: Final = 20
CAMERA: Final = Camera("pinhole", 1640, 1232, 1800.0, 1800.0, 819.5, 615.5)
RIG: Final = Rig(CAMERA, np.array([[-0.44, 0.0, 0.0], [0.44, 0.0, 0.0]]))
EQ1_C: Final = """
#include <math.h>
void eq1(long n, const double *alpha, const double *beta, double d, double *l)
{
    for (long i = 0; i < n; i++) {
        double ca = cos(alpha[i]), sb = sin(beta[i]);
        l[i] = d / (2.0 * sin(alpha[i])) * (ca * cos(beta[i]) + sqrt(1.0 - ca * ca * sb * sb));
    }
}
"""
EVALUATIONS: Final = 200_000


def main(argv: list[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench solve", description=__doc__)
    parser.add_argument("--candidates", type=int, nargs="+", default=list(COUNTS), metavar="N", help="a side")
    parser.add_argument("--repeats", type=int, default=15, help="of each trigger; the fastest counts")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    if min(args.candidates) < 2 or max(args.candidates) > 64 or args.repeats < 1:
        raise BuddylineError("--candidates: 2 to 64, as a message holds; --repeats: at least 1")
    figures = measure(sorted(set(args.candidates)), args.repeats)
    if args.json:
        json.dump(figures, sys.stdout, indent=1)
        sys.stdout.write("\n")
    else:
        sys.stdout.write(table(figures))
    return 0


def measure(counts: list[int], repeats: int) -> dict[str, Any]:
    """Return all figures, times as the median over triggers of the fastest repeat."""
    rows = []
    for count in counts:
        row: dict[str, Any] = {"candidates": count, "hypotheses": math.comb(count, 2) ** 2}
        for name, sensed in (("alone_ms", False), ("sensors_ms", True)):
            rng = np.random.default_rng(count)
            triggers = [trigger(rng, count, sensed) for _ in range(TRIGGERS)]
            times, right = zip(*(timed(arguments, repeats) for arguments in triggers), strict=True)
            row[name] = 1e3 * float(np.median(times))
            row[name.replace("_ms", "_solved")] = sum(right) / TRIGGERS
        row["ns_per_hypothesis"] = 1e6 * row["sensors_ms"] / row["hypotheses"]
        rows.append(row)
    figures: dict[str, Any] = {"solver": rows, "eq1_numpy_ns": eq1_numpy_ns(repeats), "eq1_c_ns": eq1_c_ns(repeats)}
    by_count = {row["candidates"]: row["sensors_ms"] for row in rows}
    if {16, 64} <= by_count.keys():
        figures["growth_16_to_64"] = math.log(by_count[64] / by_count[16]) / math.log(4.0)
    return figures


def table(figures: dict[str, Any]) -> str:
    """Return the figures for a person."""
    lines = ["candidates  hypotheses   ms alone (solved)   ms with sensors (solved)   ns/hypothesis"]
    lines += [
        f"{row['candidates']:10d}  {row['hypotheses']:10d}  {row['alone_ms']:8.3f} ({row['alone_solved']:4.0%})"
        f"      {row['sensors_ms']:8.3f} ({row['sensors_solved']:4.0%})         {row['ns_per_hypothesis']:10.1f}"
        for row in figures["solver"]
    ]
    if "growth_16_to_64" in figures:
        lines.append(f"growth from 16 to 64 candidates a side: their number to the {figures['growth_16_to_64']:.2f}")
    c = figures["eq1_c_ns"]
    lines.append(
        f"Eq. 1 alone: {figures['eq1_numpy_ns']:.1f} ns in numpy, {f'{c:.1f} ns in C' if c else 'no gcc for C'}"
    )
    return "\n".join(lines) + "\n"


def timed(arguments: tuple[Any, ...], repeats: int) -> tuple[float, bool]:
    """Return the fastest of some repeats, and whether there was a pose."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        found = solve_trigger(*arguments)
        seconds.append(time.perf_counter() - start)
    return min(seconds), isinstance(found, Fix)


def trigger(rng: np.random.Generator, count: int, sensed: bool) -> tuple[Any, ...]:
    """Return the arguments of one trigger: two nodes face to face at 2 to 15 m, four lights and false candidates."""
    mount = RIG.R_body_camera
    while True:
        R_ned_a, R_ned_b = upright(rng, 0.0) @ mount, upright(rng, math.pi) @ mount
        t = rng.uniform(2.0, 15.0) * CAMERA.bearings(rng.uniform((300, 200), (1340, 1032), (1, 2)))[0]
        R = R_ned_a.T @ R_ned_b
        pixels = [image(RIG.lights_m @ R.T + t), image((RIG.lights_m - t) @ R)]
        if all((p > 0).all() and (p < (1639, 1231)).all() for p in pixels):
            break
    views = []
    for clear in pixels:
        false = rng.uniform((0, 0), (1640, 1232), (count - 2, 2))
        all_px = rng.permutation(np.concatenate((clear + rng.standard_normal((2, 2)), false)))
        one = np.ones(count)
        views.append(View(all_px, one, np.full(count, np.nan), 100.0 * one, 255.0 * one, 0.0 * one, 0))
    sensors = [Sensed(), Sensed()]
    if sensed:
        sigma = np.radians((1.0, 1.0, 4.0))
        depth_m = 10.0 + float((R_ned_a @ t)[2])
        sensors = [
            Sensed(quaternion_of(R_ned_a @ mount.T), sigma, 10.0, 0.02),
            Sensed(quaternion_of(R_ned_b @ mount.T), sigma, depth_m, 0.02),
        ]
    return (*views, RIG, RIG, *sensors, Settings())


def upright(rng: np.random.Generator, heading_rad: float) -> Floats:
    """Return a body's rotation to NED: about upright, about that heading."""
    (y, p, r), R = rng.normal((heading_rad, 0.0, 0.0), 0.1), np.eye(3)
    for i, j, angle in ((0, 1, y), (2, 0, p), (1, 2, r)):
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = math.cos(angle)
        turn[i, j], turn[j, i] = -math.sin(angle), math.sin(angle)
        R = R @ turn
    return R


def image(points_m: Floats) -> Floats:
    """Project points of the camera's frame with the plain pinhole; behind it nothing is in the picture."""
    z = np.where(points_m[:, 2:] > 0.1, points_m[:, 2:], np.nan)
    pixels: Floats = points_m[:, :2] / z * CAMERA.fx_px + (CAMERA.cx_px, CAMERA.cy_px)
    return pixels


def fastest_ns(evaluate: Callable[[], object], repeats: int) -> float:
    """Return the fastest time of one of EVALUATIONS."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        evaluate()
        seconds.append(time.perf_counter() - start)
    return 1e9 * min(seconds) / EVALUATIONS


def angles() -> tuple[Floats, Floats]:
    """Return alpha and beta to evaluate Eq. 1 at."""
    rng = np.random.default_rng(0)
    return rng.uniform(0.05, 0.5, EVALUATIONS), rng.uniform(-0.5, 0.5, EVALUATIONS)


def eq1_numpy_ns(repeats: int) -> float:
    """Time one Eq. 1, from its angles, in numpy."""
    alpha, beta = angles()
    length_m = np.array(0.88)
    return fastest_ns(lambda: eq1_range_m(np.cos(alpha), np.sin(alpha), np.sin(beta), length_m), repeats)


def eq1_c_ns(repeats: int) -> float | None:
    """Time one Eq. 1, from its angles, in C; None without a compiler."""
    compiler = which("gcc") or which("cc")
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder, "eq1.c"), Path(folder, "eq1.so")
        source.write_text(EQ1_C, encoding="utf-8")
        command = [compiler, "-O2", "-shared", "-fPIC", "-o", str(library), str(source), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise BuddylineError(f"{compiler} cannot compile Eq. 1: {done.stderr.strip().splitlines()[-1:]}")
        evaluate = ctypes.CDLL(str(library)).eq1
    pointer = ctypes.POINTER(ctypes.c_double)
    evaluate.argtypes = [ctypes.c_long, pointer, pointer, ctypes.c_double, pointer]
    evaluate.restype = None
    (alpha, beta), out = angles(), np.empty(EVALUATIONS)
    a, b, c = (array.ctypes.data_as(pointer) for array in (alpha, beta, out))
    return fastest_ns(lambda: evaluate(EVALUATIONS, a, b, 0.88, c), repeats)
