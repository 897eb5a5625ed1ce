"""Relative pose from mutual bearings: numpy alone."""
