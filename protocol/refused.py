"""What value a field has that was refused, for errors that name field and value."""

from __future__ import annotations

import re
from typing import Any


def field_of(error: str) -> str:
    """Return the field that an error of msgspec names, such as `camera.fx_px`; "" for none."""
    place = re.search(r"at `\$\.?(.*?)`\Z", error)
    return place.group(1) if place else ""


def value_at(root: Any, field: str) -> Any:
    """Return the value of a field, such as `blobs[2].u_px`, in decoded tables and lists; raise LookupError for none."""
    value = root
    for part in re.findall(r"[^.\[\]]+", field):
        try:
            value = value[int(part)] if isinstance(value, list) else value[part]
        except (TypeError, ValueError) as error:
            raise LookupError(field) from error
    return value


def without_field(error: str, field: str) -> str:
    """Return an error of msgspec without the field at its end."""
    return error.removesuffix(f" - at `$.{field}`").removesuffix(f" - at `${field}`")
