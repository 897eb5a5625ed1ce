"""`buddyline demo`: hub, two simulated nodes and the solver as processes of this machine, and their poses live."""

from __future__ import annotations

import argparse
import ctypes
import json
import logging
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

from buddyline.node.sim.scenario import ENVIRONMENTS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.service import Service
from buddyline.tools.dashboard import Dashboard

log = logging.getLogger(__name__)

END_WITHIN_S: Final = 1.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--seconds", type=float, metavar="S", help="end after this long; default: at Ctrl-C")
    parser.add_argument("--environment", default="cavern", choices=ENVIRONMENTS, help="default: cavern")
    parser.add_argument("--seed", type=int, default=1, help="another dive for each; default: 1")
    parser.add_argument("--rate", type=float, default=10.0, metavar="HZ", help="triggers a second; default: 10")
    parser.add_argument("--record", metavar="DIR", help="keep the nodes' dive logs here; default: they are removed")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.add_argument("--monitor", action="store_true", help="watch it on the monitor's page, in the browser")


_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None
_PR_SET_PDEATHSIG: Final = 1


def _end_with_parent() -> None:
    """In a child, before it becomes the command: have the kernel end it if the demo dies without a word."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Processes:
    """The demo's child processes, each with its log; ended together, by their own ids."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._children: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, *words: str) -> None:
        """Start `buddyline words...`; its messages go to a file of its own."""
        with open(self._log_of(name), "wb") as errors:
            self._children[name] = subprocess.Popen(
                [sys.executable, "-P", "-m", "buddyline", *words],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                # Ctrl-C reaches this process alone, which ends the others in order.
                start_new_session=True,
                preexec_fn=_end_with_parent,  # noqa: PLW1509  (no other thread runs yet, and it only calls prctl)
            )

    def _log_of(self, name: str) -> Path:
        return self._directory / f"{name}.log"

    def died(self) -> str | None:
        """Return what ended before its time, with its last words, or None."""
        for name, child in self._children.items():
            if child.poll() is not None:
                last = self._log_of(name).read_text(errors="replace").strip().splitlines()[-1:]
                return f"{name} ended with status {child.returncode}: {''.join(last) or 'no message'}"
        return None

    def cpu_seconds(self) -> dict[str, float]:
        """Return processor time used by each, where the system tells (Linux)."""
        used = {}
        for name, child in self._children.items():
            try:
                fields = Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()
                used[name] = (int(fields[11]) + int(fields[12])) / 100
            except (OSError, ValueError, IndexError):
                continue
        return used

    def end(self) -> None:
        """Ask all to end, nodes and solver before the hub; kill what does not."""
        for child in self._children.values():
            if child.poll() is None:
                child.send_signal(signal.SIGTERM)
        ends_s = time.monotonic() + END_WITHIN_S
        for name, child in self._children.items():
            try:
                child.wait(max(ends_s - time.monotonic(), 0.01))
            except subprocess.TimeoutExpired:
                log.warning("demo: %s did not end when asked; killed", name)
                child.kill()
                child.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


NODE_TOML: Final = """\
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
"""


def run(args: argparse.Namespace) -> int:
    """Run the demo until its time is over, or until stopped."""
    from buddyline.protocol.zenoh_bus import connect

    service = Service("demo")
    service.handle_signals()
    work = Path(tempfile.mkdtemp(prefix="buddyline-demo-"))
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    processes = Processes(work)
    try:
        start_ns = time.time_ns()
        records = Path(args.record).resolve() if args.record else work
        for node in ("a", "b"):
            (work / f"{node}.toml").write_text(
                NODE_TOML.format(
                    node=node,
                    endpoint=endpoint,
                    rate=float(args.rate),
                    directory=json.dumps(str(records)),
                    environment=args.environment,
                    seed=args.seed,
                    start_ns=start_ns,
                )
            )
        processes.start("hub", "hub", "--listen", endpoint)
        processes.start("node a", "node", "--config", str(work / "a.toml"))
        processes.start("node b", "node", "--config", str(work / "b.toml"))
        processes.start("solver", "solver", "--connect", endpoint)
        if args.monitor:
            port = _free_port()
            processes.start("monitor", "monitor", "--connect", endpoint, "--port", str(port), "--open")
            log.info("demo: the page is http://127.0.0.1:%d", port)
        bus = connect(endpoint, stop=service.stop, on_wait=lambda _: None)
        if bus is None:
            return service.join()
        with bus:
            bus.on_failure(lambda error: service.fail("bus", error))
            dashboard = Dashboard(args.environment, args.seed, start_ns, args.rate)
            dashboard.subscribe(bus)
            over = _watch(service, processes, dashboard, args.seconds)
        summary = dashboard.summary(processes.cpu_seconds())
    finally:
        processes.end()
        shutil.rmtree(work, ignore_errors=True)
    print(json.dumps(summary) if args.json else dashboard.summary_text(summary))
    status = service.join()
    return 1 if over and not summary["poses"] else status


def _watch(service: Service, processes: Processes, dashboard: Dashboard, seconds: float | None) -> bool:
    """Show what goes on; return whether the time was over, and not stopped from outside."""
    ends_s = None if seconds is None else time.monotonic() + seconds
    interactive = sys.stderr.isatty()
    while not service.stop.wait(0.25 if interactive else 1.0):
        dead = processes.died()
        if dead is not None:
            service.fail("processes", BuddylineError(dead))
        print(dashboard.screen() if interactive else dashboard.line(), file=sys.stderr, flush=True)
        if ends_s is not None and time.monotonic() >= ends_s:
            return True
    return False
