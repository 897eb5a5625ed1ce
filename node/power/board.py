"""A Pi's temperature and its bits of undervoltage and throttling, from the kernel's files."""

from __future__ import annotations

import re
import subprocess
import time
from pathlib import Path
from typing import Final

ROOT: Final = Path("/")
# vcgencmd is a process of its own: where there is nothing else, it is asked this seldom.
COMMAND_EVERY_S: Final = 10.0
COMMAND_WITHIN_S: Final = 2.0


def temperature_degc(root: Path = ROOT) -> float | None:
    """Return the temperature of the hottest thermal zone; None if there is none."""
    found = []
    for file in root.glob("sys/class/thermal/thermal_zone*/temp"):
        try:
            found.append(int(file.read_text()) / 1e3)
        except (OSError, ValueError):
            continue
    return max(found, default=None)


class Throttled:
    """The bits as `vcgencmd get_throttled` has them (protocol/health.py), read without a process where there is a file.

    Source: the firmware's file, else vcgencmd, else the kernel's rpi_volt, which has undervoltage only.
    """

    def __init__(self, root: Path = ROOT) -> None:
        self._root = root
        self._command_s: float | None = None
        self._said: int | None = None

    def read(self) -> int | None:
        """Return the bits; None on a machine without them. vcgencmd's may be COMMAND_EVERY_S old."""
        for file in self._root.glob("sys/devices/platform/soc*/soc*:firmware/get_throttled"):
            try:
                return int(file.read_text(), 16)
            except (OSError, ValueError):
                continue
        now_s = time.monotonic()
        if self._command_s is None or now_s - self._command_s >= COMMAND_EVERY_S:
            self._command_s, self._said = now_s, _ask_firmware()
        return self._undervoltage() if self._said is None else self._said

    def _undervoltage(self) -> int | None:
        for name in self._root.glob("sys/class/hwmon/hwmon*/name"):
            try:
                if name.read_text().strip() == "rpi_volt":
                    return int((name.parent / "in0_lcrit_alarm").read_text())
            except (OSError, ValueError):
                continue
        return None


def _ask_firmware() -> int | None:
    try:
        said = subprocess.run(
            ["vcgencmd", "get_throttled"],
            capture_output=True,
            text=True,
            timeout=COMMAND_WITHIN_S,
            check=False,
            errors="replace",
        ).stdout
    except (OSError, subprocess.TimeoutExpired):
        return None
    match = re.search(r"throttled=(0x[0-9a-fA-F]+)", said)
    return int(match.group(1), 16) if match else None
