"""`buddyline ros2`: publish what nodes and solver say for ROS 2, in the form of its middleware rmw_zenoh.

ROS 2 machines with RMW_IMPLEMENTATION=rmw_zenoh_cpp and our hub as their router see them as any other topic.
"""

from __future__ import annotations

import argparse
import logging
import os
import struct
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from buddyline.protocol import topics
from buddyline.protocol.clock import Clock, SystemClock
from buddyline.protocol.errors import MessageError
from buddyline.protocol.security import ROS
from buddyline.tools.client import client_config
from buddyline.tools.export.ros_messages import RosMessage, Translation, type_store
from buddyline.tools.live import LiveClient, follow_running

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus
    from buddyline.protocol.envelope import Envelope

log = logging.getLogger(__name__)

NODE_NAME: Final = "buddyline"
# Quality of service in rmw_zenoh's liveliness tokens: reliable, volatile, the last 10 kept, the rest default.
QOS: Final = "::,10:,:,:,,"
# A client that invents nodes must not fill hub and graph; 16 nodes have some 700.
MAX_TOPICS: Final = 2048


class RosGraph:
    """One ROS node and its publishers in the form of rmw_zenoh: keys, liveliness tokens, attachments."""

    def __init__(self, session: Any, store: Any, clock: Clock, domain: int) -> None:
        self._session = session
        self._store = store
        self._clock = clock
        self._domain = domain
        self._zid = str(session.zid())
        self._endpoints: dict[str, RosEndpoint] = {}
        self._tokens = [session.liveliness().declare_token(self._token(0, "NN"))]

    def _token(self, entity: int, kind: str) -> str:
        # An empty enclave and the root namespace are both written as %.
        return f"@ros2_lv/{self._domain}/{self._zid}/0/{entity}/{kind}/%/%/{NODE_NAME}"

    def publish(self, message: RosMessage) -> None:
        """Send one message; its topic is declared at the first message."""
        self.declare(message)
        endpoint = self._endpoints[message.topic]
        payload = bytes(self._store.serialize_cdr(message.value, message.type_name))
        endpoint.sequence += 1
        endpoint.publisher.put(payload, attachment=attachment(endpoint.sequence, self._clock.now_ns(), endpoint.gid))

    def declare(self, message: RosMessage) -> None:
        """Declare the topic of a message, if it is not declared yet."""
        if message.topic in self._endpoints:
            return
        if len(self._endpoints) >= MAX_TOPICS:
            raise MessageError(f"{message.topic}: there are {MAX_TOPICS} topics of ROS already")
        entity = len(self._endpoints) + 1
        type_key = f"{dds_type(message.type_name)}/{self._store.hash_rihs01(message.type_name)}"
        mangled = message.topic.replace("/", "%")
        publisher = self._session.declare_publisher(f"{self._domain}/{message.topic.lstrip('/')}/{type_key}")
        token = f"{self._token(entity, 'MP')}/{mangled}/{type_key}/{QOS}"
        self._tokens.append(self._session.liveliness().declare_token(token))
        log.info("ros2: %s (%s)", message.topic, message.type_name)
        self._endpoints[message.topic] = RosEndpoint(publisher, os.urandom(16))


@dataclass
class RosEndpoint:
    """One publisher of a ROS topic. gid: its id in every sample."""

    publisher: Any
    gid: bytes
    sequence: int = 0


def dds_type(type_name: str) -> str:
    """Return DDS's form of `package/msg/Type`: `package::msg::dds_::Type_`."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """Return rmw_zenoh's attachment of a sample: two int64, then the gid with its length before it."""
    return struct.pack("<qqB", sequence, stamp_ns, len(gid)) + gid


def run(args: argparse.Namespace) -> int:
    """Translate until stopped."""
    store = type_store()
    client = LiveClient("ros2", client_config(args, ROS), args.seconds)

    def translate(bus: Bus) -> None:
        from buddyline.protocol.zenoh_bus import open_session

        # ROS's keys and payloads do not go over our bus, but over a session of their own.
        tls = client.config.tls
        session: Any = open_session(client.config.connect, stop=client.stop, on_wait=log.info, tls=tls)
        if session is None:
            return
        try:
            translation, graph = Translation(store.types), RosGraph(session, store, SystemClock(), args.domain)
            lock = threading.Lock()

            def publish(envelope: Envelope) -> None:
                # Each subscription has a thread of its own; sequence numbers must rise one by one.
                with lock:
                    try:
                        for translated in translation.messages(envelope.message):
                            graph.publish(translated)
                    except MessageError as error:
                        client.refusals.note(envelope.key, error)

            states = (topics.INFO, topics.NODE_STATUS, topics.SOLVER_STATUS)
            of_pairs = (topics.POSE, topics.TRACK, topics.TRACK_LAG, topics.REJECTED)
            streams = (topics.ATTITUDE, topics.DEPTH, *of_pairs, topics.NET_POSE)
            follow_running(bus, states, streams, client.refusals, publish)
            client.wait()
        finally:
            # First, because messages come until then.
            bus.close()
            session.close()

    return client.run(translate)
