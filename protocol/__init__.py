"""What all packages share: messages, topics, bus, dive log, clock. Imports no other package of the project."""

try:
    # Written when the package is built or installed; says which commit this is.
    from buddyline.protocol._version import __version__
except ImportError:
    __version__ = "0.0.0"

__all__ = ["__version__"]
