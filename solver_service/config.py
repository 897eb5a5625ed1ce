"""The solver's configuration: one TOML file, strict; every key has a default."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path
from typing import Annotated, cast

from buddyline.protocol.config import Config, ConfigError, Namespace, load_config
from buddyline.protocol.envelope import read_message
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import NodeId, NodeInfo, TrackMode
from buddyline.protocol.security import SOLVER, Tls, check_identity
from buddyline.protocol.topics import check_node_id
from buddyline.solver_service.choices import CHECKS, METHODS, TRACKS
from buddyline.solver_service.geometry.observation import Method, Settings
from buddyline.solver_service.tracking import TrackSettings
from msgspec import UNSET, Meta, field
from msgspec.structs import replace

# Rates of a stored dive's track: one row in ten seconds, and as many as a fast inertial unit has samples.
LEAST_TRACK_HZ, MOST_TRACK_HZ = 0.1, 1000.0


class SolveConfig(Config, frozen=True, kw_only=True):
    """[solve]: method, checks to use, possible ranges. skew_sigma_s: difference of the nodes' clocks, 1 sd."""

    method: str = "refined"
    checks: list[str] = field(default_factory=lambda: list(CHECKS))
    range_min_m: Annotated[float, Meta(gt=0)] = Settings.range_min_m
    range_max_m: Annotated[float, Meta(gt=0)] = Settings.range_max_m
    skew_sigma_s: Annotated[float, Meta(ge=0)] = Settings.skew_sigma_s

    def settings(self, source: str) -> Settings:
        """Return the settings of the geometry; raise ConfigError. source: the file's name in errors."""
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


def track_settings(mode: str, rate_hz: float) -> TrackSettings | None:
    """Return what the solver takes for a stored dive's one track, None for none; raise ConfigError."""
    if mode not in TRACKS:
        raise ConfigError(f"track = {mode!r}: known are {', '.join(TRACKS)}")
    if not LEAST_TRACK_HZ <= rate_hz <= MOST_TRACK_HZ:
        raise ConfigError(f"track_hz = {rate_hz:g}: give {LEAST_TRACK_HZ:g} to {MOST_TRACK_HZ:g}")
    return None if mode == "none" else TrackSettings(frozenset((cast(TrackMode, mode),)), rate_hz)


class TrackConfig(Config, frozen=True, kw_only=True):
    """[track]: rate of the live track's messages; 0 for no track. expect: tell the nodes where to look for lights."""

    rate_hz: Annotated[float, Meta(ge=0, le=200)] = 20.0
    expect: bool = True

    @property
    def settings(self) -> TrackSettings | None:
        """The settings of the tracks: one without delay, and a more accurate one a second later."""
        return TrackSettings(frozenset(("filter", "lag")), self.rate_hz, self.expect) if self.rate_hz else None


class SolverConfig(Config, frozen=True, kw_only=True):
    """The solver's configuration.

    nodes: solve every pair of these nodes. pairs: solve these pairs, A first. Neither: solve every pair that appears.
    status_file: its path; "" for the runtime directory (protocol/statusfile.py). journal: where it keeps what it has
    answered, so that it answers nothing twice; "" likewise. share: several solvers on one hub divide the pairs. lights:
    files of the NodeInfo of buoys and tripods of lamps alone, which run no program; relative to the configuration's.
    """

    nodes: list[NodeId] = field(default_factory=list)
    pairs: list[tuple[NodeId, NodeId]] = field(default_factory=list)
    connect: str = "tcp/127.0.0.1:7447"
    namespace: Namespace = ""
    tls: Tls | None = None
    status_file: str = ""
    journal: str = ""
    share: bool = False
    lights: list[str] = field(default_factory=list)
    solve: SolveConfig = field(default_factory=SolveConfig)
    track: TrackConfig = field(default_factory=TrackConfig)

    def __post_init__(self) -> None:
        """Check nodes and pairs."""
        if len(self.nodes) == 1 or len(set(self.nodes)) != len(self.nodes):
            raise ValueError(f"nodes: two or more different ids, or none, not {self.nodes}")
        if self.nodes and self.pairs:
            raise ValueError("nodes, pairs: give one of them")
        if any(a == b for a, b in self.pairs) or len({frozenset(pair) for pair in self.pairs}) != len(self.pairs):
            raise ValueError(f"pairs: each of two different ids, and once, not {[list(pair) for pair in self.pairs]}")

    @property
    def chosen(self) -> list[tuple[str, str]] | None:
        """The pairs to solve; None for all that appear."""
        return self.pairs or list(combinations(self.nodes, 2)) or None

    def lamps_alone(self) -> list[NodeInfo]:
        """Read the files of `lights`; raise ConfigError naming file, field and value."""
        infos: list[NodeInfo] = []
        for path in map(Path, self.lights):
            try:
                info = read_message(path, NodeInfo)
            except MessageError as error:
                raise ConfigError(f"lights: {error}") from error
            if info.role != "lights" or info.fixed is UNSET:
                raise ConfigError(f'lights: {path}: node {info.node} has not role "lights" and a place (fixed)')
            if info.node in (one.node for one in infos):
                raise ConfigError(f"lights: {path}: node {info.node} is named twice")
            infos.append(info)
        return infos


def node_ids(words: list[str]) -> list[str]:
    """Return the ids of `--nodes A B` or `--nodes A,B`; raise ConfigError unless they are two or more different ids."""
    ids = [check_node_id(node) for word in words for node in word.split(",")]
    if len(ids) < 2 or len(set(ids)) != len(ids):
        raise ConfigError(f"--nodes {' '.join(words)}: give two or more different ids")
    return ids


def load_solver_config(path: Path | str | None) -> SolverConfig:
    """Read the solver's TOML file, or take the defaults; raise ConfigError naming file, field and value."""
    if path is None:
        return SolverConfig()
    config = load_config(path, SolverConfig)
    config = replace(config, lights=[str(Path(path).parent / one) for one in config.lights])
    if config.tls is None:
        return config
    tls = config.tls.beside(path)
    check_identity(tls, SOLVER)
    return replace(config, tls=tls)
