"""Read the messages to evaluate, or to export, from dive logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Final

from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.health import REPORTED_OFFSET_SIGMA_S
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    LightTruth,
    Message,
    NodeInfo,
    NodePose,
    Rejected,
    RelativePose,
    SolverStatus,
    Track,
    Truth,
)
from buddyline.protocol.topics import (
    ARTAG,
    ATTITUDE,
    CANDIDATES,
    INFO,
    LIGHT_TRUTH,
    NET_TRUTH,
    POSE,
    REJECTED,
    SOLVER_STATUS,
    TRACK,
    TRACK_LAG,
    TRUTH,
    Topic,
)
from buddyline.solver_service.clock_curve import ClockCurve
from buddyline.tools.clock_curves import apart_problem, noted_apart, noted_curves
from buddyline.tools.dives import Dive, open_each
from buddyline.tools.evaluation.clocks import SimulatedClocks, take_ned_truths, take_onto_common_clock
from buddyline.tools.evaluation.recorded import Recorded
from buddyline.tools.evaluation.truth import inverted
from buddyline.tools.pairs import Pair, pair_words, wanted_pair
from msgspec import UNSET

_RESULTS: Final = (POSE, REJECTED)
# Clocks are named as apart where a solver's status has them further apart than four sigmas of what it reports.
STATUS_APART_S: Final = 4.0 * REPORTED_OFFSET_SIGMA_S
# Used where a log has no results of the solver: poses from tags are evaluated in the same way.
_TAGS: Final = (ARTAG,)
_TRACKS: Final = (TRACK, TRACK_LAG)
# The list of Recorded that has the messages of a type.
_LISTS: Final = {
    RelativePose: "poses",
    Rejected: "rejected",
    Track: "tracks",
    Candidates: "candidates",
    LightTruth: "light_truths",
}
_TRUTHS: Final = (TRUTH, LIGHT_TRUTH, NET_TRUTH)


def _names(dives: Sequence[Dive]) -> str:
    return ", ".join(dive.name for dive in dives)


def _ids(dives: Sequence[Dive], *topics: Topic) -> list[tuple[str, ...]]:
    return sorted({ids for dive in dives for ids in dive.ids(*(topic.name for topic in topics))})


def _results(dives: Sequence[Dive]) -> tuple[Topic, ...]:
    return _RESULTS if _ids(dives, *_RESULTS) else _TAGS


def _choose_pair(dives: Sequence[Dive], wanted: Pair | None) -> Pair:
    pairs = [(ids[0], ids[1]) for ids in _ids(dives, *_results(dives)) or _ids(dives, *_TRACKS) or _ids(dives, TRUTH)]
    if not pairs:
        nodes = [ids[0] for ids in _ids(dives, CANDIDATES)]
        pairs = [(nodes[0], nodes[-1])] if nodes else []
    if wanted is not None:
        return wanted_pair(wanted, pairs, _names(dives))
    if len(pairs) > 1:
        raise BuddylineError(f"{_names(dives)}: holds pairs {pair_words(pairs)}; choose one with --pair A/B")
    if not pairs:
        raise BuddylineError(f"{_names(dives)}: no poses in it; solve it first: buddyline solve DIVE.mcap -o OUT.mcap")
    return pairs[0]


def _take(recorded: Recorded, ids: tuple[str, ...], message: Message) -> None:
    """Store one message; messages of other nodes and pairs are dropped, and the first NodeInfo of a node is kept."""
    nodes = recorded.nodes
    if isinstance(message, Truth):
        if ids == nodes:
            recorded.truths.append(message)
        elif ids == nodes[::-1]:
            recorded.truths.append(inverted(message))
    elif isinstance(message, NodePose):
        if message.node == nodes[0]:
            recorded.ned_truths_a.append(message)
    elif ids != nodes if len(ids) == 2 else ids[0] not in nodes:
        return
    elif isinstance(message, Attitude):
        recorded.attitudes_a += [message] if message.node == nodes[0] else []
    elif isinstance(message, NodeInfo):
        recorded.infos.setdefault(message.node, message)
    else:
        getattr(recorded, _LISTS[type(message)]).append(message)


def simulated_clocks(logs: Sequence[Dive]) -> SimulatedClocks:
    """Return what `simulate` has noted of the clocks in the first log where they do not agree."""
    for log in logs:
        try:
            found = SimulatedClocks.of(log.metadata())
        except ValueError as error:
            raise BuddylineError(
                f"{log.name}: its metadata of the simulated clocks cannot be read ({error})"
            ) from error
        if found.offset_ns or found.drift:
            return found
    return SimulatedClocks()


def _clocks_apart(log: Dive, pair: Pair, curves: Mapping[str, ClockCurve]) -> list[str]:
    """Return a line where the last status of a pair's solver says that the clocks differ."""
    told = [one.message for one in log.messages(SOLVER_STATUS.name) if one.ids == pair]
    last = told[-1] if told else None
    if not isinstance(last, SolverStatus) or last.clock_skew_s is UNSET or abs(last.clock_skew_s) <= STATUS_APART_S:
        return []
    counted = pair in noted_apart(log.metadata(), log.name)
    return [f"{log.name}: {apart_problem(pair, last.clock_skew_s, curves, last.stamp_ns, counted=counted)}"]


def load(paths: Sequence[str], truth_paths: Sequence[str] = (), pair: Pair | None = None) -> Recorded:
    """Read one pair's messages.

    Poses, rejections and tracks are those of the first listed log with poses or rejections. Truth is taken only from
    truth_paths if they have it. Candidates and NodeInfo come in the order of the listed logs. All is on the clock of
    the poses: midway between both nodes' clocks, or on the first node's where the dive was solved with clocks known.
    """
    with ExitStack() as stack:
        logs = open_each(paths, stack)
        truth_logs = open_each(truth_paths, stack)
        recorded = Recorded(_choose_pair([*logs, *truth_logs], pair))
        results = _results(logs)
        answering = [log for log in logs if _ids([log], *results)] or [log for log in logs if _ids([log], *_TRACKS)]
        recorded.environment = next((log.metadata().get("environment", "") for log in [*logs, *truth_logs]), "")
        for log in answering[1:]:
            recorded.problems.append(f"{log.name}: its poses are left out, those of {answering[0].name} are taken")
        sighted = {topic.name for topic in _TRUTHS if _ids(truth_logs, topic)}
        for log in [*logs, *truth_logs]:
            topics: list[Topic] = [INFO, CANDIDATES]
            if log in answering[:1]:
                topics += [*results, *_TRACKS]
            if answering:
                topics += [ATTITUDE]
            topics += [topic for topic in _TRUTHS if log in truth_logs or topic.name not in sighted]
            for envelope in log.messages(*(topic.name for topic in topics), doing=f"read {log.name}"):
                _take(recorded, envelope.ids, envelope.message)
            recorded.doubled += log.repeated.get("/".join(recorded.nodes), 0)
        for log in answering[:1]:
            curves = noted_curves(log.metadata(), log.name)
            take_ned_truths(recorded, simulated_clocks([*logs, *truth_logs]), curves)
            take_onto_common_clock(recorded, curves)
            recorded.problems += _clocks_apart(log, recorded.nodes, curves)
    return recorded


def load_for_evaluation(paths: Sequence[str], truth_paths: Sequence[str] = (), pair: Pair | None = None) -> Recorded:
    """Read one pair's messages; raise BuddylineError if nothing can be compared with truth."""
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
