"""The last outcomes that a live solver has published, in a small file that outlives a kill of solver and hub."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from buddyline.protocol.messages import Message, Rejected
from buddyline.protocol.statusfile import runtime_directory
from buddyline.solver_service.answered import Outcome, is_in_order

log = logging.getLogger(__name__)

# From this size on only the last line of each pair is kept.
MOST_BYTES: Final = 256 * 1024
# The file of another solver that shared the work, and has written nothing for so long, is no longer needed.
KEPT_S: Final = 600.0
# A line: both nodes, trigger, time, and a word that shows that the line is whole.
END: Final = "."
WORDS: Final = 5


class Journal:
    """One line for each outcome: whose, of which trigger, when. A write error is logged once, and the solver goes on.

    A line is in the system's hands as soon as it is written, so it outlives the process; a power cut ends the dive for
    nodes and solver alike. instance: of solvers that share the work, each has its own file, and reads those of all.
    """

    def __init__(self, path: Path, instance: str = "") -> None:
        self._common = path
        self.path = path.with_name(f"{path.name}.{instance}") if instance else path
        self._last: dict[tuple[str, str], bytes] = {}
        self._file: int | None = None
        self._bytes = 0
        self._failed = False

    @classmethod
    def of(cls, endpoint: str, namespace: str = "", instance: str = "") -> Journal | None:
        """Return the journal of the solver at a hub, in the runtime directory; None if there is none."""
        directory = runtime_directory()
        name = re.sub(r"[^A-Za-z0-9]+", "-", f"{endpoint} {namespace}").strip("-")
        return None if directory is None else cls(directory / f"solver-{name}.answered", instance)

    def read(self) -> list[Outcome]:
        """Return the last outcome of each pair; a line that was cut off is left out."""
        found: dict[tuple[str, str], Outcome] = {}
        for line in self._lines():
            words = line.decode("ascii", "replace").split()
            if len(words) != WORDS or words[-1] != END or not all(word.isdecimal() for word in words[2:4]):
                continue
            node_a, node_b, trigger, stamp_ns = words[0], words[1], int(words[2]), int(words[3])
            if (node_a, node_b) in found and found[node_a, node_b].stamp_ns > stamp_ns and self.path != self._common:
                continue
            # Of an outcome that was published, only its trigger and its time count.
            found[node_a, node_b] = Rejected(
                node_a=node_a, node_b=node_b, stamp_ns=stamp_ns, trigger=trigger, reason="ambiguous"
            )
            self._last[node_a, node_b] = line + b"\n"
        return list(found.values())

    def _lines(self) -> list[bytes]:
        """Return the lines of this file; of a shared journal those of all solvers, whose old files are removed."""
        lines: list[bytes] = []
        of_all = [*self._common.parent.glob(f"{self._common.name}.*")] if self.path != self._common else []
        for path in [self._common, *of_all]:
            with contextlib.suppress(OSError):
                lines += path.read_bytes().splitlines()
                if path not in (self._common, self.path) and time.time() - path.stat().st_mtime > KEPT_S:
                    path.unlink()
        return lines

    def add(self, messages: Iterable[Message]) -> None:
        """Note the outcomes among messages that were published."""
        lines = []
        for message in messages:
            if isinstance(message, Outcome) and is_in_order(message):
                pair = message.node_a, message.node_b
                self._last[pair] = _line(message)
                lines.append(self._last[pair])
        if lines:
            self._write(b"".join(lines))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _write(self, text: bytes) -> None:
        try:
            if self._file is None or self._bytes + len(text) > MOST_BYTES:
                self._begin()
            else:
                os.write(self._file, text)
                self._bytes += len(text)
        except OSError as error:
            if not self._failed:
                log.warning("solver: journal %s cannot be written: %s", self.path, error.strerror)
            self._failed = True
        else:
            self._failed = False

    def _begin(self) -> None:
        """Put the last line of each pair into a new file, which takes the old one's place at once."""
        self.close()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        file = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
        text = b"".join(self._last.values())
        os.write(file, text)
        fresh.replace(self.path)
        self._file, self._bytes = file, len(text)


def _line(outcome: Outcome) -> bytes:
    return f"{outcome.node_a} {outcome.node_b} {outcome.trigger} {outcome.stamp_ns} {END}\n".encode()
