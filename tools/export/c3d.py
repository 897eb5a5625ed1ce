"""All nodes of a net as markers in a C3D file, for motion capture and biomechanics programs."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.dives import Dive
from buddyline.tools.export.network import load_markers
from buddyline.tools.extras import needed
from buddyline.tools.newfile import new_file

# A C3D file has one rate and no times: a missing row is a frame without markers. It has at most so many frames.
MOST_FRAMES: Final = 65535


def export(dive: Dive, output: Path, _what: str | None = None) -> int:
    """Write the nodes' cameras and lamps into output, which must not exist, in mm; return the number of frames."""
    ezc3d = needed("ezc3d", "--format c3d", "c3d")
    markers = load_markers([str(reader.path) for reader in dive.readers])
    period_ns = 1e9 / markers.rate_hz
    frames = [round((stamp_ns - markers.stamps_ns[0]) / period_ns) for stamp_ns in markers.stamps_ns]
    if frames[-1] >= MOST_FRAMES:
        raise BuddylineError(f"{dive.name}: {frames[-1] + 1} frames; a C3D file has at most {MOST_FRAMES}: use trc")
    # Homogeneous coordinates; of a marker that is not there the residual is -1.
    points = np.full((4, len(markers.names), frames[-1] + 1), np.nan)
    points[:3, :, frames] = 1e3 * markers.places_m.transpose(2, 1, 0)
    points[3] = 1.0
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [markers.rate_hz]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = markers.names
    file.add_parameter("POINT", "X_SCREEN", ["+X"])
    file.add_parameter("POINT", "Y_SCREEN", ["+Y"])
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = np.where(np.isnan(points[:1]), -1.0, 0.0)
    with new_file(output) as part, tempfile.TemporaryDirectory(dir=part.parent) as folder:
        # The library appends .c3d to a name without it.
        written = Path(folder) / "all.c3d"
        file.write(str(written))
        if not _is_whole(written, points.size):
            raise BuddylineError(f"{output}: cannot be written whole; look whether its disk is full")
        written.rename(part)
    return len(frames)


def _is_whole(written: Path, values: int) -> bool:
    """Return whether a file has so many values, of four bytes: the library says nothing where it could not write.

    What it writes last is the number of the block, of 512 bytes and counted from 1, in which the values begin. (It
    must not read the file itself: a cut one ends the process.)
    """
    with open(written, "rb") as file:
        head = file.read(18)
    block = int.from_bytes(head[16:18], "little")
    return block > 1 and written.stat().st_size >= 512 * (block - 1) + 4 * values
