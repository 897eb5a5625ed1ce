"""What all packages share: messages, topics, bus, dive log, clock. Imports no other package of the project."""

__version__ = "0.1.0"
