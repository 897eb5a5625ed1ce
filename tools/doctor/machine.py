"""Facts about this machine, read from its files."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

from buddyline.node.power.board import ROOT


def timesyncd(root: Path = ROOT) -> bool:
    """Return whether systemd-timesyncd reports a synchronised clock."""
    return (root / "run/systemd/timesync/synchronized").exists()


def space(directory: Path) -> tuple[int, str]:
    """Return the free bytes at directory's place, and why it cannot be written, "" if it can. It need not exist yet."""
    place = directory.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    try:
        free_bytes = shutil.disk_usage(place).free
        with tempfile.TemporaryFile(dir=place) as file:
            file.write(b"buddyline")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return 0, f"cannot be written: {error.strerror}"
    return free_bytes, ""
