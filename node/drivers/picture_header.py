"""The size that a picture file's header states, read without decoding the picture: PNG, JPEG, BMP and TIFF."""

from __future__ import annotations

from collections.abc import Callable
from struct import error, unpack_from
from typing import Final, TypeAlias

Size: TypeAlias = tuple[int, int]


def stated_size(data: bytes) -> Size | None:
    """Return (width_px, height_px) of a picture file's bytes; None if no header gives it."""
    for magic, read in _READERS.items():
        if data.startswith(magic):
            try:
                return read(data)
            except error:  # the header is cut off
                return None
    return None


def _png(data: bytes) -> Size:
    width, height = unpack_from(">II", data, 16)
    return width, height


def _bmp(data: bytes) -> Size:
    width, height = unpack_from("<ii", data, 18)
    return abs(width), abs(height)  # a negative height: the first row is on top


def _jpeg(data: bytes) -> Size | None:
    """Follow the segments to the start of frame: markers C0 to CF without C4 (tables), C8 (reserved), CC (coding)."""
    at = 2
    while True:
        (mark, length) = unpack_from(">HH", data, at)
        if mark >> 8 != 0xFF:
            return None
        if mark == 0xFFFF:  # a fill byte
            at += 1
        elif 0xFFC0 <= mark <= 0xFFCF and mark not in (0xFFC4, 0xFFC8, 0xFFCC):
            height, width = unpack_from(">HH", data, at + 5)
            return width, height
        else:
            at += 2 + length


def _tiff(data: bytes) -> Size | None:
    """Read ImageWidth (tag 256) and ImageLength (257) of the first directory; both are shorts or longs."""
    order = "<" if data[:2] == b"II" else ">"
    (at,) = unpack_from(order + "I", data, 4)
    (count,) = unpack_from(order + "H", data, at)
    found = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind = unpack_from(order + "HH", data, entry)
        if tag in (256, 257):
            (found[tag],) = unpack_from(order + ("H" if kind == 3 else "I"), data, entry + 8)
    return (found[256], found[257]) if len(found) == 2 else None


_READERS: Final[dict[bytes, Callable[[bytes], Size | None]]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    b"BM": _bmp,
    b"\xff\xd8": _jpeg,
    b"II*\x00": _tiff,
    b"MM\x00*": _tiff,
}
