"""A dive as a ROS 2 log (MCAP, CDR), which `ros2 bag play` plays and rosbags, Foxglove and PlotJuggler read."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, Final

from buddyline.protocol.divelog import CHUNK_NS
from buddyline.protocol.errors import MessageError
from buddyline.protocol.topics import NET_POSE
from buddyline.tools.dives import Dive
from buddyline.tools.export.formats import check_shows
from buddyline.tools.export.ros_messages import Translation, type_store
from buddyline.tools.newfile import new_file

log = logging.getLogger(__name__)

OF_NODES: Final = ("info", "attitude", "depth", "image", "node_status", NET_POSE.name)
TOPICS: Final = (*OF_NODES, "pose", "track", "track_lag", "rejected")


def export(dive: Dive, output: Path, what: str | None = None) -> int:
    """Write a dive into output, which must not exist; return how many messages it has.

    what: "poses" leaves the tracks out, "track" the poses; None: all.
    """
    from mcap.writer import CompressionType, Writer

    store = type_store()
    translation = Translation(store.types)
    left_out = {"poses": {"track", "track_lag"}, "track": {"pose"}}.get(what or "", set())
    topics = [topic for topic in (*TOPICS, "solver_status") if topic not in left_out]
    count = refused = cut_ns = 0
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    with new_file(output) as part, open(part, "xb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="buddyline")
        # The calibrations first: without them no camera has its place in the map.
        for info in dive.infos().values():
            list(translation.messages(info))
        for envelope in dive.messages(*topics, doing="export"):
            try:
                said = list(translation.messages(envelope.message))
            except MessageError:
                refused += 1
                continue
            if envelope.time_ns - cut_ns >= CHUNK_NS:
                writer.flush()
                cut_ns = envelope.time_ns
            for message in said:
                channel = channels.get(message.topic)
                if channel is None:
                    channel = channels[message.topic] = _channel(
                        writer, store, schemas, message.topic, message.type_name
                    )
                data = bytes(store.serialize_cdr(message.value, message.type_name))
                stamp_ns = getattr(envelope.message, "stamp_ns", envelope.time_ns)
                writer.add_message(channel, envelope.time_ns, data, stamp_ns, count & 0xFFFFFFFF)
                count += 1
        writer.finish()
        check_shows(dive, count)
    if refused:
        log.warning("%s: %d messages have times after 2038, which ROS 2 cannot say: left out", dive.name, refused)
    return count


def _channel(writer: Any, store: Any, schemas: dict[str, int], topic: str, type_name: str) -> int:
    if type_name not in schemas:
        text = store.generate_msgdef(type_name, ros_version=2)[0]
        schemas[type_name] = writer.register_schema(type_name, "ros2msg", text.encode())
    registered: int = writer.register_channel(topic, "cdr", schemas[type_name], {"offered_qos_profiles": ""})
    return registered
