"""Dive logs by the mcap library alone, so that a fault of our own reader or writer cannot hide itself."""

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

CHUNK_BYTES = 64 * 1024


@dataclass(frozen=True)
class Entry:
    """One message of a log: key, schema name and text, log time and publish time in ns, payload."""

    key: str
    schema: tuple[str, bytes]
    log_time_ns: int
    publish_time_ns: int
    payload: bytes

    @property
    def topic(self) -> str:
        """Last part of the key."""
        return self.key.rpartition("/")[2]

    @property
    def node(self) -> str:
        """Node id of a node's key."""
        return self.key.split("/")[2]

    @cached_property
    def message(self) -> dict[str, object]:
        """The payload as JSON."""
        return json.loads(self.payload)

    def at(self, log_time_ns: int) -> "Entry":
        """The same message, received at another time."""
        return replace(self, log_time_ns=log_time_ns)

    def saying(self, **fields: object) -> "Entry":
        """The same message with other fields."""
        return replace(self, payload=json.dumps({**self.message, **fields}, separators=(",", ":")).encode())


def read_log(path: Path) -> list[Entry]:
    """Return all messages of a sound log by log time (ties: as in the file)."""
    with open(path, "rb") as file:
        return [
            Entry(channel.topic, (schema.name, schema.data), message.log_time, message.publish_time, message.data)
            for schema, channel, message in make_reader(file).iter_messages()
            if schema is not None
        ]


def write_log(path: Path, entries: list[Entry]) -> Path:
    """Write messages in the order given."""
    with open(path, "wb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="buddyline", library="golden")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for number, entry in enumerate(entries):
            name, text = entry.schema
            if name not in schemas:
                schemas[name] = writer.register_schema(name, "jsonschema", text)
            if entry.key not in channels:
                channels[entry.key] = writer.register_channel(entry.key, "json", schemas[name])
            writer.add_message(channels[entry.key], entry.log_time_ns, entry.payload, entry.publish_time_ns, number)
        writer.finish()
    return path
