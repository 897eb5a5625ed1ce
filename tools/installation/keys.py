"""`buddyline keys`: create an authority of your own, and certificates for every process on the bus."""

from __future__ import annotations

import argparse
import re
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from buddyline.protocol.endpoint import host_and_port
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.security import HUB, PLAYER, ROS, SOLVER, SURVEYOR, VIEWER, node_name
from buddyline.protocol.topics import check_node_id
from buddyline.tools.arguments import subcommand
from buddyline.tools.extras import needed
from buddyline.tools.hub import load_hub_config
from buddyline.tools.newfile import replace_text, write_new

if TYPE_CHECKING:
    from buddyline.tools.installation.authority import Authority

PORT: Final = 7447
DAYS: Final = 730
AUTHORITY_DAYS: Final = 3650
MOST_DAYS: Final = 36500


class Role(NamedTuple):
    """A certificate that is no node's: the commands that use it, and what it may do."""

    used_by: str
    may: str


ROLES: Final = {
    SOLVER: Role("solver", "publishes poses, tracks and what nodes are to expect; reads"),
    VIEWER: Role("record, monitor and other readers", "reads"),
    SURVEYOR: Role("mark and survey watch", "publishes marks; reads"),
    ROS: Role("ros2", "publishes for ROS; reads"),
    PLAYER: Role("play", "publishes what any node publishes; reads"),
}

_NODES_LINE: Final = re.compile(r"^nodes = \[(.*)\]$", re.MULTILINE)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    whose = parser.add_subparsers(
        dest="whose", required=True, metavar="|".join(("init", "node", *ROLES, "list", "renew"))
    )
    first = subcommand(whose, "init", "make the authority and the hub's certificate", "keys init --hub 192.168.2.1")
    first.add_argument(
        "--hub",
        default="127.0.0.1",
        metavar="HOST",
        help="the hub's address, as clients reach it; default: %(default)s",
    )
    node = subcommand(
        whose, "node", "make a node's certificate, and let it publish as this node and as no other", "keys node a"
    )
    node.add_argument("node", metavar="ID", help="the node's id, as in its configuration")
    for name, role in ROLES.items():
        subcommand(whose, name, f"make the certificate for {role.used_by}: {role.may}", f"keys {name}")
    subcommand(whose, "list", "say who may do what, and until when", "keys list")
    renew = subcommand(whose, "renew", "make a certificate anew, and keep the old one beside it", "keys renew node-a")
    renew.add_argument("name", metavar="NAME", help="as `keys list` has it: hub, solver, viewer, node-a ...")
    # Before or after the word that says whose: there an option that is not given changes nothing.
    for one in (parser, *whose.choices.values()):
        unset = None if one is parser else argparse.SUPPRESS
        one.add_argument(
            "--directory", default=unset or "keys", metavar="DIR", help="where all files are; default: keys"
        )
        one.add_argument(
            "--days",
            type=int,
            default=unset,
            metavar="N",
            help=f"how long it is valid, no longer than the authority; default: {DAYS}, the authority 10 years",
        )


def run(args: argparse.Namespace) -> int:
    """Make keys and certificates; never overwrite a file."""
    needed("cryptography", "keys", "keys")
    from buddyline.tools.installation.authority import Authority

    if args.days is not None and not 1 <= args.days <= MOST_DAYS:
        raise BuddylineError(f"--days {args.days}: from 1 to {MOST_DAYS}")
    directory = Path(args.directory)
    days = args.days or DAYS
    if args.whose == "list":
        print("\n".join(_listed(Authority.open(directory))))
        return 0
    if args.whose == "init":
        made = _init(directory, args.hub, days, args.days or AUTHORITY_DAYS)
    else:
        authority = Authority.open(directory)
        if ended := authority.ends_within(0):
            raise BuddylineError(f"{authority.certificate_path}: ended on {ended:%Y-%m-%d}; begin anew: `keys init`")
        made = _renewed(authority, args.name, days) if args.whose == "renew" else _client(authority, args, days)
        if ends := authority.ends_within(days):
            _say(f"it is valid until {ends:%Y-%m-%d}, when the authority ends; `buddyline keys init` makes another one")
    for path in made:
        print(path)
    return 0


def _init(directory: Path, host: str, days: int, authority_days: int) -> list[Path]:
    from buddyline.tools.installation.authority import Authority

    host_and_port(f"tls/{host}:{PORT}")
    authority = Authority.create(directory, authority_days)
    made = [authority.certificate_path, *authority.issue(HUB, days, server_host=host)]
    text = (
        f"# `buddyline hub --config hub.toml`: listens beyond this machine, for those with a certificate alone.\n"
        f'listen = "tls/0.0.0.0:{PORT}"\n\n'
        "# Nodes that may publish, each its own keys; `buddyline keys node ID` adds one.\nnodes = []\n\n"
        f"{_tls_table(HUB)}"
    )
    path = directory / "hub.toml"
    write_new(path, text)
    _say(f"{authority.key_path} makes certificates: it stays on this machine, and is copied nowhere")
    return [*made, path]


def _client(authority: Authority, args: argparse.Namespace, days: int) -> list[Path]:
    name = args.whose if args.whose in ROLES else node_name(check_node_id(args.node))
    made, hub = authority.issue(name, days), f"tls/{authority.hub_host()}:{PORT}"
    kept = "the key stays readable by its user alone"
    if args.whose == "node":
        _admit(authority.directory / "hub.toml", args.node)
        _say(f"copy ca.crt, {name}.crt and {name}.key to that machine, beside its configuration; {kept}")
        _say(f"`buddyline init node --node {args.node} --connect {hub}` writes the configuration")
        return made
    path = authority.directory / f"{name}.toml"
    text = f'connect = "{hub}"\n\n{_tls_table(name)}'
    write_new(path, f"# For the configuration of {name}; ca.crt, {name}.crt and {name}.key go beside it.\n{text}")
    _say(f"copy ca.crt, {name}.crt, {name}.key and {name}.toml to that machine; {kept}")
    return [*made, path]


def _listed(authority: Authority) -> list[str]:
    """Return a line for each certificate: its name, what it may do, and until when."""
    hub = load_hub_config(str(authority.directory / "hub.toml"))
    may = {HUB: "is the hub"} | {name: role.may for name, role in ROLES.items()}
    lines = []
    for name, until in authority.issued():
        words = may.get(name, f"publishes as node {name.removeprefix('node-')}; reads")
        if name in hub.shut_out:
            words = "is shut out (`shut_out` in hub.toml)"
        elif name not in may and name.removeprefix("node-") not in hub.nodes:
            words = "is not admitted (`nodes` in hub.toml)"
        left = (until - datetime.now(UTC)).days
        ends = f"EXPIRED {until:%Y-%m-%d}" if left < 0 else f"until {until:%Y-%m-%d} ({left} days)"
        lines.append(f"{name:<12} {ends:<26} {words}")
    return lines


def _renewed(authority: Authority, name: str, days: int) -> list[Path]:
    """Make a certificate anew; the old one and its key are kept under the date on which they end."""
    known = dict(authority.issued())
    if name not in known:
        raise BuddylineError(f"{name}: no certificate of this name; there are {', '.join(sorted(known))}")
    host = authority.hub_host().strip("[]") if name == HUB else None
    for ending in ("crt", "key"):
        path = authority.directory / f"{name}.{ending}"
        kept = authority.directory / f"{name}.until-{known[name]:%Y%m%d}.{ending}.old"
        if kept.exists():
            raise BuddylineError(f"{kept}: exists: it was renewed before; move it away first")
        path.rename(kept)
    made = authority.issue(name, days, server_host=host)
    _say(f"copy {name}.crt and {name}.key to that machine and start it again; the old certificate is valid to its end")
    return made


def _tls_table(name: str) -> str:
    return f'[tls]\nca = "ca.crt"\ncertificate = "{name}.crt"\nkey = "{name}.key"\n'


def _admit(path: Path, node: str) -> None:
    """Add a node to the list in the hub's file, and change nothing else."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        text = ""
    line = _NODES_LINE.search(text)
    if line is None:
        _say(f'{path}: no line `nodes = [...]`; add "{node}" to the hub\'s nodes yourself')
        return
    nodes = [word for word in re.findall(r'"([^"]*)"', line.group(1)) if word != node] + [node]
    listed = ", ".join(f'"{word}"' for word in sorted(nodes))
    replace_text(path, f"{text[: line.start()]}nodes = [{listed}]{text[line.end() :]}")
    _say(f"{path}: node {node} may publish; a running hub takes that within seconds")


def _say(text: str) -> None:
    print(f"keys: {text}", file=sys.stderr)
