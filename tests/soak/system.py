"""Two nodes at 30 Hz with attitude at 100 Hz, hub, solver, recorder and two viewers, as real processes."""

from __future__ import annotations

import os
import time
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from buddyline.protocol.clock import S_NS
from buddyline.tools.measure.load import Load, load_of

from tests.faults.system import System
from tests.processes import PATIENCE_S, Process
from tests.soak.meter import CountingViewer, Stream, Streams, stamps_of, streams_of

RATE_HZ = 30.0
# The first frames wait for those of the node that starts last.
START_S = 3.0
# Frames of the last moment may not have been sent or solved.
END_NS = 2 * S_NS

# Once the publishers' caches, which hold a minute or more, and the solver's memory of the clocks' offset are full. What
# grows then is each log's index, which is written at its end, and the monitor's picture of the dive.
SETTLED_S = 600.0
MAX_GROWTH_MIB = 4.0
MAX_GROWTH_MIB_PER_H = 10.0
MAX_MORE_FILES = 4
# Of the p99 of a minute's latencies: the median of the last third over that of the first.
MAX_P99_RATIO, MAX_P99_MORE_MS = 1.5, 10.0


@dataclass
class Minute:
    """A line of the report. rates_hz: by topic, of all nodes. pace_ms: of tools/measure/pace.py, median and p99."""

    at_s: float
    rates_hz: dict[str, float]
    median_ms: float
    p99_ms: float
    missed: int
    loads: dict[str, Load]
    load_average: float  # of the machine, over the last minute
    pace_ms: tuple[float, float]


@dataclass
class Row:
    """A line of the table: one key, by the log of its node (poses and rejections: none), the viewer, the recorder."""

    key: str
    published: int | None
    seen: dict[str, Stream]
    lost: dict[str, int]


@dataclass
class SoakResult:
    """All measurements, and the bounds that were exceeded."""

    minutes: list[Minute] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    triggers: int = 0
    failures: list[str] = field(default_factory=list)


def soak(
    directory: Path, seconds: float, every_s: float, show: Callable[[Minute], None] = lambda _: None
) -> SoakResult:
    """Run the system for `seconds`; measure every `every_s`, and at the end compare with the nodes' logs."""
    result, repeating = SoakResult(), {"devices": "repeating", "width_px": 205, "preview_hz": 1.0}
    with System(directory, RATE_HZ, **repeating, node_module="tests.soak.node") as system, ExitStack() as stack:
        system.start("hub")
        viewer = CountingViewer(system.endpoint)
        stack.callback(viewer.bus.close)
        system.start("recorder", *(["monitor"] if find_spec("websockets") else []), "solver", "a", "b")
        processes = dict(system.processes)
        pace = stack.enter_context(Process(module="buddyline.tools.measure.pace"))
        _measure(result, processes, viewer, pace, seconds, every_s, show)
        statuses = {name: processes[name].end() for name in ("a", "b")}
        _wait_at_most(PATIENCE_S, lambda: set(viewer.streams.triggers) <= set(viewer.streams.outcomes))
        statuses["solver"] = processes["solver"].end()
        # The recorder writes what it has once a second.
        outcomes = set(viewer.streams.outcomes)
        _wait_at_most(PATIENCE_S, lambda: outcomes <= set(streams_of(directory / "recorder.mcap").outcomes))
        statuses |= {name: processes[name].end() for name in processes if name not in statuses and name != "hub"}
        result.failures += [f"{name}: exit status {status}" for name, status in statuses.items() if status]
        for name, process in processes.items():
            result.failures += [f"{name}: {line}" for line in process.lines if line.startswith(("E ", "Traceback"))]
    result.failures += viewer.refusals.lines()
    _compare(result, directory, viewer.streams)
    _judge_loads(result)
    return result


def _wait_at_most(seconds: float, condition: Callable[[], bool]) -> None:
    """Wait for a condition, which may never come: a loaded machine has a backlog."""
    ends_s = time.monotonic() + seconds
    while not condition() and time.monotonic() < ends_s:
        time.sleep(0.5)


def _measure(
    result: SoakResult,
    processes: dict[str, Process],
    viewer: CountingViewer,
    pace: Process,
    seconds: float,
    every_s: float,
    show: Callable[[Minute], None],
) -> None:
    time.sleep(START_S)
    viewer.latencies_ms()
    began_s, before, viewer_before, paces = time.monotonic(), 0.0, viewer.counts(), len(pace.lines)
    while before < seconds:
        time.sleep(max(began_s + min(before + every_s, seconds) - time.monotonic(), 0.0))
        at_s, counts, latencies_ms = time.monotonic() - began_s, viewer.counts(), viewer.latencies_ms()
        paces_ms = sorted(float(line) for line in pace.lines[paces:])
        paces += len(paces_ms)
        rates: Counter[str] = Counter()
        for key, count in (counts - viewer_before).items():
            rates[key.rpartition("/")[2]] += count
        result.minutes.append(
            Minute(
                at_s=at_s,
                rates_hz={name: count / (at_s - before) for name, count in rates.items()},
                median_ms=share_of(latencies_ms, 0.5),
                p99_ms=share_of(latencies_ms, 0.99),
                missed=viewer.missed,
                loads={name: load_of(process.pid) for name, process in processes.items()},
                load_average=os.getloadavg()[0],
                pace_ms=(share_of(paces_ms, 0.5), share_of(paces_ms, 0.99)),
            )
        )
        show(result.minutes[-1])
        ended = [f"{name}: ended: {process.lines[-5:]}" for name, process in processes.items() if process.ended]
        if ended:
            raise RuntimeError("; ".join(ended))
        before, viewer_before = at_s, counts


def _compare(result: SoakResult, directory: Path, viewer: Streams) -> None:
    """Count what was published, by the nodes' own logs, from the first of each key that was on the bus."""
    seen = {"viewer": viewer, "recorder": streams_of(directory / "recorder.mcap")}
    published = {key: stamps for log in sorted(directory.glob("[ab]-*.mcap")) for key, stamps in stamps_of(log).items()}
    for key in sorted(viewer.by_key):
        stamps = published.get(key)
        row = Row(key, None, {name: streams.by_key.get(key, Stream()) for name, streams in seen.items()}, {})
        if stamps is not None:
            first = bisect_left(stamps, row.seen["viewer"].first_ns)
            row.published = len(stamps) - first
            for name, stream in row.seen.items():
                # Each from its own first one: on a loaded machine one of them may hear a node seconds before the other.
                heard = bisect_left(stamps, stream.first_ns)
                through = bisect_right(stamps, stream.last_ns)
                row.lost[name] = through - heard - stream.count
                row.lost[name] += max(bisect_right(stamps, stamps[-1] - END_NS) - through, 0)
        else:
            row.lost["recorder"] = row.seen["viewer"].count - row.seen["recorder"].count
        result.rows.append(row)
        for name, stream in row.seen.items():
            if row.lost.get(name) or stream.repeated or stream.seq_gaps:
                result.failures.append(f"{key}: {name}: {row.lost.get(name)} lost, {stream}")
            # Poses and rejections are in the order of triggers; a late one's stamp may be before another's.
            if stream.disordered and stamps is not None:
                result.failures.append(f"{key}: {name}: {stream.disordered} out of order")
    # The recorder has filled in, from the nodes' logs, what they saw before they were on the bus.
    first = min(viewer.triggers, default=0)
    for name, streams in seen.items():
        complete_to = max(streams.triggers, default=0) - 2 * RATE_HZ
        due = {trigger for trigger in streams.triggers if first <= trigger <= complete_to}
        outcomes = Counter(streams.outcomes)
        result.triggers = len(due)
        without, doubled = len(due - outcomes.keys()), sum(outcomes.values()) - len(outcomes)
        if without or doubled or not due:
            result.failures.append(f"{name}: of {len(due)} triggers {without} without an outcome, {doubled} with two")


def _judge_loads(result: SoakResult) -> None:
    settled = [minute for minute in result.minutes if minute.at_s >= min(SETTLED_S, result.minutes[-1].at_s / 2)]
    first, last = settled[0], settled[-1]
    hours = (last.at_s - first.at_s) / 3600
    for name, load in last.loads.items():
        grown_mib, more_files = load.rss_mib - first.loads[name].rss_mib, load.files - first.loads[name].files
        if last.at_s > SETTLED_S and grown_mib > MAX_GROWTH_MIB + MAX_GROWTH_MIB_PER_H * hours:
            result.failures.append(f"{name}: grew by {grown_mib:.1f} MiB in {hours:.2f} h")
        if more_files > MAX_MORE_FILES:
            result.failures.append(f"{name}: {more_files} more open files")
    third = len(settled) // 3
    if third >= 2:
        early, late = (median([m.p99_ms for m in part]) for part in (settled[:third], settled[-third:]))
        if late > MAX_P99_RATIO * early + MAX_P99_MORE_MS:
            result.failures.append(f"p99 of the latency went from {early:.1f} to {late:.1f} ms")


def share_of(values: list[float], share: float) -> float:
    """Return what this share of sorted values lies below; -1 where there are none."""
    return values[int(len(values) * share)] if values else -1.0


def median(values: list[float]) -> float:
    return share_of(sorted(values), 0.5)
