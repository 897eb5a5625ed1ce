"""New files: what a command writes never takes the place of a file that is there, and is never found half written.

A file is written beside its place, as NAME.part, and gets its name when it is whole. Where the command fails or is
interrupted, the part is removed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from buddyline.protocol.errors import BuddylineError

if TYPE_CHECKING:
    from buddyline.protocol.divelog import DiveLogWriter

REMOVE_IT: Final = "name another or remove it first"


def check_new(path: Path | str, hint: str = REMOVE_IT) -> Path:
    """Return the path; raise BuddylineError where a file is there, so that no work is done for nothing."""
    if os.path.lexists(path):
        raise BuddylineError(f"{path}: exists; {hint}")
    return Path(path)


def write_new(path: Path | str, content: str | bytes, hint: str = REMOVE_IT) -> None:
    """Write a new file; raise BuddylineError where one exists, or where the place cannot be written.

    hint: what to do about a file that exists.
    """
    target = check_new(path, hint)
    part = _part_of(target)
    try:
        with open(part, "xb") as file, _named_when_whole(part, target, hint):
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
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


@contextmanager
def new_dive_log(path: Path | str, metadata: dict[str, str] | None = None) -> Iterator[DiveLogWriter]:
    """Write a new dive log; raise BuddylineError where one exists, or where the place cannot be written."""
    from buddyline.protocol.divelog import DiveLogWriter

    target = check_new(path)
    part = _part_of(target)
    writer = DiveLogWriter(part, metadata=metadata)
    with _named_when_whole(part, target):
        try:
            yield writer
            writer.close()
        except OSError as error:
            raise BuddylineError(f"{path}: cannot be written: {error.strerror}") from error
        finally:
            writer.abandon()


def _part_of(target: Path) -> Path:
    part = target.with_name(f"{target.name}.part")
    return check_new(part, "a command still writes it, or ended without a word; in that case remove it")


@contextmanager
def _named_when_whole(part: Path, target: Path, hint: str = REMOVE_IT) -> Iterator[None]:
    try:
        yield
        try:
            os.link(part, target)
        except FileExistsError:
            raise BuddylineError(f"{target}: exists; {hint}") from None
        except OSError:
            # A file system without hard links (a memory stick's).
            check_new(target, hint)
            part.rename(target)
    finally:
        part.unlink(missing_ok=True)
