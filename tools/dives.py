"""Read stored dives: several logs as one dive, and one policy for damage.

What can be read is used. What cannot be read is listed in `Dive.losses`, by file and byte. `buddyline` prints these
losses on stderr and exits with 1; no command has to do that itself.
"""

from __future__ import annotations

import heapq
import logging
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Final, TypeVar

import msgspec
from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import ConfigError
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.envelope import Envelope, Refusals, read_message
from buddyline.protocol.errors import BuddylineError, MessageError
from buddyline.protocol.messages import Message, NodeInfo, NodePose, Rejected, RelativePose, Track
from buddyline.protocol.pictures import with_pictures
from buddyline.protocol.topics import INFO, NET_POSE, TOPICS, Topic, parse_key
from buddyline.tools import losses
from buddyline.tools.clock_sets import ClockSets
from buddyline.tools.progress import Progress

log = logging.getLogger(__name__)

M = TypeVar("M", bound=Message)

_NAMES: Final = frozenset(topic.name for topic in TOPICS)
_OUTCOMES: Final = (RelativePose, Rejected)
_ROWS: Final = (Track, NodePose)


@dataclass
class _Pass:
    """Counts what one reading of a dive left out: bad messages, by log, and second outcomes of triggers, by pair."""

    refusals: dict[Path, Refusals] = field(default_factory=dict)
    repeated: Counter[str] = field(default_factory=Counter)


class Dive:
    """One dive out of one or more logs (each node's own, say), with the pictures beside them.

    An empty log is left out where there are others. Raises BuddylineError for a file that is no dive log, and where
    two logs describe a node differently at the same time. one_rig: False allows that, for a solved log beside the
    logs that it was made from.
    """

    def __init__(self, paths: Sequence[str] | Sequence[Path], *, one_rig: bool = True) -> None:
        self._stack = ExitStack()
        self._passes: list[_Pass] = []
        self._left_out: list[str] = []
        self._one_rig = one_rig
        self._closed = False
        self.readers: list[DiveLogReader] = []
        try:
            with_content, self._left_out = _without_empty(with_pictures(_distinct(paths)))
            for path in with_content:
                self.readers.append(self._stack.enter_context(DiveLogReader(path)))
            self._clock_sets = ClockSets(self.readers)
            self._infos = self._first_infos()
        except BaseException:
            self.close()
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
        """Log time of the first message; raises if no log has any."""
        starts = [start_ns for start_ns, _ in self._spans_ns if start_ns is not None]
        if not starts:
            raise BuddylineError(f"{self.name}: no message can be read")
        return min(starts)

    @cached_property
    def end_ns(self) -> int:
        """Log time of the last message."""
        return max((end_ns for _, end_ns in self._spans_ns if end_ns is not None), default=0)

    @cached_property
    def _spans_ns(self) -> list[tuple[int | None, int | None]]:
        return [self._clock_sets.span_ns(reader) for reader in self.readers]

    @property
    def seconds(self) -> float:
        """From the first message to the last; 0 if there is none."""
        starts = [start_ns for start_ns, _ in self._spans_ns if start_ns is not None]
        return (self.end_ns - min(starts)) / S_NS if starts else 0.0

    @property
    def losses(self) -> list[str]:
        """What could not be read so far, a line each: file, byte or key, loss."""
        found = [*self._left_out, *(f"{reader.path}: {text}" for reader in self.readers for text in reader.damage)]
        return found + [f"{path}: {line}" for path, refusals in self._refusals().items() for line in refusals.lines()]

    @property
    def refused(self) -> int:
        """How many messages were refused so far."""
        return sum(refusals.count for refusals in self._refusals().values())

    @property
    def repeated(self) -> dict[str, int]:
        """How many second outcomes of a trigger were left out so far, by pair (`a/b`)."""
        return {key: max(one.repeated[key] for one in self._passes) for one in self._passes for key in one.repeated}

    def _refusals(self) -> dict[Path, Refusals]:
        # Every reading of a dive meets the same bad messages, so the longest reading has the right count.
        found: dict[Path, Refusals] = {}
        for reading in self._passes:
            for path, refusals in reading.refusals.items():
                if path not in found or refusals.count > found[path].count:
                    found[path] = refusals
        return found

    def nodes(self, *topic_names: str) -> list[str]:
        """Return the ids of the nodes that have one of these topics, sorted."""
        found = [parsed for key in filter(_wanted(topic_names), self.keys) if (parsed := parse_key(key))]
        return sorted(
            {one for topic, ids in found for field, one in zip(topic.id_fields, ids, strict=True) if field != "net"}
        )

    def ids(self, *topic_names: str) -> list[tuple[str, ...]]:
        """Return the ids, of nodes or pairs, that these topics have in the logs, sorted."""
        return sorted({parsed[1] for key in filter(_wanted(topic_names), self.keys) if (parsed := parse_key(key))})

    def messages(self, *topic_names: str, since_ns: int | None = None, doing: str = "") -> Iterator[Envelope]:
        """Yield the sound messages of these topics (none named: of all), by log time.

        Of two outcomes of one trigger the first counts, and of two rows of a track, or of a node in a net, with one
        stamp and mode. since_ns: the least log time. doing: shows progress under this name.
        """
        if not doing:
            yield from self._first_results(topic_names, since_ns)
            return
        with Progress(doing, self.seconds) as progress:
            for envelope in self._first_results(topic_names, since_ns):
                progress.show((envelope.time_ns - self.start_ns) / S_NS)
                yield envelope

    def all_of(self, topic: Topic, kind: type[M], *, doing: str = "") -> Iterator[M]:
        """Yield the messages of one topic, as of their type."""
        for envelope in self.messages(topic.name, doing=doing):
            if isinstance(envelope.message, kind):
                yield envelope.message

    def _first_results(self, topic_names: Iterable[str], since_ns: int | None) -> Iterator[Envelope]:
        reading = _Pass()
        wanted = _wanted(topic_names)
        streams = [self._open(reader, wanted, since_ns, reading) for reader in self.readers]
        answered: set[tuple[tuple[str, ...], int]] = set()
        rows_ns: dict[tuple[str, str], set[int]] = defaultdict(set)
        self._passes.append(reading)
        for envelope in heapq.merge(*streams, key=lambda envelope: envelope.time_ns):
            message = envelope.message
            if isinstance(message, _OUTCOMES):
                if (envelope.ids, message.trigger) in answered:
                    reading.repeated["/".join(envelope.ids)] += 1
                    continue
                answered.add((envelope.ids, message.trigger))
            elif isinstance(message, _ROWS):
                of_mode = rows_ns[envelope.key, message.mode]
                if message.stamp_ns in of_mode:
                    continue
                of_mode.add(message.stamp_ns)
            yield envelope

    def _open(
        self, reader: DiveLogReader, wanted: Callable[[str], bool], since_ns: int | None, reading: _Pass
    ) -> Iterator[Envelope]:
        def refuse(key: str, error: MessageError) -> None:
            reading.refusals.setdefault(reader.path, Refusals()).note(key, error)

        return self._clock_sets.envelopes(reader, wanted, since_ns, refuse)

    def metadata(self) -> dict[str, str]:
        """Return the metadata of the logs; the first named log takes precedence."""
        noted: dict[str, str] = {}
        for reader in reversed(self.readers):
            noted |= reader.metadata()
        return noted

    def infos(self) -> dict[str, NodeInfo]:
        """Return the first sound NodeInfo of each node."""
        return dict(self._infos)

    def _first_infos(self) -> dict[str, NodeInfo]:
        """Return the first NodeInfo of each node, the first named log's where several have one."""
        first: dict[str, tuple[DiveLogReader, NodeInfo]] = {}
        reading = _Pass()
        self._passes.append(reading)
        for reader in self.readers:
            for envelope in self._open(reader, _wanted((INFO.name,)), None, reading):
                info = envelope.message
                if not isinstance(info, NodeInfo):
                    continue
                other, known = first.setdefault(info.node, (reader, info))
                if self._one_rig and _rig(known) != _rig(info) and other is not reader and _overlap(other, reader):
                    raise BuddylineError(
                        f"{other.path} and {reader.path} describe node {info.node} differently at the same time: "
                        "they are of two dives or two rigs; solve them apart"
                    )
        return {node: info for node, (_, info) in first.items()}

    def close(self) -> None:
        """Close all logs, and report the losses to the command line."""
        self._stack.close()
        if self._closed:
            return
        self._closed = True
        losses.report(self.losses)
        for pair, count in self.repeated.items():
            log.warning("%s: %d second outcomes of triggers of %s left out: the first counts", self.name, count, pair)

    def __enter__(self) -> Dive:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def open_each(paths: Sequence[str], stack: ExitStack) -> list[Dive]:
    """Open each log as a dive of its own, where some logs take precedence over others; the stack closes them."""
    with_content, left_out = _without_empty(_distinct(paths))
    losses.report(left_out)
    return [stack.enter_context(Dive([path])) for path in with_content]


def first_with_net(logs: Sequence[Dive]) -> Dive:
    """Return the first log that has poses of a net; raise BuddylineError if none has."""
    for log_of_net in logs:
        if log_of_net.ids(NET_POSE.name):
            return log_of_net
    names = ", ".join(one.name for one in logs)
    raise BuddylineError(f"{names}: no poses of a net in it; solve it with three nodes or a fixed one")


def _distinct(paths: Sequence[str] | Sequence[Path]) -> list[Path]:
    """Return the paths; raise BuddylineError if one is named twice."""
    seen: set[Path] = set()
    for path in map(Path, paths):
        if path.resolve() in seen:
            raise BuddylineError(f"{path}: is named twice")
        seen.add(path.resolve())
    return [Path(path) for path in paths]


def _without_empty(paths: list[Path]) -> tuple[list[Path], list[str]]:
    """Leave out empty files, unless all are; return the others, and a line for each that is left out."""
    empty = [path for path in paths if path.is_file() and path.stat().st_size == 0]
    if len(empty) == len(paths):
        return paths, []
    lines = [f"{path}: is empty (0 bytes): nothing was recorded in it; left out" for path in empty]
    return [path for path in paths if path not in empty], lines


def _wanted(topic_names: Iterable[str]) -> Callable[[str], bool]:
    names = frozenset(topic_names)
    if names - _NAMES:
        raise ValueError(f"no topic is named {', '.join(sorted(names - _NAMES))}")

    def wanted(key: str) -> bool:
        parsed = parse_key(key)
        return parsed is not None and (not names or parsed[0].name in names)

    return wanted


def _rig(info: NodeInfo) -> NodeInfo:
    return msgspec.structs.replace(info, stamp_ns=0, software="", config_sha256="")


def _overlap(one: DiveLogReader, other: DiveLogReader) -> bool:
    if one.start_ns is None or one.end_ns is None or other.start_ns is None or other.end_ns is None:
        return False
    return one.start_ns <= other.end_ns and other.start_ns <= one.end_ns


def load_info(path: str, node: str | None = None) -> NodeInfo:
    """Read a NodeInfo from a JSON file, or node's (default: the first one) of a log; raise an error naming the file."""
    file = Path(path)
    if file.suffix == ".mcap":
        with Dive([file]) as dive:
            infos = dive.infos()
        if not infos or (node is not None and node not in infos):
            of_node = f" of node {node}; it has {', '.join(infos) or 'none'}" if node is not None else ""
            raise ConfigError(f"{path}: holds no NodeInfo{of_node}")
        return infos[node or next(iter(infos))]
    try:
        return read_message(file, NodeInfo)
    except MessageError as error:
        raise ConfigError(str(error)) from error
