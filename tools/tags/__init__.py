"""Poses from AR tags: the yardstick beside the lights."""
