"""`buddyline init`: write a commented configuration of a node, a hub or a solver to start from."""

from __future__ import annotations

import argparse
import re
import shlex
from importlib import resources
from pathlib import Path
from typing import Final

from buddyline.protocol.endpoint import host_and_port
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.topics import check_node_id
from buddyline.tools.newfile import write_new

HUB: Final = """\
# The hub: the one process that nodes, solver and viewers connect to. `buddyline hub --config hub.toml`.
listen = "tcp/127.0.0.1:7447"     # <- this machine alone; for others tls/0.0.0.0:7447 with [tls] below

# nodes = ["a", "b"]              # who may publish, with TLS; `buddyline keys node a` adds to it
# shut_out = ["viewer"]           # certificates that may neither publish nor read
# namespace = ""                  # a prefix of all keys, where others use the same network; the same for every client
# status_file = ""                # its health report; default: in the runtime directory

# [tls]                           # the files of `buddyline keys init --hub ADDRESS`, which writes this as well
# ca = "ca.crt"
# certificate = "hub.crt"
# key = "hub.key"
"""

SOLVER: Final = """\
# The solver: candidates, attitudes and depths in, poses and track out. `buddyline solver --config solver.toml`.
connect = "tcp/127.0.0.1:7447"    # <- the hub

# nodes = ["a", "b"]              # solve every pair of these; default: every pair that appears
# pairs = [["a", "b"]]            # or these pairs alone
# namespace = ""                  # as the hub has it
# status_file = ""                # its health report; default: in the runtime directory
# journal = ""                    # what it has answered, so that it answers nothing twice; default: likewise
# lights = ["c.json"]             # NodeInfo of tripods and buoys of lamps alone, which run no program
# share = false                   # true: all solvers on this hub that are started so divide the pairs among them

[solve]
method = "refined"
# checks = ["range", "twist", "attitude", "depth"]   # which contradictions reject a pose
range_min_m = 0.5
range_max_m = 30.0                # nothing farther is a pose
# skew_sigma_s = 0.0              # how far the nodes' clocks may be apart, 1 sd; widens the checks

[track]
rate_hz = 20.0                    # of the live track; 0 for none
expect = true                     # tell the nodes where to look for lights

# [tls]                           # the files of `buddyline keys solver`
# ca = "ca.crt"
# certificate = "solver.crt"
# key = "solver.key"
"""

# The table [tls], commented out or not, up to the next empty line.
_TLS_TABLE: Final = re.compile(r"^(?:# )?\[tls\].*(?:\n.+)*", re.MULTILINE)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("service", choices=("node", "hub", "solver"), help="whose configuration to write")
    parser.add_argument("-o", "--output", metavar="FILE.toml", help="default: NODE.toml, hub.toml, solver.toml")
    parser.add_argument("--node", default="a", metavar="ID", help="a node's id: 1 to 32 of a-z, 0-9, _; default: a")
    parser.add_argument("--connect", metavar="ENDPOINT", help="where the hub is, such as tls/192.168.2.1:7447")
    parser.add_argument("--simulated", action="store_true", help="a node with a simulated camera and sensors")


def run(args: argparse.Namespace) -> int:
    """Write one file, which must not exist; say what to do next."""
    path = Path(
        args.output or (f"{check_node_id(args.node)}.toml" if args.service == "node" else f"{args.service}.toml")
    )
    if args.simulated and args.service != "node":
        raise BuddylineError(f"--simulated: a {args.service} has no camera")
    text = text_of(args.service, args.node, args.connect, simulated=args.simulated)
    write_new(path, text)
    marked = "; set what is marked with <-" if "<-" in text else ""
    named = shlex.quote(str(path))
    print(f"{path}: written{marked}\nnext: buddyline {args.service} --config {named}")
    if args.service == "node" and not args.simulated:
        print(f"      buddyline doctor --config {named}      # says what is missing before a dive")
    return 0


def text_of(service: str, node: str = "a", connect: str | None = None, *, simulated: bool = False) -> str:
    """Return a starting configuration. connect: the hub of a node or a solver; what a hub listens on."""
    if connect is not None:
        host_and_port(connect)
    if service == "node":
        example = "a.toml" if simulated else "pi.toml"
        text = (resources.files("buddyline.node") / "examples" / example).read_text(encoding="utf-8")
        text = re.sub(r'^node = "a".*', f'node = "{check_node_id(node)}"', text, count=1, flags=re.MULTILINE)
        text = text.replace("node-a.", f"node-{node}.").replace("keys node a", f"keys node {node}")
    else:
        text = HUB if service == "hub" else SOLVER
    if connect is None:
        return text
    text = re.sub(r'^(connect|listen) = "[^"]*"', rf'\1 = "{connect}"', text, count=1, flags=re.MULTILINE)
    return _TLS_TABLE.sub(lambda table: _switched(table[0], on=connect.startswith("tls/")), text, count=1)


def _switched(lines: str, *, on: bool) -> str:
    """Return lines of a configuration, taken in or commented out, whatever they were before."""
    plain = [line.removeprefix("# ") for line in lines.split("\n")]
    return "\n".join(line if on else f"# {line}" for line in plain)
