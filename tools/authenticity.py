"""Say whether logs are what their nodes wrote, by the nodes' digests (protocol.digest_check)."""

from __future__ import annotations

import heapq
import logging
from collections import defaultdict
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.digest import is_covered
from buddyline.protocol.digest_check import DigestCheck, Discrepancy, Refuses
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.pictures import SUFFIX
from buddyline.protocol.topics import DIGEST, parse_key
from buddyline.tools import losses

log = logging.getLogger(__name__)

# The name of the lines of `check_logs` in a new log's metadata.
AUTHENTICITY: Final = "authenticity"

_WORDS: Final = {
    "altered": "is not what the node wrote",
    "missing": "is not complete, and the rest of these seconds is not verified",
    "unsigned": "has something that nobody vouches for, which is no sign of forgery",
}


def digest_check(authority: Path | str | None, *, own: bool = True) -> DigestCheck:
    """Return a check that accepts the authority's nodes; without the package cryptography, one of the sums alone."""
    try:
        from buddyline.protocol.signing import Trust
    except ImportError:
        if authority is not None:
            log.warning("signatures are not checked: the package cryptography is missing (`make install EXTRAS=keys`)")
        return DigestCheck(own=own)
    refuses: Refuses = Trust(authority).refuses
    return DigestCheck(refuses, must_sign=authority is not None, own=own)


def check_logs(readers: Sequence[DiveLogReader], authority: str | None) -> list[str]:
    """Compare each log with its nodes' digests; return a line for each node, and report what was altered as a loss.

    Logs without digests are left out, unless an authority is named.
    """
    lines: list[str] = []
    folders = {reader.path.parent for reader in readers}
    for reader in readers:
        if reader.path.parent.suffix == SUFFIX and reader.path.parent.with_suffix(".mcap").parent in folders:
            continue
        nodes = _nodes(reader)
        signed = [node for node in nodes if DIGEST.key(node) in reader.keys]
        if not signed and authority is None:
            continue
        # In a node's own log, in the order of the file: log times go back where its clock was set. A recording has
        # at its end what came late.
        own = "boot" in reader.metadata()
        # Before anything is said of signatures: it refuses an authority that is no certificate.
        check = digest_check(authority, own=own)
        if authority is not None:
            unsigned = [f"{reader.path}: node {node}: is not signed" for node in nodes if node not in signed]
            losses.report(unsigned)
            lines += unsigned
        if not signed:
            continue
        pictures = reader.path.with_suffix(SUFFIX)
        together = [reader, *(one for one in readers if one.path.parent == pictures)]
        found: list[Discrepancy] = []
        streams = [one.stored(_is_told) if own else one.records(_is_told) for one in together]
        for record in heapq.merge(*streams, key=lambda record: record.log_time_ns):
            found += check.add(record.key, record.payload, record.log_time_ns)
        found += check.finish()
        lines += report(str(reader.path), check, found)
    return lines


def report(name: str, check: DigestCheck, found: Iterable[Discrepancy]) -> list[str]:
    """Log what was found of each node; return it as lines. What was altered is a loss."""
    lines: list[str] = []
    by_kind: dict[tuple[str, str], list[Discrepancy]] = defaultdict(list)
    for finding in found:
        by_kind[finding.node, finding.kind].append(finding)
    for node, of in sorted(check.nodes.items()):
        if of.newest:
            signed = f", {of.signed} of them signed" if of.signed else ", none of them signed"
            lines.append(f"{name}: node {node}: {of.seconds} s are as the node wrote them{signed}")
            log.info("%s", lines[-1])
    for (node, kind), findings in sorted(by_kind.items()):
        first = min(findings, key=lambda one: one.since_ns)
        at = datetime.fromtimestamp(min(first.since_ns, 2**61) / S_NS, UTC)
        seconds = len({one.since_ns for one in findings})
        since = f"from {at:%Y-%m-%d %H:%M:%S} UTC on ({first.words}), {seconds} s in all"
        lines.append(f"{name}: node {node}: {_WORDS[kind]}, {since}")
        if kind == "altered":
            losses.report(lines[-1:])
        log.log(logging.INFO if kind == "unsigned" else logging.WARNING, "%s", lines[-1])
    return lines


def _nodes(reader: DiveLogReader) -> list[str]:
    parsed = [one for key in reader.keys if (one := parse_key(key))]
    return sorted({ids[0] for topic, ids in parsed if is_covered(topic)})


def _is_told(key: str) -> bool:
    parsed = parse_key(key)
    return parsed is not None and (parsed[0] is DIGEST or is_covered(parsed[0]))
