"""Simulate the dives of the experiments, and solve them by each method, with the program's own commands."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from buddyline.protocol.errors import BuddylineError
from buddyline.tools.cli import command_named
from buddyline.tools.dives import Dive
from buddyline.tools.evaluation.logs import load_for_evaluation
from buddyline.tools.evaluation.network import NodeFigures, load_network, network_figures
from buddyline.tools.evaluation.result import Result, evaluate

ENVIRONMENTS: Final = ("cavern", "night_reef", "lake", "basin")
# Seeds that nothing was tuned on.
SEED: Final = 90_210

OURS: Final = "ours"
OURS_CAMERA: Final = "ours, camera only"
PAPER: Final = "paper's, all sensors"
PAPER_CAMERA: Final = "paper's, camera only"
TAGS: Final = "AR tags"

_SOLVES: Final[Mapping[str, tuple[str, str, str]]] = {
    OURS: ("source", "refined", "range,twist,attitude,depth"),
    OURS_CAMERA: ("source", "refined", "range,twist"),
    PAPER: ("paper", "paper", "range,attitude,depth"),
    PAPER_CAMERA: ("paper", "paper", "range"),
}
"""Detector, method and checks of each. The paper checks the range gap and, with sensors, attitude and depth."""

NETS: Final[Mapping[str, tuple[str, ...]]] = {
    "four nodes at 10 Hz, a on a tripod": ("--nodes", "4", "--fixed", "a", "--rate", "10"),
    "a basin at 20 Hz, a and c on tripods": (
        *("--nodes", "3", "--fixed", "a", "--fixed", "c", "--rate", "20"),
        *("--environment", "basin", "--range-max", "6"),
    ),
}
"""Dives of more than two nodes, all with inertial units, and what `simulate` is told for them."""

_LONG_METHODS: Final = {OURS: "refined", "paper's": "paper", "paper's text, literally": "paper_literal"}


@dataclass(frozen=True)
class Size:
    """The lengths of the simulated dives. seconds, rate_hz: of each rendered dive. long_*: of the dive out to 20 m.

    net_seconds: of those of more than two nodes. tank_step: every tank_step-th picture of the tank's video is used.
    """

    seconds: float
    rate_hz: float
    long_seconds: float
    long_rate_hz: float
    net_seconds: float
    tank_step: int


FULL: Final = Size(seconds=60.0, rate_hz=2.0, long_seconds=240.0, long_rate_hz=4.0, net_seconds=20.0, tank_step=5)
QUICK: Final = Size(seconds=8.0, rate_hz=2.0, long_seconds=42.0, long_rate_hz=2.0, net_seconds=5.0, tank_step=80)


def call(name: str, *words: str) -> None:
    """Run one command of the program, without its output; raise BuddylineError if it fails."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        status = command_named(name).run(words)
    # `artag` also returns 1 if no picture shows a tag, which is a result here.
    if status and name != "artag":
        raise BuddylineError(f"buddyline {name} {' '.join(words)}: ended with {status}")


def measured(path: Path) -> Result:
    """Return the evaluation of a solved log."""
    return evaluate(load_for_evaluation([str(path)]))


@dataclass(frozen=True)
class Rendered:
    """One environment's dive with pictures. logs, results: by method."""

    environment: str
    dive: Path
    logs: dict[str, Path]
    results: dict[str, Result]


def rendered(environment: str, size: Size, directory: Path) -> Rendered:
    """Simulate a dive with pictures and tags, detect lights in it, and solve it by every method."""
    dive = directory / f"{environment}.mcap"
    words = ["--environment", environment, "--seconds", str(size.seconds), "--rate", str(size.rate_hz)]
    seed = SEED + ENVIRONMENTS.index(environment)
    call("simulate", str(dive), "--images", "--tags", "--seed", str(seed), *words)
    logs: dict[str, Path] = {}
    for detector, chosen in (("source", "auto"), ("paper", environment)):
        found = directory / f"{environment}.{detector}.mcap"
        call("detect", str(dive), "-o", str(found), "--method", detector, "--environment", chosen)
        for name, (wanted, method, checks) in _SOLVES.items():
            if wanted == detector:
                logs[name] = directory / f"{environment}.{len(logs)}.mcap"
                call("solve", str(found), "-o", str(logs[name]), "--method", method, "--checks", checks)
    logs[TAGS] = directory / f"{environment}.tags.mcap"
    call("artag", str(dive), "-o", str(logs[TAGS]))
    return Rendered(environment, dive, logs, {name: measured(path) for name, path in logs.items() if has_poses(path)})


def has_poses(path: Path) -> bool:
    """Return whether a log has any outcome; a log from tags may have none."""
    with Dive([path]) as dive:
        return bool(dive.ids("pose", "rejected", "artag"))


def long_dive(size: Size, directory: Path) -> tuple[Path, dict[str, Result]]:
    """Simulate candidates out to 20 m, and solve them by our method and the paper's."""
    dive = directory / "long.mcap"
    words = ["--seconds", str(size.long_seconds), "--rate", str(size.long_rate_hz), "--range-max", "20"]
    call("simulate", str(dive), "--seed", str(SEED + 10), "--undisturbed", "--gross", "0", "--misses", "0", *words)
    results = {}
    for name, method in _LONG_METHODS.items():
        out = directory / f"long.{method}.mcap"
        checks = "range,twist,attitude,depth" if name == OURS else "range,attitude,depth"
        call("solve", str(dive), "-o", str(out), "--method", method, "--checks", checks)
        results[name] = measured(out)
    return dive, results


def net_dives(size: Size, directory: Path) -> dict[str, list[NodeFigures]]:
    """Simulate and solve the dives of more than two nodes; return their nodes' figures in one frame."""
    found = {}
    for number, (name, words) in enumerate(NETS.items()):
        dive, solved = directory / f"net{number}.mcap", directory / f"net{number}.solved.mcap"
        seed = str(SEED + 20 + number)
        call("simulate", str(dive), "--imu", "--seed", seed, "--seconds", str(size.net_seconds), *words)
        call("solve", str(dive), "-o", str(solved))
        found[name] = network_figures(*load_network([str(solved)], [str(dive)]))
    return found
