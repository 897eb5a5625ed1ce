"""How fast the detectors are beside others' feature finders: milliseconds per picture, on one thread, as ratios.

The same pictures for all: those of the dives named, or else rendered by this project's simulator. In each round every
finder goes over all pictures of an environment before the next begins, as it would in a camera's loop; ratios are of
the same round, as a machine's speed changes from minute to minute, and the median round counts. pupil-apriltags is
measured in a process of its own, where it is installed: its releases corrupt the heap now and then.
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
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, TypeAlias

import cv2
import numpy as np
from buddyline.node.detect import METHODS, make_detector
from buddyline.node.drivers.stored import decode_picture
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CompressedImage
from buddyline.protocol.topics import IMAGE
from buddyline.tools.dives import Dive
from numpy.typing import NDArray

Pictures: TypeAlias = list[NDArray[np.uint8]]
Finder: TypeAlias = Callable[[NDArray[np.uint8]], object]

OURS: Final = METHODS[0]
WIDTHS_PX: Final = (820, 1640)
ASPECT: Final = 616 / 820
ENVIRONMENTS: Final = ("cavern", "night_reef", "lake", "basin")
ROUNDS: Final = 5
APRILTAGS: Final = "pupil-apriltags"
APRILTAGS_PROGRAM: Final = """
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
    parser = argparse.ArgumentParser(prog="python -m buddyline.tools.bench detect", description=__doc__)
    parser.add_argument(
        "dives", nargs="*", metavar="DIVE.mcap", help="one environment each; default: rendered pictures"
    )
    parser.add_argument("--pictures", type=int, default=12, metavar="N", help="of each environment; default: 12")
    parser.add_argument("--width", type=int, nargs="+", default=list(WIDTHS_PX), metavar="PX")
    parser.add_argument(
        "--frames", type=int, metavar="N", help="only: how the memory of ours grows up to this many pictures"
    )
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    if args.pictures < 1 or min(args.width) < 64 or (args.frames is not None and args.frames < 10):
        raise BuddylineError("--pictures: at least 1; --width: at least 64; --frames: at least 10")
    cv2.setNumThreads(1)
    sources = args.dives or list(ENVIRONMENTS)
    if args.frames:
        figures: Any = growth(_pictures(sources[0], args.width[0], args.pictures), args.frames)
        text = "".join(f"after {frames:>6s} pictures: {kib} KiB resident\n" for frames, kib in figures.items())
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
    """Return a row for each source and width: ms per picture by finder, and the time of ours over each one's."""
    rows = []
    for source in sources:
        for width_px in widths_px:
            pictures = _pictures(source, width_px, count)
            rounds = _rounds(_finders(), pictures)
            ms: dict[str, float | None] = {name: float(np.median(times)) for name, times in rounds.items()}
            ratio: dict[str, float | None] = {
                name: float(np.median(rounds[OURS] / times)) for name, times in rounds.items() if name != OURS
            }
            apriltags_ms = _apriltags_ms(pictures)
            ms[APRILTAGS] = apriltags_ms
            ratio[APRILTAGS] = _over(ms[OURS], apriltags_ms)
            rows.append({"source": Path(source).stem, "width_px": width_px, "ms": ms, "ratio": ratio})
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Return the figures for a person: ms, and what ours takes of each other's time."""
    names = list(rows[0]["ms"])
    lines = [f"{'ms per picture':24s}" + "".join(f"{name:>17s}" for name in names)]

    def line(title: str, ms: dict[str, float | None], ratio: dict[str, float | None]) -> str:
        cells = []
        for name in names:
            value, share = ms[name], ratio.get(name)
            after = f" ({share:4.2f})" if share is not None else " " * 7
            cells.append(f"{value:8.2f}{after}" if value is not None else f"{'-':>8s}{' ' * 7}")
        return f"{title:24s}" + "".join(f"{cell:>17s}" for cell in cells)

    lines += [line(f"{row['source']} {row['width_px']} px", row["ms"], row["ratio"]) for row in rows]
    for width_px in sorted({row["width_px"] for row in rows}):
        of_width = [row["ms"] for row in rows if row["width_px"] == width_px]
        known = [name for name in names if all(ms[name] is not None for ms in of_width)]
        mean = dict.fromkeys(names) | {name: sum(ms[name] for ms in of_width) / len(of_width) for name in known}
        pooled = {name: _over(mean[OURS], mean[name]) for name in known if name != OURS}
        lines.append(line(f"all {width_px} px", mean, pooled))
    lines.append(f"in parentheses: the time of {OURS} over that finder's")
    if find_spec("pupil_apriltags") is None:
        lines.append(f"{APRILTAGS}: not installed")
    return "\n".join(lines) + "\n"


def _over(ours_ms: float | None, other_ms: float | None) -> float | None:
    return ours_ms / other_ms if ours_ms and other_ms else None


def growth(pictures: Pictures, frames: int) -> dict[str, int]:
    """Return the process's resident memory in KiB by the number of pictures that ours has gone over."""
    detector = make_detector(OURS)
    resident_kib = {}
    for i in range(1, frames + 1):
        detector.detect(pictures[i % len(pictures)])
        if i in (frames // 10, frames):
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            resident_kib[str(i)] = pages * resource.getpagesize() // 1024
    return resident_kib


def _finders() -> dict[str, Finder]:
    """Return what is compared, each with its defaults."""
    aruco = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    blobs = cv2.SimpleBlobDetector.create()
    finders: dict[str, Finder] = {method: make_detector(method).detect for method in METHODS}
    return finders | {"cv2.aruco 36h11": aruco.detectMarkers, "SimpleBlob": blobs.detect}


def _rounds(finders: dict[str, Finder], pictures: Pictures) -> dict[str, NDArray[np.float64]]:
    """Return each finder's mean ms per picture in each round, after a first one to warm up."""
    times = {name: np.empty(ROUNDS + 1) for name in finders}
    for i in range(ROUNDS + 1):
        for name, finder in finders.items():
            start = time.thread_time()
            for picture in pictures:
                finder(picture)
            times[name][i] = 1e3 * (time.thread_time() - start) / len(pictures)
    return {name: of_rounds[1:] for name, of_rounds in times.items()}


def _apriltags_ms(pictures: Pictures) -> float | None:
    """Return pupil-apriltags' mean ms in a process of its own; None where it is missing or dies."""
    if find_spec("pupil_apriltags") is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pictures.npy"
        np.save(path, np.stack([cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) for picture in pictures]))
        done = subprocess.run(
            [sys.executable, "-c", APRILTAGS_PROGRAM, str(path)],
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
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
        for envelope in dive.messages(IMAGE.name):
            image = envelope.message
            if isinstance(image, CompressedImage):
                yield decode_picture(image.data, f"{path}: picture at {image.stamp_ns}")


def _rendered(environment: str, size: tuple[int, int], count: int) -> Iterator[NDArray[np.uint8]]:
    from buddyline.node.sim.scenario import ENVIRONMENTS as KNOWN
    from buddyline.node.sim.scenario import Scenario
    from buddyline.node.sim.world import World

    if environment not in KNOWN:
        raise BuddylineError(f"{environment}: is neither a dive (.mcap) nor one of {', '.join(KNOWN)}")
    scenario = Scenario(environment=environment, seed=3, width_px=size[0], height_px=size[1])  # type: ignore[arg-type]
    world = World(scenario)
    for i in range(count):
        node = (scenario.node_a, scenario.node_b)[i % 2]
        yield world.render(node, scenario.start_ns + round((1.0 + 3.7 * i) * 1e9))
