"""Make the golden dives and the sample dive again: `python -m tests.golden.make FOLDER`.

FOLDER/sample.mcap is what `buddyline sample` gives, and lies as tools/sample.mcap. The dives in tests/data/golden are
the reference, not this program: another OpenCV compresses pictures differently, and the simulator may change. Run it to
add a dive, and commit that dive alone.
"""

import argparse
import math
from pathlib import Path

import numpy as np
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.messages import Rejected, RelativePose
from buddyline.tools.cli import main

from tests.golden.logs import Entry, read_log, write_log
from tests.tools import survey_world

S_NS = 1_000_000_000
TRUTHS = ("truth", "light_truth")


def simulate(path: Path, options: str) -> list[Entry]:
    """Run `buddyline simulate`; return the log's messages."""
    if main(["simulate", str(path), *options.split()]) != 0:
        raise SystemExit(f"{path}: simulate failed")
    return read_log(path)


def without_light(entries: list[Entry], seer: str, light: str, from_s: float, to_s: float) -> list[Entry]:
    """Take the other node's light out of seer's candidates for a while, as a lamp does that fails."""
    start_ns = entries[0].log_time_ns
    truth = {entry.message["trigger"]: entry.message for entry in entries if entry.key.endswith(f"{seer}/light_truth")}
    out = []
    for entry in entries:
        seconds = (entry.log_time_ns - start_ns) / S_NS
        if entry.topic == "candidates" and entry.node == seer and from_s <= seconds < to_s:
            lights = {one["name"]: one for one in truth[entry.message["trigger"]]["lights"]}
            u_px, v_px = lights[light]["u_px"], lights[light]["v_px"]
            kept = [b for b in entry.message["blobs"] if math.hypot(b["u_px"] - u_px, b["v_px"] - v_px) > 25]
            entry = entry.saying(blobs=kept)  # noqa: PLW2901
        out.append(entry)
    return out


def write_cut_by_the_second(path: Path, entries: list[Entry]) -> None:
    """Write a log in chunks of a second, as a node's recorder does."""
    with DiveLogWriter(path) as writer:
        second = 0
        for entry in entries:
            if entry.log_time_ns // S_NS != second:
                second = entry.log_time_ns // S_NS
                writer.flush()
            writer.write(entry.key, entry.payload, entry.log_time_ns, entry.publish_time_ns)


def damage(path: Path) -> None:
    """Invert 200 bytes in the middle, and cut the last tenth off."""
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 200] = bytes(255 - byte for byte in data[middle : middle + 200])
    path.write_bytes(data[: len(data) * 9 // 10])


def leapfrog(path: Path) -> None:
    """Three legs of a survey, without what the solver said of them."""
    rng = np.random.default_rng(5)
    messages = survey_world.dive(survey_world.line(rng, 3), rng, rest_s=8.0, swim_s=2.0)
    by_second = path.with_name("by_second.mcap")
    with DiveLogWriter(by_second) as writer:
        for message in messages:
            if not isinstance(message, RelativePose | Rejected):
                writer.write_message(message)
    write_log(path, read_log(by_second))
    by_second.unlink()


def sample(path: Path) -> None:
    """Write 30 s of a cavern: candidates of its pictures at 5 Hz, and each node's pictures every two seconds."""
    pictures, found = path.with_name("pictures.mcap"), path.with_name("found.mcap")
    entries = simulate(pictures, "--environment cavern --seconds 30 --rate 5 --images --exposure auto --imu --seed 8")
    if main(["detect", str(pictures), "-o", str(found)]) != 0:
        raise SystemExit(f"{path}: detect failed")
    candidates = [entry for entry in read_log(found) if entry.topic == "candidates"]
    pictures.unlink()
    found.unlink()
    start_ns = entries[0].log_time_ns
    # Stamps are some milliseconds off their triggers.
    since_ns = start_ns - S_NS // 20
    kept = [
        entry for entry in entries if entry.topic != "image" or (entry.log_time_ns - since_ns) % (2 * S_NS) < S_NS // 10
    ]
    write_log(path, sorted(kept + candidates, key=lambda entry: entry.log_time_ns))


def make(folder: Path) -> None:
    """Write all golden dives, and the sample dive, into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    sample(folder / "sample.mcap")
    simulate(folder / "cavern.mcap", "--environment cavern --seconds 14 --seed 3")
    inertial = folder / "cavern_inertial.mcap"
    entries = simulate(inertial, "--environment cavern --seconds 6 --seed 12 --imu --inertial poor --others 1")
    write_log(inertial, [entry for entry in entries if entry.topic not in TRUTHS])
    lake = folder / "lake_dead_lamp.mcap"
    entries = simulate(lake, "--environment lake --seconds 12 --seed 11 --false 1 --others 0")
    # Three lights first, then two at one node, and then a lamp of the other goes out as well.
    entries = without_light(entries, "a", "left", 3.0, 12.0)
    entries = without_light(entries, "b", "right", 8.0, 9.0)
    write_log(lake, entries)
    reef = simulate(
        folder / "both.mcap", "--environment night_reef --seconds 14 --seed 5 --clock-offset-ms 30 --others 2"
    )
    (folder / "both.mcap").unlink()
    for node in "ab":
        write_log(folder / f"night_reef_{node}.mcap", [e for e in reef if e.key.startswith(f"buddyline/node/{node}/")])
    damaged = folder / "basin_damaged.mcap"
    entries = simulate(folder / "whole.mcap", "--environment basin --seconds 12 --seed 7")
    (folder / "whole.mcap").unlink()
    write_cut_by_the_second(damaged, entries)
    damage(damaged)
    simulate(
        folder / "night_reef_pictures.mcap",
        "--environment night_reef --seconds 1.6 --rate 5 --seed 2 --images --width 480",
    )
    simulate(
        folder / "lake_pictures.mcap",
        "--environment lake --seconds 1.6 --rate 5 --seed 4 --images --width 480 --row-time-us 20",
    )
    simulate(folder / "basin_pictures.mcap", "--environment basin --seconds 1.6 --rate 5 --seed 8 --images --width 480")
    leapfrog(folder / "survey.mcap")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    make(parser.parse_args().folder)
