"""Write new files: an existing file is never replaced, and no file is ever incomplete under its final name.

A file is written as NAME.part and renamed when it is complete. If the command fails or is interrupted, the part is
removed.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from buddyline.protocol.errors import BuddylineError

if TYPE_CHECKING:
    import numpy as np
    from buddyline.protocol.divelog import DiveLogWriter
    from numpy.typing import NDArray

REMOVE_IT: Final = "name another or remove it first"


def check_new(path: Path | str, hint: str = REMOVE_IT) -> Path:
    """Return the path; raise BuddylineError if a file is there. Call it before the work whose result goes there."""
    # An empty name is this folder.
    path = _named(path)
    if os.path.lexists(path):
        raise BuddylineError(f"{path}: exists; {hint}")
    return path


def _named(path: Path | str) -> Path:
    """Return the path; raise BuddylineError for `-`, which many programs take for standard output."""
    if str(path) == "-":
        raise BuddylineError("-: this does not go to standard output; name a file or folder")
    return Path(path)


@contextmanager
def new_file(path: Path | str, hint: str = REMOVE_IT) -> Iterator[Path]:
    """Yield NAME.part to write to, and rename it to NAME at the end.

    Raises BuddylineError if NAME exists (hint: what to do about it), or cannot be written.
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
            # A file system without hard links, such as a memory stick's.
            check_new(target, hint)
            part.rename(target)
    except OSError as error:
        raise BuddylineError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        # A file system that has become read-only refuses this, too: what is told is why the file was not written.
        with suppress(OSError):
            part.unlink(missing_ok=True)


def as_bytes(content: str | bytes) -> bytes:
    """Return text as UTF-8; what is none, as a file's name may be, becomes "?"."""
    return content.encode(errors="replace") if isinstance(content, str) else content


def write_new(path: Path | str, content: str | bytes, hint: str = REMOVE_IT) -> None:
    """Write a new file; raise BuddylineError as new_file does."""
    with new_file(path, hint) as part:
        part.write_bytes(as_bytes(content))


def replace_text(path: Path, text: str) -> None:
    """Replace a file, or the one that a link leads to, all at once; it keeps its permissions. Raise BuddylineError."""
    target = path.resolve()
    fresh = target.with_name(f"{target.name}.{os.getpid()}.new")
    try:
        fresh.write_bytes(text.encode())
        shutil.copymode(target, fresh)
        os.replace(fresh, target)
    except OSError as error:
        raise BuddylineError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        with suppress(OSError):
            fresh.unlink(missing_ok=True)


def write_output(target: str, content: str | bytes) -> None:
    """Write a command's output to a new file, and name it on stderr; `-`: to stdout."""
    if target != "-":
        write_new(target, content)
        print(f"wrote {target}", file=sys.stderr)
        return
    sys.stdout.buffer.write(as_bytes(content))
    sys.stdout.flush()


def new_folder(path: Path | str) -> Path:
    """Make a folder for a command's output; raise BuddylineError if it exists and is not empty."""
    folder = _named(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise BuddylineError(f"{folder}: is not empty; name another folder, or empty it")
    except FileExistsError as error:
        raise BuddylineError(f"{folder}: exists and is no folder; name another") from error
    except OSError as error:
        raise BuddylineError(f"{folder}: cannot be made: {error.strerror}") from error
    return folder


def write_picture(folder: Path, name: str, picture: NDArray[np.uint8]) -> None:
    """Write a new picture as NAME.png, or as NAME_2.png and so on if that exists."""
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
