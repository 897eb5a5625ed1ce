"""Run the doctor's checks: this machine, the bus, and the devices if no node uses them."""

from __future__ import annotations

import sys
import threading
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Final

from buddyline.node.chrony import ChronyError, read_tracking
from buddyline.node.config import NodeConfig, load_node_config
from buddyline.node.power.board import Throttled, temperature_degc
from buddyline.node.time_base import is_kept
from buddyline.protocol.config import load_config
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.client import ClientConfig
from buddyline.tools.doctor import bus, machine, rig
from buddyline.tools.health import machine as judge
from buddyline.tools.health.finding import Finding
from msgspec.structs import replace

WITHIN_S: Final = 10.0
SAY_AFTER_S: Final = 2.0

Check = Callable[[], list[Finding]]


def load(path: str | None) -> tuple[NodeConfig | None, ClientConfig]:
    """Read a node's configuration, or a client's; raise ConfigError naming file, field and value."""
    if path is None:
        return None, ClientConfig()
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):
        table = {"node": ""}  # load_node_config reports what is wrong with the file
    if "node" not in table:
        config = load_config(path, ClientConfig)
        return None, replace(config, tls=config.tls and config.tls.beside(path))
    node = load_node_config(path)
    return node, ClientConfig(connect=node.connect, namespace=node.namespace, tls=node.tls)


def diagnose(node: NodeConfig | None, client: ClientConfig) -> list[Finding]:
    """Check the machine and the bus, then camera and sensors if no node uses them."""
    ends_s, own = time.monotonic() + WITHIN_S, None if node is None else node.node
    seen = bus.Seen(error=f"{client.connect} did not answer")

    def look() -> list[Finding]:
        nonlocal seen
        seen = bus.look(client, own)
        return bus.check_bus(seen, client.connect, own)

    findings = together({"this machine": lambda: check_machine(node), "the bus": look}, ends_s)
    if node is None:
        return findings
    if f"node/{node.node}" in seen.alive:
        return [*findings, Finding("camera", "skipped", f"in use: node {node.node} runs, and says how it is above")]
    return findings + together(
        {
            "the camera": lambda: rig.check_camera(node),
            "the sensors": lambda: rig.check_sensors(node),
            "the panel": lambda: rig.check_panel(node),
            "the battery": lambda: rig.check_battery(node),
        },
        ends_s,
    )


def check_machine(node: NodeConfig | None) -> list[Finding]:
    """Check clock, clock chip, disk, temperature and power."""
    tracking, error = None, ""
    try:
        tracking = read_tracking()
    except ChronyError as found:
        error = str(found)
    stamps = node is not None and node.camera.name == "picamera2"
    directory = Path(node.record.directory if node else ".")
    free_bytes, unwritable = machine.space(directory)
    rate_px = node.record.images_hz * node.camera.width_px * node.camera.height_px if node else 0.0
    min_free_bytes = node.record.min_free_mb * 1_000_000 if node else 0
    return [
        judge.clock(tracking, error, machine.timesyncd(), stamps=stamps),
        judge.clock_chip(kept=is_kept(), stamps=stamps),
        judge.disk(str(directory.absolute()), free_bytes, min_free_bytes, rate_px, unwritable),
        judge.temperature(temperature_degc()),
        judge.power(Throttled().read()),
    ]


def together(tasks: dict[str, Check], ends_s: float) -> list[Finding]:
    """Run all checks at once, each in a thread of its own; a check that is not done at ends_s becomes a problem."""
    results: dict[str, list[Finding] | Exception] = {}
    changed = threading.Condition()

    def do(name: str, task: Check) -> None:
        try:
            result: list[Finding] | Exception = task()
        except Exception as error:  # a check that fails must not hide the others' findings
            result = error
        with changed:
            results[name] = result
            changed.notify_all()

    for name, task in tasks.items():
        threading.Thread(target=do, args=(name, task), name=name, daemon=True).start()
    with changed:
        if not changed.wait_for(lambda: len(results) == len(tasks), SAY_AFTER_S):
            waiting = ", ".join(name for name in tasks if name not in results)
            print(f"still looking at {waiting} ...", file=sys.stderr, flush=True)
        changed.wait_for(lambda: len(results) == len(tasks), max(ends_s - time.monotonic(), 0.5))
        done = dict(results)
    findings: list[Finding] = []
    for name in tasks:
        result = done.get(name)
        if result is None:
            findings.append(Finding(name, "problem", "gave no answer in time", "it hangs: check cables, then reboot"))
        elif isinstance(result, BuddylineError):
            findings.append(Finding(name, "problem", str(result)))
        elif isinstance(result, Exception):
            advice = "this is a fault of the program: please report it"
            findings.append(Finding(name, "problem", f"{type(result).__name__}: {result}", advice))
        else:
            findings += result
    return findings
