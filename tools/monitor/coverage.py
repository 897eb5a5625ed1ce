"""Show in bins of time when a dive has poses or a track, and when not."""

from __future__ import annotations

import base64
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.tools.evaluation.stretches import Outcome, Stretch, stretches
from buddyline.tools.health.words import duration_words, reason_words

BINS: Final = 600
# No bin is shorter: with several triggers in each, a slow trigger rate makes no stripes.
LEAST_BIN_NS: Final = S_NS
TRACK_LEGEND: Final = "green: a good track; yellow: partly; red: too uncertain; grey: no track"
LEGEND: Final = "green: poses; yellow: some triggers without; red: most without; grey: nothing to solve"
CSS: Final = (
    ".strip{position:relative}.strip img{width:100%;height:22px;display:block;image-rendering:pixelated;"
    "border-radius:3px}.strip i{position:absolute;top:0;width:3px;height:22px;background:#fff;outline:1px solid #000}"
)
# Blue, green, red, opacity: without triggers, all solved, some solved, most rejected.
_COLOURS: Final = np.array([(128, 128, 128, 50), (90, 154, 63, 255), (39, 162, 201, 255), (63, 72, 208, 255)], np.uint8)


class Coverage:
    """Counts poses and rejections by time; begin_ns and end_ns bound the dive."""

    def __init__(self, begin_ns: int, end_ns: int) -> None:
        self.begin_ns = begin_ns
        self.end_ns = max(end_ns, begin_ns + 1)
        bins = min(BINS, max((end_ns - begin_ns) // LEAST_BIN_NS, 1))
        self.solved = np.zeros(bins, int)
        self.rejected = np.zeros(bins, int)
        self.complete = False
        self._outcomes: list[Outcome] = []

    def add(self, at_ns: int, reason: str | None, stamp_ns: int | None = None) -> None:
        """Count one trigger; reason: None for a pose; stamp_ns: the trigger's own time, if it is not the log's."""
        self._outcomes.append(Outcome(at_ns if stamp_ns is None else stamp_ns, at_ns, reason))
        bins = len(self.solved)
        index = min(max((at_ns - self.begin_ns) * bins // (self.end_ns - self.begin_ns), 0), bins - 1)
        if reason is None:
            self.solved[index] += 1
        else:
            self.rejected[index] += 1

    def times(self) -> list[int]:
        """Return the times of all outcomes in the log, in order; empty until the whole dive has been read."""
        return sorted(outcome.at_ns for outcome in self._outcomes) if self.complete else []

    def without(self) -> list[Stretch]:
        """Return the stretches without a pose; empty until the whole dive has been read."""
        return stretches(self._outcomes) if self.complete else []

    def strip(self, cursor_ns: int | None = None) -> str:
        """Return the dive as a strip of colours, as HTML, which CSS stretches; cursor_ns: marked in it."""
        import cv2

        kinds = np.where(
            self.rejected > self.solved, 3, np.where(self.rejected > 0, 2, np.where(self.solved > 0, 1, 0))
        )
        data = base64.b64encode(cv2.imencode(".png", _COLOURS[kinds][None])[1].tobytes()).decode()
        cursor = ""
        if cursor_ns is not None:
            share = (cursor_ns - self.begin_ns) / (self.end_ns - self.begin_ns)
            cursor = f'<i style="left:{100 * share:.2f}%"></i>'
        image = f'<img alt="where the dive has poses" src="data:image/png;base64,{data}">'
        return f'<div class="strip">{image}{cursor}</div>'

    def words(self, stretch: Stretch) -> str:
        """Return begin, length and reasons of a stretch without a pose, in words."""
        why = ", ".join(f"{reason_words(reason)} ({count})" for reason, count in stretch.reasons.most_common(3))
        at_s = (stretch.begin_at_ns - self.begin_ns) / S_NS
        return f"from {clock_words(at_s)} for {duration_words(stretch.seconds)}: {why or 'no pictures'}"


def clock_words(seconds: float) -> str:
    """Return a time from the dive's start as minutes and seconds, or hours."""
    tenths = round(max(seconds, 0.0) * 10)
    minutes, rest = divmod(tenths, 600)
    hours, minutes = divmod(minutes, 60)
    head = f"{hours}:{minutes:02d}" if hours else f"{minutes}"
    return f"{head}:{rest / 10:04.1f}"
