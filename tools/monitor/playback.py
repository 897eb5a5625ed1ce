"""A stored dive as a picture of the pair at any instant, read as it is played and never held as a whole."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final, Self

from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import decode
from buddyline.protocol.divelog import DiveLogReader, Record, read_logs
from buddyline.protocol.errors import BuddylineError, MessageError
from buddyline.protocol.messages import NodeInfo, Rejected, RelativePose
from buddyline.protocol.pictures import with_pictures
from buddyline.protocol.topics import (
    ATTITUDE,
    CANDIDATES,
    DEPTH,
    IMAGE,
    INFO,
    NODE_STATUS,
    POSE,
    REJECTED,
    SOLVER_STATUS,
    Topic,
    parse_key,
)
from buddyline.tools.monitor.coverage import Coverage
from buddyline.tools.monitor.picture import PairPicture

SHOWN: Final = (INFO, CANDIDATES, ATTITUDE, DEPTH, IMAGE, NODE_STATUS, POSE, REJECTED, SOLVER_STATUS)
# Before an instant that was jumped to, this much of the dive is read for trail and plots.
LEAD_NS: Final = 30 * S_NS


class Playback:
    """The logs of one dive, at one instant."""

    def __init__(self, paths: list[str]) -> None:
        self._stack = ExitStack()
        self.bad = 0
        try:
            self._readers = [self._stack.enter_context(DiveLogReader(path)) for path in with_pictures(paths)]
            starts = [reader.start_ns for reader in self._readers if reader.start_ns is not None]
            if not starts:
                raise BuddylineError(f"{', '.join(paths)}: no message can be read")
            self.start_ns = min(starts)
            self.end_ns = max(reader.end_ns for reader in self._readers if reader.end_ns is not None)
            self._infos = list(self._first_infos())
        except BaseException:
            self._stack.close()
            raise
        self.seek(self.start_ns)

    def _first_infos(self) -> Iterator[NodeInfo]:
        """Yield the first calibration of each node, for jumps past it."""
        for reader in self._readers:
            expected = {key for key in reader.keys if _is_one_of(key, (INFO,))}
            if not expected:
                continue
            for record in reader.records(lambda key: _is_one_of(key, (INFO,))):
                if record.key not in expected:
                    continue
                try:
                    info = decode(record.payload, NodeInfo)
                except MessageError:
                    self.bad += 1
                    continue
                expected.discard(record.key)
                yield info
                if not expected:
                    break

    def seek(self, to_ns: int) -> None:
        """Go to an instant of log time, forward or back."""
        to_ns = min(max(to_ns, self.start_ns), self.end_ns)
        self.picture = PairPicture()
        for info in self._infos:
            self.picture.take(info, None, self.start_ns)
        self._records = read_logs(self._readers, lambda key: _is_one_of(key, SHOWN), to_ns - LEAD_NS)
        self._next: Record | None = next(self._records, None)
        self.position_ns = to_ns
        self._feed()

    def advance(self, to_ns: int) -> None:
        """Go on to a later instant."""
        self.position_ns = min(max(to_ns, self.position_ns), self.end_ns)
        self._feed()

    def _feed(self) -> None:
        while self._next is not None and self._next.log_time_ns <= self.position_ns:
            self._take(self._next)
            self._next = next(self._records, None)

    def _take(self, record: Record) -> None:
        parsed = parse_key(record.key)
        if parsed is None:
            return
        try:
            message = record.decode()
        except MessageError:
            self.bad += 1
            return
        if message is not None:
            self.picture.take(message, parsed[1][0], record.log_time_ns)

    def close(self) -> None:
        """Close the logs."""
        self._stack.close()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the logs."""
        self.close()


def _is_one_of(key: str, topics: tuple[Topic, ...]) -> bool:
    parsed = parse_key(key)
    return parsed is not None and parsed[0] in topics


def survey(paths: list[str], coverage: Coverage) -> Iterator[None]:
    """Fill coverage from the logs, a record at a time; yields so that the reader sets the pace.

    Opens the logs anew: it runs beside the playback, which reads elsewhere in the files.
    """
    with ExitStack() as stack:
        readers = [stack.enter_context(DiveLogReader(Path(path))) for path in paths]
        for record in read_logs(readers, lambda key: _is_one_of(key, (POSE, REJECTED))):
            try:
                result = record.decode()
            except MessageError:
                continue
            if isinstance(result, RelativePose):
                coverage.add(record.log_time_ns, None)
            elif isinstance(result, Rejected):
                coverage.add(record.log_time_ns, result.reason)
            yield
    coverage.complete = True
