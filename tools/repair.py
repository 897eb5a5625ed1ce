"""`buddyline repair`: make a complete, indexed log from a damaged one, and report what was lost."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.parity import restore
from buddyline.tools import losses
from buddyline.tools.newfile import new_dive_log
from buddyline.tools.progress import followed

SHOWN_GAPS: Final = 20


def run(args: argparse.Namespace) -> int:
    """Repair one log; say what was lost."""
    # A wrong index would hide chunks; walking through the file finds them.
    with healed(Path(args.input), Path(args.output)) as path, DiveLogReader(path, trust_index=False) as reader:
        numbers, times_ns = array("q"), array("q")
        metadata = {**reader.metadata(), "repaired_from": Path(args.input).name}
        with new_dive_log(args.output, metadata) as writer:
            for record in followed(reader.records(), "repair", reader.start_ns, reader.end_ns):
                writer.write(
                    record.key, record.payload, record.log_time_ns, record.publish_time_ns, schema=record.schema_name
                )
                numbers.append(record.sequence)
                times_ns.append(min(record.log_time_ns, 2**63 - 1))
        lines = [*reader.damage, *missing(np.array(numbers, np.int64), np.array(times_ns, np.int64))]
    losses.report([f"{args.input}: {line}" for line in lines])
    intact = "it was whole" if path == Path(args.input) else "nothing of it is lost"
    verdict = "what could be read of it" if lines else intact
    print(f"{args.output}: {len(numbers)} messages; {verdict}", file=sys.stderr)
    return 0


@contextmanager
def healed(path: Path, beside: Path) -> Iterator[Path]:
    """Yield the log, or a copy whose damaged bytes are restored from the log's parity, and say so.

    The copy is beside another path while it is used.
    """
    try:
        patches, lost = restore(path) if path.is_file() and path.stat().st_size else ({}, 0)
    except OSError as error:
        raise BuddylineError(f"{path}: cannot be read: {error.strerror}") from error
    if lost:
        print(f"{path}: {lost} damaged blocks are more than their parity restores", file=sys.stderr)
    if not patches:
        yield path
        return
    try:
        part = tempfile.NamedTemporaryFile(dir=beside.parent, prefix=f"{beside.name}.", suffix=".part")
    except OSError as error:
        raise BuddylineError(f"{beside}: cannot be written: {error.strerror}") from error
    with part as copy:
        with open(path, "rb") as damaged:
            shutil.copyfileobj(damaged, copy)
        for offset, block in patches.items():
            copy.seek(offset)
            copy.write(block)
        copy.flush()
        size = sum(map(len, patches.values()))
        print(f"{path}: {len(patches)} damaged blocks ({size} bytes) restored from the parity", file=sys.stderr)
        yield Path(copy.name)


def missing(numbers: np.ndarray, times_ns: np.ndarray) -> list[str]:
    """Return a line for each gap in the messages' sequence numbers.

    numbers, times_ns: (n,) int, in any order. If the writer did not number its messages, no loss can be found;
    messages lost after the last one are not seen.
    """
    order = np.argsort(numbers, kind="stable")
    numbers, times_ns = numbers[order], times_ns[order]
    if len(numbers) == 0 or (np.diff(numbers) == 0).any():
        return []
    lines = [f"{numbers[0]} messages are lost before {_clock(times_ns[0])}"] if numbers[0] else []
    for i in np.flatnonzero(np.diff(numbers) > 1):
        lost = numbers[i + 1] - numbers[i] - 1
        lines.append(f"{lost} messages are lost between {_clock(times_ns[i])} and {_clock(times_ns[i + 1])}")
    if len(lines) > SHOWN_GAPS:
        total = numbers[-1] + 1 - len(numbers)
        lines = [*lines[:SHOWN_GAPS], f"and more: {total} messages are lost in {len(lines)} gaps"]
    return lines


def _clock(time_ns: int) -> str:
    seconds, ns = divmod(int(time_ns), S_NS)
    return f"{time.strftime('%Y-%m-%d %H:%M:%S', time.gmtime(seconds))}.{ns // 1_000_000:03d} UTC"
