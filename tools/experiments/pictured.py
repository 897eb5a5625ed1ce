"""Pictures of one trigger for the report: raw, with the candidates, and with the chosen pair."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
import numpy as np
from buddyline.node.detect import make_detector
from buddyline.node.drivers.stored import decode_picture
from buddyline.protocol.clock import trigger_index
from buddyline.protocol.messages import Candidates, CompressedImage, RelativePose
from buddyline.tools.dives import Dive
from buddyline.tools.draw.marks import mark_candidates, mark_lights
from buddyline.tools.experiments.runs import OURS, Rendered

MOST_MARKED: Final = 6
LETTERS: Final = 2.2
# Scale that gives about 140 dots an inch on paper. More would show noise alone, and make the file large.
ON_PAPER: Final = 0.6


def detections(dive: Rendered, path: Path) -> int | None:
    """Draw A's and B's pictures of one trigger, raw, with candidates, and with the chosen pair; return the trigger."""
    errors = dive.results[OURS].errors
    good = errors.select((errors.right_pair == 1.0) & (errors.true_range_m > 2.0))
    if not len(good):
        return None
    trigger = int(good.trigger[len(good) // 2])
    with Dive([dive.dive]) as log:
        infos = log.infos()
        pictures = {}
        for envelope in log.messages("image"):
            message, node = envelope.message, envelope.node
            if not isinstance(message, CompressedImage):
                continue
            if trigger_index(message.stamp_ns, infos[node].trigger_period_ns) == trigger:
                pictures[node] = decode_picture(message.data, envelope.key)
    chosen: dict[str, tuple[int, int]] = {}
    frames: dict[str, Candidates] = {}
    with Dive([dive.logs[OURS]]) as log:
        for envelope in log.messages("pose", "candidates"):
            found = envelope.message
            if isinstance(found, RelativePose) and found.trigger == trigger:
                chosen = {found.node_a: found.blobs_a, found.node_b: found.blobs_b}
            elif isinstance(found, Candidates) and found.trigger == trigger:
                frames[found.node] = found
    columns = []
    for node, lights in chosen.items():
        raw = pictures[node]
        # Two pictures side by side on paper: their letters must be larger than on a screen.
        candidates = mark_candidates(raw, make_detector().detect(raw)[:MOST_MARKED], letters=LETTERS)
        columns.append(np.vstack([raw, candidates, mark_lights(raw, frames[node].blobs, lights)]))
    whole = cv2.resize(np.hstack(columns), None, fx=ON_PAPER, fy=ON_PAPER, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), whole, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return trigger
