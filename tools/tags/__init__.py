"""Poses from AR tags, to compare the poses from lights with."""
