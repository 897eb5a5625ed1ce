"""The names that a node's configuration can choose from, without importing what they name."""

from typing import Final

DETECTORS: Final = ("source", "paper")
PRESETS: Final = ("auto", "cavern", "night_reef", "lake", "basin", "day_reef")
"""Environments of the `paper` detector: it has thresholds for each. Other detectors adapt to the water."""
