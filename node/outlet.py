"""The output of a node's messages: always to its own log, and to the bus while connected."""

from __future__ import annotations

import threading
from collections import Counter
from typing import TYPE_CHECKING

from buddyline.protocol.clock import Clock
from buddyline.protocol.codec import encode
from buddyline.protocol.messages import Message
from buddyline.protocol.topics import Topic, key_of, topic_of

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, Publisher
    from buddyline.protocol.recorder import Recorder


class Outlet:
    """Records and publishes; safe to use from several threads.

    Messages sent while there is no bus are in the log only. When the bus connects, the last message of each
    latest-only topic (info, status) is published again.
    """

    def __init__(self, node: str, recorder: Recorder, clock: Clock) -> None:
        self.node = node
        self.sent: Counter[str] = Counter()
        self._recorder = recorder
        self._clock = clock
        self._lock = threading.Lock()
        self._bus: Bus | None = None
        self._publishers: dict[str, Publisher] = {}
        self._latest: dict[str, Message] = {}

    def send(self, message: Message, *, record: bool = True, publish: bool = True) -> None:
        """Record and publish one message."""
        topic = topic_of(message)
        payload = encode(message)
        if record:
            self._recorder.write(key_of(message), payload, self._clock.now_ns())
        with self._lock:
            self.sent[topic.name] += 1
            if topic.latest_only:
                self._latest[topic.name] = message
            if publish and self._bus is not None:
                self._publisher(topic).put_bytes(payload)

    @property
    def connected(self) -> bool:
        """Whether there is a bus to publish on."""
        return self._bus is not None

    def connect(self, bus: Bus) -> None:
        """Publish on this bus from now on, beginning with the last message of each latest-only topic."""
        with self._lock:
            self._bus = bus
            for message in self._latest.values():
                self._publisher(topic_of(message)).put_bytes(encode(message))

    def disconnect(self) -> None:
        """Stop publishing; the bus closes the publishers when it is closed."""
        with self._lock:
            self._bus = None
            self._publishers.clear()

    def _publisher(self, topic: Topic) -> Publisher:
        publisher = self._publishers.get(topic.name)
        if publisher is None and self._bus is not None:
            publisher = self._publishers[topic.name] = self._bus.publisher(topic, self.node)
        if publisher is None:
            raise RuntimeError("no bus")
        return publisher
