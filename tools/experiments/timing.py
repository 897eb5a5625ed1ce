"""Run times on this machine, as processor time of one thread, so that other processes do not count."""

from __future__ import annotations

import time
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np
from buddyline.node.detect import make_detector
from buddyline.protocol.messages import Candidates
from buddyline.solver_service.config import SolveConfig
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.closed_form import eq1_range_m
from buddyline.tools.dives import Dive
from buddyline.tools.measure.pictures import stored_pictures
from buddyline.tools.measure.turns import fastest_s, seconds_of

_PICTURES: Final = 12
_TRIGGERS: Final = 100
_EVALUATIONS: Final = 500


def equation_1() -> float:
    """Return the time of one evaluation of the paper's Eq. 1, both ranges, ms."""
    cos_alpha, sin_beta = np.cos([0.2, 0.21]), np.array([0.1, -0.1])
    sin_alpha, length_m = np.sin([0.2, 0.21]), np.array([0.88, 0.88])

    def series() -> None:
        for _ in range(_EVALUATIONS):
            eq1_range_m(cos_alpha, sin_alpha, sin_beta, length_m)

    return 1e3 * fastest_s(series, 5, time.process_time) / _EVALUATIONS


def trigger(found: Path) -> dict[str, float]:
    """Return the time per trigger of a log of candidates, ms, including matching and messages."""
    core = SolverCore(SolveConfig().settings("experiments"), [("a", "b")])
    taken_ms = []
    with Dive([found]) as dive:
        for envelope in dive.messages("info", "attitude", "depth", "candidates"):
            message = envelope.message
            matched, began_s = core.matched, time.process_time()
            core.handle(message)
            # Most messages complete no trigger; only those that do are timed.
            if core.matched > matched:
                taken_ms.append((time.process_time() - began_s) * 1e3 / (core.matched - matched))
            if len(taken_ms) >= _TRIGGERS and isinstance(message, Candidates):
                break
    return {"median_ms": float(np.median(taken_ms)), "p95_ms": float(np.percentile(taken_ms, 95))}


def frame(dive: Path) -> dict[str, float]:
    """Return each detector's time per picture, ms: the median over pictures of a dive."""
    pictures = list(islice(stored_pictures(dive), _PICTURES))
    times = {}
    for method in ("source", "paper"):
        detect = make_detector(method, "auto").detect
        taken_s = [seconds_of(partial(detect, picture), time.process_time) for picture in pictures]
        times[f"{method}_ms"] = 1e3 * float(np.median(taken_s))
    return times
