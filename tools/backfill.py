"""`buddyline backfill`: complete a topside recording from the nodes' own logs."""

from __future__ import annotations

import argparse
import heapq
import sys
import zlib
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
from buddyline.protocol.divelog import DiveLogReader, Record
from buddyline.protocol.errors import BuddylineError, MessageError
from buddyline.protocol.messages import Expect
from buddyline.protocol.topics import EXPECT
from buddyline.tools.authenticity import AUTHENTICITY, check_logs
from buddyline.tools.dives import Dive
from buddyline.tools.newfile import new_dive_log
from buddyline.tools.progress import followed

Stamps: TypeAlias = dict[str, tuple[np.ndarray, np.ndarray]]  # series: stamps (ns), sorted, and their payloads' CRC-32


class Union:
    """Chooses the messages of several logs' union: each series and stamp once, from the first log that has it."""

    def __init__(self) -> None:
        self.differing: Counter[str] = Counter()
        self._known: Stamps = {}

    def choose(self, reader: DiveLogReader) -> dict[str, np.ndarray]:
        """Read a log once; return for each series which of its messages, in their order, are new: (n,) bool."""
        stamps: defaultdict[str, array[int]] = defaultdict(lambda: array("q"))
        sums: defaultdict[str, array[int]] = defaultdict(lambda: array("L"))
        for record in followed(reader.records(), f"read {reader.path}", reader.start_ns, reader.end_ns):
            series = _series(record)
            stamps[series].append(_stamp_ns(record))
            sums[series].append(zlib.crc32(record.payload))
        return {series: self._choose(series, np.array(stamps[series]), np.array(sums[series])) for series in stamps}

    def _choose(self, series: str, stamps: np.ndarray, sums: np.ndarray) -> np.ndarray:
        known, known_sums = self._known.get(series, (np.empty(0, stamps.dtype), np.empty(0, sums.dtype)))
        every, every_sum = np.concatenate([known, stamps]), np.concatenate([known_sums, sums])
        kept, first, which = np.unique(every, return_index=True, return_inverse=True)
        self.differing[_key(series)] += int(np.count_nonzero(every_sum[first][which] != every_sum))
        self._known[series] = (kept, every_sum[first])
        new = np.zeros(len(every), bool)
        new[first] = True
        return new[len(known) :]


def run(args: argparse.Namespace) -> int:
    """Write the union of the logs; report what the topside recording had missed."""
    with Dive([args.topside, *args.nodes]) as dive:
        told = check_logs(dive.readers, args.authority)
        union = Union()
        # Nodes' own logs come first: their log times are the node's, and their pictures are not previews.
        topside = Path(args.topside)
        ordered = sorted(dive.readers, key=lambda reader: reader.path == topside)
        chosen = [union.choose(reader) for reader in ordered]
        before: Counter[str] = Counter()
        if ordered[-1].path == topside:
            for series, new in chosen[-1].items():
                before[_key(series)] += len(new)
        added: Counter[str] = Counter()
        streams = [_new(reader, new) for reader, new in zip(ordered, chosen, strict=True)]
        metadata = {
            **ordered[-1].metadata(),
            "backfilled_from": ", ".join(reader.path.name for reader in ordered),
            **({AUTHENTICITY: "; ".join(told)} if told else {}),
        }
        with new_dive_log(args.output, metadata) as writer:
            merged = heapq.merge(*streams, key=lambda record: record.log_time_ns)
            for record in followed(merged, "write", dive.start_ns, dive.end_ns):
                writer.write(
                    record.key, record.payload, record.log_time_ns, record.publish_time_ns, schema=record.schema_name
                )
                added[record.key] += 1
            if not added:
                raise BuddylineError(f"{dive.name}: no message can be read")
    for key, count in sorted(added.items()):
        differing = f", {union.differing[key]} differ (the node's own are kept)" if union.differing[key] else ""
        print(f"  {key}: {before[key]} topside, {count} now{differing}", file=sys.stderr)
    print(f"{args.output}: {sum(added.values())} messages, {before.total()} of them topside", file=sys.stderr)
    return 0


def _new(reader: DiveLogReader, new: dict[str, np.ndarray]) -> Iterator[Record]:
    at: Counter[str] = Counter()
    for record in reader.records():
        series = _series(record)
        if new[series][at[series]]:
            yield record
        at[series] += 1


def _series(record: Record) -> str:
    """Return in what a message's stamp is its own: its key, and of what a picture is to show, whose lights too.

    A node that sees two others has expectations of both for one picture.
    """
    if record.schema_name != EXPECT.schema_name:
        return record.key
    try:
        message = record.open().message
    except MessageError:
        return record.key
    return f"{record.key} {message.seen}" if isinstance(message, Expect) else record.key


def _key(series: str) -> str:
    return series.partition(" ")[0]


def _stamp_ns(record: Record) -> int:
    """Return what identifies a message of its key: its stamp, or its log time where it has none."""
    return min(record.publish_time_ns, 2**63 - 1)
