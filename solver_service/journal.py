"""What a live solver has received and said, in small files that outlive a kill of solver and hub."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgspec
from buddyline.protocol.bus import CACHE_S
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import encode
from buddyline.protocol.messages import Message
from buddyline.protocol.messages.fields import Count
from buddyline.protocol.statusfile import runtime_directory
from buddyline.protocol.topics import POSE, REJECTED, key_of, parse_key
from buddyline.solver_service.answered import THIS_DIVE_NS, Answer, Outcome, answer_of

log = logging.getLogger(__name__)

# From this size on a file becomes the one before, and a new one begins with the last outcome of each pair.
MOST_BYTES: Final = 4 * 1024 * 1024
# A frame's line begins with it.
FRAME: Final = b"frame"
# Its last word shows that the line is whole.
END: Final = b"."
FRAME_WORDS: Final = 4
# The file of another solver that shared the work, and has written nothing for so long, is no longer needed.
KEPT_S: Final = 600.0


@dataclass
class Noted:
    """What earlier solvers at this hub have received and said.

    said: answers, in their order. recent: key and payload, as they were published, of the outcomes of the last minute;
    of a file that was written to in the last minute, those of the minute before its pairs' newest. frames: node,
    trigger and stamp of the frames of this dive.
    """

    said: list[Answer] = field(default_factory=list)
    recent: list[tuple[str, bytes]] = field(default_factory=list)
    frames: list[tuple[str, int, int]] = field(default_factory=list)


class Journal:
    """One line for each outcome, with its key and payload, and one for each frame, with its node, trigger and stamp.

    A write error is logged once, and the solver goes on.

    A line is in the system's hands as soon as it is written, so it outlives the process; a power cut ends the dive for
    nodes and solver alike. Several threads may add. instance: of solvers that share the work, each has its own file,
    and reads those of all.
    """

    def __init__(self, path: Path, instance: str = "") -> None:
        self._common = path
        self.path = path.with_name(f"{path.name}.{instance}") if instance else path
        self._last: dict[tuple[str, str], bytes] = {}
        self._decoder = msgspec.json.Decoder(Answer)
        self._numbers = msgspec.json.Decoder(Count)
        self._file: int | None = None
        self._bytes = 0
        self._failed = False
        self._lock = threading.Lock()

    @classmethod
    def of(cls, endpoint: str, namespace: str = "", instance: str = "") -> Journal | None:
        """Return the journal of the solver at a hub, in the runtime directory; None if there is none."""
        directory = runtime_directory()
        name = re.sub(r"[^A-Za-z0-9]+", "-", f"{endpoint} {namespace}").strip("-")
        return None if directory is None else cls(directory / f"solver-{name}.answered", instance)

    def read(self, now_ns: int, pairs: Iterable[tuple[str, str]] | None = None) -> Noted:
        """Return what is noted, of these pairs if given; a line that was cut off is left out. now_ns: wall clock."""
        wanted = None if pairs is None else {topic.key(*pair).encode() for pair in pairs for topic in (POSE, REJECTED)}
        past = Noted()
        noted: list[tuple[Answer, str, bytes, bool]] = []
        newest_ns: dict[tuple[str, str], int] = {}
        for line, lately in self._lines(now_ns):
            key, _, payload = line.partition(b" ")
            if wanted is not None and key not in wanted:
                continue
            if key == FRAME:
                words = payload.split()
                if len(words) == FRAME_WORDS and words[-1] == END:
                    with contextlib.suppress(msgspec.DecodeError):
                        trigger, stamp_ns = map(self._numbers.decode, words[1:3])
                        if abs(now_ns - stamp_ns) < THIS_DIVE_NS:
                            past.frames.append((words[0].decode("ascii", "replace"), trigger, stamp_ns))
                continue
            try:
                one = self._decoder.decode(payload)
            except msgspec.DecodeError:
                continue
            named = key.decode("ascii", "replace")
            if (parsed := parse_key(named)) is None or parsed[0] not in (POSE, REJECTED):
                continue
            past.said.append(one)
            if abs(now_ns - one.stamp_ns) < THIS_DIVE_NS:
                noted.append((one, named, payload, lately))
            if one.in_order:
                pair = one.node_a, one.node_b
                newest_ns[pair] = max(newest_ns.get(pair, 0), one.stamp_ns)
                self._last[one.node_a, one.node_b] = line + b"\n"
        if self.path != self._common:
            past.said.sort(key=lambda one: one.stamp_ns)
            noted.sort(key=lambda each: each[0].stamp_ns)
        past.recent = [
            (named, payload)
            for one, named, payload, lately in noted
            if abs(now_ns - one.stamp_ns) < CACHE_S * S_NS
            # What was noted last may not have been sent, however old it was then.
            or (lately and abs(newest_ns.get((one.node_a, one.node_b), 0) - one.stamp_ns) < CACHE_S * S_NS)
        ]
        return past

    def _lines(self, now_ns: int) -> Iterator[tuple[bytes, bool]]:
        """Yield the lines of this journal, and whether their file was written to in the last minute.

        Of a shared journal those of all solvers, whose old files are removed.
        """
        is_shared = self.path != self._common
        of_all = sorted(self._common.parent.glob(f"{self._common.name}.*"), key=_is_current) if is_shared else []
        for path in [_before(self._common), self._common, *of_all]:
            with contextlib.suppress(OSError):
                lately = abs(now_ns / S_NS - path.stat().st_mtime) < CACHE_S
                yield from ((line, lately) for line in path.read_bytes().splitlines())
                if path in of_all and path != self.path and time.time() - path.stat().st_mtime > KEPT_S:
                    path.unlink()

    def add(self, messages: Iterable[Message]) -> None:
        """Note the outcomes among messages that are about to be published."""
        outcomes = [message for message in messages if isinstance(message, Outcome)]
        lines = [_line(key_of(message), encode(message)) for message in outcomes]
        if lines:
            self._write(b"".join(lines))
        with self._lock:
            for message, line in zip(outcomes, lines, strict=True):
                if answer_of(message).in_order:
                    self._last[message.node_a, message.node_b] = line

    def add_frame(self, node: str, trigger: int, stamp_ns: int) -> None:
        """Note a frame that has been received: its trigger will have an outcome, also if its node ends too."""
        self._write(b"%s %s %d %d %s\n" % (FRAME, node.encode(), trigger, stamp_ns, END))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _write(self, text: bytes) -> None:
        with self._lock:
            try:
                if self._file is None:
                    self._file = self._open()
                if self._bytes + len(text) > MOST_BYTES:
                    self._file = self._begin()
                self._bytes += os.write(self._file, text)
            except OSError as error:
                if not self._failed:
                    log.warning("solver: journal %s cannot be written: %s", self.path, error.strerror)
                self._failed = True
            else:
                self._failed = False

    def _open(self) -> int:
        """Go on with the file; the solver before may have been killed within a line."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        self._bytes = os.fstat(file).st_size
        if self._bytes:
            self._bytes += os.write(file, b"\n")
        return file

    def _begin(self) -> int:
        """Begin a new file with the last outcome of each pair; the old one takes the place of the one before."""
        self.close()
        self.path.replace(_before(self.path))
        file = self._open()
        self._bytes += os.write(file, b"".join(self._last.values()))
        return file


def _before(path: Path) -> Path:
    """Return the name of the file that was full."""
    return path.with_name(f"{path.name}~")


def _is_current(path: Path) -> bool:
    return not path.name.endswith("~")


def _line(key: str, payload: bytes) -> bytes:
    return key.encode() + b" " + payload + b"\n"
