"""The whole system as real processes: hub, two nodes, solver; each can be started, stopped and killed."""

from __future__ import annotations

import signal
from pathlib import Path

from buddyline.protocol.endpoint import is_loopback

from tests.faults.observer import Observer, Tally
from tests.processes import Process, free_endpoint

NODE = """
node = "{node}"
connect = "{endpoint}"
rate_hz = {rate_hz}
[camera]
name = "simulated"
width_px = 410
height_px = 308
[record]
directory = "{directory}"
images_hz = 0.0
[preview]
rate_hz = 0.0
[simulation]
environment = "basin"
"""

READY = {"hub": "listens", "a": "connected", "b": "connected", "solver": "connected", "viewer": "into"}


class System:
    """Processes by name: hub, a, b, solver, viewer."""

    def __init__(self, directory: Path, rate_hz: float, endpoint: str | None = None) -> None:
        self.directory = directory
        self.rate_hz = rate_hz
        self.endpoint = endpoint or free_endpoint()
        self.processes: dict[str, Process] = {}
        self.observer: Observer | None = None

    def spawn(self, name: str, namespace: str | None = None) -> Process:
        """Start a process and do not wait for it; namespace: the network namespace it lives in."""
        if name == "hub":
            words = ["hub", "--listen", self.endpoint, *([] if is_loopback(self.endpoint) else ["--insecure"])]
        elif name == "solver":
            words = ["solver", "--connect", self.endpoint]
        elif name == "viewer":
            words = ["record", str(self.directory / "viewer.mcap"), "--connect", self.endpoint]
        else:
            config = self.directory / f"{name}.toml"
            config.write_text(
                NODE.format(node=name, endpoint=self.endpoint, rate_hz=self.rate_hz, directory=self.directory)
            )
            words = ["node", "--config", str(config)]
        prefix = ("ip", "netns", "exec", namespace) if namespace else ()
        self.processes[name] = Process(*words, prefix=prefix)
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
        """Kill without a chance to say anything."""
        process = self.processes.pop(name)
        process.send(signal.SIGKILL)
        process.wait()
        process.end()

    def freeze(self, name: str) -> None:
        """Stop a process where it stands."""
        self.processes[name].send(signal.SIGSTOP)

    def thaw(self, name: str) -> None:
        """Let it go on."""
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
