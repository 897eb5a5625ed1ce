"""What can be chosen of a node: known without loading what it names."""

from typing import Final

DETECTORS: Final = ("source", "paper")
PRESETS: Final = ("auto", "cavern", "night_reef", "lake", "basin")
