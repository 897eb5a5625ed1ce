"""Encode messages to, and decode them from, the payloads of the bus and of dive logs: one JSON object each, UTF-8.

`encode` writes nothing that `decode` would refuse. Fields of type float are always written as floats.
"""

from __future__ import annotations

import json
import math
from typing import Any, Final, TypeVar

import msgspec
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import CompressedImage, FoxgloveTime, Message
from buddyline.protocol.refused import field_of, value_at, without_field

MAX_MESSAGE_BYTES: Final = 16 * 1024 * 1024
# Of a refused message so long at most the error names the value, if it is so long at most as JSON.
MAX_READ_AGAIN_BYTES: Final = 256 * 1024
MAX_VALUE_LENGTH: Final = 60

M = TypeVar("M", bound=Message)


def plain(value: object) -> object:
    """Convert numpy scalars and arrays to Python's numbers and lists."""
    to_list = getattr(value, "tolist", None)
    if to_list is None:
        raise TypeError(f"cannot encode {type(value).__name__}")
    return to_list()


_ENCODER = msgspec.json.Encoder(enc_hook=plain)
_DECODERS: dict[type[Message], msgspec.json.Decoder[Any]] = {}


def decode(payload: bytes, schema: type[M]) -> M:
    """Decode and validate one message; raise MessageError naming the field."""
    if len(payload) > MAX_MESSAGE_BYTES:
        raise MessageError(f"{schema.__name__}: {len(payload)} bytes, at most {MAX_MESSAGE_BYTES}")
    decoder = _DECODERS.get(schema)
    if decoder is None:
        decoder = _DECODERS.setdefault(schema, msgspec.json.Decoder(schema))
    try:
        message: M = decoder.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        where = _non_finite_field(payload) or _named(str(error), payload)
        raise MessageError(f"{schema.__name__}: {where}") from error
    return message


def _non_finite_field(payload: bytes) -> str | None:
    """Name the field that holds a NaN or an infinity; None if no field does."""
    if not any(word in payload for word in (b"NaN", b"Infinity")):
        return None
    try:
        root = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    stack: list[tuple[str, object]] = [("$", root)]
    while stack:
        path, value = stack.pop()
        if isinstance(value, float) and not math.isfinite(value):
            return f"not a finite number: {value} - at `{path}`"
        if isinstance(value, dict):
            stack.extend((f"{path}.{key}", item) for key, item in value.items())
        elif isinstance(value, list):
            stack.extend((f"{path}[{i}]", item) for i, item in enumerate(value))
    return None


def _named(error: str, payload: bytes) -> str:
    """Return an error with the refused value, where that is a short one; a message is read again for that."""
    field = field_of(error)
    if not field or len(payload) > MAX_READ_AGAIN_BYTES:
        return error
    try:
        value = json.dumps(value_at(msgspec.json.decode(payload), field))
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, LookupError):
        return error
    return f"{field} = {value}: {without_field(error, field)}" if len(value) <= MAX_VALUE_LENGTH else error


class _Stamp(msgspec.Struct):
    """The measurement time, in the two forms in which a message may have it."""

    stamp_ns: int | None = None
    timestamp: FoxgloveTime | None = None


_STAMP_DECODER = msgspec.json.Decoder(_Stamp)


def payload_stamp_ns(payload: bytes) -> int | None:
    """Return the measurement time of a payload, ns; None if it has none."""
    try:
        stamp = _STAMP_DECODER.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
    if stamp.timestamp is not None:
        return stamp.timestamp.sec * 1_000_000_000 + stamp.timestamp.nsec
    return stamp.stamp_ns


def message_stamp_ns(message: Message) -> int:
    """Return the measurement time of a message, ns; 0 if it has none."""
    if isinstance(message, CompressedImage):
        return message.timestamp.sec * 1_000_000_000 + message.timestamp.nsec
    stamp_ns: int = getattr(message, "stamp_ns", 0)
    return stamp_ns


def encode(message: Message) -> bytes:
    """Encode one message; raise MessageError if it is not valid.

    The result is decoded again as a check, so that a NaN, an integer in place of a float or a numpy scalar never
    reaches the bus.
    """
    try:
        first = _ENCODER.encode(message)
    except (TypeError, ValueError, OverflowError, msgspec.MsgspecError) as error:
        raise MessageError(f"{type(message).__name__}: {error}") from error
    return _ENCODER.encode(decode(first, type(message)))
