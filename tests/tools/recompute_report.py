"""Every number of a dive's report, computed again from the log, with nothing of this project.

`python recompute_report.py DIVE.mcap REPORT.html`: says which numbers of the report differ; exit status 1 if any does.
"""

from __future__ import annotations

import itertools
import json
import math
import re
import statistics
import sys
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from mcap.reader import make_reader

# The report's rules, stated anew.
STRETCH_S = 1.0
TRACK_SPACING_S, MAX_TRACK_POINTS = 0.2, 3000
DEPTH_SPACING_S = 1.0
COVERED_SHARE, WRONG_SHARE, WRONG_SIGMAS, NO_LIGHT_S = 0.05, 0.1, 3.0, 0.5
GATE, LISTED, TRACK_GAP_S, TRUTH_GAP_S = 16.266, 12, 0.5, 0.5


def read(path: str) -> tuple[dict[str, list[tuple[int, dict[str, Any]]]], int, int]:
    """Return the log's messages by key as (log time, JSON), and its first and last time."""
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    times: list[int] = []
    with open(path, "rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
            times.append(message.log_time)
    return found, min(times), max(times)


def spread(covariance: list[float]) -> float:
    """Return the root of the sum of the position's variances."""
    return math.sqrt(covariance[0] + covariance[7] + covariance[14])


def far(off: np.ndarray, covariance: list[float]) -> float:
    """Return how far off a position is, squared, by its covariance."""
    P = np.array(covariance).reshape(6, 6)[:3, :3]
    return float(off @ np.linalg.inv((P + P.T) / 2) @ off)


def stats(errors: list[float]) -> dict[str, Any]:
    if not errors:
        return {"count": 0, "median_m": None, "p95_m": None, "rms_m": None}
    size = np.abs(errors)
    return {
        "count": len(errors),
        "median_m": float(np.median(size)),
        "p95_m": float(np.percentile(size, 95)),
        "rms_m": float(np.sqrt(np.mean(size**2))),
    }


class TruePlaces:
    """True places by time: the cubic through two before and two after, where they are near enough."""

    def __init__(self, rows: list[dict[str, Any]]) -> None:
        rows = sorted(rows, key=lambda row: row["stamp_ns"])
        self.ns = [row["stamp_ns"] for row in rows]
        self.t = np.array([row["t_a_b_m"] for row in rows])

    def at(self, ns: int) -> np.ndarray | None:
        after = int(np.searchsorted(self.ns, ns))
        if 0 < after < len(self.ns) and self.near(after):
            use = [k for k in range(after - 2, after + 2) if 0 <= k < len(self.ns)]
            if after - 2 in use and not self.near(after - 1):
                use.remove(after - 2)
            if after + 1 in use and not self.near(after + 1):
                use.remove(after + 1)
            place = np.zeros(3)
            for k in use:
                weight = math.prod((ns - self.ns[j]) / (self.ns[k] - self.ns[j]) for j in use if j != k)
                place += weight * self.t[k]
            return place
        best = min(range(len(self.ns)), key=lambda k: abs(self.ns[k] - ns), default=None)
        return None if best is None or abs(self.ns[best] - ns) > 20_000_000 else self.t[best]

    def near(self, k: int) -> bool:
        return 0 < self.ns[k] - self.ns[k - 1] <= TRUTH_GAP_S * 1e9


def thinned(rows: list[tuple[int, dict[str, Any]]], spacing_ns: int) -> list[dict[str, Any]]:
    kept: list[dict[str, Any]] = []
    last = None
    for at, row in rows:
        if last is None or not 0 <= at - last < spacing_ns:
            kept.append(row)
            last = at
    return kept


def gaps(outcomes: list[tuple[int, int, str | None]]) -> list[tuple[int, int, int, Counter[str]]]:
    """Return (begin stamp, end stamp, begin log time, reasons) between poses, and to the dive's ends."""
    outcomes = sorted(outcomes, key=lambda one: one[0])
    steps = [b[0] - a[0] for a, b in itertools.pairwise(outcomes) if b[0] > a[0]]
    period = statistics.median(steps) if steps else 0
    marks = [0, *(k for k, one in enumerate(outcomes) if one[2] is None), len(outcomes) - 1]
    found = []
    for begin, end in itertools.pairwise(marks):
        first, last = outcomes[begin], outcomes[end]
        if begin < end and (last[0] - first[0] > 1.5 * period or first[2] is not None or last[2] is not None):
            why = Counter(one[2] for one in outcomes[begin : end + 1] if one[2] is not None)
            found.append((first[0], last[0], first[1], why))
    return found


def recompute(path: str) -> dict[str, Any]:
    """Return the numbers of a report of the log's only pair."""
    log, start, end = read(path)
    (pair,) = {
        key.split("/")[2:4][0] + "/" + key.split("/")[3] for key in log if re.fullmatch(r"buddyline/pair/.*/pose", key)
    }
    a, b = pair.split("/")

    def of(name: str) -> list[tuple[int, dict[str, Any]]]:
        return log.get(f"buddyline/pair/{a}/{b}/{name}", [])

    poses = [row for _, row in of("pose")]
    rejected = [row for _, row in of("rejected")]
    outcomes = [(row["stamp_ns"], at, None) for at, row in of("pose")]
    outcomes += [(row["stamp_ns"], at, row["reason"]) for at, row in of("rejected")]
    found = gaps(outcomes)
    stamps = sorted(row["stamp_ns"] for row in poses)
    between = [(y - x) / 1e9 for x, y in itertools.pairwise(stamps)] + [(one[1] - one[0]) / 1e9 for one in found]
    spacing_ns = max(round(TRACK_SPACING_S * 1e9), (end - start) // MAX_TRACK_POINTS)
    tracks = thinned(of("track"), spacing_ns)
    depths: dict[str, Any] = {}
    for node in (a, b):
        rows = log.get(f"buddyline/node/{node}/depth", [])
        kept = [row["depth_m"] for row in thinned(rows, max(round(DEPTH_SPACING_S * 1e9), spacing_ns))]
        if kept:
            depths[node] = {"least_m": min(kept), "most_m": max(kept), "sigma_m": rows[-1][1]["sigma_m"]}
    truth = TruePlaces([row for _, row in of("truth")])
    frames = {row["trigger"] for node in (a, b) for _, row in log.get(f"buddyline/node/{node}/candidates", [])}
    ended = {row["trigger"] for row in (*poses, *rejected)}
    blobs = {
        (node, row["trigger"]): row["blobs"]
        for node in (a, b)
        for _, row in log.get(f"buddyline/node/{node}/candidates", [])
    }
    lights_px = [
        blobs[node, row["trigger"]][k]["sigma_px"]
        for row in poses
        for node, chosen in ((a, row["blobs_a"]), (b, row["blobs_b"]))
        for k in chosen
        if 0 <= k < len(blobs.get((node, row["trigger"]), []))
    ]
    return {
        "dive": {
            "begun": time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(start // 10**9)),
            "seconds": (end - start) / 1e9,
            "nodes": sorted({key.split("/")[2] for key in log if key.startswith("buddyline/node/")}),
            "pair": [a, b],
        },
        "triggers": {
            "total": len(frames | ended),
            "with_pose": len(poses),
            "without_outcome": len(frames - ended) if frames else None,
            "rejected": dict(Counter(row["reason"] for row in rejected)),
            "longest_without_pose_s": max(between),
            "without_pose": [
                {"from_s": (at - start) / 1e9, "seconds": (last - first) / 1e9, "reasons": dict(why)}
                for first, last, at, why in found
                if (last - first) / 1e9 >= STRETCH_S
            ],
        },
        "poses": {
            "range_least_m": min(row["range_m"] for row in poses),
            "range_most_m": max(row["range_m"] for row in poses),
            "range_median_m": statistics.median(row["range_m"] for row in poses),
            "sigma_median_m": statistics.median(spread(row["covariance"]) for row in poses),
            "range_gap_median_m": statistics.median(
                abs(row["range_gap_m"]) for row in poses if row["method"] != "three_lights"
            ),
            "light_sigma_median_px": statistics.median(lights_px) if lights_px else None,
            "methods": dict(Counter(row["method"] for row in poses)),
            "checks": dict(Counter(check for row in poses for check in row["checks"])),
        },
        "track": of_track(tracks, poses, [row for _, row in of("track")], spacing_ns),
        "depths": depths,
        "against_truth": against(truth, poses, tracks) if len(truth.ns) else None,
        "error_budget": budget(poses, tracks, depths, [row for _, row in of("status")]),
        "outliers": outliers(poses, [row for _, row in of("track")]) if of("track") else None,
        # Of more than two nodes: tests/tools/test_report_net.py.
        "network": None,
    }


def of_track(
    kept: list[dict[str, Any]], poses: list[dict[str, Any]], every: list[dict[str, Any]], spacing_ns: int
) -> dict[str, Any] | None:
    if not kept:
        return None
    first, last = min(row["stamp_ns"] for row in poses), max(row["stamp_ns"] for row in poses)
    stamps = sorted(row["stamp_ns"] for row in kept)
    period_s = statistics.median(y - x for x, y in itertools.pairwise(stamps)) / 1e9
    good = sum(
        first <= row["stamp_ns"] <= last and spread(row["covariance"]) < COVERED_SHARE * row["range_m"] for row in kept
    )
    dark_s, lit_before = 0.0, None
    for row in every:
        lit = row["stamp_ns"] - round(row["age_s"] * 1e9)
        dark_s = max(dark_s, row["age_s"], (lit - (lit if lit_before is None else lit_before)) / 1e9)
        lit_before = lit
    return {
        "mode": kept[0]["mode"],
        "spacing_s": spacing_ns / 1e9,
        "samples": len(kept),
        "covered": min(good * period_s / ((last - first) / 1e9), 1.0),
        "longest_without_light_s": dark_s,
        "sigma_median_m": statistics.median(spread(row["covariance"]) for row in kept),
        "speed_median_mps": statistics.median(float(np.linalg.norm(row["v_a_b_mps"])) for row in kept),
    }


def against(truth: TruePlaces, poses: list[dict[str, Any]], tracks: list[dict[str, Any]]) -> dict[str, Any]:
    known = [(row, place) for row in poses if (place := truth.at(row["stamp_ns"])) is not None]
    said: dict[str, Any] = {
        "poses": {
            "position": stats([float(np.linalg.norm(place - row["t_a_b_m"])) for row, place in known]),
            "range": stats([row["range_m"] - float(np.linalg.norm(place)) for row, place in known]),
        }
    }
    told = [
        (row, place, place - np.array(row["t_a_b_m"]))
        for row in tracks
        if (place := truth.at(row["stamp_ns"])) is not None
    ]
    if tracks:
        said["track"] = {
            "samples": len(told),
            "wrong": sum(
                float(np.linalg.norm(off)) > WRONG_SHARE * float(np.linalg.norm(place))
                and far(off, row["covariance"]) > WRONG_SIGMAS**2
                for row, place, off in told
            ),
            "position": stats([float(np.linalg.norm(off)) for _, _, off in told]),
            "position_without_light": stats(
                [float(np.linalg.norm(off)) for row, _, off in told if row["age_s"] > NO_LIGHT_S]
            ),
        }
    return said


def budget(
    poses: list[dict[str, Any]], tracks: list[dict[str, Any]], depths: dict[str, Any], status: list[dict[str, Any]]
) -> dict[str, Any]:
    added = [
        math.sqrt(max(sum(s * s for s in row["sigma_ned_m"]) - spread(row["covariance"]) ** 2, 0.0))
        for row in poses
        if "sigma_ned_m" in row
    ]
    offset_s = status[-1].get("clock_skew_s") if status else None
    speeds = [float(np.linalg.norm(row["v_a_b_mps"])) for row in tracks]
    return {
        "optics_m": statistics.median(spread(row["covariance"]) for row in poses),
        "compass_m": statistics.median(added) if added else None,
        "depth_m": math.sqrt(sum(one["sigma_m"] ** 2 for one in depths.values())) if len(depths) == 2 else None,
        "clock_offset_s": offset_s,
        "clock_m": abs(offset_s) * statistics.median(speeds) if offset_s is not None and speeds else None,
    }


def outliers(poses: list[dict[str, Any]], tracks: list[dict[str, Any]]) -> dict[str, Any]:
    stamps = np.array([row["stamp_ns"] for row in tracks])
    found, judged = [], 0
    for row in poses:
        after = int(np.searchsorted(stamps, row["stamp_ns"]))
        if after < len(stamps) and stamps[after] == row["stamp_ns"]:
            place = np.array(tracks[after]["t_a_b_m"])
        elif 0 < after < len(stamps) and stamps[after] - stamps[after - 1] <= TRACK_GAP_S * 1e9:
            share = (row["stamp_ns"] - int(stamps[after - 1])) / int(stamps[after] - stamps[after - 1])
            one, other = (np.array(tracks[k]["t_a_b_m"]) for k in (after - 1, after))
            place = one + share * (other - one)
        else:
            continue
        judged += 1
        off = np.array(row["t_a_b_m"]) - place
        sigmas = math.sqrt(far(off, row["covariance"]))
        if sigmas**2 > GATE:
            found.append(
                {
                    "trigger": row["trigger"],
                    "stamp_ns": row["stamp_ns"],
                    "off_m": float(np.linalg.norm(off)),
                    "sigmas": sigmas,
                }
            )
    listed = sorted(found, key=lambda one: -one["sigmas"])[:LISTED]
    return {"judged": judged, "found": len(found), "listed": listed}


def numbers_in(page: str) -> dict[str, Any]:
    """Return the numbers that a report's page carries."""
    (text,) = re.findall(r'<script type="application/json" id="numbers">(.*?)</script>', page, flags=re.DOTALL)
    found: dict[str, Any] = json.loads(text)
    return found


def differences(told: Any, computed: Any, path: str = "") -> Iterator[str]:
    """Yield each number that differs by more than rounding, and each that only one of the two has."""
    if isinstance(told, dict) and isinstance(computed, dict):
        for name in sorted({*told, *computed}):
            if name in told and name in computed:
                yield from differences(told[name], computed[name], f"{path}.{name}")
            else:
                yield f"{path}.{name}: only in {'the report' if name in told else 'the log'}"
    elif isinstance(told, list) and isinstance(computed, list) and len(told) == len(computed):
        for k, (one, other) in enumerate(zip(told, computed, strict=False)):
            yield from differences(one, other, f"{path}[{k}]")
    elif isinstance(told, float) and isinstance(computed, float | int):
        if not math.isclose(told, computed, rel_tol=1e-6, abs_tol=1e-9):
            yield f"{path}: {told} in the report, {computed} by the log"
    elif told != computed:
        yield f"{path}: {told} in the report, {computed} by the log"


def main(dive: str, report: str) -> int:
    with open(report, encoding="utf-8") as file:
        told = numbers_in(file.read())
    told.pop("about")
    wrong = list(differences(told, recompute(dive)))
    print("\n".join(wrong) or "every number of the report follows from the log")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
