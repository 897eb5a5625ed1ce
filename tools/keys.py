"""`buddyline keys`: create an authority of your own, and certificates for every process on the bus."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from buddyline.protocol.endpoint import host_and_port
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.security import HUB, node_name
from buddyline.protocol.topics import check_node_id
from buddyline.tools.arguments import subcommand
from buddyline.tools.newfile import write_new

if TYPE_CHECKING:
    from buddyline.tools.authority import Authority

PORT: Final = 7447
DAYS: Final = 730
AUTHORITY_DAYS: Final = 3650

# The role of each certificate, and what it is for.
ROLES: Final = {
    "solver": "make the solver's certificate, which may publish poses",
    "viewer": "make the certificate for commands that only read: record, monitor",
    "surveyor": "make the certificate for marking stations: mark, survey watch; it reads as well",
    "ros2": "make the certificate of `ros2`, which may publish its messages for ROS; it reads as well",
    "player": "make the certificate of `play`, which may publish what any node publishes",
}

_NODES_LINE: Final = re.compile(r"^nodes = \[(.*)\]$", re.MULTILINE)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--directory", default="keys", metavar="DIR", help="where all files are; default: %(default)s")
    parser.add_argument(
        "--days", type=int, metavar="N", help=f"how long it is valid; default: {DAYS}, the authority 10 years"
    )
    whose = parser.add_subparsers(dest="whose", required=True, metavar="|".join(("init", "node", *ROLES)))
    first = subcommand(whose, "init", "make the authority and the hub's certificate", "keys init --hub 192.168.2.1")
    first.add_argument("--hub", default="127.0.0.1", metavar="HOST", help="where clients find it; default: %(default)s")
    node = subcommand(
        whose, "node", "make a node's certificate; the hub then lets it publish its own keys", "keys node a"
    )
    node.add_argument("node", metavar="ID", help="the node's id, as in its configuration")
    for role, text in ROLES.items():
        subcommand(whose, role, text, f"keys {role}")


def run(args: argparse.Namespace) -> int:
    """Make keys and certificates; never overwrite a file."""
    try:
        from buddyline.tools.authority import Authority
    except ImportError as error:
        raise BuddylineError("keys: the package cryptography is missing; `make install EXTRAS=keys`") from error
    if args.days is not None and args.days < 1:
        raise BuddylineError(f"--days {args.days}: at least 1")
    directory = Path(args.directory)
    days = args.days or DAYS
    if args.whose == "init":
        made = _init(directory, args.hub, days, args.days or AUTHORITY_DAYS)
    else:
        made = _client(Authority.open(directory), args, days)
    for path in made:
        print(path)
    return 0


def _init(directory: Path, host: str, days: int, authority_days: int) -> list[Path]:
    from buddyline.tools.authority import Authority

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
    made = authority.issue(name, days)
    path = authority.directory / f"{name}.toml"
    connect = f'connect = "tls/{authority.hub_host()}:{PORT}"\n\n{_tls_table(name)}'
    first = f'node = "{args.node}"\n' if args.whose == "node" else ""
    write_new(
        path, f"# For the configuration of {name}; ca.crt, {name}.crt and {name}.key go beside it.\n{first}{connect}"
    )
    if args.whose == "node":
        _admit(authority.directory / "hub.toml", args.node)
    _say(
        f"copy ca.crt, {name}.crt, {name}.key and {name}.toml to that machine; the key stays readable by its user alone"
    )
    return [*made, path]


def _tls_table(name: str) -> str:
    return f'[tls]\nca = "ca.crt"\ncertificate = "{name}.crt"\nkey = "{name}.key"\n'


def _admit(path: Path, node: str) -> None:
    """Add a node to the list in the hub's file, and change nothing else."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError:
        text = ""
    line = _NODES_LINE.search(text)
    if line is None:
        _say(f'{path}: no line `nodes = [...]`; add "{node}" to the hub\'s nodes yourself')
        return
    nodes = [word for word in re.findall(r'"([^"]*)"', line.group(1)) if word != node] + [node]
    listed = ", ".join(f'"{word}"' for word in sorted(nodes))
    path.write_text(f"{text[: line.start()]}nodes = [{listed}]{text[line.end() :]}", encoding="utf-8")
    _say(f"{path}: node {node} may publish; a hub that runs reads it when it is started again")


def _say(text: str) -> None:
    print(f"keys: {text}", file=sys.stderr)
