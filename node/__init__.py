"""One node: capture, detect, publish and record."""

from protocol import __version__

__all__ = ["__version__"]
