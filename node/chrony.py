"""chrony's figures for this machine's clock: `chronyc -c tracking`, read with a time limit."""

from __future__ import annotations

import math
import subprocess
from dataclasses import dataclass
from typing import Any, Final

from buddyline.protocol.errors import BuddylineError

COMMAND: Final = ("chronyc", "-n", "-c", "tracking")
# A stopped node must not wait longer than its other threads do.
TIMEOUT_S: Final = 1.0
FIELDS: Final = 14
# chronyd's reference id where it serves its own, unsynchronised clock (the directive `local`).
LOCAL_REFERENCE: Final = "7F7F0101"


class ChronyError(BuddylineError):
    """chronyc is installed but gives no figures; the text says why and what to do."""


@dataclass(frozen=True, slots=True)
class Tracking:
    """The report of `chronyc tracking`.

    offset_s: this clock minus the true time. rms_s: of the last offsets. bound_s: greatest possible error.
    frequency_ppm: rate at which the uncorrected clock gains. skew_ppm: bound of the error of frequency_ppm.
    source: address or reference clock; "local" for an unsynchronised clock that chrony serves to others.
    """

    source: str
    stratum: int
    offset_s: float
    rms_s: float
    bound_s: float
    frequency_ppm: float
    skew_ppm: float
    synchronised: bool

    @property
    def local(self) -> bool:
        """Whether the clock is its own reference: then its offset means nothing."""
        return self.source == "local"

    def status_fields(self) -> dict[str, Any]:
        """Return the known figures under the names of their NodeStatus fields."""
        if not self.synchronised:
            return {"clock_source": ""}
        if self.local:
            return {"clock_source": "local"}
        return {
            "clock_offset_s": self.offset_s,
            "clock_rms_s": self.rms_s,
            "clock_bound_s": self.bound_s,
            "clock_frequency_ppm": self.frequency_ppm,
            "clock_source": self.source,
        }


def decode_tracking(text: str) -> Tracking:
    """Decode a line of `chronyc -c tracking`; raise ChronyError for any other text.

    Reference id, address, stratum, reference time, system time (positive: the clock is slow), last offset, RMS offset,
    frequency (positive: fast), residual frequency, skew, root delay, root dispersion, update interval, leap status
    (chrony 4, client.c; the bound is that of chronyc(1), "Root dispersion").
    """
    line = text.strip()
    fields = line.split(",")
    if len(fields) != FIELDS:
        raise ChronyError(f"chronyc said {line[:60]!r}, which is not its tracking report (chrony 4 is expected)")
    try:
        stratum = int(fields[2])
        slow_s, rms_s, frequency_ppm, skew_ppm, delay_s, dispersion_s = (float(fields[i]) for i in (4, 6, 7, 9, 10, 11))
    except ValueError:
        raise ChronyError(f"chronyc said {line[:60]!r}: a number was expected") from None
    if not all(map(math.isfinite, (slow_s, rms_s, frequency_ppm, skew_ppm, delay_s, dispersion_s))) or rms_s < 0:
        raise ChronyError(f"chronyc said {line[:60]!r}: its numbers are not sound")
    return Tracking(
        source="local" if fields[0] == LOCAL_REFERENCE else fields[1],
        stratum=stratum,
        offset_s=-slow_s,
        rms_s=rms_s,
        bound_s=abs(slow_s) + abs(dispersion_s) + abs(delay_s) / 2,
        frequency_ppm=frequency_ppm,
        skew_ppm=skew_ppm,
        synchronised=fields[13] != "Not synchronised",
    )


def read_tracking(timeout_s: float = TIMEOUT_S) -> Tracking | None:
    """Ask chronyc; None if chrony is not installed. Raises ChronyError if it gives no figures."""
    try:
        asked = subprocess.run(
            COMMAND, capture_output=True, text=True, errors="replace", timeout=timeout_s, check=False,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except FileNotFoundError:
        return None
    except subprocess.TimeoutExpired:
        raise ChronyError(f"chronyc gave no answer for {timeout_s:g} s: systemctl restart chrony") from None
    except OSError as error:
        raise ChronyError(f"chronyc cannot be run: {error.strerror}") from error
    said = (asked.stdout.strip() or asked.stderr.strip()).splitlines()
    if asked.returncode:
        words = said[0] if said else f"status {asked.returncode}"
        if "Cannot talk to daemon" in words:
            words += ": chronyd does not run (systemctl enable --now chrony)"
        raise ChronyError(f"chronyc: {words}")
    return decode_tracking(said[0] if said else "")
