"""Strict TOML configuration: unknown keys, wrong types and wrong values are errors that name file, field and value."""

from __future__ import annotations

import difflib
import hashlib
import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final, TypeAlias, TypeVar

import msgspec
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.refused import field_of, value_at, without_field

C = TypeVar("C", bound=msgspec.Struct)
# Text longer than this is a large survey's: there rtoml, where it is installed, takes a sixth of tomllib's time.
LONG: Final = 100_000
# What a dive log begins with.
MCAP: Final = b"\x89MCAP"
# In front of all keys on the bus; Zenoh gives other characters a meaning of their own.
Namespace: TypeAlias = Annotated[str, msgspec.Meta(pattern=r"^([A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*)?\Z")]


class ConfigError(BuddylineError):
    """A configuration that cannot be used."""


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all configuration tables: unknown keys are errors."""


def load_config(path: Path | str, schema: type[C]) -> C:
    """Read a TOML file as schema; raise ConfigError naming file, field and value."""
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    text = text_of(content, path, "a configuration in TOML")
    return parse_config(text.replace("\r\n", "\n").replace("\r", "\n"), schema, str(path))


def text_of(content: bytes, path: Path | str, wanted: str) -> str:
    """Return a file's text; raise ConfigError that says where it is none, and what is wanted in its place."""
    if content.startswith(MCAP):
        raise ConfigError(f"{path}: is a dive log; name {wanted} here")
    try:
        # Editors of Windows may put a byte order mark before the text.
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ConfigError(
            f"{path}: byte 0x{content[error.start]:02x} in line {line} is not UTF-8 text; name {wanted}, saved as UTF-8"
        ) from error


def parse_config(text: str, schema: type[C], name: str) -> C:
    """Read TOML text as schema; name: the file's name in errors. Raises ConfigError."""
    try:
        table = _table_of(text)
        infinite = [f"{field} = {value}" for field, value in _numbers_of(table) if not math.isfinite(value)]
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{name}: not TOML: {error}") from error
    if infinite:
        raise ConfigError(f"{name}: {infinite[0]}: not a finite number")
    try:
        return msgspec.convert(table, schema)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{name}: {_explain(str(error), table, schema)}") from error


def _table_of(text: str) -> dict[str, Any]:
    if len(text) > LONG:
        try:
            import rtoml

            return rtoml.loads(text)
        except (ModuleNotFoundError, ValueError):
            pass  # tomllib says where an error is.
    return tomllib.loads(text)


def _numbers_of(value: Any, field: str = "") -> Iterator[tuple[str, float]]:
    """Yield all numbers with a point in a table, each with its field's name."""
    if isinstance(value, float):
        yield field, value
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from _numbers_of(each, f"{field}.{key}" if field else key)
    elif isinstance(value, list):
        for at, each in enumerate(value):
            yield from _numbers_of(each, f"{field}[{at}]")


def config_sha256(config: msgspec.Struct) -> str:
    """Return the SHA-256 of a configuration, defaults included."""
    return hashlib.sha256(msgspec.json.encode(config, order="sorted")).hexdigest()


def _explain(error: str, table: dict[str, Any], schema: type[msgspec.Struct]) -> str:
    """Add the value, or the nearest known key, to msgspec's message."""
    field = field_of(error)
    unknown = re.search(r"unknown field `(.*?)`", error)
    if unknown:
        known = _keys_at(schema, field)
        near = difflib.get_close_matches(unknown.group(1), known, 1)
        where = f"[{field}] " if field else ""
        hint = f"did you mean `{near[0]}`?" if near else f"known: {', '.join(known)}"
        return f"{where}unknown key `{unknown.group(1)}`; {hint}"
    try:
        value = value_at(table, field)
    except LookupError:
        return error
    if not field:
        return error
    error = without_field(error, field)
    if not isinstance(value, dict):
        return f"{field} = {value!r}: {error}"
    # What a table checks by itself begins with its keys.
    return f"{field}.{error}" if re.match(r"\w+: ", error) else f"[{field}] {error}"


def _keys_at(schema: type[msgspec.Struct], field: str) -> list[str]:
    kind: msgspec.inspect.Type = msgspec.inspect.type_info(schema)
    for part in re.findall(r"[^.\[\]]+", field):
        if isinstance(kind, msgspec.inspect.StructType):
            kind = next((f.type for f in kind.fields if f.encode_name == part), kind)
        if isinstance(kind, msgspec.inspect.UnionType):
            kind = next((t for t in kind.types if isinstance(t, msgspec.inspect.StructType)), kind)
    return [f.encode_name for f in kind.fields] if isinstance(kind, msgspec.inspect.StructType) else []
