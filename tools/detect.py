"""`buddyline detect`: find candidates in stored pictures, or in the pictures of a dive."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import msgspec
from buddyline.node.detect import Detection, make_detector
from buddyline.node.detect.masks import Corners
from buddyline.node.devices import Frame
from buddyline.node.drivers.stored import PICTURE_SUFFIXES, PictureError, decode_picture, picture_files, read_picture
from buddyline.node.pipeline import Pipeline
from buddyline.protocol.codec import encode
from buddyline.protocol.envelope import Envelope, envelope_of
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Candidates, CompressedImage, NodeInfo
from buddyline.protocol.topics import CANDIDATES, IMAGE, TOPICS
from buddyline.tools import losses
from buddyline.tools.dives import Dive
from buddyline.tools.draw.marks import mark_candidates
from buddyline.tools.newfile import new_dive_log, new_folder, write_picture
from buddyline.tools.progress import Progress

log = logging.getLogger(__name__)

FOLDER_PERIOD_NS = 100_000_000
# Topics that are copied: all but earlier candidates and the solver's results.
DERIVED_FROM = tuple(topic.name for topic in TOPICS if not topic.solved and topic is not CANDIDATES)


@dataclass
class DiveDetector:
    """Finds candidates in the pictures of a dive, with a detector for each node."""

    method: str
    environment: str
    infos: dict[str, NodeInfo]
    masks: Mapping[str, Sequence[Corners]] = field(default_factory=dict)
    skipped: int = 0
    pictures: int = 0
    _pipelines: dict[str, Pipeline] = field(default_factory=dict)
    last: tuple[Frame, list[Detection]] | None = None

    def candidates(self, envelope: Envelope) -> Envelope | None:
        """Return the candidates of one picture; None if it cannot be used, and the reason is reported as a loss."""
        image, node = envelope.message, envelope.node
        if not isinstance(image, CompressedImage):
            return None
        info = self.infos.get(node)
        try:
            picture = decode_picture(image.data, f"picture of node {node} at {image.stamp_ns}")
            height, width = picture.shape[:2]
            if info is not None and (width, height) != (info.width_px, info.height_px):
                raise PictureError(
                    f"picture of node {node} at {image.stamp_ns}: {width}x{height} px, "
                    f"its NodeInfo says {info.width_px}x{info.height_px}"
                )
        except PictureError as error:
            self.skipped += 1
            losses.report([str(error)])
            return None
        pipeline = self._pipelines.get(node)
        if pipeline is None:
            period_ns = info.trigger_period_ns if info else FOLDER_PERIOD_NS
            focal_px = info.camera.fx_px if info else None
            detector = make_detector(self.method, self.environment, focal_px=focal_px, masks=self.masks.get(node, ()))
            pipeline = self._pipelines[node] = Pipeline(node, f"detect-{self.method}", period_ns, detector)
        self.pictures += 1
        frame = Frame(picture, image.stamp_ns, info.row_time_ns if info else 0)
        candidates = pipeline.candidates(frame)
        self.last = (frame, pipeline.detections)
        return envelope_of(candidates, envelope.time_ns) if candidates is not None else None


def recorded_masks(dive: Dive) -> dict[str, list[list[tuple[float, float]]]]:
    """Return the masks of each node, from the configurations that the nodes wrote into their logs."""
    found = {}
    for reader in dive.readers:
        noted = reader.metadata()
        try:
            config = msgspec.json.decode(noted.get("config", "{}"), type=_RecordedConfig)
        except msgspec.DecodeError as error:
            losses.report([f"{reader.path}: its masks cannot be read from its configuration: {error}"])
            continue
        if config.detector.masks:
            found[noted.get("node", "")] = config.detector.masks
    return found


class _RecordedDetector(msgspec.Struct):
    masks: list[list[tuple[float, float]]] = msgspec.field(default_factory=list)


class _RecordedConfig(msgspec.Struct):
    detector: _RecordedDetector = msgspec.field(default_factory=_RecordedDetector)


def _given_masks(words: Sequence[str]) -> list[list[tuple[float, float]]]:
    """Return the masks of `--mask U,V,U,V ...`; raise BuddylineError."""
    masks = []
    for word in words:
        try:
            numbers = [float(number) for number in word.split(",")]
        except ValueError as error:
            raise BuddylineError(f"--mask {word}: not numbers with commas between them") from error
        if len(numbers) % 2:
            raise BuddylineError(f"--mask {word}: {len(numbers)} numbers; give u and v of each corner")
        masks.append(list(zip(numbers[::2], numbers[1::2], strict=True)))
    return masks


def run(args: argparse.Namespace) -> int:
    """Find candidates in pictures or in a dive; return the exit status."""
    cv2.setNumThreads(1)
    if args.draw:
        new_folder(args.draw)
    dives = [path for path in args.inputs if Path(path).suffix == ".mcap"]
    if dives and len(dives) != len(args.inputs):
        raise BuddylineError("give either pictures or dive logs, not both at once")
    return _detect_dive(args, dives) if dives else _detect_pictures(args)


def _detect_pictures(args: argparse.Namespace) -> int:
    if args.output:
        raise BuddylineError(
            "-o writes a dive log, which needs a dive's times and calibration; pictures give JSON lines"
        )
    files: list[Path] = []
    for name in args.inputs:
        found = picture_files(Path(name))
        if not found:
            raise BuddylineError(f"{name}: holds no pictures; known: {', '.join(sorted(PICTURE_SUFFIXES))}")
        files += found
    detector = make_detector(args.method, args.environment, masks=_given_masks(args.mask))
    pipeline = Pipeline("picture", f"detect-{args.method}", FOLDER_PERIOD_NS, detector)
    skipped = 0
    with Progress("detect", len(files)) as progress:
        for i, file in enumerate(files):
            progress.show(i, file.name)
            try:
                picture = read_picture(file)
            except PictureError as error:
                skipped += 1
                losses.report([str(error)])
                continue
            candidates = pipeline.candidates(Frame(picture, i * FOLDER_PERIOD_NS))
            if candidates is not None:
                print(f'{{"file":{json.dumps(str(file))},{encode(candidates).decode()[1:]}')
            if args.draw:
                write_picture(Path(args.draw), file.stem, mark_candidates(picture, pipeline.detections))
    if skipped:
        log.warning("%d of %d pictures skipped", skipped, len(files))
    return 1 if skipped == len(files) else 0


def _detect_dive(args: argparse.Namespace, paths: list[str]) -> int:
    with Dive(paths) as dive:
        infos = dive.infos()
        if not dive.nodes("image"):
            raise BuddylineError(f"{dive.name}: holds no pictures; topics: {', '.join(dive.keys) or 'none'}")
        given = _given_masks(args.mask)
        masks = {node: given for node in dive.nodes("image")} if given else recorded_masks(dive)
        detector = DiveDetector(args.method, args.environment, infos, masks)
        with new_dive_log(args.output) if args.output else nullcontext() as writer:
            for envelope in dive.messages(*DERIVED_FROM, doing="detect"):
                found = detector.candidates(envelope) if envelope.topic is IMAGE else envelope
                if found is None:
                    continue
                if writer is not None:
                    writer.write(found.key, found.payload, found.time_ns)
                elif isinstance(found.message, Candidates):
                    print(found.payload.decode())
                if isinstance(found.message, Candidates) and args.draw and detector.last:
                    frame, detections = detector.last
                    name = f"{found.node}_{found.message.trigger}"
                    write_picture(Path(args.draw), name, mark_candidates(frame.image, detections))
    print(f"{detector.pictures} pictures, {detector.skipped} skipped", file=sys.stderr)
    return 0
