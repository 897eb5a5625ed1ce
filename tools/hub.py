"""`buddyline hub`: the one listener that nodes, solver and viewers connect to."""

from __future__ import annotations

import argparse
import logging
import os
from typing import TYPE_CHECKING, Final

from buddyline.protocol.config import Config, Namespace, load_config
from buddyline.protocol.endpoint import DEFAULT_ENDPOINT, is_loopback
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import NodeId
from buddyline.protocol.options import above_zero
from buddyline.protocol.security import HUB, Tls, check_identity
from buddyline.protocol.service import Service
from buddyline.protocol.statusfile import StatusFile
from msgspec import field
from msgspec.structs import replace

if TYPE_CHECKING:
    from buddyline.protocol.zenoh_bus.hub import Hub

log = logging.getLogger(__name__)

# How often the configuration is looked at.
LOOK_S: Final = 1.0


class HubConfig(Config, frozen=True, kw_only=True):
    """The hub's TOML file. nodes: who may publish, with TLS; namespace: as the clients have it. shut_out: names of
    certificates that may neither publish nor read ("viewer", "node-b"). A changed file's lists count at once.

    status_file: its health report; "": in the runtime directory (protocol/statusfile.py).
    """

    listen: str = DEFAULT_ENDPOINT
    namespace: Namespace = ""
    nodes: list[NodeId] = field(default_factory=list)
    shut_out: list[str] = field(default_factory=list)
    tls: Tls | None = None
    status_file: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--config", metavar="FILE.toml", help="the hub's configuration")
    parser.add_argument("--listen", metavar="ENDPOINT", help=f"where; default: {DEFAULT_ENDPOINT}, this machine alone")
    parser.add_argument("--insecure", action="store_true", help="listen beyond this machine without TLS")
    parser.add_argument("--seconds", type=above_zero, metavar="S", help="stop after this long")


def load_hub_config(path: str | None) -> HubConfig:
    """Read the hub's TOML file, or take the defaults; raise ConfigError naming file, field and value."""
    if path is None:
        return HubConfig()
    config = load_config(path, HubConfig)
    return config if config.tls is None else replace(config, tls=config.tls.beside(path))


def check_exposure(config: HubConfig, *, insecure: bool) -> str | None:
    """Return a warning or None; raise BuddylineError if the hub would be open to anyone without --insecure."""
    if config.tls is not None:
        check_identity(config.tls, HUB)
        return None if config.nodes else "no node may publish: `nodes` is empty"
    if config.nodes:
        raise BuddylineError(
            "hub: `nodes` restricts who may publish, which needs a [tls] table to identify the clients"
        )
    if is_loopback(config.listen):
        return None
    if not insecure:
        raise BuddylineError(
            f"hub: {config.listen} is open to the network: use TLS (`buddyline keys init`), or add --insecure "
            "where the network is yours alone"
        )
    return f"INSECURE: everyone who reaches {config.listen} can read and send everything"


def run(args: argparse.Namespace) -> int:
    """Run the hub until it is stopped."""
    from buddyline.protocol.access import access_rules
    from buddyline.protocol.zenoh_bus import open_hub

    config = load_hub_config(args.config)
    if args.listen:
        config = replace(config, listen=args.listen)
    warning = check_exposure(config, insecure=args.insecure)
    if warning is not None:
        log.warning("hub: %s", warning)
    access = None if config.tls is None else access_rules(config.nodes, config.namespace, config.shut_out)
    service = Service("hub", StatusFile.of("hub", config.status_file))
    service.handle_signals()
    with open_hub(config.listen, tls=config.tls, access=access) as hub:
        log.info("hub: listens on %s%s", config.listen, " (TLS, client certificates)" if config.tls else "")
        if access is not None:
            service.spawn("access", lambda: _follow_file(service, hub, args.config, config))
        service.wait(args.seconds)
        # The thread that may open the hub's session again ends before the hub closes.
        return service.join()


def _follow_file(service: Service, hub: Hub, path: str, config: HubConfig) -> None:
    """Take the lists of who is admitted whenever the configuration changes; one that is not valid changes nothing."""
    from buddyline.protocol.access import access_rules

    # The first look reads the file again: it may have changed since `config` was read.
    before: tuple[int, int] | None = None
    while not service.stop.wait(LOOK_S):
        now = _state_of(path)
        if now == before:
            continue
        before = now
        try:
            changed = load_hub_config(path)
        except BuddylineError as error:
            log.error("hub: %s; who is admitted stays as it was", error)
            continue
        if (changed.nodes, changed.shut_out) == (config.nodes, config.shut_out):
            continue
        config = changed
        hub.admit(access_rules(config.nodes, config.namespace, config.shut_out))
        out = f"; shut out: {', '.join(config.shut_out)}" if config.shut_out else ""
        log.info("hub: nodes that may publish: %s%s", ", ".join(config.nodes) or "none", out)


def _state_of(path: str) -> tuple[int, int] | None:
    """Return a file's time and size, which change when it is written; None if it is not there."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
