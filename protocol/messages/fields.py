"""The base of all messages, the kinds of their fields, and what several of them check."""

from __future__ import annotations

import math
from typing import Annotated, Final, TypeAlias

from msgspec import Meta, Struct

NODE_ID_PATTERN: Final = r"^[a-z0-9_]{1,32}\Z"
NodeId: TypeAlias = Annotated[str, Meta(pattern=NODE_ID_PATTERN)]
StampNs: TypeAlias = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Count: TypeAlias = Annotated[int, Meta(ge=0, le=2**63 - 1)]
NonNegative: TypeAlias = Annotated[float, Meta(ge=0)]
Positive: TypeAlias = Annotated[float, Meta(gt=0)]
Vector3: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]


class Message(Struct, frozen=True, kw_only=True):
    """Base of all messages."""


def check_unit(field: str, q_xyzw: Quaternion) -> None:
    """Raise ValueError if a quaternion's norm is not 1 within 1e-3."""
    norm = math.hypot(*q_xyzw)
    if not abs(norm - 1.0) <= 1e-3:
        raise ValueError(f"{field}: norm {norm:.6g} is not 1")


def check_finite(field: str, values: tuple[float, ...]) -> None:
    """Raise ValueError if a number is not finite."""
    if not all(map(math.isfinite, values)):
        raise ValueError(f"{field}: not finite")
