"""What a node has said within a second, as checksums that it signs."""

from __future__ import annotations

from typing import Annotated, Final

from buddyline.protocol.messages.fields import Count, Message, NodeId, StampNs
from msgspec import UNSET, Meta, Struct, UnsetType

MAX_SAID: Final = 512


class Said(Struct, frozen=True, kw_only=True, gc=False):
    """Consecutive messages of one topic, each with a later stamp than the one before.

    topic: the last chunk of their key. sha256: of their payloads' SHA-256, one after the other; its first half, in hex.
    """

    topic: Annotated[str, Meta(max_length=32)]
    count: Annotated[int, Meta(ge=1, le=2**31)]
    first_ns: StampNs
    last_ns: StampNs
    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{32}\Z")]


class Digest(Message, frozen=True, kw_only=True):
    """Checksums of all that a node has said since its last digest.

    seq: counts the digests of a boot. since_ns: stamp_ns of the last digest, or when the node began. last: the node
    ended in order. Signed, its payload ends with a field `signature`: ECDSA with SHA-256, in base64, over the payload
    without this field (protocol/digest.py).
    """

    node: NodeId
    stamp_ns: StampNs
    boot: str
    seq: Count
    since_ns: StampNs
    said: Annotated[list[Said], Meta(max_length=MAX_SAID)]
    last: bool | UnsetType = UNSET
    signature: str | UnsetType = UNSET
