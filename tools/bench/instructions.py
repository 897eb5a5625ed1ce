"""How many machine instructions our detector needs for a picture, and how long a Raspberry Pi 3 may take for them.

Valgrind counts them, so no other load disturbs the figures. The pictures are rendered at the exposure that the node's
own loop chooses. OpenCV and numpy may use vectors of 16 bytes only, as an ARM processor has them.

The time on a Pi 3 is an assumption, not a measurement: as many instructions as here, on one core of 1.2 GHz that
completes one of them in two cycles on average. Its processor does at most two in one cycle, in order, and waits for
memory more often than that of a server.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.bench.detect import ENVIRONMENTS, Pictures, pictures_of
from buddyline.tools.measure.tables import cells_of, text_table

WIDTHS_PX: Final = (820, 1640)
PI3_PER_MS: Final = 1.2e9 * 0.5 / 1e3
COUNTED: Final = re.compile(rb"Collected : (\d+)")
NARROW: Final = {
    "OPENCV_CPU_DISABLE": "AVX2,AVX512_SKX",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4",
    "OPENBLAS_CORETYPE": "Nehalem",
}
"""No vectors of more than 16 bytes."""
PROGRAM: Final = """
import os, subprocess, sys
import cv2
import numpy as np
from buddyline.tools.bench.detect import Guided
cv2.setNumThreads(1)
guided = Guided(list(np.load(sys.argv[2])))
search = guided if sys.argv[1] == "guided" else guided.whole
for counting in "off", "on", "off":
    subprocess.run(["callgrind_control", "-i", counting, str(os.getpid())], check=True, stdout=subprocess.DEVNULL)
    if counting == "on":
        for picture in guided.searched:
            search(picture)
print(len(guided.searched))
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmark's arguments."""
    parser.add_argument("--environment", nargs="+", choices=ENVIRONMENTS, default=list(ENVIRONMENTS), metavar="WATER")
    parser.add_argument("--pictures", type=int, default=4, metavar="N", help="of each environment; default: 4")
    parser.add_argument("--width", type=int, nargs="+", default=list(WIDTHS_PX), metavar="PX")


def measure(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Return a row for each width: millions of instructions and a Pi 3's ms per picture, whole and guided."""
    if args.pictures < 1 or min(args.width) < 64:
        raise BuddylineError("--pictures: at least 1; --width: at least 64")
    if shutil.which("valgrind") is None or shutil.which("callgrind_control") is None:
        raise BuddylineError("valgrind: is not installed; on Debian: sudo apt install valgrind")
    return [_row(width_px, args.environment, args.pictures) for width_px in args.width]


def _row(width_px: int, environments: list[str], count: int) -> dict[str, Any]:
    pictures = [picture for water in environments for picture in pictures_of(water, width_px, count, lamps=True)]
    whole, guided = (counted(how, pictures) for how in ("whole", "guided"))
    return {
        "width_px": width_px,
        "whole": whole / 1e6,
        "guided": guided / 1e6,
        "ratio": guided / whole,
        "pi3_whole_ms": whole / PI3_PER_MS,
        "pi3_guided_ms": guided / PI3_PER_MS,
    }


def counted(how: str, pictures: Pictures) -> float:
    """Return the instructions per picture, of those that can be searched in regions. how: "whole" or "guided"."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pictures.npy"
        np.save(path, np.stack(pictures))
        command = ["valgrind", "--tool=callgrind", "--instr-atstart=no", "--callgrind-out-file=/dev/null"]
        command += [sys.executable, "-c", PROGRAM, how, str(path)]
        done = subprocess.run(command, capture_output=True, check=False, env=os.environ | NARROW, timeout=1800)
    found = COUNTED.search(done.stderr)
    if done.returncode or found is None:
        raise BuddylineError(f"valgrind: {done.stderr.decode(errors='replace').strip()[-300:]}")
    searched = int(done.stdout.split()[-1])
    if not searched:
        raise BuddylineError("no picture can be searched in regions")
    return int(found[1]) / searched


def table(figures: list[dict[str, Any]]) -> str:
    """Return the rows as text."""
    columns = {
        "width": "{width_px}",
        "million instructions, whole": "{whole:.1f}",
        "guided": "{guided:.1f}",
        "guided over whole": "{ratio:.2f}",
        "a Pi 3's ms, whole": "{pi3_whole_ms:.0f}",
        "its ms, guided": "{pi3_guided_ms:.0f}",
    }
    return text_table(cells_of(figures, columns))
