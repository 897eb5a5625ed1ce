"""New files: what a command writes never takes the place of a file that is there."""

from __future__ import annotations

import sys
from pathlib import Path

from buddyline.protocol.errors import BuddylineError


def write_new(path: Path | str, content: str | bytes, hint: str = "name another or remove it first") -> None:
    """Write a new file; raise BuddylineError where one exists, or where the place cannot be written.

    hint: what to do about a file that exists.
    """
    data = content.encode() if isinstance(content, str) else content
    try:
        with open(path, "xb") as file:
            file.write(data)
    except FileExistsError:
        raise BuddylineError(f"{path}: exists; {hint}") from None
    except OSError as error:
        raise BuddylineError(f"{path}: cannot be written: {error.strerror}") from error


def write_output(target: str, content: str | bytes) -> None:
    """Write what a command was asked for: to a new file, which is named on stderr, or to stdout for `-`."""
    if target != "-":
        write_new(target, content)
        print(f"wrote {target}", file=sys.stderr)
        return
    sys.stdout.buffer.write(content.encode() if isinstance(content, str) else content)
    sys.stdout.flush()
