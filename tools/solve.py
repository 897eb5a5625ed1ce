"""`buddyline solve`: the whole pipeline on stored dives, offline and deterministic."""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations, islice
from pathlib import Path
from typing import Final

from buddyline.node.choices import DETECTORS
from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import ConfigError, load_config
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.health import CLOCKS_APART_S
from buddyline.protocol.messages import CompressedImage, Message, NodeInfo, NodePose, SolverStatus, Track
from buddyline.protocol.topics import TRACK
from buddyline.solver_service.clock_curve import ClockCurve
from buddyline.solver_service.config import SolveConfig, node_ids, track_settings
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.pair_core import PairCore, PairId
from buddyline.tools.authenticity import AUTHENTICITY, check_logs
from buddyline.tools.clock_curves import APART, CURVES, apart_problem, apart_text, chosen_curves, curves_text
from buddyline.tools.dives import Dive, load_info
from buddyline.tools.newfile import new_dive_log
from buddyline.tools.option_values import node_files
from msgspec import UNSET
from msgspec.structs import replace

log = logging.getLogger(__name__)

# This many messages are matched before the matched triggers are solved, all at once.
TOGETHER: Final = 2048
# Half a trigger period at 10 Hz. An offset with a larger sd (1 sd) does not tell which pictures were taken together.
CLOCK_KNOWN_S: Final = 0.05
# Clocks are named as apart where the track's offset is above CLOCKS_APART_S, and above this many of its sigmas.
CLOCK_SIGMAS: Final = 4.0
# A track of single lamps may be wrong about its clocks: an offset is advised where it is known this well, 1 sd.
ADVISED_SIGMA_S: Final = 0.01
# A track whose rows are further apart is told in parts.
PART_S: Final = 1.0
# The inputs that the output has beside the poses, so that it can be evaluated and solved again without other logs.
COPIED = ("info", "candidates", "imu", "attitude", "depth", "mark", "truth", "light_truth", "net_truth")


class _ClocksApartError(Exception):
    """A dive was solved before its track had told how far its nodes' clocks are apart."""

    def __init__(self, apart_s: dict[PairId, float]) -> None:
        super().__init__()
        self.apart_s = apart_s


@dataclass(frozen=True, eq=False)
class _StoredDive:
    """A dive and how to solve it. lone: nodes of lamps alone, or of a camera alone: in the network, and in no pair."""

    args: argparse.Namespace
    dive: Dive
    settings: Settings
    nodes: list[str]
    lone: list[str]
    infos: dict[str, NodeInfo]
    replaced: dict[str, NodeInfo]
    curves: dict[str, ClockCurve]
    attitudes: list[Envelope]
    metadata: dict[str, str]

    def solve(self) -> _DiveSolved:
        """Solve the dive and write the output; once more where its track finds the clocks apart."""
        try:
            return self._solve({})
        except _ClocksApartError as found:
            apart_s = found.apart_s
        log.info("clocks: the track has found them apart; solving again, with poses that count it")
        return self._solve(apart_s)

    def _solve(self, apart_s: dict[PairId, float]) -> _DiveSolved:
        """Solve the dive and write the output.

        apart_s: how far pairs' clocks are apart, empty where that is not known yet. Raises _ClocksApartError, and
        writes nothing, if the tracks have told it then.
        """
        args, dive = self.args, self.dive
        core = SolverCore(
            self.settings,
            [pair for pair in combinations(self.nodes, 2) if all(_is_full(self.infos[node]) for node in pair)],
            self.curves,
            apart_s=apart_s,
            track=track_settings(args.track, args.track_hz),
            lone=self.lone,
        )
        tracks = defaultdict[tuple[str, ...], Tracked](Tracked)
        with new_dive_log(args.output, self.metadata | {APART: apart_text(apart_s)}) as writer:
            for info in self.replaced.values():
                core.handle(info)
                writer.write_message(info, dive.start_ns)
            envelopes = messages_of(
                dive,
                self.infos,
                *dict.fromkeys([*self.nodes, *self.lone]),
                detector=args.detector,
                environment=args.environment,
                doing="solve again" if apart_s else "solve",
            )
            if self.attitudes:
                from buddyline.tools.attitudes import in_place_of

                envelopes = in_place_of(envelopes, self.attitudes)
            while together := list(islice(envelopes, TOGETHER)):
                sound = [envelope for envelope in together if not is_replaced(envelope.message, self.replaced)]
                for envelope in sound:
                    writer.write(envelope.key, envelope.payload, envelope.time_ns, envelope.stamp_ns)
                _write(writer, core.handle_many(envelope.message for envelope in sound), tracks)
            _write(writer, core.finish(), tracks)
            bad = dive.refused
            if not apart_s and (found_s := clocks_apart(core)):
                raise _ClocksApartError(found_s)
            for pair in core.pairs.values():
                # What the whole dive told: counts, the clocks' offset, problems. There is no diver left to advise.
                problems = core.health.of_dive(pair.nodes)
                status = pair.report(dive.end_ns, dive.end_ns, problems, bad, sorted(core.unused), over=True)
                writer.write_message(_of_dive(status, pair), dive.end_ns)
        problems_of = {pair: self._track_problems(one, apart_s) for pair, one in core.pairs.items()}
        return _DiveSolved(core, tracks, problems_of, bad)

    def _track_problems(self, pair: PairCore, apart_s: Mapping[PairId, float]) -> list[str]:
        """Return the problems that a pair's track has told, and found in the dive."""
        offset_s = _clocks_apart_s(pair)
        problems = [*pair.tracker.problems] if pair.tracker is not None else []
        if offset_s is not None:
            middle_ns = (self.dive.start_ns + self.dive.end_ns) // 2
            problems.append(apart_problem(pair.nodes, offset_s, self.curves, middle_ns, counted=pair.nodes in apart_s))
        return problems


@dataclass(frozen=True, eq=False)
class _DiveSolved:
    """What solving a dive has given. bad: how many messages were refused."""

    core: SolverCore
    tracks: Mapping[tuple[str, ...], Tracked]
    problems_of: Mapping[PairId, list[str]]
    bad: int


def run(args: argparse.Namespace) -> int:
    """Solve a dive; return 0, or 1 if no trigger was resolved."""
    settings = SolveConfig(method=args.method, checks=[check for check in args.checks.split(",") if check]).settings(
        "--checks"
    )
    replaced, began_s = replacements(args.info), time.monotonic()
    with Dive(args.dives) as dive:
        replaced |= placed(args.place, dive.infos() | replaced)
        nodes, infos = nodes_of(dive, args.nodes), dive.infos() | replaced
        nodes = _with_info(dive, nodes, infos, given=args.nodes is not None)
        check_detector(dive, nodes, args.detector, args.environment)
        if len(nodes) > 2 and (args.clock_offset is not None or args.clocks is not None):
            raise ConfigError("--clock-offset and --clocks are of one pair; choose it with --nodes A B")
        lone = [node for node, info in infos.items() if not _is_full(info) and (node in nodes or not args.nodes)]
        curves = chosen_curves(dive, nodes, args.clock_offset, args.clocks)
        attitudes, metadata = _attitudes(dive, args, nodes), _metadata(dive, args, curves)
        done = _StoredDive(args, dive, settings, nodes, lone, infos, replaced, curves, attitudes, metadata).solve()
    core = done.core
    _summarize(args, core, done.tracks, done.problems_of, done.bad, time.monotonic() - began_s)
    if not core.counts.total():
        log.error("no trigger was resolved: the dive holds no candidates of %s", " or ".join(nodes))
    elif not core.matched:
        # Two rates are named already.
        one_rate = len({infos[node].trigger_period_ns for node in nodes}) == 1
        why = ": are the logs of the same dive?" if one_rate else ""
        log.error("nodes %s have no trigger in common%s", " and ".join(nodes), why)
    return 0 if core.matched else 1


def _metadata(dive: Dive, args: argparse.Namespace, curves: Mapping[str, ClockCurve]) -> dict[str, str]:
    """Return the output's metadata, but for what is found of the clocks."""
    metadata = dive.metadata() | {"command": "solve", "method": args.method, "checks": args.checks}
    told = check_logs(dive.readers, args.authority)
    metadata |= {AUTHENTICITY: "; ".join(told)} if told else {}
    # A solved dive that is solved again may name the curves of before.
    return metadata | ({CURVES: curves_text(curves)} if curves or CURVES in metadata else {})


def clocks_apart(core: SolverCore) -> dict[PairId, float]:
    """Return how far the clocks of pairs are apart, B's minus A's, s, where whole dives' tracks have found it."""
    found = {
        nodes: _clocks_apart_s(pair)
        for nodes, pair in core.pairs.items()
        if pair.tracker is not None and pair.tracker.makes_whole
    }
    return {nodes: offset_s for nodes, offset_s in found.items() if offset_s is not None}


def _of_dive(status: SolverStatus, pair: PairCore) -> SolverStatus:
    """Return a pair's status with what the whole dive tells of the clocks, and without advice."""
    offset_s = _clocks_apart_s(pair)
    return replace(status, advice=UNSET, clock_skew_s=status.clock_skew_s if offset_s is None else offset_s)


def _clocks_apart_s(pair: PairCore) -> float | None:
    """Return B's clock minus A's as the track found it, None where they agree or it does not tell."""
    clock = pair.tracker.clock_now() if pair.tracker is not None else None
    if clock is None or not clock[1] <= ADVISED_SIGMA_S:
        return None
    return clock[0] if abs(clock[0]) > max(CLOCKS_APART_S, CLOCK_SIGMAS * clock[1]) else None


def _is_full(info: NodeInfo) -> bool:
    return info.has_camera and info.has_lights


def _attitudes(dive: Dive, args: argparse.Namespace, nodes: list[str]) -> list[Envelope]:
    """Return the attitudes that were asked for anew."""
    if args.attitude_again is None:
        return []
    from buddyline.tools.attitudes import again

    return again(dive, args.attitude_again, nodes)


def is_replaced(message: Message, replaced: Mapping[str, NodeInfo]) -> bool:
    """Tell whether a message is a calibration in place of which another one was given."""
    return isinstance(message, NodeInfo) and message.node in replaced


def replacements(given: list[str]) -> dict[str, NodeInfo]:
    """Read the calibrations of `--info NODE=FILE`."""
    replaced = {}
    for node, path in node_files("--info", given):
        info = load_info(path, node)
        if info.node != node:
            raise ConfigError(f"--info {node}={path}: the file describes node {info.node}")
        replaced[node] = info
    return replaced


def placed(given: list[str], infos: Mapping[str, NodeInfo]) -> dict[str, NodeInfo]:
    """Return the calibrations of the nodes of `--place NODE=FILE`, with their places."""
    if not given:
        return {}
    from buddyline.node.config import PlaceConfig

    found: dict[str, NodeInfo] = {}
    for node, path in node_files("--place", given):
        if node not in infos:
            raise ConfigError(f"--place {node}={path}: no NodeInfo of node {node}; nodes: {', '.join(sorted(infos))}")
        if node in found:
            raise ConfigError(f"--place {node}={path}: node {node} has a place already")
        found[node] = replace(infos[node], fixed=load_config(path, PlaceConfig).fixed.place)
    return found


def nodes_of(dive: Dive, given: list[str] | None) -> list[str]:
    """Return the nodes to solve: the given ones, or all of the dive; raise if there are fewer than two."""
    present = dive.nodes("candidates", "image")
    if given:
        nodes = node_ids(given)
        missing = [node for node in nodes if node not in present]
        if missing:
            raise BuddylineError(
                f"{dive.name}: holds nothing of node {missing[0]}; it has {', '.join(present) or 'none'}"
            )
        return nodes
    if len(present) < 2:
        have = f"only of node {present[0]}" if present else "of no node"
        raise BuddylineError(f"{dive.name}: candidates or pictures {have}; give the logs of both nodes")
    return present


def pair_of(dive: Dive, given: list[str] | None) -> tuple[str, str]:
    """Return a command's one pair: the given one, or the dive's two nodes; raise if it is not clear."""
    nodes = nodes_of(dive, given)
    if len(nodes) > 2:
        raise BuddylineError(f"{dive.name}: nodes {', '.join(nodes)}; choose a pair with --nodes A B")
    return nodes[0], nodes[1]


def _with_info(dive: Dive, nodes: list[str], infos: Mapping[str, NodeInfo], *, given: bool) -> list[str]:
    """Leave out the nodes without a calibration; raise if such a node was asked for, or fewer than two are left."""
    known = [node for node in nodes if node in infos]
    unknown = [node for node in nodes if node not in infos]
    if unknown and (given or len(known) < 2):
        raise BuddylineError(f"{dive.name}: no NodeInfo of node {unknown[0]}; give one with --info {unknown[0]}=FILE")
    for node in unknown:
        log.warning("%s: no NodeInfo of node %s: it is left out; give one with --info %s=FILE", dive.name, node, node)
    return known


def _pictured(dive: Dive, nodes: Iterable[str]) -> list[str]:
    """Return the nodes of which a dive has pictures and no candidates."""
    return [node for node in nodes if node in dive.nodes("image") and node not in dive.nodes("candidates")]


def check_detector(dive: Dive, nodes: Iterable[str], detector: str, environment: str) -> None:
    """Say where a detector that was asked for has nothing to do; raise BuddylineError for an unknown one."""
    if (detector, environment) == (DETECTORS[0], "auto"):
        return
    from buddyline.node.detect import values_of

    values_of(detector, environment)
    if not _pictured(dive, nodes):
        log.warning(
            "%s: its candidates are taken as they are: --detector and --environment are for nodes with pictures and "
            "without candidates; `buddyline detect` finds candidates anew",
            dive.name,
        )


def messages_of(
    dive: Dive, infos: dict[str, NodeInfo], *nodes: str, detector: str, environment: str, doing: str
) -> Iterator[Envelope]:
    """Yield the messages for solver and output; pictures of a node without candidates are detected."""
    raw = _pictured(dive, nodes)
    finder = None
    if raw:
        from buddyline.tools.detect import DiveDetector, recorded_masks

        finder = DiveDetector(detector, environment, infos, recorded_masks(dive))
    topics = (*COPIED, "image") if raw else COPIED
    for envelope in dive.messages(*topics, doing=doing):
        if len(envelope.ids) == 1 and envelope.node not in nodes:
            continue
        if not isinstance(envelope.message, CompressedImage):
            yield envelope
        elif finder is not None and envelope.node in raw:
            found = finder.candidates(envelope)
            if found is not None:
                yield found


def solved(core: SolverCore, messages: Iterable[Message]) -> Iterator[Message]:
    """Yield what the solver makes of messages, many at a time, to the end of the dive's triggers.

    A node's streams keep a minute of messages, so each batch spans less than that.
    """
    rest = iter(messages)
    while together := list(islice(rest, TOGETHER)):
        yield from core.handle_many(together)
    yield from core.flush()


@dataclass
class Tracked:
    """What was written of one pair's track, or of one node's place in a net.

    rows: how many. parts: how many stretches of rows that are less than PART_S apart; apart_ns: the time between these.
    longest_gap_s: the longest time without a light.
    """

    rows: int = 0
    parts: int = 0
    first_ns: int = 0
    last_ns: int = 0
    apart_ns: int = 0
    longest_gap_s: float = 0.0

    def take(self, track: Track | NodePose) -> None:
        """Count a row."""
        self.first_ns = self.first_ns if self.rows else track.stamp_ns
        step_ns = track.stamp_ns - self.last_ns if self.rows else 0
        if not self.rows or step_ns > PART_S * S_NS:
            self.parts += 1
            self.apart_ns += step_ns
            self.longest_gap_s = max(self.longest_gap_s, step_ns / S_NS)
        self.last_ns = max(self.last_ns, track.stamp_ns)
        self.rows += 1
        self.longest_gap_s = max(self.longest_gap_s, track.age_s)

    @property
    def span_s(self) -> float:
        """From the first to the last row."""
        return (self.last_ns - self.first_ns) / S_NS

    def __str__(self) -> str:
        """Say how many rows there are, and over how long."""
        told_s = self.span_s - self.apart_ns / S_NS
        of = f" of {self.span_s:.1f} s, in {self.parts} parts" if self.parts > 1 else " s"
        return f"{self.rows} rows over {told_s:.1f}{of}, longest time without a light {self.longest_gap_s:.1f} s"


def _write(writer: DiveLogWriter, results: Iterable[Message], tracks: dict[tuple[str, ...], Tracked]) -> None:
    """Write outcomes, track and network; a track of any mode goes to the topic `track`.

    tracks: by pair; by "net", the net and the node of what the network tells.
    """
    for result in results:
        if isinstance(result, Track):
            tracks[result.node_a, result.node_b].take(result)
        elif isinstance(result, NodePose):
            tracks["net", result.net, result.node].take(result)
        key = TRACK.key(result.node_a, result.node_b) if isinstance(result, Track) else None
        writer.write_message(result, key=key)


def _summarize(
    args: argparse.Namespace,
    core: SolverCore,
    tracks: Mapping[tuple[str, ...], Tracked],
    problems_of: Mapping[PairId, list[str]],
    bad: int,
    took_s: float,
) -> None:
    of_pairs = [one for pair in core.pairs for one in core.health.of_dive(pair)]
    # Nodes of lamps alone, or of a camera alone, are in no pair.
    for problem in dict.fromkeys([*of_pairs, *core.health.sizes_of_dive(sorted(core.streams))]):
        log.warning("%s", problem)
    for problem in core.network.problems if core.network is not None else ():
        log.warning("network: %s", problem)
    told = {ids[1:]: of for ids, of in sorted(tracks.items()) if len(ids) == 3}
    for pair in core.pairs.values():
        for problem in problems_of[pair.nodes]:
            log.warning("track of %s and %s: %s", *pair.nodes, problem)
    if args.json:
        pairs = [
            {
                "node_a": pair.nodes[0],
                "node_b": pair.nodes[1],
                "triggers": pair.counts.total(),
                "matched": pair.matcher.matched,
                "solved": pair.counts["solved"],
                "rejected": _rejected(pair.counts),
                "track": _track_figures(pair, tracks, problems_of[pair.nodes]),
            }
            for pair in core.pairs.values()
        ]
        totals = pairs[0] if len(pairs) == 1 else _totals(core)
        nodes = [
            {"net": net, "node": node, "rows": of.rows, "span_s": of.span_s, "longest_gap_s": of.longest_gap_s}
            for (net, node), of in told.items()
        ]
        run = {
            "pairs": pairs,
            "network": nodes,
            "bad_messages": bad,
            "seconds": took_s,
            "output": str(Path(args.output)),
        }
        print(json.dumps(totals | run))
        return
    for pair in core.pairs.values():
        solved, triggers = pair.counts["solved"], pair.counts.total()
        print(f"{args.output}: {solved} poses of {triggers} triggers, nodes {pair.nodes[0]} and {pair.nodes[1]}")
        for reason, count in _rejected(pair.counts).items():
            print(f"  {count:6d} {reason}")
        if pair.tracker is not None:
            print(_track_text(args.track, pair, tracks))
    for (net, node), of in told.items():
        print(f"  node {node} in the net {net}: {of}")
    if bad:
        print(f"  {bad:6d} messages that could not be used")
    print(f"  {took_s:.1f} s, {core.counts.total() / max(took_s, 1e-9):.0f} triggers/s")


def _totals(core: SolverCore) -> dict[str, object]:
    counts = core.counts
    return {
        "triggers": counts.total(),
        "matched": core.matched,
        "solved": counts["solved"],
        "rejected": _rejected(counts),
    }


def _rejected(counts: Counter[str]) -> dict[str, int]:
    return {reason: count for reason, count in sorted(counts.items()) if reason != "solved"}


def _track_figures(
    pair: PairCore, tracks: Mapping[tuple[str, ...], Tracked], problems: list[str]
) -> dict[str, object] | None:
    """Return the track's figures, None where none was asked for."""
    if pair.tracker is None:
        return None
    told, clock = tracks.get(pair.nodes, Tracked()), pair.tracker.clock_now()
    return {
        "rows": told.rows,
        "span_s": told.span_s,
        "longest_gap_s": told.longest_gap_s,
        "clock_offset_s": clock and clock[0],
        "clock_sigma_s": clock and clock[1],
        "problems": problems,
    }


def _track_text(mode: str, pair: PairCore, tracks: Mapping[tuple[str, ...], Tracked]) -> str:
    told = tracks.get(pair.nodes, Tracked())
    if pair.tracker is None or not told.rows:
        why = pair.tracker.problems if pair.tracker is not None else []
        return f"  no track ({mode}): {'; '.join(one.removeprefix('no track: ') for one in why) or 'no row is due'}"
    clock = pair.tracker.clock_now()
    clocks = "" if clock is None else f"; {_clock_words(pair.nodes, *clock)}"
    return f"  track ({mode}): {told}{clocks}"


def _clock_words(nodes: tuple[str, str], offset_s: float, sigma_s: float) -> str:
    """Return what the track says of B's clock against A's."""
    if not sigma_s <= CLOCK_KNOWN_S:
        return "clock offset not known"
    return f"clock of {nodes[1]} {1e3 * offset_s:+.1f} ms from {nodes[0]}'s (1 sd {1e3 * sigma_s:.1f})"
