"""The detectors' speed compared with other feature finders: milliseconds per picture on one thread, and ratios.

All finders get the same pictures: those of the given dives, or pictures rendered by this project's simulator. In each
round every finder takes all pictures of an environment in turn. Ratios are taken within a round, because a machine's
speed changes from minute to minute; the median over the rounds counts. pupil-apriltags, if it is installed, runs in a
process of its own, because some of its releases corrupt the heap.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any, Final, TypeAlias

import cv2
import numpy as np
from buddyline.node.choices import DETECTORS
from buddyline.node.detect import GuidedDetector, Region, make_detector
from buddyline.node.detect.detection import is_likely
from buddyline.node.guide import FLOOR, SIGMAS
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.bench.lights import FIRST_COUNTED, SIGMA, loop_frames
from buddyline.tools.measure.load import load_of
from buddyline.tools.measure.pictures import simulated_world, spread, stored_pictures, views
from buddyline.tools.measure.tables import text_table
from buddyline.tools.measure.turns import by_turns
from numpy.typing import NDArray

Pictures: TypeAlias = list[NDArray[np.uint8]]
Finder: TypeAlias = Callable[[NDArray[np.uint8]], object]

OURS: Final = DETECTORS[0]
WIDTHS_PX: Final = (820, 1640)
ASPECT: Final = 616 / 820
ENVIRONMENTS: Final = ("cavern", "night_reef", "lake", "basin")
SEED: Final = 3
GUIDED: Final = f"{OURS}, guided"
STEP_S: Final = 3.7
LOOP_STEP: Final = 23
"""Every so many pictures of the node's loop count."""
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmark's arguments."""
    parser.add_argument(
        "dives", nargs="*", metavar="DIVE.mcap", help="one environment each; default: rendered pictures"
    )
    parser.add_argument("--pictures", type=int, default=12, metavar="N", help="of each environment; default: 12")
    parser.add_argument("--width", type=int, nargs="+", default=list(WIDTHS_PX), metavar="PX")
    parser.add_argument(
        "--lamps", action="store_true", help="render at the exposure that the node's own loop chooses, not the scene's"
    )
    parser.add_argument(
        "--frames", type=int, metavar="N", help="measure only our detector's memory, up to this many pictures"
    )


def measure(args: argparse.Namespace) -> Any:
    """Return a row for each source and width, or with --frames the resident memory, KiB, by number of pictures.

    A row: ms per picture of each finder, and our detector's time over each finder's.
    """
    if args.pictures < 1 or min(args.width) < 64 or (args.frames is not None and args.frames < 10):
        raise BuddylineError("--pictures: at least 1; --width: at least 64; --frames: at least 10")
    cv2.setNumThreads(1)
    sources = args.dives or list(ENVIRONMENTS)
    if args.frames:
        return growth(pictures_of(sources[0], args.width[0], args.pictures, lamps=args.lamps), args.frames)
    return [
        compare(Path(source).stem, width_px, pictures_of(source, width_px, args.pictures, lamps=args.lamps))
        for source in sources
        for width_px in args.width
    ]


def compare(source: str, width_px: int, pictures: Pictures) -> dict[str, Any]:
    """Return the row for these pictures."""

    def over_all(finder: Finder) -> Callable[[], object]:
        return lambda: [finder(picture) for picture in pictures]

    guided = Guided(pictures)
    rounds = by_turns({name: over_all(finder) for name, finder in (_finders() | {GUIDED: guided}).items()}, ROUNDS)
    ms: dict[str, float | None] = {name: 1e3 * float(np.median(s)) / len(pictures) for name, s in rounds.items()}
    ratio: dict[str, float | None] = {
        name: float(np.median(rounds[OURS] / s)) for name, s in rounds.items() if name != OURS
    }
    ms[APRILTAGS] = _apriltags_ms(pictures)
    ratio[APRILTAGS] = _over(ms[OURS], ms[APRILTAGS])
    return {"source": source, "width_px": width_px, "ms": ms, "ratio": ratio, "guided_share": guided.share}


class Guided:
    """Our detector where two lights of each picture are expected: as far off as the track foretells them at 10 Hz.

    searched: the pictures that are searched in regions only; in the others nothing is likely, or the lights are large.
    share: of all pictures, how many these are. whole: searches a whole picture.
    """

    def __init__(self, pictures: Pictures) -> None:
        detector = make_detector(OURS)
        if not isinstance(detector, GuidedDetector):
            raise TypeError(f"{OURS} searches no regions")
        self.whole, self._detect_near = detector.detect, detector.detect_near
        self._regions: dict[int, list[Region]] = {}
        rng = np.random.default_rng(SEED)
        for picture in pictures:
            sigma_px = SIGMA * picture.shape[1]
            regions: list[Region] = []
            for d in self.whole(picture):
                if is_likely(d.blob) and len(regions) < 2:
                    u, v = np.add((d.blob.u_px, d.blob.v_px), rng.normal(0.0, sigma_px, 2)).tolist()
                    radius_px = SIGMAS * sigma_px + FLOOR * picture.shape[1]
                    regions.append(Region((u, v), radius_px, float(np.sqrt(d.blob.area_px / np.pi))))
            if regions and self._detect_near(picture, regions) is not None:
                self._regions[id(picture)] = regions
        self.searched = [picture for picture in pictures if id(picture) in self._regions]
        self.share = len(self._regions) / len(pictures)

    def __call__(self, picture: NDArray[np.uint8]) -> object:
        """Search a picture: the regions only, if it is one of `searched`."""
        regions = self._regions.get(id(picture))
        return self.whole(picture) if regions is None else self._detect_near(picture, regions)


def growth(pictures: Pictures, frames: int) -> dict[str, int]:
    """Return the process's resident memory, KiB, by the number of pictures that our detector has processed."""
    detector = make_detector(OURS)
    resident_kib = {}
    for i in range(1, frames + 1):
        detector.detect(pictures[i % len(pictures)])
        if i in (frames // 10, frames):
            resident_kib[str(i)] = load_of().rss_bytes // 1024
    return resident_kib


def table(figures: Any) -> str:
    """Return the figures as text: ms, and our detector's time over each finder's."""
    if isinstance(figures, dict):
        return "\n".join(f"after {frames:>6s} pictures: {kib} KiB resident" for frames, kib in figures.items())
    names = list(figures[0]["ms"])

    def line(title: str, ms: Mapping[str, float | None], ratio: Mapping[str, float | None]) -> list[str]:
        cells = []
        for name in names:
            value, share = ms[name], ratio.get(name)
            after = f" ({share:4.2f})" if share is not None else " " * 7
            cells.append(f"{'-' if value is None else f'{value:.2f}'}{after}")
        return [title, *cells]

    rows = [["ms per picture", *names]]
    rows += [line(f"{row['source']} {row['width_px']} px", row["ms"], row["ratio"]) for row in figures]
    for width_px in sorted({row["width_px"] for row in figures}):
        of_width = [row["ms"] for row in figures if row["width_px"] == width_px]
        known = [name for name in names if all(ms[name] is not None for ms in of_width)]
        mean = dict.fromkeys(names) | {name: sum(ms[name] for ms in of_width) / len(of_width) for name in known}
        pooled = {name: _over(mean[OURS], mean[name]) for name in known if name != OURS}
        rows.append(line(f"all {width_px} px", mean, pooled))
    shares = [row["guided_share"] for row in figures]
    note = f"\n{GUIDED}: regions only in {sum(shares) / len(shares):.0%} of the pictures"
    absent = f"\n{APRILTAGS}: not installed" if find_spec("pupil_apriltags") is None else ""
    return f"{text_table(rows)}\nin parentheses: the time of {OURS} over that finder's{note}{absent}"


def _over(ours_ms: float | None, other_ms: float | None) -> float | None:
    return ours_ms / other_ms if ours_ms and other_ms else None


def _finders() -> dict[str, Finder]:
    """Return the finders, each with its default settings."""
    aruco = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    blobs = cv2.SimpleBlobDetector.create()
    finders: dict[str, Finder] = {method: make_detector(method).detect for method in DETECTORS}
    return finders | {"cv2.aruco 36h11": aruco.detectMarkers, "SimpleBlob": blobs.detect}


def _apriltags_ms(pictures: Pictures) -> float | None:
    """Return the mean ms of pupil-apriltags, in a process of its own; None if it is not installed or crashes."""
    if find_spec("pupil_apriltags") is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pictures.npy"
        np.save(path, np.stack([cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) for picture in pictures]))
        command = [sys.executable, "-c", APRILTAGS_PROGRAM, str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    return 1e3 * float(np.mean([float(word) for word in done.stdout.split()])) if done.returncode == 0 else None


def pictures_of(source: str, width_px: int, count: int, *, lamps: bool) -> Pictures:
    """Return colour pictures of this width, from a dive, or rendered of an environment.

    lamps: rendered ones have the exposure that the node's loop has locked to the lamps, and not the scene's.
    """
    height_px = round(width_px * ASPECT)
    if source.endswith(".mcap"):
        stored = [_in_colour(picture, width_px, height_px) for picture in stored_pictures(source)]
        if not stored:
            raise BuddylineError(f"{source}: holds no pictures")
        return spread(stored, count)
    world = simulated_world(source, SEED, width_px, height_px)
    if not lamps:
        return [world.render(node, stamp_ns) for node, stamp_ns in views(world, count, STEP_S)]
    frames = loop_frames(world, world.scenario.node_a, FIRST_COUNTED + count * LOOP_STEP)
    return [frame.image for frame, _ in islice(frames, 0, None, LOOP_STEP)][:count]


def _in_colour(picture: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    colour = picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    method = cv2.INTER_AREA if colour.shape[1] > width_px else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(colour, (width_px, height_px), interpolation=method), np.uint8)
