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
    import numpy as np
    from buddyline.protocol.divelog import DiveLogWriter
    from numpy.typing import NDArray

REMOVE_IT: Final = "name another or remove it first"


def check_new(path: Path | str, hint: str = REMOVE_IT) -> Path:
    """Return the path; raise BuddylineError where a file is there, so that no work is done for nothing."""
    if os.path.lexists(path):
        raise BuddylineError(f"{path}: exists; {hint}")
    return Path(path)


@contextmanager
def new_file(path: Path | str, hint: str = REMOVE_IT) -> Iterator[Path]:
    """Give the place beside a new file to write to, and name it when it is whole.

    Raises BuddylineError where a file is there (hint: what to do about it), or where the place cannot be written.
    """
    target = check_new(path, hint)
    if not target.parent.is_dir():
        raise BuddylineError(f"{path}: cannot be written: there is no folder {target.parent}")
    part = target.with_name(f"{target.name}.part")
    check_new(part, "a command still writes it, or was killed; remove it in that case")
    try:
        yield part
        try:
            os.link(part, target)
        except FileExistsError:
            check_new(target, hint)
        except OSError:
            # A file system without hard links (a memory stick's).
            check_new(target, hint)
            part.rename(target)
    except OSError as error:
        raise BuddylineError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        part.unlink(missing_ok=True)


def write_new(path: Path | str, content: str | bytes, hint: str = REMOVE_IT) -> None:
    """Write a new file; raise BuddylineError as new_file does."""
    with new_file(path, hint) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def write_output(target: str, content: str | bytes) -> None:
    """Write what a command was asked for: to a new file, which is named on stderr, or to stdout for `-`."""
    if target != "-":
        write_new(target, content)
        print(f"wrote {target}", file=sys.stderr)
        return
    sys.stdout.buffer.write(content.encode() if isinstance(content, str) else content)
    sys.stdout.flush()


def new_folder(path: Path | str) -> Path:
    """Make a folder for what a command writes; raise BuddylineError where there is one with something in it."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise BuddylineError(f"{folder}: is not empty; name another folder")
    except OSError as error:
        raise BuddylineError(f"{folder}: cannot be made: {error.strerror}") from error
    return folder


def write_picture(folder: Path, name: str, picture: NDArray[np.uint8]) -> None:
    """Write a new picture as NAME.png, or NAME_2.png and so on where that is taken."""
    import cv2

    path, number = folder / f"{name}.png", 2
    while path.exists():
        path, number = folder / f"{name}_{number}.png", number + 1
    write_new(path, cv2.imencode(".png", picture)[1].tobytes())


@contextmanager
def new_dive_log(path: Path | str, metadata: dict[str, str] | None = None) -> Iterator[DiveLogWriter]:
    """Write a new dive log; raise BuddylineError as new_file does."""
    from buddyline.protocol.divelog import DiveLogWriter

    with new_file(path) as part:
        writer = DiveLogWriter(part, metadata=metadata)
        try:
            yield writer
            writer.close()
        finally:
            writer.abandon()
