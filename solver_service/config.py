"""The solver's configuration: one TOML file, strict; every key has a default."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, cast, get_args

from buddyline.protocol.config import Config, ConfigError, load_config
from buddyline.protocol.messages import NodeId
from buddyline.protocol.security import SOLVER, Tls, check_identity
from buddyline.solver_service.geometry.observation import Method, Settings
from msgspec import Meta, field
from msgspec.structs import replace

CHECKS = ("range", "twist", "attitude", "depth")
METHODS = get_args(Method)


class SolveConfig(Config, frozen=True, kw_only=True):
    """[solve]: method, the checks to use, the ranges to believe; skew_sigma_s: how well the clocks agree, 1 sd."""

    method: str = "refined"
    checks: list[str] = field(default_factory=lambda: list(CHECKS))
    range_min_m: Annotated[float, Meta(gt=0)] = 0.5
    range_max_m: Annotated[float, Meta(gt=0)] = 30.0
    skew_sigma_s: Annotated[float, Meta(ge=0)] = 0.0

    def settings(self, source: str) -> Settings:
        """Return what the geometry takes; source: the file, for errors."""
        if self.method not in METHODS:
            raise ConfigError(f"{source}: solve.method = {self.method!r}: known are {', '.join(METHODS)}")
        unknown = [check for check in self.checks if check not in CHECKS]
        if unknown:
            raise ConfigError(f"{source}: solve.checks = {unknown[0]!r}: known are {', '.join(CHECKS)}")
        if not self.range_min_m < self.range_max_m < math.inf:
            what = f"solve.range_min_m = {self.range_min_m:g}, range_max_m = {self.range_max_m:g}"
            raise ConfigError(f"{source}: {what}: not 0 < min < max")
        return Settings(
            method=cast(Method, self.method),
            checks=frozenset(self.checks),
            range_min_m=self.range_min_m,
            range_max_m=self.range_max_m,
            skew_sigma_s=self.skew_sigma_s,
        )


class SolverConfig(Config, frozen=True, kw_only=True):
    """A whole solver. nodes: the pair [a, b]; empty: the first two that appear, in alphabetical order.

    status_file: where it says how it is; "": in the runtime directory (protocol/statusfile.py).
    """

    nodes: list[NodeId] = field(default_factory=list)
    connect: str = "tcp/127.0.0.1:7447"
    namespace: str = ""
    tls: Tls | None = None
    status_file: str = ""
    solve: SolveConfig = field(default_factory=SolveConfig)

    def __post_init__(self) -> None:
        """Check the pair."""
        if len(self.nodes) not in (0, 2) or len(set(self.nodes)) != len(self.nodes):
            raise ValueError(f"nodes: two different ids, or none, not {self.nodes}")


def load_solver_config(path: Path | str | None) -> SolverConfig:
    """Read the solver's TOML file, or take the defaults; raise ConfigError naming file, field and value."""
    if path is None:
        return SolverConfig()
    config = load_config(path, SolverConfig)
    if config.tls is None:
        return config
    tls = config.tls.beside(path)
    check_identity(tls, SOLVER)
    return replace(config, tls=tls)
