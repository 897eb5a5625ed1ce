"""The load of a process: memory, open files, processor time, also by thread (Linux)."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from pathlib import Path

from buddyline.protocol.errors import BuddylineError


@dataclass(frozen=True)
class Load:
    """rss_bytes: resident memory; files: open file descriptors; cpu_s: processor time since the process began."""

    rss_bytes: int
    files: int
    cpu_s: float

    @property
    def rss_mib(self) -> float:
        """Resident memory, MiB."""
        return self.rss_bytes / 2**20


def load_of(pid: int | None = None) -> Load:
    """Return the load of a process (None: this one); raise BuddylineError if it has ended, or without /proc."""
    process = Path(f"/proc/{os.getpid() if pid is None else pid}")
    try:
        fields = (process / "stat").read_text().rpartition(")")[2].split()
        pages = int((process / "statm").read_text().split()[1])
        files = len(os.listdir(process / "fd"))
    except (OSError, ValueError, IndexError) as error:
        raise BuddylineError(f"process {process.name} cannot be measured: {error}") from error
    return Load(
        rss_bytes=pages * os.sysconf("SC_PAGE_SIZE"),
        files=files,
        cpu_s=(int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"),
    )


def thread_times_s() -> dict[str, float]:
    """Return the processor time of each of this process's threads so far, by its name.

    Threads of libraries are added up as "others". What has ended is left out.
    """
    names = {str(thread.native_id): thread.name for thread in threading.enumerate()}
    found: dict[str, float] = {}
    for task in Path("/proc/self/task").iterdir():
        try:
            spent_s = int((task / "schedstat").read_text().split()[0]) / 1e9
        except (OSError, ValueError, IndexError):
            continue
        name = names.get(task.name, "others")
        found[name] = found.get(name, 0.0) + spent_s
    return found
