"""The solver's speed: milliseconds per trigger, solved alone or with many others, ns per hypothesis, growth.

A hypothesis assigns two candidates in A's picture to B's left and right light, and two in B's picture to A's. The
column beside it counts combinations of pairs without left and right: a quarter as many. The same run measures the
paper's Eq. 1 alone, in C and in numpy.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from shutil import which
from typing import Any, Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.solver_service.geometry.closed_form import eq1_range_m
from buddyline.solver_service.geometry.trigger import Fix, Settings, solve_triggers
from buddyline.tools.bench.triggers import RIG, simulate
from buddyline.tools.measure.tables import cells_of, text_table
from buddyline.tools.measure.turns import fastest_s
from numpy.typing import NDArray

Floats = NDArray[np.float64]

COUNTS: Final = (2, 4, 8, 16, 32, 64)
TRIGGERS: Final = 20
RANGE_M: Final = (2.0, 15.0)
SETTINGS: Final = Settings()
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmark's arguments."""
    parser.add_argument("--candidates", type=int, nargs="+", default=list(COUNTS), metavar="N", help="a side")
    parser.add_argument("--repeats", type=int, default=15, help="of each trigger; the fastest counts")


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Return all figures. A time is the median over triggers of each trigger's fastest repeat."""
    if min(args.candidates) < 2 or max(args.candidates) > 64 or args.repeats < 1:
        raise BuddylineError("--candidates: 2 to 64, as a message holds; --repeats: at least 1")
    rows = [solved(count, args.repeats) for count in sorted(set(args.candidates))]
    figures = {"solver": rows, "eq1_numpy_ns": eq1_numpy_ns(args.repeats), "eq1_c_ns": eq1_c_ns(args.repeats)}
    by_count = {row["candidates"]: row["sensors_ms"] for row in rows}
    if {16, 64} <= by_count.keys():
        figures["growth_16_to_64"] = math.log(by_count[64] / by_count[16]) / math.log(4.0)
    return figures


def solved(count: int, repeats: int) -> dict[str, Any]:
    """Return the row for triggers with `count` candidates in each picture."""
    row: dict[str, Any] = {"candidates": count, "hypotheses": (count * (count - 1)) ** 2}
    for name, sensors in (("alone", False), ("sensors", True)):
        rng = np.random.default_rng(count)
        triggers = [simulate(rng, RANGE_M, count - 2) for _ in range(TRIGGERS)]
        works = [partial(trigger.solve, SETTINGS, sensors=sensors) for trigger in triggers]
        row[f"{name}_ms"] = 1e3 * float(np.median([fastest_s(work, repeats) for work in works]))
        row[f"{name}_solved"] = sum(isinstance(work(), Fix) for work in works) / TRIGGERS
    together = [trigger.observed(sensors=True) for trigger in triggers]
    row["together_ms"] = 1e3 / TRIGGERS * fastest_s(lambda: solve_triggers(together, RIG, RIG, SETTINGS), repeats)
    row["ns_per_hypothesis"] = 1e6 * row["sensors_ms"] / row["hypotheses"]
    row["ns_per_combination"] = 4.0 * row["ns_per_hypothesis"]
    return row


def table(figures: dict[str, Any]) -> str:
    """Return the figures for a person."""
    columns = {
        "candidates": "{candidates}",
        "hypotheses": "{hypotheses}",
        "ms alone (solved)": "{alone_ms:.3f} ({alone_solved:4.0%})",
        "ms with sensors (solved)": "{sensors_ms:.3f} ({sensors_solved:4.0%})",
        "ms of many": "{together_ms:.3f}",
        "ns/hypothesis": "{ns_per_hypothesis:.1f}",
        "ns/combination": "{ns_per_combination:.1f}",
    }
    lines = [text_table(cells_of(figures["solver"], columns))]
    if "growth_16_to_64" in figures:
        lines.append(f"growth from 16 to 64 candidates a side: their number to the {figures['growth_16_to_64']:.2f}")
    c = figures["eq1_c_ns"]
    lines.append(
        f"Eq. 1 alone: {figures['eq1_numpy_ns']:.1f} ns in numpy, {f'{c:.1f} ns in C' if c else 'no gcc for C'}"
    )
    return "\n".join(lines)


def eq1_ns(evaluate: Callable[[], object], repeats: int) -> float:
    """Return the fastest time of one evaluation, ns; evaluate() makes EVALUATIONS of them."""
    return 1e9 * fastest_s(evaluate, repeats) / EVALUATIONS


def angles() -> tuple[Floats, Floats]:
    """Return alpha and beta, rad, for the evaluations of Eq. 1."""
    rng = np.random.default_rng(0)
    return rng.uniform(0.05, 0.5, EVALUATIONS), rng.uniform(-0.5, 0.5, EVALUATIONS)


def eq1_numpy_ns(repeats: int) -> float:
    """Time one Eq. 1, from its angles, in numpy."""
    alpha, beta = angles()
    length_m = np.array(0.88)
    return eq1_ns(lambda: eq1_range_m(np.cos(alpha), np.sin(alpha), np.sin(beta), length_m), repeats)


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
    return eq1_ns(lambda: evaluate(EVALUATIONS, a, b, 0.88, c), repeats)
