"""`buddyline solve`: the whole pipeline on stored dives, offline and deterministic."""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Iterator
from pathlib import Path

from buddyline.protocol.config import ConfigError
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CompressedImage, NodeInfo, Rejected, RelativePose
from buddyline.protocol.topics import check_node_id
from buddyline.solver_service.config import CHECKS, METHODS, SolveConfig
from buddyline.solver_service.core import SolverCore
from buddyline.tools.dives import Dive, load_info
from buddyline.tools.newfile import new_dive_log

log = logging.getLogger(__name__)

# What the output carries beside the poses, so that it can be evaluated and solved again on its own.
COPIED = ("info", "candidates", "imu", "attitude", "depth", "mark", "truth", "light_truth", "net_truth")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="one dive: its log, or each node's own")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.mcap", help="poses, rejections, and their inputs")
    parser.add_argument("--method", choices=METHODS, default="refined", help="default: refined")
    parser.add_argument(
        "--checks", default=",".join(CHECKS), help=f"comma-separated, of {', '.join(CHECKS)} (default: all)"
    )
    parser.add_argument("--nodes", nargs=2, metavar=("A", "B"), help="the pair; default: the dive's two nodes")
    parser.add_argument(
        "--info",
        action="append",
        default=[],
        metavar="NODE=FILE",
        help="calibration in place of the log's: JSON or log",
    )
    parser.add_argument(
        "--clock-offset",
        type=float,
        default=0.0,
        metavar="S",
        help="B's clock minus A's, as `buddyline align` tells it",
    )
    parser.add_argument("--environment", default="auto", help="for dives of pictures; default: auto")
    parser.add_argument("--detector", default="source", help="for dives of pictures; default: source")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def run(args: argparse.Namespace) -> int:
    """Solve a dive; return 0, or 1 where not one trigger was resolved."""
    settings = SolveConfig(method=args.method, checks=[check for check in args.checks.split(",") if check]).settings(
        "--checks"
    )
    replaced = replacements(args.info)
    with Dive(args.dives) as dive:
        node_a, node_b = pair_of(dive, args.nodes)
        infos = dive.infos() | replaced
        for node in (node_a, node_b):
            if node not in infos:
                raise BuddylineError(f"{dive.name}: no NodeInfo of node {node}; give one with --info {node}=FILE")
        core = SolverCore(node_a, node_b, settings, round(args.clock_offset * 1e9))
        began_s = time.monotonic()
        metadata = dive.metadata() | {"command": "solve", "method": args.method, "checks": args.checks}
        with new_dive_log(args.output, metadata) as writer:
            for info in replaced.values():
                core.handle(info)
                writer.write_message(info, dive.start_ns)
            for envelope in messages_of(dive, args, infos, node_a, node_b, doing="solve"):
                message = envelope.message
                if isinstance(message, NodeInfo) and message.node in replaced:
                    continue
                writer.write(envelope.key, envelope.payload, envelope.time_ns)
                _write(writer, core.handle(message))
            _write(writer, core.flush())
        bad = dive.refused
    _summarize(args, core, bad, time.monotonic() - began_s)
    resolved = sum(core.counts.values())
    if resolved == 0:
        log.error("no trigger was resolved: the dive holds no candidates of %s or %s", node_a, node_b)
    elif core.matched == 0:
        log.error("nodes %s and %s have no trigger in common: are the logs of the same dive?", node_a, node_b)
    return 0 if core.matched else 1


def replacements(given: list[str]) -> dict[str, NodeInfo]:
    """Read the calibrations of `--info NODE=FILE`."""
    replaced = {}
    for text in given:
        node, equals, path = text.partition("=")
        if not equals:
            raise ConfigError(f"--info {text}: give NODE=FILE")
        info = load_info(path)
        if info.node != check_node_id(node):
            raise ConfigError(f"--info {text}: the file describes node {info.node}")
        replaced[node] = info
    return replaced


def pair_of(dive: Dive, given: list[str] | None) -> tuple[str, str]:
    """Return the pair to solve: the given one, or the dive's two nodes; raise where there is none."""
    present = dive.nodes("candidates", "image")
    if given:
        missing = [node for node in given if node not in present]
        if missing:
            raise BuddylineError(
                f"{dive.name}: holds nothing of node {missing[0]}; it has {', '.join(present) or 'none'}"
            )
        return given[0], given[1]
    if len(present) < 2:
        have = f"only of node {present[0]}" if present else "of no node"
        raise BuddylineError(f"{dive.name}: candidates or pictures {have}; give the logs of both nodes")
    if len(present) > 2:
        raise BuddylineError(f"{dive.name}: nodes {', '.join(present)}; choose a pair with --nodes A B")
    return present[0], present[1]


def messages_of(
    dive: Dive, args: argparse.Namespace, infos: dict[str, NodeInfo], *pair: str, doing: str
) -> Iterator[Envelope]:
    """Yield what the solver and the output need; the pictures of a node without candidates are detected."""
    raw = [node for node in pair if node not in dive.nodes("candidates")]
    detector = None
    if raw:
        from buddyline.tools.detect import DiveDetector

        detector = DiveDetector(args.detector, args.environment, infos)
    topics = (*COPIED, "image") if raw else COPIED
    for envelope in dive.messages(*topics, doing=doing):
        if len(envelope.ids) == 1 and envelope.node not in pair:
            continue
        if not isinstance(envelope.message, CompressedImage):
            yield envelope
        elif detector is not None and envelope.node in raw:
            found = detector.candidates(envelope)
            if found is not None:
                yield found


def _write(writer: DiveLogWriter, results: list[RelativePose | Rejected]) -> None:
    for result in results:
        writer.write_message(result)


def _summarize(args: argparse.Namespace, core: SolverCore, bad: int, took_s: float) -> None:
    resolved = sum(core.counts.values())
    rejected = {reason: count for reason, count in sorted(core.counts.items()) if reason != "solved"}
    if args.json:
        print(
            json.dumps(
                {
                    "node_a": core.node_a,
                    "node_b": core.node_b,
                    "triggers": resolved,
                    "matched": core.matched,
                    "solved": core.counts["solved"],
                    "rejected": rejected,
                    "bad_messages": bad,
                    "seconds": took_s,
                    "output": str(Path(args.output)),
                }
            )
        )
        return
    print(f"{args.output}: {core.counts['solved']} poses of {resolved} triggers, nodes {core.node_a} and {core.node_b}")
    for reason, count in rejected.items():
        print(f"  {count:6d} {reason}")
    if bad:
        print(f"  {bad:6d} messages that could not be used")
    print(f"  {took_s:.1f} s, {resolved / max(took_s, 1e-9):.0f} triggers/s")
