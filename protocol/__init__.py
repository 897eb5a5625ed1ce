"""What all packages share: messages, topics, bus, dive log, clock. Imports no other package of the project."""

from importlib import import_module

try:
    # Says which commit this is. Building or installing writes it: linters must not need it, so it is imported by name.
    __version__: str = import_module("buddyline.protocol._version").__version__
except ImportError:
    __version__ = "0.0.0"

__all__ = ["__version__"]
