"""A poor link between this network namespace and a new one: rate, delay, loss and reordering. Needs root.

Written for kernels without netem: each end is a TUN device, and a process of its own passes the packets between them.
Run as `python -m tests.faults.shaper NAMESPACE` it is that process. At its end it says what share of the packets it has
passed later than it should have: a machine that is too busy is another link.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import itertools
import os
import random
import select
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

HERE, THERE = "10.249.78.1", "10.249.78.2"
SEED = 20
# A packet that is passed so much later than it arrives.
LATE_S = 0.05

_CLONE_NEWNET = 0x40000000
_TUNSETIFF = 0x400454CA
_IFF_TUN, _IFF_NO_PI = 0x0001, 0x1000


@dataclass(frozen=True)
class PoorLink:
    """What the link does to packets, in each direction. late_s: how much longer a reordered packet takes.

    queue_bytes: what waits for its turn; packets beyond are dropped, as a modem does.
    """

    rate_bps: float = 256_000.0
    delay_s: float = 0.2
    loss: float = 0.05
    reordered: float = 0.1
    late_s: float = 0.08
    queue_bytes: int = 32 * 1024


class OneWay:
    """One direction of the link: packets that are on their way, by when they arrive."""

    def __init__(self, link: PoorLink, rng: random.Random) -> None:
        self._link = link
        self._rng = rng
        self._free_s = 0.0
        self._order = itertools.count()
        self._under_way: list[tuple[float, int, bytes]] = []
        self.passed = self.late = 0

    def send(self, packet: bytes, now_s: float) -> None:
        """Take a packet; it may be lost."""
        link = self._link
        waiting_s = max(self._free_s - now_s, 0.0)
        if waiting_s * link.rate_bps / 8 > link.queue_bytes:
            return
        self._free_s = now_s + waiting_s + len(packet) * 8 / link.rate_bps
        if self._rng.random() < link.loss:
            return
        late_s = link.late_s if self._rng.random() < link.reordered else 0.0
        heapq.heappush(self._under_way, (self._free_s + link.delay_s + late_s, next(self._order), packet))

    def arrived(self, now_s: float) -> Iterator[bytes]:
        """Return the packets that have arrived."""
        while self._under_way and self._under_way[0][0] <= now_s:
            arrived_s, _, packet = heapq.heappop(self._under_way)
            self.passed += 1
            self.late += now_s - arrived_s > LATE_S
            yield packet

    @property
    def next_s(self) -> float:
        """When the next packet arrives; infinity if none is under way."""
        return self._under_way[0][0] if self._under_way else float("inf")


def main() -> None:
    """Pass packets between the two ends until the parent closes stdin."""
    namespace, link = sys.argv[1], PoorLink(*map(float, sys.argv[2:]))
    libc = ctypes.CDLL(None, use_errno=True)
    here = _tun("buddyline0")
    # The device stays in the namespace it was made in, whatever namespace its reader goes to.
    with open(f"/run/netns/{namespace}") as other:
        if libc.setns(other.fileno(), _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns")
    there = _tun("buddyline0")
    print("ready", flush=True)
    rng = random.Random(SEED)
    ways = {here: (OneWay(link, rng), there), there: (OneWay(link, rng), here)}
    while True:
        soonest_s = min(way.next_s for way, _ in ways.values())
        timeout_s = max(min(soonest_s - time.monotonic(), 1.0), 0.0)
        readable, _, _ = select.select([here, there, sys.stdin], [], [], timeout_s)
        if sys.stdin in readable:
            passed, late = (sum(getattr(way, name) for way, _ in ways.values()) for name in ("passed", "late"))
            print(late / max(passed, 1), flush=True)
            return
        now_s = time.monotonic()
        for end in readable:
            ways[end][0].send(os.read(end, 65536), now_s)
        for way, end in ways.values():
            for packet in way.arrived(now_s):
                os.write(end, packet)


def _tun(name: str) -> int:
    device = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH", name.encode(), _IFF_TUN | _IFF_NO_PI))
    return device


@dataclass
class Tether:
    """A namespace behind a link. host: the address of this end. late: once it has ended, the share of late packets."""

    namespace: str
    host: str
    late: float = 0.0


@contextmanager
def poor_link(link: PoorLink) -> Iterator[Tether]:
    """Make a namespace behind such a link."""
    name = f"bt{os.getpid() % 100000}"
    _ip("netns", "add", name)
    try:
        words = [sys.executable, "-m", "tests.faults.shaper", name, *(str(value) for value in asdict(link).values())]
        with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as shaper:
            assert shaper.stdin is not None
            assert shaper.stdout is not None
            try:
                assert shaper.stdout.readline() == b"ready\n"
                for prefix, own, other in (((), HERE, THERE), (("-n", name), THERE, HERE)):
                    _ip(*prefix, "address", "add", own, "peer", other, "dev", "buddyline0")
                    _ip(*prefix, "link", "set", "buddyline0", "up")
                _ip("-n", name, "link", "set", "lo", "up")
                tether = Tether(name, HERE)
                yield tether
                shaper.stdin.close()
                tether.late = float(shaper.stdout.readline())
            finally:
                shaper.stdin.close()
    finally:
        _ip("netns", "delete", name)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


if __name__ == "__main__":
    main()
