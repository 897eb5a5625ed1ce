"""How a command reaches the hub: `--connect`, or a configuration with a [tls] table."""

from __future__ import annotations

import argparse
from pathlib import Path

from buddyline.protocol.config import Config, Namespace, load_config
from buddyline.protocol.endpoint import DEFAULT_ENDPOINT
from buddyline.protocol.security import VIEWER, Tls, check_identity
from msgspec.structs import replace


class ClientConfig(Config, frozen=True, kw_only=True):
    """The TOML file of a command on the bus (`buddyline keys viewer`, `surveyor`, `player` and `ros2` write one)."""

    connect: str = DEFAULT_ENDPOINT
    namespace: Namespace = ""
    tls: Tls | None = None


def add_client_arguments(parser: argparse.ArgumentParser, role: str = VIEWER) -> None:
    """Declare the arguments for the hub's address; role: the certificate that the command needs."""
    parser.add_argument("--config", metavar="FILE.toml", help=f"where the hub is, with [tls] (`buddyline keys {role}`)")
    parser.add_argument("--connect", metavar="ENDPOINT", help=f"the hub; default: {DEFAULT_ENDPOINT}")


def client_config(args: argparse.Namespace, role: str = VIEWER) -> ClientConfig:
    """Return the configuration that the arguments give; raise BuddylineError naming the file and its fault."""
    return client_config_of(args.config, args.connect, role)


def client_config_of(path: Path | str | None, connect: str | None = None, role: str = VIEWER) -> ClientConfig:
    """Return the configuration of a TOML file, or the defaults; connect: an endpoint that takes precedence."""
    config = load_config(path, ClientConfig) if path else ClientConfig()
    if config.tls is not None and path:
        config = replace(config, tls=config.tls.beside(path))
    if connect:
        config = replace(config, connect=connect)
    if config.tls is not None:
        check_identity(config.tls, role)
    return config
