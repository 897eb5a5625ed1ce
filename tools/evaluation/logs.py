"""Reads what is to be evaluated, or exported, out of dive logs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Final

from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.errors import BuddylineError, MessageError
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    LightTruth,
    Message,
    NodeInfo,
    Rejected,
    RelativePose,
    Truth,
)
from buddyline.protocol.topics import (
    ARTAG,
    ATTITUDE,
    CANDIDATES,
    INFO,
    LIGHT_TRUTH,
    POSE,
    REJECTED,
    TRUTH,
    Topic,
    parse_key,
)
from buddyline.tools.evaluation.recorded import Pair, Recorded
from buddyline.tools.evaluation.truth import inverted
from buddyline.tools.progress import Progress

_RESULTS: Final = (POSE, REJECTED)
# Where a log has no result of the solver's: poses from tags are measured as any others.
_TAGS: Final = (ARTAG,)
_TRUTHS: Final = (TRUTH, LIGHT_TRUTH)


def parse_pair(text: str) -> Pair:
    """Return the two node ids of `A/B`; raise BuddylineError otherwise."""
    parsed = parse_key(f"buddyline/pair/{text}/pose")
    if parsed is None:
        raise BuddylineError(f"--pair {text}: give A/B, two node ids")
    return parsed[1][0], parsed[1][1]


def _names(readers: Sequence[DiveLogReader]) -> str:
    return ", ".join(str(reader.path) for reader in readers)


def _ids(readers: Sequence[DiveLogReader], *topics: Topic) -> list[tuple[str, ...]]:
    parsed = [parse_key(key) for reader in readers for key in reader.keys]
    return sorted({found[1] for found in parsed if found is not None and found[0] in topics})


def _results(readers: Sequence[DiveLogReader]) -> tuple[Topic, ...]:
    return _RESULTS if _ids(readers, *_RESULTS) else _TAGS


def _choose_pair(readers: Sequence[DiveLogReader], wanted: Pair | None) -> Pair:
    pairs = [(ids[0], ids[1]) for ids in _ids(readers, *_results(readers)) or _ids(readers, TRUTH)]
    if not pairs:
        nodes = [ids[0] for ids in _ids(readers, CANDIDATES)]
        pairs = [(nodes[0], nodes[-1])] if nodes else []
    if wanted is not None:
        if wanted not in pairs and wanted[::-1] not in pairs:
            have = ", ".join("/".join(pair) for pair in pairs) or "none"
            raise BuddylineError(f"{_names(readers)}: nothing of pair {'/'.join(wanted)}; pairs: {have}")
        return wanted if wanted in pairs else (wanted[1], wanted[0])
    if len(pairs) > 1:
        listed = ", ".join("/".join(pair) for pair in pairs)
        raise BuddylineError(f"{_names(readers)}: holds pairs {listed}; choose one with --pair A/B")
    if not pairs:
        raise BuddylineError(
            f"{_names(readers)}: no poses in it; solve it first: buddyline solve DIVE.mcap -o OUT.mcap"
        )
    return pairs[0]


def _messages(
    reader: DiveLogReader, topics: Sequence[Topic], progress: Progress, problems: list[str]
) -> Iterator[tuple[Topic, tuple[str, ...], Message]]:
    """Yield a log's sound messages of these topics with their ids."""
    bad = 0
    first_bad = ""

    def wanted(key: str) -> bool:
        parsed = parse_key(key)
        return parsed is not None and parsed[0] in topics

    start_ns = reader.start_ns or 0
    for record in reader.records(wanted):
        progress.show((record.log_time_ns - start_ns) / 1e9)
        parsed = parse_key(record.key)
        try:
            message = record.decode()
        except MessageError as error:
            bad += 1
            first_bad = first_bad or f"{record.key}: {error}"
            continue
        if parsed is not None and message is not None:
            yield *parsed, message
    if bad:
        problems.append(f"{reader.path}: {bad} messages that could not be used, the first: {first_bad}")
    problems.extend(f"{reader.path}: {text}" for text in reader.damage if f"{reader.path}: {text}" not in problems)


def _take(recorded: Recorded, topic: Topic, ids: tuple[str, ...], message: Message) -> None:
    """Sort one message in; those of other nodes and pairs are dropped, and of two NodeInfo the first stays."""
    nodes = recorded.nodes
    if isinstance(message, Truth):
        if ids == nodes:
            recorded.truths.append(message)
        elif ids == nodes[::-1]:
            recorded.truths.append(inverted(message))
    elif len(ids) == 2 and ids != nodes:
        return
    elif isinstance(message, RelativePose):
        recorded.poses.append(message)
    elif isinstance(message, Rejected):
        recorded.rejected.append(message)
    elif getattr(message, "node", None) not in nodes:
        return
    elif isinstance(message, Candidates):
        recorded.candidates.append(message)
    elif isinstance(message, LightTruth):
        recorded.light_truths.append(message)
    elif isinstance(message, Attitude) and message.node == nodes[0]:
        recorded.attitudes_a.append(message)
    elif isinstance(message, NodeInfo):
        recorded.infos.setdefault(message.node, message)


def load(paths: Sequence[str], truth_paths: Sequence[str] = (), pair: Pair | None = None) -> Recorded:
    """Read one pair's messages.

    Poses and rejections are those of the first log named that holds any. Truth comes from truth_paths alone where
    they hold it. Of Candidates and NodeInfo of several logs, the first named stand first.
    """
    with ExitStack() as stack:
        logs = [stack.enter_context(DiveLogReader(path)) for path in paths]
        truth_logs = [stack.enter_context(DiveLogReader(path)) for path in truth_paths]
        recorded = Recorded(_choose_pair([*logs, *truth_logs], pair))
        results = _results(logs)
        answering = [log for log in logs if _ids([log], *results)]
        recorded.environment = next((log.metadata().get("environment", "") for log in [*logs, *truth_logs]), "")
        for log in answering[1:]:
            recorded.problems.append(f"{log.path}: its poses are left out, those of {answering[0].path} are taken")
        sighted = {topic.name for topic in _TRUTHS if _ids(truth_logs, topic)}
        for log in [*logs, *truth_logs]:
            topics: list[Topic] = [INFO, CANDIDATES]
            if log in answering[:1]:
                topics += results
            if answering:
                topics += [ATTITUDE]
            topics += [topic for topic in _TRUTHS if log in truth_logs or topic.name not in sighted]
            with Progress(f"read {log.path.name}", ((log.end_ns or 0) - (log.start_ns or 0)) / 1e9) as progress:
                for topic, ids, message in _messages(log, topics, progress, recorded.problems):
                    _take(recorded, topic, ids, message)
    return recorded


def load_for_evaluation(paths: Sequence[str], truth_paths: Sequence[str] = (), pair: Pair | None = None) -> Recorded:
    """Read one pair's messages; raise BuddylineError where nothing can be compared with truth."""
    recorded = load(paths, truth_paths, pair)
    named = ", ".join([*paths, *truth_paths])
    answered = recorded.poses or recorded.rejected
    if not recorded.truths and not (recorded.light_truths and not answered):
        raise BuddylineError(f"{named}: no truth of pair {'/'.join(recorded.nodes)}; name its log with --truth T.mcap")
    if not answered and not (recorded.candidates and recorded.light_truths):
        raise BuddylineError(
            f"{', '.join(paths)}: no poses in it; solve it first: buddyline solve DIVE.mcap -o OUT.mcap"
        )
    return recorded
