"""The table of topics. Publishing, recording, schemas and health are derived from it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final, Literal

from buddyline.protocol import messages
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import NODE_ID_PATTERN, Message

_PLACES: Final = re.compile(r"{(\w+)}")
_ID_FIELDS: Final = {"node": "node", "a": "node_a", "b": "node_b", "net": "net"}

Priority = Literal["interactive_high", "data_high", "data", "data_low", "background"]


@dataclass(frozen=True)
class Topic:
    """One kind of message.

    template: its key, with {node}, {a} and {b}, or {net} and {node}. schema: the message's type. rate_hz: nominal; 0
    for messages sent on change. latest_only: a late subscriber gets only the newest message (of other topics, what it
    missed). express: sent at once, not in batches. stale_s: age from which it is stale (0: never). retained: the hub
    keeps the newest message of each key, also after its sender is gone. repeated: a publisher that takes another's
    place sends that one's last messages again, and subscribers drop those that they have. solved: a result of the
    solver, which `solve` computes again from a stored dive. max_bytes: of a payload; a larger one is not sent, and no
    hub passes it on.

    On a slow link. shed: the order in which it does without the topic: 1 first, 4 last, 0 never. keep_hz: up to this
    rate it is sent anyway. prompt: what waits goes together with these messages; they are also sent as datagrams,
    because a connection that has lost a packet stands still for a second.
    """

    name: str
    template: str
    schema: type[Message]
    rate_hz: float
    priority: Priority
    express: bool = False
    latest_only: bool = False
    stale_s: float = 0.0
    retained: bool = False
    repeated: bool = False
    solved: bool = False
    max_bytes: int = 64 * 1024
    shed: int = 0
    keep_hz: float = 0.0
    prompt: bool = False

    def key(self, *ids: str) -> str:
        """Return the Zenoh key, which is also the MCAP topic. ids: a node's, a pair's two, or a net's and a node's."""
        for node_id in ids:
            check_node_id(node_id)
        names = _PLACES.findall(self.template)
        if len(ids) != len(names):
            raise ValueError(f"topic {self.name} takes {len(names)} node ids, got {len(ids)}")
        return self.template.format(**dict(zip(names, ids, strict=True)))

    @cached_property
    def schema_name(self) -> str:
        """The schema's name in MCAP and in the Zenoh encoding."""
        home = "foxglove" if self.schema is messages.CompressedImage else "buddyline"
        return f"{home}.{self.schema.__name__}"

    @cached_property
    def id_fields(self) -> tuple[str, ...]:
        """The message's fields that hold the key's ids, in the key's order."""
        return tuple(_ID_FIELDS[name] for name in _PLACES.findall(self.template))

    def key_any(self) -> str:
        """Return the key expression that matches this topic of all nodes or pairs."""
        return _PLACES.sub("*", self.template)

    @property
    def encoding(self) -> str:
        """Zenoh encoding of the payload."""
        return f"application/json;{self.schema_name}"


# Of a sample: ten times what it takes.
SAMPLE_BYTES: Final = 4096

INFO: Final = Topic("info", "buddyline/node/{node}/info", messages.NodeInfo, 0.0, "data", latest_only=True)
CANDIDATES: Final = Topic(
    "candidates",
    "buddyline/node/{node}/candidates",
    messages.Candidates,
    10.0,
    "interactive_high",
    express=True,
    stale_s=1.0,
    prompt=True,
)
# Older than stale_s an expectation says nothing of where a light is now.
EXPECT: Final = Topic(
    "expect",
    "buddyline/node/{node}/expect",
    messages.Expect,
    10.0,
    "interactive_high",
    express=True,
    latest_only=True,
    stale_s=0.5,
    solved=True,
)
IMU: Final = Topic(
    "imu", "buddyline/node/{node}/imu", messages.Imu, 100.0, "data", stale_s=2.0, shed=2, max_bytes=SAMPLE_BYTES
)
# Only where a link leaves out samples and has room for means: one in 50 ms, eight in a message.
IMU_MEANS: Final = Topic(
    "imu_means",
    "buddyline/node/{node}/imu_means",
    messages.ImuMeans,
    2.5,
    "data",
    shed=2,
    max_bytes=SAMPLE_BYTES,
)
ATTITUDE: Final = Topic(
    "attitude",
    "buddyline/node/{node}/attitude",
    messages.Attitude,
    100.0,
    "data_high",
    express=True,
    stale_s=2.0,
    shed=3,
    keep_hz=5.0,
    max_bytes=SAMPLE_BYTES,
)
DEPTH: Final = Topic(
    "depth",
    "buddyline/node/{node}/depth",
    messages.Depth,
    20.0,
    "data_high",
    express=True,
    stale_s=2.0,
    shed=3,
    keep_hz=2.0,
    max_bytes=SAMPLE_BYTES,
)
# A full picture of a stored dive, in base64; a live preview is a twentieth of it.
IMAGE: Final = Topic(
    "image",
    "buddyline/node/{node}/image",
    messages.CompressedImage,
    1.0,
    "background",
    stale_s=3.0,
    max_bytes=4 * 1024 * 1024,
    shed=1,
)
NODE_STATUS: Final = Topic(
    "node_status",
    "buddyline/node/{node}/status",
    messages.NodeStatus,
    1.0,
    "data_low",
    latest_only=True,
    stale_s=3.0,
    shed=4,
    keep_hz=0.5,
)
CLOCK: Final = Topic(
    "clock",
    "buddyline/node/{node}/clock",
    messages.ClockBeacon,
    4.0,
    "interactive_high",
    express=True,
    max_bytes=SAMPLE_BYTES,
)
CLOCK_SET: Final = Topic("clock_set", "buddyline/node/{node}/clock_set", messages.ClockSet, 0.0, "data")
# One in ten seconds tells that others are missing, and of which run.
DIGEST: Final = Topic("digest", "buddyline/node/{node}/digest", messages.Digest, 1.0, "data_low", shed=4, keep_hz=0.1)
LIGHT_TRUTH: Final = Topic("light_truth", "buddyline/node/{node}/light_truth", messages.LightTruth, 10.0, "data_low")
MARK: Final = Topic("mark", "buddyline/node/{node}/mark", messages.Mark, 0.0, "data")
POSE: Final = Topic(
    "pose",
    "buddyline/pair/{a}/{b}/pose",
    messages.RelativePose,
    10.0,
    "interactive_high",
    express=True,
    stale_s=1.0,
    retained=True,
    repeated=True,
    solved=True,
)
# After POSE, because topic_of returns the first topic of a schema.
ARTAG: Final = Topic("artag", "buddyline/pair/{a}/{b}/artag", messages.RelativePose, 10.0, "data")
REJECTED: Final = Topic(
    "rejected",
    "buddyline/pair/{a}/{b}/rejected",
    messages.Rejected,
    10.0,
    "interactive_high",
    express=True,
    retained=True,
    repeated=True,
    solved=True,
)
TRACK: Final = Topic(
    "track",
    "buddyline/pair/{a}/{b}/track",
    messages.Track,
    20.0,
    "interactive_high",
    express=True,
    stale_s=1.0,
    retained=True,
    solved=True,
)
# After TRACK, because topic_of returns the first topic of a schema (and this one for the mode `lag`).
TRACK_LAG: Final = Topic(
    "track_lag",
    "buddyline/pair/{a}/{b}/track_lag",
    messages.Track,
    20.0,
    "data",
    stale_s=3.0,
    retained=True,
    solved=True,
)
TRUTH: Final = Topic("truth", "buddyline/pair/{a}/{b}/truth", messages.Truth, 10.0, "data_low")
NET_POSE: Final = Topic(
    "net_pose",
    "buddyline/net/{net}/{node}",
    messages.NodePose,
    20.0,
    "interactive_high",
    express=True,
    stale_s=1.0,
    retained=True,
    solved=True,
)
# After NET_POSE, because topic_of returns the first topic of a schema (and this one for the mode `truth`).
NET_TRUTH: Final = Topic("net_truth", "buddyline/net/{net}/truth/{node}", messages.NodePose, 10.0, "data_low")
SOLVER_STATUS: Final = Topic(
    "solver_status",
    "buddyline/pair/{a}/{b}/status",
    messages.SolverStatus,
    1.0,
    "data_low",
    latest_only=True,
    stale_s=3.0,
    solved=True,
)

TOPICS: Final = (
    INFO,
    CANDIDATES,
    EXPECT,
    IMU,
    IMU_MEANS,
    ATTITUDE,
    DEPTH,
    IMAGE,
    NODE_STATUS,
    CLOCK,
    CLOCK_SET,
    DIGEST,
    LIGHT_TRUTH,
    MARK,
    POSE,
    ARTAG,
    REJECTED,
    TRACK,
    TRACK_LAG,
    TRUTH,
    NET_POSE,
    NET_TRUTH,
    SOLVER_STATUS,
)

EVERYTHING: Final = "buddyline/**"
# On this key a node answers questions about its own log (protocol/log_pages.py); no message is published on it.
LOG: Final = "buddyline/node/{node}/log"

_NODE_ID = re.compile(NODE_ID_PATTERN)
_FIRST: Final = {topic.schema: topic for topic in reversed(TOPICS)}
_PATTERNS: Final = [
    (
        topic,
        re.compile(_PLACES.sub("([a-z0-9_]{1,32})", topic.template) + r"\Z"),
    )
    for topic in TOPICS
]


def check_node_id(node_id: str) -> str:
    """Return node_id; raise BuddylineError if it is not valid."""
    if not _NODE_ID.match(node_id):
        raise BuddylineError(f"node id {node_id!r}: use 1 to 32 of a-z, 0-9 and _")
    return node_id


@lru_cache(maxsize=4096)
def parse_key(key: str) -> tuple[Topic, tuple[str, ...]] | None:
    """Return the topic and the ids of a key; None if it is not a Buddyline key."""
    for topic, pattern in _PATTERNS:
        match = pattern.match(key)
        if match:
            return topic, match.groups()
    return None


def topic_of(message: Message) -> Topic:
    """Return the topic of a message by its type, and of a Track or a NodePose by its mode."""
    if isinstance(message, messages.Track) and message.mode == "lag":
        return TRACK_LAG
    if isinstance(message, messages.NodePose) and message.mode == "truth":
        return NET_TRUTH
    topic = _FIRST.get(type(message))
    if topic is None:
        raise TypeError(f"no topic carries {type(message).__name__}")
    return topic


def key_of(message: Message) -> str:
    """Return the key on which a message is published. Truth does not name its pair: use TRUTH.key for it."""
    topic = topic_of(message)
    if isinstance(message, messages.CompressedImage):
        return topic.key(message.frame_id.removesuffix("_camera"))
    return topic.key(*(str(getattr(message, field)) for field in topic.id_fields))
