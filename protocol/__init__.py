"""The shared vocabulary: messages, topics, bus, dive log, clock. Imports nothing else of ours."""

__version__ = "0.1.0"
