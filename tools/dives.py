"""Stored dives as the tools take them: several logs as one, checked to belong together."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from types import TracebackType

import msgspec
from buddyline.protocol.codec import decode
from buddyline.protocol.config import ConfigError
from buddyline.protocol.divelog import DiveLogReader, Record, read_logs
from buddyline.protocol.errors import BuddylineError, MessageError
from buddyline.protocol.messages import NodeInfo
from buddyline.protocol.pictures import with_pictures
from buddyline.protocol.topics import INFO, parse_key


class Dive:
    """One dive out of one or more logs (each node's own, say), with the pictures beside them."""

    def __init__(self, paths: list[str] | list[Path]) -> None:
        self._stack = ExitStack()
        self.readers = []
        try:
            seen: set[Path] = set()
            for path in map(Path, paths):
                if path.resolve() in seen:
                    raise BuddylineError(f"{path}: is named twice")
                seen.add(path.resolve())
            for path in with_pictures(paths):
                self.readers.append(self._stack.enter_context(DiveLogReader(path)))
            self._infos = self._check_one_dive()
        except BaseException:
            self._stack.close()
            raise

    @property
    def name(self) -> str:
        """The logs' names, for messages to a person."""
        return ", ".join(str(reader.path) for reader in self.readers)

    @property
    def keys(self) -> list[str]:
        """Topics of all logs, sorted."""
        return sorted({key for reader in self.readers for key in reader.keys})

    @cached_property
    def start_ns(self) -> int:
        """Log time of the first message; raises where no log has any."""
        starts = [reader.start_ns for reader in self.readers if reader.start_ns is not None]
        if not starts:
            raise BuddylineError(f"{self.name}: no message can be read{self._damage_text()}")
        return min(starts)

    @cached_property
    def end_ns(self) -> int:
        """Log time of the last message."""
        return max((reader.end_ns for reader in self.readers if reader.end_ns is not None), default=0)

    @property
    def damage(self) -> list[str]:
        """What could not be read, a line each."""
        return [f"{reader.path}: {text}" for reader in self.readers for text in reader.damage]

    def _damage_text(self) -> str:
        return "".join(f"; {text}" for text in self.damage)

    def nodes(self, *topic_names: str) -> list[str]:
        """Return the ids of the nodes that sent on any of these topics, sorted."""
        found = set()
        for key in self.keys:
            parsed = parse_key(key)
            if parsed and parsed[0].name in topic_names:
                found.add(parsed[1][0])
        return sorted(found)

    def records(self, *topic_names: str) -> Iterator[Record]:
        """Yield the records of these topics (none named: of all), by log time."""

        def wanted(key: str) -> bool:
            parsed = parse_key(key)
            return parsed is not None and (not topic_names or parsed[0].name in topic_names)

        return read_logs(self.readers, wanted)

    def metadata(self) -> dict[str, str]:
        """Return what the logs say about themselves; the first named prevails."""
        noted: dict[str, str] = {}
        for reader in reversed(self.readers):
            noted |= reader.metadata()
        return noted

    def infos(self) -> dict[str, NodeInfo]:
        """Return the first sound NodeInfo of each node."""
        return dict(self._infos)

    def _check_one_dive(self) -> dict[str, NodeInfo]:
        """Return the first NodeInfo of each node; refuse logs of which two describe one differently at one time."""
        first: dict[str, tuple[DiveLogReader, NodeInfo]] = {}
        for reader in self.readers:
            for info in _infos_of(reader):
                other, known = first.setdefault(info.node, (reader, info))
                if other is reader or _rig(known) == _rig(info):
                    continue
                if _overlap(other, reader):
                    raise BuddylineError(
                        f"{other.path} and {reader.path} describe node {info.node} differently at the same time: "
                        "they are of two dives or two rigs; solve them apart"
                    )
        return {node: info for node, (_, info) in first.items()}

    def close(self) -> None:
        """Close all logs."""
        self._stack.close()

    def __enter__(self) -> Dive:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _infos_of(reader: DiveLogReader) -> Iterator[NodeInfo]:
    def wanted(key: str) -> bool:
        parsed = parse_key(key)
        return parsed is not None and parsed[0] is INFO

    if not any(wanted(key) for key in reader.keys):
        return
    for record in reader.records(wanted):
        try:
            yield decode(record.payload, NodeInfo)
        except MessageError:
            continue


def _rig(info: NodeInfo) -> NodeInfo:
    return msgspec.structs.replace(info, stamp_ns=0, software="", config_sha256="")


def _overlap(one: DiveLogReader, other: DiveLogReader) -> bool:
    if one.start_ns is None or one.end_ns is None or other.start_ns is None or other.end_ns is None:
        return False
    return one.start_ns <= other.end_ns and other.start_ns <= one.end_ns


def load_info(path: str) -> NodeInfo:
    """Read a NodeInfo from a JSON file, or the first one of a dive log; raise an error naming the file."""
    file = Path(path)
    if file.suffix == ".mcap":
        with DiveLogReader(file) as reader:
            info = next(_infos_of(reader), None)
        if info is None:
            raise ConfigError(f"{path}: holds no NodeInfo")
        return info
    try:
        return decode(file.read_bytes(), NodeInfo)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except MessageError as error:
        raise ConfigError(f"{path}: {error}") from error
