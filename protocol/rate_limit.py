"""How much of each key a receiver takes: many times what its topic's table says, and no more.

A client at full speed sends a hundred thousand messages a second. To decode them, or only to queue them, would take the
processor from all others on the machine. A stored dive is played faster than it was: the limit is off meanwhile.
"""

from __future__ import annotations

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Final

from buddyline.protocol.bus import MAX_TRIGGER_HZ
from buddyline.protocol.sequence import owner_of
from buddyline.protocol.topics import Topic, parse_key

# Over the topic's nominal rate: drivers and configurations may be faster.
MARGIN: Final = 4.0
# What a link held up comes at once: at its topic's rate, what its publisher holds. A client that begins to flood is
# named and shut out only when it has used this up. Of bytes less, for memory.
BURST_S: Final = 60.0
BYTES_BURST_S: Final = 10.0
# An owner that has used this share of it comes after all others, for as long as that, s, is so.
AHEAD: Final = 1 / 6
AHEAD_S: Final = 1.0
# Sixteen times what 30 frames a second take; of larger messages, one a second.
MOST_BYTES_PER_S: Final = 1_000_000.0
# Keys that are no topic's.
OTHER_HZ: Final = 100.0
# Keys of an owner, and owners, that have a limit of their own.
MAX_KEYS: Final = 128
MAX_OWNERS: Final = 256
# So much left out between two looks is a flood; so many other owners are heard while one is shut out.
FLOOD_MESSAGES: Final = 200
FLOOD_BYTES: Final = 200_000
MAX_HEARD: Final = 32
# How long an owner is named after its last message that was left out, and how many owners are named at most.
SAID_S: Final = 15.0
MAX_SAID: Final = 4


def most_hz(topic: Topic | None) -> float:
    """Return how many messages a second are taken of a key of this topic; None: of a key that is no topic's."""
    return OTHER_HZ if topic is None else MARGIN * max(topic.rate_hz, MAX_TRIGGER_HZ)


def most_at_once(topic: Topic | None) -> float:
    """Return how many messages of a key of this topic are taken at once."""
    return BURST_S * most_hz(topic) / MARGIN


def most_bytes_per_s(topic: Topic | None) -> float:
    """Return how many bytes a second are taken of a key of this topic."""
    return max(MOST_BYTES_PER_S, 0.0 if topic is None else topic.max_bytes)


class _Bucket:
    """What may still come of one key now."""

    __slots__ = ("at_once", "bytes", "bytes_per_s", "hz", "messages", "since_s")

    def __init__(self, topic: Topic | None, now_s: float) -> None:
        self.hz, self.at_once, self.bytes_per_s = most_hz(topic), most_at_once(topic), most_bytes_per_s(topic)
        self.messages, self.bytes, self.since_s = self.at_once, self.bytes_per_s * BYTES_BURST_S, now_s

    @property
    def is_ahead(self) -> bool:
        """Whether much has come at once."""
        left = min(self.messages / self.at_once, self.bytes / (self.bytes_per_s * BYTES_BURST_S))
        return left < 1.0 - AHEAD

    def takes(self, size_bytes: int, now_s: float) -> bool:
        """Return whether there is room for a message; if so, take it."""
        passed_s, self.since_s = now_s - self.since_s, now_s
        self.messages = min(self.messages + passed_s * self.hz, self.at_once)
        self.bytes = min(self.bytes + passed_s * self.bytes_per_s, BYTES_BURST_S * self.bytes_per_s)
        if self.messages < 1.0 or self.bytes < size_bytes:
            return False
        self.messages -= 1.0
        self.bytes -= size_bytes
        return True


class _Owner:
    """What may still come of the keys of one owner, and what was left out."""

    def __init__(self) -> None:
        self.buckets: dict[str, _Bucket] = {}
        self.dropped = 0
        self.dropped_bytes = 0
        self.dropped_s = 0.0
        self.ahead_s = -math.inf
        self.at_look = 0, 0

    def is_flood(self) -> bool:
        """Return whether much was left out since the last look."""
        messages, size = self.at_look
        self.at_look = self.dropped, self.dropped_bytes
        return self.dropped - messages >= FLOOD_MESSAGES or self.dropped_bytes - size >= FLOOD_BYTES


class RateLimit:
    """Admits what comes on each key, up to its rate; counts the rest by owner. Safe to use from several threads.

    now_s: a clock that nobody sets. is_off: whether everything is admitted.
    """

    def __init__(
        self, now_s: Callable[[], float] = time.monotonic, *, is_off: Callable[[], bool] = lambda: False
    ) -> None:
        self._now_s = now_s
        self._is_off = is_off
        # The one that has been silent longest is first.
        self._owners: OrderedDict[str, _Owner] = OrderedDict()
        self._lock = threading.Lock()

    def admits(self, key: str, size_bytes: int) -> bool:
        """Return whether to take a message of this size on this key."""
        if self._is_off():
            return True
        now_s, name = self._now_s(), owner_of(key)
        with self._lock:
            owner = self._owners.get(name)
            if owner is None:
                owner = self._owners[name] = _Owner()
                if len(self._owners) > MAX_OWNERS:
                    self._owners.popitem(last=False)
            else:
                self._owners.move_to_end(name)
            bucket = owner.buckets.get(key) or self._add(owner, key, now_s)
            takes = bucket.takes(size_bytes, now_s)
            if bucket.is_ahead:
                owner.ahead_s = now_s
            if takes:
                return True
            owner.dropped += 1
            owner.dropped_bytes += size_bytes
            owner.dropped_s = now_s
            return False

    def is_ahead(self, key: str) -> bool:
        """Return whether much has come at once from this key's owner, now or a moment ago."""
        with self._lock:
            owner = self._owners.get(owner_of(key))
            return owner is not None and self._now_s() - owner.ahead_s < AHEAD_S

    def flooding(self) -> set[str]:
        """Return the owners of whom much was left out since the last call."""
        with self._lock:
            return {name for name, owner in self._owners.items() if owner.is_flood()}

    def owners(self) -> list[str]:
        """Return the owners that have been heard last."""
        with self._lock:
            return list(self._owners)[-MAX_HEARD:]

    def empty(self, names: Iterable[str]) -> None:
        """Let nothing come at once of these owners' keys."""
        now_s = self._now_s()
        with self._lock:
            for name in names:
                for bucket in self._owners[name].buckets.values() if name in self._owners else ():
                    bucket.messages, bucket.bytes, bucket.since_s = 0.0, 0.0, now_s

    @property
    def dropped(self) -> dict[str, int]:
        """How many messages of each owner were left out."""
        with self._lock:
            return {name: owner.dropped for name, owner in self._owners.items() if owner.dropped}

    def problem(self) -> str:
        """Return who sends too much now, for people; "" if nobody."""
        now_s = self._now_s()
        with self._lock:
            words = [
                f"{name} sends too much: {owner.dropped} messages left out"
                for name, owner in sorted(self._owners.items())
                if owner.dropped and now_s - owner.dropped_s < SAID_S
            ]
        return "; ".join(words[:MAX_SAID])

    def _add(self, owner: _Owner, key: str, now_s: float) -> _Bucket:
        parsed = parse_key(key)
        if parsed is None or len(owner.buckets) >= MAX_KEYS:
            # All such keys of an owner share one.
            key, parsed = "", None
        if key not in owner.buckets:
            owner.buckets[key] = _Bucket(None if parsed is None else parsed[0], now_s)
        return owner.buckets[key]
