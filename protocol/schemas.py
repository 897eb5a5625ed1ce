"""Flat JSON schemas of the messages, as log viewers need them: no $ref, no anyOf, all types inline."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import msgspec
from buddyline.protocol.messages import Message
from msgspec import inspect

_PLAIN = {
    inspect.IntType: {"type": "integer"},
    inspect.FloatType: {"type": "number"},
    inspect.StrType: {"type": "string"},
    inspect.LiteralType: {"type": "string"},
    inspect.BoolType: {"type": "boolean"},
    inspect.BytesType: {"type": "string", "contentEncoding": "base64"},
}


@cache
def json_schema(schema: type[Message]) -> bytes:
    """Return the JSON schema of a message type as UTF-8 JSON."""
    return json.dumps(_describe(msgspec.inspect.type_info(schema)), separators=(",", ":")).encode()


def _describe(kind: inspect.Type) -> dict[str, Any]:
    if isinstance(kind, inspect.Metadata):
        return _describe(kind.type)
    if isinstance(kind, inspect.UnionType):
        present = [item for item in kind.types if type(item).__name__ != "UnsetType"]
        named = [item for item in present if not isinstance(item, inspect.CustomType)]
        return _describe((named or present)[0])
    if isinstance(kind, inspect.StructType):
        return {
            "type": "object",
            "title": kind.cls.__name__,
            "properties": {field.encode_name: _describe(field.type) for field in kind.fields},
            "required": [field.encode_name for field in kind.fields if field.required],
        }
    if isinstance(kind, inspect.ListType):
        return {"type": "array", "items": _describe(kind.item_type)}
    if isinstance(kind, inspect.TupleType):
        return {"type": "array", "items": _describe(kind.item_types[0])}
    if isinstance(kind, inspect.DictType):
        return {"type": "object"}
    for plain, description in _PLAIN.items():
        if isinstance(kind, plain):
            return dict(description)
    raise TypeError(f"no JSON schema for {kind}")
