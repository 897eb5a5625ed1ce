"""`buddyline demo`: hub, simulated nodes and the solver as processes of this machine, and their poses live."""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Final

from buddyline.node.sim.scenario import ENVIRONMENTS, Scenario, more_nodes
from buddyline.protocol.codec import encode
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.options import above_zero
from buddyline.protocol.service import Service
from buddyline.tools.draw.above import ARROWS, ASCII_ARROWS
from buddyline.tools.progress import terminal_size

if TYPE_CHECKING:
    from buddyline.protocol.messages import Message
    from buddyline.tools.demo.dashboard import Dashboard
    from buddyline.tools.demo.team_dashboard import TeamDashboard
    from buddyline.tools.measure.children import Child

log = logging.getLogger(__name__)

LOOK_S: Final = 0.1
# A loaded machine takes a while until both nodes send pictures. Where none come for so long, `--seconds` ends it, too.
BEGINS_WITHIN_S: Final = 300.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "--seconds", type=above_zero, metavar="S", help="end so long after both first pictures; default: at Ctrl-C"
    )
    parser.add_argument("--environment", default="cavern", choices=ENVIRONMENTS, help="the waters; default: cavern")
    parser.add_argument("--seed", type=int, default=1, help="each seed gives another dive; default: 1")
    parser.add_argument("--rate", type=above_zero, default=10.0, metavar="HZ", help="triggers a second; default: 10")
    parser.add_argument(
        "--nodes",
        type=int,
        default=2,
        metavar="N",
        help="how many nodes: a, b, c, ...; each renders its pictures; default: 2",
    )
    parser.add_argument(
        "--fixed", action="append", default=[], metavar="NODE", help="a node that stands still, such as a; repeatable"
    )
    parser.add_argument("--blink", action="store_true", help="each node's left lamp blinks by a code of its own")
    parser.add_argument(
        "--record",
        metavar="DIR",
        help="keep the nodes' dive logs here, the truth, and the solved dive with its report; default: nothing is kept",
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.add_argument(
        "--monitor",
        action="store_true",
        help="watch it on the monitor's page in the browser; needs the extra `monitor`",
    )


_NODE_TOML: Final = """\
node = "{node}"
connect = "{endpoint}"
rate_hz = {rate}
[camera]
name = "simulated"
[sensors]
name = "simulated"
[record]
directory = {directory}
[simulation]
environment = "{environment}"
seed = {seed}
start_ns = {start_ns}
more_nodes = {more_nodes}
fixed_nodes = {fixed_nodes}
blinking = {blinking}
"""


def run(args: argparse.Namespace) -> int:
    """Run the demo until its time is over, or until it is stopped; 2 where one of its processes dies."""
    from buddyline.tools.client import ClientConfig
    from buddyline.tools.demo.dashboard import Dashboard, summary_text
    from buddyline.tools.demo.team_dashboard import TeamDashboard, team_summary_text
    from buddyline.tools.live import open_bus
    from buddyline.tools.measure.children import end_all, free_endpoint

    start_ns = time.time_ns()
    scenario = Scenario(
        environment=args.environment,
        seed=args.seed,
        start_ns=start_ns,
        more_nodes=more_nodes(args.nodes),
        fixed_nodes=tuple(args.fixed),
    )
    service = Service("demo")
    service.handle_signals()
    work = Path(tempfile.mkdtemp(prefix="buddyline-demo-"))
    records = Path(args.record).resolve() if args.record else work
    before = set(records.glob("*.mcap"))
    endpoint = free_endpoint()
    children: list[Child] = []
    over = False
    try:
        _start(children, args, work, records, endpoint, scenario)
        service.spawn("processes", lambda: _watch(service, children))
        bus = open_bus(ClientConfig(connect=endpoint), service.stop, lambda _: None)
        if bus is None:
            return service.join()
        with bus:
            bus.on_failure(lambda error: service.fail("bus", error))
            dashboard: Dashboard | TeamDashboard = (
                TeamDashboard(scenario, args.rate)
                if scenario.is_team
                else Dashboard(args.environment, args.seed, start_ns, args.rate)
            )
            dashboard.subscribe(bus)
            over = _show(service, dashboard, args.seconds)
        summary = dashboard.summary(_cpu_seconds(children))
    finally:
        service.stop.set()
        for name in end_all(children):
            log.warning("demo: %s did not end when asked; killed", name)
        shutil.rmtree(work, ignore_errors=True)
    text = team_summary_text if scenario.is_team else summary_text
    print(json.dumps(summary) if args.json else text(summary), flush=True)
    status = service.join()
    if args.record:
        _keep(sorted(set(records.glob("*.mcap")) - before), dashboard.truth(time.time_ns()))
    return 1 if over and not summary["poses"] else status


def write_nodes(
    work: Path, records: Path, endpoint: str, scenario: Scenario, rate_hz: float, *, blink: bool = False
) -> Iterator[tuple[str, Path]]:
    """Write each simulated node's configuration into work, for logs in records; yield its id and the file."""
    for node in scenario.nodes:
        config = work / f"{node}.toml"
        config.write_text(
            _NODE_TOML.format(
                node=node,
                endpoint=endpoint,
                rate=float(rate_hz),
                directory=json.dumps(str(records)),
                environment=scenario.environment,
                seed=scenario.seed,
                start_ns=scenario.start_ns,
                more_nodes=json.dumps(scenario.more_nodes),
                fixed_nodes=json.dumps(scenario.fixed_nodes),
                blinking=json.dumps(blink),
            )
        )
        yield node, config


def _start(
    children: list[Child], args: argparse.Namespace, work: Path, records: Path, endpoint: str, scenario: Scenario
) -> None:
    """Start hub, nodes, solver and, where it is wanted, the monitor; nodes and solver end before the hub."""
    from buddyline.tools.measure.children import Child, free_port

    hub = Child("hub", "--listen", endpoint)
    try:
        for node, config in write_nodes(work, records, endpoint, scenario, args.rate, blink=args.blink):
            children.append(Child("node", "--config", str(config), name=f"node {node}"))
        children.append(Child("solver", "--connect", endpoint))
        if args.monitor:
            port = free_port()
            children.append(Child("monitor", "--connect", endpoint, "--port", str(port), "--open"))
            log.info("demo: the page is http://127.0.0.1:%d", port)
    finally:
        children.append(hub)


def _keep(logs: list[Path], truth: Iterable[tuple[int, str, Message]]) -> None:
    """Write the truth beside the nodes' logs, solve them, and say what lies where."""
    from buddyline.tools.after import run_command
    from buddyline.tools.newfile import new_dive_log

    if len(logs) < 2:
        return
    records, when = logs[0].parent, logs[0].stem.partition("-")[2]
    true, solved, report = (
        records / f"{name}-{when}.{suffix}"
        for name, suffix in (("truth", "mcap"), ("solved", "mcap"), ("report", "html"))
    )
    with new_dive_log(true) as writer:
        for stamp_ns, key, message in truth:
            writer.write(key, encode(message), stamp_ns, stamp_ns)
    with redirect_stdout(sys.stderr):
        run_command(["solve", *map(str, logs), "-o", str(solved)])
        try:
            run_command(["report", str(solved), "-o", str(report)])
        except BuddylineError as error:
            log.info("demo: no report: %s", error)
    log.info(
        "demo: kept in %s: %s", records, ", ".join(path.name for path in (*logs, true, solved, report) if path.exists())
    )
    log.info("demo: its errors: buddyline evaluate %s", shlex.join(map(str, (solved, "--truth", true))))


def _watch(service: Service, children: list[Child]) -> None:
    """End the demo as soon as one of its processes has died, and say which and why; runs in a thread of its own."""
    while not service.stop.wait(LOOK_S):
        deaths = [death for child in reversed(children) if (death := child.death()) is not None]
        if deaths:
            # The hub first: the others may only follow it.
            service.fail("processes", BuddylineError(deaths[0]))


def _cpu_seconds(children: list[Child]) -> dict[str, float]:
    """Return the processor time of each process that still runs."""
    used = {}
    for child in children:
        try:
            used[child.name] = child.load().cpu_s
        except BuddylineError:
            continue
    return used


def _show(service: Service, dashboard: Dashboard | TeamDashboard, seconds: float | None) -> bool:
    """Show the state until the end; return True if the time was over, False if the demo was stopped."""
    begun, ends_s = False, math.inf if seconds is None else time.monotonic() + BEGINS_WITHIN_S
    interactive = sys.stderr.isatty() and os.environ.get("TERM") != "dumb"
    coloured = not os.environ.get("NO_COLOR")
    arrows = ARROWS if "utf" in (sys.stderr.encoding or "").lower() else ASCII_ARROWS
    over = False
    while not over and not service.stop.wait(0.25 if interactive else 1.0):
        size = terminal_size()
        if interactive:
            text = dashboard.screen(size.columns, size.lines, coloured=coloured, arrows=arrows)
        else:
            text = dashboard.line()
        # A line's end below a full screen would move it up, its title out of sight.
        print(text, file=sys.stderr, flush=True, end="" if interactive else "\n")
        if seconds is not None and not begun and dashboard.begun:
            begun, ends_s = True, time.monotonic() + seconds
        over = time.monotonic() >= ends_s
    if interactive:
        print(file=sys.stderr)
    return over
