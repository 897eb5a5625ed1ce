"""Figures made by matplotlib without a display, and written as PNG, SVG or PDF or put into a page."""

from __future__ import annotations

import io
import logging
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.extras import needed
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Lines break between poses that are further apart in time than this.
GAP_S: Final = 1.5
COLOURS: Final = ("tab:orange", "tab:blue", "tab:green", "tab:pink")
NO_POSE_COLOUR: Final = "#d0483f"
# Up to so many values none is left out.
MANY_VALUES: Final = 20
# An axis is stretched if all values span more than this many times what their inner 96 % span.
STRETCHED: Final = 4.0
# Letters that matplotlib's own font lacks are taken from the first of these that is installed and has them.
FALLBACK_FONTS: Final = (
    "Noto Sans",
    "Noto Sans CJK SC",
    "Noto Sans CJK JP",
    "WenQuanYi Zen Hei",
    "Noto Sans Arabic",
    "Noto Sans Hebrew",
    "Noto Sans Thai",
    "Noto Sans Devanagari",
    "Unifont",
)
_STYLE: Final[dict[Any, Any]] = {
    # Coordinates of a grid are written in full, without an offset at the axis.
    "axes.formatter.limits": (-5, 9),
    "axes.formatter.useoffset": False,
    "axes.grid": True,
    "axes.titlepad": 10.0,
    "figure.constrained_layout.use": True,
    "font.size": 9.0,
    "grid.linewidth": 0.4,
    "legend.fontsize": 8.0,
    "lines.markersize": 4.0,
    "savefig.dpi": 120,
    # Text stays text in SVG, so that it can be searched.
    "svg.fonttype": "none",
    # Fixed, so that the same data give the same file.
    "svg.hashsalt": "buddyline",
}


def check() -> None:
    """Raise BuddylineError if matplotlib is missing. Call it before the work, not after."""
    mpl = needed("matplotlib", "drawing", "plots")
    mpl.rcParams.update(_STYLE)
    # Its first start of all tells that it has listed the fonts.
    logging.getLogger("matplotlib").setLevel(logging.WARNING)
    from matplotlib import font_manager

    installed = set(font_manager.get_font_names())
    mpl.rcParams["font.family"] = ["DejaVu Sans", *(name for name in FALLBACK_FONTS if name in installed)]


@contextmanager
def _missing_letters_said(*, drawn: bool) -> Iterator[None]:
    """Say on stderr, in one line, which letters no installed font has. drawn: as shapes, so that they are lost."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.filterwarnings("always", r"Glyph .* missing from font")
        yield
    missing = {match[1] for one in caught if (match := re.match(r"Glyph (\d+) ", str(one.message)))}
    for one in caught:
        if not str(one.message).startswith("Glyph "):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    if missing and drawn:
        letters = "".join(sorted(chr(int(code)) for code in missing))
        print(f"no installed font has {letters}: drawn as boxes; install one, such as fonts-noto-cjk", file=sys.stderr)


def new_figure(
    width_in: float, height_in: float, rows: int = 1, columns: int = 1, **how: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure and its axes, row by row; how: further arguments of matplotlib's `subplots`."""
    check()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in))
    return figure, list(np.ravel(figure.subplots(rows, columns, **how)))


def save(figure: Figure, path: Path) -> None:
    """Write a figure in the format that the path's suffix names."""
    try:
        with _missing_letters_said(drawn=path.suffix != ".svg"):
            figure.savefig(path)
    except (OSError, ValueError) as error:
        raise BuddylineError(f"{path}: cannot be written: {error}") from error


def svg(figure: Figure) -> str:
    """Return a figure as an SVG file."""
    file = io.StringIO()
    # Text stays text there: whoever shows it has fonts of its own.
    with _missing_letters_said(drawn=False):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return file.getvalue()


def inline_svg(figure: Figure, words: str) -> str:
    """Return a figure as an <svg> element of a page; words: its description for screen readers."""
    element = svg(figure)
    element = element[element.index("<svg") :]
    # In a page: no namespaces, ids unique among all figures, and the width set by the page.
    element = re.sub(r' xmlns(:\w+)?="[^"]*"| id="[^"]*_\d+"|\s*<metadata>.*?</metadata>', "", element, flags=re.DOTALL)
    return re.sub(r' width="[^"]*" height="[^"]*"', f' role="img" aria-label="{escape(words)}"', element, count=1)


def pdf(figures: Sequence[Figure]) -> bytes:
    """Return a PDF of one figure a page."""
    check()
    from matplotlib.backends.backend_pdf import PdfPages

    file = io.BytesIO()
    with _missing_letters_said(drawn=True), PdfPages(file, metadata={"CreationDate": None}) as pages:
        for figure in figures:
            figure.savefig(pages, format="pdf")
    return file.getvalue()


def broken(
    t_s: NDArray[np.float64], *values: NDArray[np.float64], gap_s: float = GAP_S
) -> tuple[NDArray[np.float64], ...]:
    """Return times (n,) and values (n,) with NaN in each gap of time, so that no line crosses it."""
    gaps = np.flatnonzero(np.diff(t_s) > gap_s) + 1
    return tuple(np.insert(column.astype(float), gaps, np.nan) for column in (t_s, *values))


def inner_limits(values: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return limits without the few far values that would stretch the axis; None if no value would.

    The page's plots have the same rule (`limits` in app.js). The caller says how many values are outside.
    """
    if len(values) <= MANY_VALUES:
        return None
    low, high = np.percentile(values, (2, 98), method="closest_observation").tolist()
    span = high - low
    if span <= 0.0 or values.max() - values.min() <= STRETCHED * span:
        return None
    return low - span / 2, high + span / 2
