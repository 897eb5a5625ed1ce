"""One node: capture, detect, publish and record."""

from buddyline.protocol import __version__

__all__ = ["__version__"]
