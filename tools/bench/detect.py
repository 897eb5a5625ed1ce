"""How fast the detectors are beside others' feature finders: milliseconds per picture, on one thread, as ratios.

The same pictures for all: those of the dives named, or else rendered by this project's simulator. Each finder goes
over all pictures of an environment before the next begins, as it would in a camera's loop. pupil-apriltags is measured
in a process of its own, where it is installed: its releases corrupt the heap now and then.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from node.detect import METHODS, make_detector
from node.drivers.stored import decode_picture
from protocol.errors import BuddylineError
from protocol.messages import CompressedImage, MessageError, decode
from protocol.topics import IMAGE
from tools.dives import Dive

Pictures: TypeAlias = list[NDArray[np.uint8]]
Finder: TypeAlias = Callable[[NDArray[np.uint8]], object]

OURS: Final = METHODS[0]
WIDTHS_PX: Final = (820, 1640)
ASPECT: Final = 616 / 820
ENVIRONMENTS: Final = ("cavern", "night_reef", "lake", "basin")
APRILTAGS: Final = """
import sys, time
import numpy as np
from pupil_apriltags import Detector
pictures = np.load(sys.argv[1])
detector = Detector(families="tag36h11", nthreads=1, quad_decimate=2.0)
detector.detect(pictures[0])
times = []
for picture in pictures:
    start = time.thread_time()
    detector.detect(picture)
    times.append(time.thread_time() - start)
print(*times)
"""


def main(argv: list[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench detect", description=__doc__)
    parser.add_argument(
        "dives", nargs="*", metavar="DIVE.mcap", help="one environment each; default: rendered pictures"
    )
    parser.add_argument("--pictures", type=int, default=12, metavar="N", help="of each environment; default: 12")
    parser.add_argument("--width", type=int, nargs="+", default=list(WIDTHS_PX), metavar="PX")
    parser.add_argument(
        "--frames", type=int, metavar="N", help="only: how the memory of ours grows over this many pictures"
    )
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    if args.pictures < 1 or min(args.width) < 64 or (args.frames is not None and args.frames < 100):
        raise BuddylineError("--pictures: at least 1; --width: at least 64; --frames: at least 100")
    cv2.setNumThreads(1)
    sources = args.dives or list(ENVIRONMENTS)
    if args.frames:
        figures: Any = growth(_pictures(sources[0], args.width[0], args.pictures), args.frames)
        text = f"{figures['frames']} pictures: {figures['grown_kib']} KiB more than after the first hundred\n"
    else:
        figures = measure(sources, args.width, args.pictures)
        text = table(figures)
    if args.json:
        json.dump(figures, sys.stdout, indent=1)
        sys.stdout.write("\n")
    else:
        sys.stdout.write(text)
    return 0


def measure(sources: list[str], widths_px: list[int], count: int) -> list[dict[str, Any]]:
    """Return a row for each source and width: the mean ms per picture by finder."""
    rows = []
    for source in sources:
        for width_px in widths_px:
            pictures = _pictures(source, width_px, count)
            times: dict[str, float | None] = {n: _mean_ms(finder, pictures) for n, finder in _finders().items()}
            times["pupil-apriltags"] = _apriltags_ms(pictures)
            rows.append({"source": Path(source).stem, "width_px": width_px, "ms": times})
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Return the figures for a person: ms, and what ours takes of each other's time."""
    names = list(rows[0]["ms"])
    lines = [f"{'ms per picture':24s}" + "".join(f"{name:>17s}" for name in names)]

    def line(title: str, ms: dict[str, float | None]) -> str:
        cells = []
        for name in names:
            value = ms[name]
            ratio = f" ({ms[OURS] / value:4.2f})" if value and name != OURS else " " * 7  # type: ignore[operator]
            cells.append(f"{value:8.2f}{ratio}" if value is not None else f"{'-':>8s}{' ' * 7}")
        return f"{title:24s}" + "".join(f"{cell:>17s}" for cell in cells)

    lines += [line(f"{row['source']} {row['width_px']} px", row["ms"]) for row in rows]
    for width_px in sorted({row["width_px"] for row in rows}):
        of_width = [row["ms"] for row in rows if row["width_px"] == width_px]
        pooled = {
            name: None if any(ms[name] is None for ms in of_width) else sum(ms[name] for ms in of_width) / len(of_width)
            for name in names
        }
        lines.append(line(f"all {width_px} px", pooled))
    lines.append(f"in parentheses: the time of {OURS} over that finder's")
    return "\n".join(lines) + "\n"


def growth(pictures: Pictures, frames: int) -> dict[str, int]:
    """Return by how much the process's peak memory grows after the first hundred pictures."""
    detector = make_detector(OURS)
    before_kib = 0
    for i in range(frames):
        detector.detect(pictures[i % len(pictures)])
        if i == 99:
            before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"frames": frames, "grown_kib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib}


def _finders() -> dict[str, Finder]:
    """Return what is compared, each with its defaults."""
    aruco = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    blobs = cv2.SimpleBlobDetector.create()
    finders: dict[str, Finder] = {method: make_detector(method).detect for method in METHODS}
    return finders | {"cv2.aruco 36h11": aruco.detectMarkers, "SimpleBlob": blobs.detect}


def _mean_ms(finder: Finder, pictures: Pictures) -> float:
    """Return the mean over the pictures of the faster of two rounds, after a first one to warm up."""
    times = np.empty((3, len(pictures)))
    for i in range(3):
        for j, picture in enumerate(pictures):
            start = time.thread_time()
            finder(picture)
            times[i, j] = time.thread_time() - start
    return 1e3 * float(times[1:].min(axis=0).mean())


def _apriltags_ms(pictures: Pictures) -> float | None:
    """Return pupil-apriltags' mean ms in a process of its own; None where it is missing or dies."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pictures.npy"
        np.save(path, np.stack([cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) for picture in pictures]))
        done = subprocess.run(
            [sys.executable, "-c", APRILTAGS, str(path)], capture_output=True, text=True, check=False, timeout=600
        )
    return 1e3 * float(np.mean([float(word) for word in done.stdout.split()])) if done.returncode == 0 else None


def _pictures(source: str, width_px: int, count: int) -> Pictures:
    """Return pictures of a dive, or of an environment that the simulator renders, in colour and of this width."""
    size = (width_px, round(width_px * ASPECT))
    taken = _stored(source) if source.endswith(".mcap") else _rendered(source, size, count)
    some: Pictures = []
    for picture in taken:
        colour = picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
        smaller = colour.shape[1] > size[0]
        method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        some.append(np.asarray(cv2.resize(colour, size, interpolation=method), np.uint8))
    if not some:
        raise BuddylineError(f"{source}: holds no pictures")
    return [some[round(i)] for i in np.linspace(0, len(some) - 1, min(count, len(some)))]


def _stored(path: str) -> Iterator[NDArray[np.uint8]]:
    with Dive([path]) as dive:
        for record in dive.records(IMAGE.name):
            try:
                image = decode(record.payload, CompressedImage)
            except MessageError:
                continue
            yield decode_picture(image.data, f"{path}: picture at {image.stamp_ns}")


def _rendered(environment: str, size: tuple[int, int], count: int) -> Iterator[NDArray[np.uint8]]:
    from node.sim.scenario import ENVIRONMENTS as KNOWN
    from node.sim.scenario import Scenario
    from node.sim.world import World

    if environment not in KNOWN:
        raise BuddylineError(f"{environment}: is neither a dive (.mcap) nor one of {', '.join(KNOWN)}")
    scenario = Scenario(environment=environment, seed=3, width_px=size[0], height_px=size[1])  # type: ignore[arg-type]
    world = World(scenario)
    for i in range(count):
        node = (scenario.node_a, scenario.node_b)[i % 2]
        yield world.render(node, scenario.start_ns + round((1.0 + 3.7 * i) * 1e9))
