"""The stages of the pipeline, run by the commands that a person would use; results as plain JSON objects.

Commands outlive what is inside of them: a golden result must not have to change because the code was moved.
"""

import contextlib
import io
import json
import math
import tomllib
from collections.abc import Iterable
from pathlib import Path

from buddyline.tools.cli import main

from tests.golden.logs import read_log

Record = dict[str, object]
TRACK_STEP = 10
UPPER = [6 * row + column for row in range(6) for column in range(row, 6)]

UPPER_V = [0, 1, 2, 4, 5, 8]


def run(*words: object) -> tuple[int, str]:
    """Run a command of `buddyline` in this process; return exit status and stdout."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        status = main([str(word) for word in words])
    return status, out.getvalue()


def detect(dive: Path) -> tuple[int, list[Record]]:
    """Pictures -> candidates: exit status, and each frame's candidates by node and trigger."""
    status, text = run("detect", dive, "--json")
    frames = [_frame(json.loads(line)) for line in text.splitlines()]
    return status, sorted(frames, key=lambda frame: (frame["node"], frame["trigger"]))


def solve(dives: list[Path], output: Path, *options: str) -> tuple[int, list[Record]]:
    """Candidates (or pictures) -> outcomes: exit status, and every pose and rejection by pair and trigger."""
    assert not output.exists(), output
    status, _ = run("solve", *dives, "-o", output, "--track", "none", *options)
    return status, outcomes_of(output)


def track(dives: list[Path], output: Path, mode: str) -> tuple[int, list[Record]]:
    """Candidates and sensors -> track: exit status, and every tenth row of the track by time."""
    assert not output.exists(), output
    status, _ = run("solve", *dives, "-o", output, "--track", mode, "--track-hz", "20")
    return status, rows_of(output)


def rows_of(log: Path) -> list[Record]:
    """Return every tenth row of the track of a solved log by time."""
    rows = [entry.message for entry in read_log(log) if entry.topic == "track"]
    return [_row(row) for row in sorted(rows, key=lambda row: row["stamp_ns"])[::TRACK_STEP]]


def outcomes_of(log: Path) -> list[Record]:
    """Return the poses and rejections of a solved log by pair and trigger."""
    outcomes = [_outcome(entry.topic, entry.message) for entry in read_log(log) if entry.topic in ("pose", "rejected")]
    return sorted(outcomes, key=lambda one: (one["pair"], one["trigger"], one["stamp_ns"]))


def outcomes_of_messages(payloads: list[bytes]) -> list[Record]:
    """Return the same of encoded poses and rejections."""
    messages = [json.loads(payload) for payload in payloads]
    outcomes = [_outcome("pose" if "t_a_b_m" in message else "rejected", message) for message in messages]
    return sorted(outcomes, key=lambda one: (one["pair"], one["trigger"], one["stamp_ns"]))


def align(dives: list[Path]) -> tuple[int, list[Record]]:
    """Candidates -> offset of the clocks: exit status, and the one result, if there is one."""
    status, text = run("align", *dives, "--json")
    return status, [json.loads(line) for line in text.splitlines()]


def legs(project: Path, logs: list[Path]) -> tuple[int, list[Record]]:
    """Solved dive and the nodes' own logs -> legs and stations: exit status, and what the project file holds of them.

    Of problems and alarms, which are words, it is their number that counts.
    """
    status, _ = run("survey", "legs", project, "--dive", *logs)
    tables = tomllib.loads(project.read_text())
    records: list[Record] = [{"what": "problems", "count": len(tables.get("problem", []))}]
    for what in ("station", "leg", "point"):
        for row in tables.get(what, []):
            counted = {name: len(row[name]) for name in ("alarms", "notes") if name in row}
            records.append({"what": what, **row, **counted})
    return status, records


def _frame(message: Record) -> Record:
    blobs = [
        [round(blob["u_px"], 9), round(blob["v_px"], 9)]
        + [
            _significant(blob.get(name, 0), 9)
            for name in ("sigma_px", "area_px", "peak", "elongation", "dt_ns", "score")
        ]
        for blob in message["blobs"]
    ]
    names = ("node", "trigger", "seq", "stamp_ns", "width_px", "height_px")
    return {**{name: message[name] for name in names}, "truncated": message.get("truncated", 0), "blobs": blobs}


def _outcome(topic: str, message: Record) -> Record:
    outcome: Record = {
        "pair": f"{message['node_a']}/{message['node_b']}",
        "trigger": message["trigger"],
        "stamp_ns": message["stamp_ns"],
        "outcome": topic,
    }
    if topic == "rejected":
        return {**outcome, "reason": message["reason"]}
    outcome |= {name: message[name] for name in ("method", "blobs_a", "blobs_b", "checks", "skew_ns")}
    outcome["lights"] = sum(index >= 0 for index in [*message["blobs_a"], *message["blobs_b"]])
    outcome["t_a_b_m"] = _rounded(message["t_a_b_m"], 11)
    outcome["q_a_b_xyzw"] = _rounded(message["q_a_b_xyzw"], 13)
    outcome["chi2"] = _significant(message["chi2"], 9)
    if "t_ned_m" in message:
        outcome["t_ned_m"] = _rounded(message["t_ned_m"], 11)
    outcome["covariance"] = [_significant(message["covariance"][index], 10) for index in UPPER]
    return outcome


def _row(message: Record) -> Record:
    row: Record = {
        "pair": f"{message['node_a']}/{message['node_b']}",
        "name": str(message["stamp_ns"]),
        "mode": message["mode"],
        "lights": message["lights"],
        "age_s": round(message["age_s"], 9),
        "t_a_b_m": _rounded(message["t_a_b_m"], 11),
        "q_a_b_xyzw": _rounded(message["q_a_b_xyzw"], 13),
        "covariance": [_significant(message["covariance"][index], 10) for index in UPPER],
        "v_a_b_mps": _rounded(message["v_a_b_mps"], 11),
        "v_covariance": [_significant(message["v_covariance"][index], 10) for index in UPPER_V],
    }
    for name in ("t_ned_m", "sigma_ned_m"):
        row[name] = _rounded(message[name], 11)
    for name in ("azimuth_rad", "sigma_azimuth_rad", "inclination_rad", "sigma_inclination_rad"):
        row[name] = round(message[name], 11)
    return row


def _rounded(values: Iterable[float], digits: int) -> list[float]:
    return [round(value, digits) for value in values]


def _significant(value: float, digits: int) -> float:
    return value if value == 0 else round(value, digits - 1 - math.floor(math.log10(abs(value))))
