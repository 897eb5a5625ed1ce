"""Where a dive has poses and where it has none, in bins of time."""

from __future__ import annotations

from collections import Counter
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.tools.health.words import duration_words, reason_words

SOLVED_COLOUR: Final = "#3f9a5a"
PARTLY_COLOUR: Final = "#c9a227"
REJECTED_COLOUR: Final = "#d0483f"


class Coverage:
    """Counts poses and rejections by time; begin_ns and end_ns bound the dive."""

    def __init__(self, begin_ns: int, end_ns: int, bins: int = 600) -> None:
        self.begin_ns = begin_ns
        self.end_ns = max(end_ns, begin_ns + 1)
        self.solved = [0] * bins
        self.rejected: list[Counter[str]] = [Counter() for _ in range(bins)]
        self.complete = False

    def add(self, at_ns: int, reason: str | None) -> None:
        """Count one trigger; reason: None for a pose."""
        bins = len(self.solved)
        index = (at_ns - self.begin_ns) * bins // (self.end_ns - self.begin_ns)
        index = min(max(index, 0), bins - 1)
        if reason is None:
            self.solved[index] += 1
        else:
            self.rejected[index][reason] += 1

    def without(self) -> list[tuple[int, int, Counter[str]]]:
        """Return the stretches (from, to in ns, reasons) in which most triggers ended without a pose."""
        bins = len(self.solved)
        span_ns = self.end_ns - self.begin_ns
        found: list[tuple[int, int, Counter[str]]] = []
        open_bin: int | None = None
        for index in range(bins + 1):
            bare = index < bins and self.rejected[index].total() > self.solved[index]
            if bare and open_bin is None:
                open_bin = index
            elif not bare and open_bin is not None:
                reasons = sum((self.rejected[k] for k in range(open_bin, index)), Counter())
                begin_ns = self.begin_ns + span_ns * open_bin // bins
                found.append((begin_ns, self.begin_ns + span_ns * index // bins, reasons))
                open_bin = None
        return found

    def strip(self, cursor_ns: int | None = None, height: int = 22) -> str:
        """Return the dive as a strip of colours, <svg>; cursor_ns: marked in it."""
        bins = len(self.solved)
        parts = [
            f'<svg viewBox="0 0 {bins} {height}" preserveAspectRatio="none" class="strip" role="img" '
            'aria-label="where the dive has poses">',
            f'<rect width="{bins}" height="{height}" fill="currentColor" fill-opacity="0.12"/>',
        ]
        begin = 0
        for index in range(1, bins + 1):
            colour = self._colour(begin)
            if index < bins and self._colour(index) == colour:
                continue
            if colour is not None:
                parts.append(f'<rect x="{begin}" width="{index - begin}" height="{height}" fill="{colour}"/>')
            begin = index
        if cursor_ns is not None:
            x = (cursor_ns - self.begin_ns) * bins / (self.end_ns - self.begin_ns)
            parts.append(
                f'<rect x="{x - 1.5:.1f}" width="3" height="{height}" fill="#fff" stroke="#000" stroke-width="0.6"/>'
            )
        return "".join(parts) + "</svg>"

    def _colour(self, index: int) -> str | None:
        solved, rejected = self.solved[index], self.rejected[index].total()
        if not solved and not rejected:
            return None
        if rejected == 0:
            return SOLVED_COLOUR
        return REJECTED_COLOUR if rejected > solved else PARTLY_COLOUR

    def words(self, begin_ns: int, end_ns: int, reasons: Counter[str]) -> str:
        """Say what a stretch without poses is about."""
        why = ", ".join(f"{reason_words(reason)} ({count})" for reason, count in reasons.most_common(3))
        at_s = (begin_ns - self.begin_ns) / S_NS
        return f"from {clock_words(at_s)} for {duration_words((end_ns - begin_ns) / S_NS)}: {why}"


def clock_words(seconds: float) -> str:
    """Return a time from the dive's start as minutes and seconds, or hours."""
    tenths = round(max(seconds, 0.0) * 10)
    minutes, rest = divmod(tenths, 600)
    hours, minutes = divmod(minutes, 60)
    head = f"{hours}:{minutes:02d}" if hours else f"{minutes}"
    return f"{head}:{rest / 10:04.1f}"
