"""Attitudes for `solve --attitude-again`: from a dive's inertial samples, in place of the recorded ones."""

from __future__ import annotations

import heapq
import logging
from collections import defaultdict
from collections.abc import Iterator, Sequence

import msgspec
from buddyline.node.attitude_again import attitude_estimator, attitudes_again
from buddyline.node.config import NodeConfig, load_node_config
from buddyline.protocol.config import ConfigError
from buddyline.protocol.envelope import Envelope, envelope_of
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Attitude, Imu
from buddyline.protocol.topics import IMU
from buddyline.tools.dives import Dive
from buddyline.tools.option_values import node_files

log = logging.getLogger(__name__)


def again(dive: Dive, given: Sequence[str], nodes: Sequence[str]) -> list[Envelope]:
    """Return the attitudes of the nodes that have inertial samples, by time.

    given: NODE=FILE.toml, a node's configuration with a later calibration; of the others the log holds theirs.
    """
    configs = _recorded(dive) | _given(given)
    samples: dict[str, list[Imu]] = defaultdict(list)
    for one in dive.all_of(IMU, Imu, doing="attitudes"):
        if one.node in nodes:
            samples[one.node].append(one)
    if not samples:
        raise BuddylineError(f"{dive.name}: no inertial samples of any node, so no attitudes again; solve without that")
    for node in nodes:
        if node not in samples:
            log.warning("%s: no inertial samples of node %s: its attitudes stay as they are", dive.name, node)
    found: list[Envelope] = []
    for node, taken in samples.items():
        if node not in configs:
            raise BuddylineError(f"{dive.name}: no configuration of node {node}: --attitude-again {node}=FILE.toml")
        taken.sort(key=lambda one: one.stamp_ns)
        estimator = attitude_estimator(configs[node], taken[0].stamp_ns)
        made = [envelope_of(one, one.stamp_ns) for one in attitudes_again(taken, estimator)]
        if not made:
            log.warning("%s: too few inertial samples of node %s: its attitudes stay as they are", dive.name, node)
        found += made
    return sorted(found, key=lambda one: one.time_ns)


def in_place_of(envelopes: Iterator[Envelope], attitudes: Sequence[Envelope]) -> Iterator[Envelope]:
    """Yield a dive's messages by time, with these attitudes in place of their nodes' recorded ones."""
    nodes = {envelope.node for envelope in attitudes}
    kept = (one for one in envelopes if not (isinstance(one.message, Attitude) and one.node in nodes))
    yield from heapq.merge(kept, attitudes, key=lambda one: one.time_ns)


def _given(given: Sequence[str]) -> dict[str, NodeConfig]:
    found = {}
    for node, path in node_files("--attitude-again", given):
        config = load_node_config(path)
        if config.node != node:
            raise ConfigError(f"--attitude-again {node}={path}: the file is of node {config.node}")
        found[node] = config
    return found


def _recorded(dive: Dive) -> dict[str, NodeConfig]:
    found: dict[str, NodeConfig] = {}
    for reader in dive.readers:
        noted = reader.metadata()
        if "config" not in noted:
            continue
        try:
            config = msgspec.json.decode(noted["config"], type=NodeConfig)
        except msgspec.DecodeError as error:
            log.warning("%s: its configuration is not usable here: %s", reader.path, error)
            continue
        found.setdefault(config.node, config)
    return found
