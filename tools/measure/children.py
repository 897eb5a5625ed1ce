"""Commands of this program as child processes: started, watched, and ended by their own ids."""

from __future__ import annotations

import ctypes
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from typing import Final

from buddyline.tools.measure.load import Load, load_of

# Long, because on a loaded machine a child waits for a processor; one that is killed leaves a log without its end.
END_WITHIN_S: Final = 10.0
LAST_BYTES: Final = 4096

_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None
_PR_SET_PDEATHSIG: Final = 1


def _end_with_parent() -> None:
    """In a child, before it becomes the command: have the kernel end it if its parent is killed."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Child:
    """`buddyline words...` as a running child process; its output goes to an unnamed temporary file.

    A context manager that ends it. Nothing in the current folder can take the place of one of its modules. The kernel
    ends it with the thread that started it: start it from one that lives as long.
    """

    def __init__(self, *words: str, name: str = "") -> None:
        self.name = name or words[0]
        self._output = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "buddyline", *words],
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=self._output,
            # Ctrl-C reaches this process alone, which ends the others in order.
            start_new_session=True,
            preexec_fn=_end_with_parent,  # noqa: PLW1509  (it only calls prctl)
        )

    @property
    def pid(self) -> int:
        """Return the process id."""
        return self._process.pid

    def death(self) -> str | None:
        """Return its exit status and its last line of output, in words; None while it runs."""
        status = self._process.poll()
        if status is None:
            return None
        self._output.seek(max(self._output.seek(0, 2) - LAST_BYTES, 0))
        lines = self._output.read().decode(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "no message")
        return f"{self.name} ended with status {status}: {last}"

    def load(self) -> Load:
        """Return its load on the machine; raise BuddylineError if it has ended."""
        return load_of(self.pid)

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *_: object) -> None:
        end_all([self])


def end_all(children: Iterable[Child], within_s: float = END_WITHIN_S) -> list[str]:
    """Ask all to end, and kill those that do not within this time; return the names of the killed."""
    children, killed = list(children), []
    for child in children:
        if child._process.poll() is None:
            child._process.send_signal(signal.SIGTERM)
    ends_s = time.monotonic() + within_s
    for child in children:
        try:
            child._process.wait(max(ends_s - time.monotonic(), 0.01))
        except subprocess.TimeoutExpired:
            killed.append(child.name)
            child._process.kill()
            child._process.wait()
        child._output.close()
    return killed


def free_port() -> int:
    """Return a free port of loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def free_endpoint() -> str:
    """Return an endpoint on loopback with a free port."""
    return f"tcp/127.0.0.1:{free_port()}"
