"""The whole system as real processes: hub, two nodes, solver; each can be started, stopped and killed."""

from __future__ import annotations

import signal
from pathlib import Path

from buddyline.protocol.endpoint import is_loopback
from buddyline.tools.measure.children import free_port

from tests.faults.observer import Observer, Tally
from tests.processes import Process, free_endpoint

NODE = """
node = "{node}"
connect = "{endpoint}"
rate_hz = {rate_hz}
[camera]
name = "{devices}"
width_px = {width_px}
height_px = {height_px}
[sensors]
name = "{sensors}"
[record]
directory = "{directory}"
images_hz = 0.0
[preview]
rate_hz = {preview_hz}
[simulation]
environment = "basin"
"""

READY = {"hub": "listens", "a": "connected", "b": "connected", "solver": "connected", "recorder": "into"}
READY |= {"monitor": "look at"}


class System:
    """Processes by name: hub, a, b, solver, recorder (of everything, into recorder.mcap, recorder-2.mcap ...), monitor.

    devices: the nodes' camera and sensors; node_module: what runs them. node: what nodes are started with.
    """

    def __init__(
        self,
        directory: Path,
        rate_hz: float,
        endpoint: str | None = None,
        *,
        devices: str = "simulated",
        width_px: int = 410,
        preview_hz: float = 0.0,
        node_module: str = "buddyline",
    ) -> None:
        self.directory = directory
        self.endpoint = endpoint or free_endpoint()
        self.processes: dict[str, Process] = {}
        self.observer: Observer | None = None
        self.node: dict[str, object] = {
            "rate_hz": rate_hz,
            "devices": devices,
            "sensors": devices,
            "width_px": width_px,
            "height_px": round(width_px * 308 / 410),
            "preview_hz": preview_hz,
        }
        self._node_module = node_module
        self._recordings = 0

    def spawn(self, name: str, namespace: str | None = None) -> Process:
        """Start a process and do not wait for it; namespace: the network namespace it lives in."""
        connect, module = ("--connect", self.endpoint), "buddyline"
        if name == "hub":
            words = ["hub", "--listen", self.endpoint, *([] if is_loopback(self.endpoint) else ["--insecure"])]
        elif name == "solver":
            config = self.directory / "solver.toml"
            config.write_text(f'connect = "{self.endpoint}"\njournal = "{self.directory / "solver.answered"}"\n')
            words = ["solver", "--config", str(config)]
        elif name == "recorder":
            self._recordings += 1
            again = f"-{self._recordings}" if self._recordings > 1 else ""
            words = ["record", str(self.directory / f"recorder{again}.mcap"), *connect]
        elif name == "monitor":
            words = ["monitor", *connect, "--port", str(free_port())]
        else:
            config, module = self.directory / f"{name}.toml", self._node_module
            place = {"endpoint": self.endpoint, "directory": self.directory}
            config.write_text(NODE.format(node=name, **place, **self.node))
            words = [*(["node"] if module == "buddyline" else []), "--config", str(config)]
        prefix = ("ip", "netns", "exec", namespace) if namespace else ()
        self.processes[name] = Process(*words, prefix=prefix, module=module)
        return self.processes[name]

    def start(self, *names: str) -> None:
        """Start processes, each once the one before is ready."""
        for name in names:
            self.spawn(name).wait_for(READY[name])

    def observe(self) -> Observer:
        """Connect the observer; the hub must be there."""
        self.observer = Observer(self.endpoint)
        return self.observer

    def kill(self, name: str) -> None:
        """Kill a process with SIGKILL."""
        process = self.processes.pop(name)
        process.send(signal.SIGKILL)
        process.wait()
        process.end()

    def freeze(self, name: str) -> None:
        """Stop a process where it stands."""
        self.processes[name].send(signal.SIGSTOP)

    def thaw(self, name: str) -> None:
        """Continue a stopped process."""
        self.processes[name].send(signal.SIGCONT)

    def finish(self) -> Tally:
        """Stop the nodes, let the solver resolve what it has, and count."""
        assert self.observer is not None
        for name in ("a", "b"):
            if name in self.processes:
                self.processes.pop(name).end()
        self.observer.settle()
        return self.observer.tally(sorted(self.directory.glob("[ab]-*.mcap")))

    def __enter__(self) -> System:
        return self

    def __exit__(self, *_: object) -> None:
        if self.observer is not None:
            self.observer.close()
        for name in sorted(self.processes, key=lambda name: name == "hub"):
            process = self.processes[name]
            process.send(signal.SIGCONT)
            process.end()
