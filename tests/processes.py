"""Real processes of the project for tests: started, waited for, and ended by their own ids."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
# Time limit for an event on the slowest and most loaded machine. A wait ends as soon as its event comes.
PATIENCE_S = 180.0


# The kernel gives ports from 32768 on to connections and to sockets that ask for any: such a port may be taken between
# the choice and its use, and a client that tries again and again may even connect to itself.
PORTS = range(20_000, 32_000)
_reserved: list[socket.socket] = []
_ports = random.SystemRandom()


def free_endpoint() -> str:
    """Return a loopback endpoint whose port, of TCP and UDP, is free, and that no other test process gets."""
    while True:
        port = _ports.choice(PORTS)
        if _reserve(port):
            return f"tcp/127.0.0.1:{port}"


def _reserve(port: int) -> bool:
    """Keep a port from other test processes until this one ends; return False if it is in use."""
    mark = socket.socket(socket.AF_UNIX)
    try:
        if sys.platform == "linux":
            mark.bind(f"\0buddyline test port {port}")
        for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
            with socket.socket(socket.AF_INET, kind) as probe:
                probe.bind(("127.0.0.1", port))
    except OSError:
        mark.close()
        return False
    _reserved.append(mark)
    return True


def until(condition: Callable[[], object], pause_s: float = 0.005) -> None:
    """Wait for a condition that no event announces; try it again after each pause."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "it did not come"
        time.sleep(pause_s)


def buddyline(*words: str, timeout: float = PATIENCE_S, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run one command to its end."""
    return subprocess.run(
        [sys.executable, "-P", "-m", "buddyline", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )


class Process:
    """A running command; its stderr is read as it comes, so that a test can wait for a line.

    prefix: a command that runs it in its own place, as `ip netns exec`. module: what runs the words.
    """

    def __init__(
        self, *words: str, cwd: Path | None = None, prefix: tuple[str, ...] = (), module: str = "buddyline"
    ) -> None:
        self.lines: list[str] = []
        self._changed = threading.Condition()
        self._child = subprocess.Popen(
            [*prefix, sys.executable, "-m", module, *map(str, words)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            cwd=cwd,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        return self._child.pid

    @property
    def ended(self) -> bool:
        return self._child.poll() is not None

    def _read(self) -> None:
        for line in self._child.stderr:
            with self._changed:
                self.lines.append(line.rstrip())
                self._changed.notify_all()
        with self._changed:
            self._changed.notify_all()

    def wait_for(self, text: str, timeout: float = PATIENCE_S) -> str:
        """Wait for a line of stderr with text in it."""
        with self._changed:
            found = self._changed.wait_for(lambda: next((line for line in self.lines if text in line), None), timeout)
        assert found, f"{text!r} did not come; stderr: {self.lines}"
        return found

    def wait(self, timeout: float = PATIENCE_S) -> int:
        """Wait for its end; return the exit status."""
        status = self._child.wait(timeout)
        self._reader.join(timeout)
        return status

    def send(self, number: signal.Signals) -> None:
        """Send a signal."""
        self._child.send_signal(number)

    def end(self, number: signal.Signals = signal.SIGTERM, timeout: float = PATIENCE_S) -> int:
        """Ask it to end; kill it where it does not; return the exit status."""
        if self._child.poll() is None:
            self._child.send_signal(number)
        try:
            status = self._child.wait(timeout)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
            raise
        finally:
            self._reader.join(PATIENCE_S)
            self._child.stderr.close()
        return status

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


@contextmanager
def recorded_solver(out: Path, *arguments: object) -> Iterator[tuple[str, Process]]:
    """A hub, a solver and `record` into out; yields the hub's endpoint and the recorder, when all are connected.

    arguments: the solver's further ones.
    """
    endpoint = free_endpoint()
    with (
        Process("hub", "--listen", endpoint) as hub,
        Process("solver", "--connect", endpoint, *arguments) as solver,
        Process("record", out, "--connect", endpoint) as record,
    ):
        hub.wait_for("listens")
        solver.wait_for("connected")
        record.wait_for("into")
        yield endpoint, record
