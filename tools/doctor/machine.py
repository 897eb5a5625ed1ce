"""Facts about this machine, read from its files."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

ROOT = Path("/")


def temperature_degc(root: Path = ROOT) -> float | None:
    """Return the temperature of the hottest thermal zone; None if there is none."""
    found = []
    for file in root.glob("sys/class/thermal/thermal_zone*/temp"):
        try:
            found.append(int(file.read_text()) / 1e3)
        except (OSError, ValueError):
            continue
    return max(found, default=None)


def throttled(root: Path = ROOT) -> int | None:
    """Return a Pi's bits of undervoltage and throttling; None on another machine.

    Source: the firmware's file, else vcgencmd, else the kernel's rpi_volt, which has undervoltage only.
    """
    for file in root.glob("sys/devices/platform/soc*/soc*:firmware/get_throttled"):
        try:
            return int(file.read_text(), 16)
        except (OSError, ValueError):
            continue
    try:
        said = subprocess.run(
            ["vcgencmd", "get_throttled"], capture_output=True, text=True, timeout=2.0, check=False, errors="replace"
        ).stdout
    except (OSError, subprocess.TimeoutExpired):
        said = ""
    match = re.search(r"throttled=(0x[0-9a-fA-F]+)", said)
    if match:
        return int(match.group(1), 16)
    for name in root.glob("sys/class/hwmon/hwmon*/name"):
        try:
            if name.read_text().strip() == "rpi_volt":
                return int((name.parent / "in0_lcrit_alarm").read_text())
        except (OSError, ValueError):
            continue
    return None


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
