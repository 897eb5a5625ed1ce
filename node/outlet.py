"""The output of a node's messages: always to its own log, and to the bus while connected."""

from __future__ import annotations

import threading
from collections import Counter
from typing import TYPE_CHECKING

from buddyline.node.imu_means import ImuPacker
from buddyline.protocol.clock import Clock
from buddyline.protocol.codec import encode, message_stamp_ns
from buddyline.protocol.digest import DigestBook, sealed
from buddyline.protocol.messages import Imu, Message
from buddyline.protocol.topics import IMU, Topic, key_of, topic_of

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, Publisher
    from buddyline.protocol.recorder import Recorder
    from buddyline.protocol.signing import Signer


class Outlet:
    """Records and publishes; safe to use from several threads.

    Messages sent while there is no bus are in the log only. When the bus connects, the last message of each
    latest-only topic (info, status) is sent again. All are of this node. boot: of this run; signer:
    signs the digests of what was sent.
    """

    def __init__(
        self, node: str, recorder: Recorder, clock: Clock, boot: str = "", signer: Signer | None = None
    ) -> None:
        self.node = node
        self.sent: Counter[str] = Counter()
        self._recorder = recorder
        self._clock = clock
        self._lock = threading.Lock()
        self._bus: Bus | None = None
        self._publishers: dict[str, Publisher] = {}
        self._latest: dict[str, Message] = {}
        self._keys: dict[str, str] = {}
        self._book = DigestBook(node, boot, clock.now_ns())
        self._packer = ImuPacker()
        self._sign = None if signer is None else signer.sign

    def send(self, message: Message, *, record: bool = True, publish: bool = True) -> None:
        """Record and publish one message."""
        payload = encode(message)
        with self._lock:
            self._send(message, payload, record=record, publish=publish)
            if self._book.is_full:
                self._send_digest()

    def send_digest(self, *, last: bool = False) -> None:
        """Send the digest of all that was sent since the last one. last: the node ends in order."""
        with self._lock:
            self._send_digest(last=last)

    def _send_digest(self, *, last: bool = False) -> None:
        digest = self._book.digest(self._clock.now_ns(), last=last)
        self._send(digest, sealed(digest, self._sign))

    def _send(self, message: Message, payload: bytes, *, record: bool = True, publish: bool = True) -> None:
        """Send; the lock is held: of each topic, digest, log and bus have the same order."""
        topic = topic_of(message)
        self._book.add(topic, message_stamp_ns(message), payload)
        if record:
            key = self._keys.get(topic.name)
            if key is None:
                key = self._keys[topic.name] = key_of(message)
            self._recorder.write(key, payload, self._clock.now_ns())
        self.sent[topic.name] += 1
        if topic.latest_only:
            self._latest[topic.name] = message
        if publish and self._bus is not None:
            if isinstance(message, Imu):
                self._publish_sample(message, payload)
            else:
                self._publisher(topic).put_bytes(payload)

    def _publish_sample(self, sample: Imu, payload: bytes) -> None:
        """Publish an inertial sample, or, where the link leaves it out, means of it and the next."""
        if self._packer.is_packing or not self._publisher(IMU).put_bytes(payload):
            means = self._packer.add(sample)
            if means is not None:
                self._send(means, encode(means))

    @property
    def connected(self) -> bool:
        """Whether there is a bus to publish on."""
        return self._bus is not None

    def connect(self, bus: Bus) -> None:
        """Publish on this bus from now on, beginning with the last message of each latest-only topic."""
        with self._lock:
            self._bus = bus
            for message in list(self._latest.values()):
                self._send(message, encode(message))

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
