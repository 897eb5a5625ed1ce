"""Packages of the extras (pyproject.toml), which may be missing."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from buddyline.protocol.errors import BuddylineError


class MissingExtraError(BuddylineError):
    """A package of an extra is not installed."""


def needed(module: str, what: str, extra: str, package: str = "") -> Any:
    """Return a module of an extra; raise MissingExtraError where it is missing. what: needs it, in words.

    package: its name for pip, where it is not the module's.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = package or module.partition(".")[0]
        clone = Path(__file__).resolve().parents[1]
        where = f" in {clone}" if (clone / "Makefile").is_file() and Path.cwd() != clone else ""
        raise MissingExtraError(
            f"{what} needs {package}, which is not installed ({error.name}): make install EXTRAS={extra}{where}"
        ) from error
