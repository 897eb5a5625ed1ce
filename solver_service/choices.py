"""The names that the solver's configuration can choose from, without importing what they name."""

from typing import Final

METHODS: Final = ("refined", "exact", "paper", "paper_midpoint", "paper_literal")
CHECKS: Final = ("range", "twist", "attitude", "depth")
TRACKS: Final = ("smooth", "lag", "filter", "none")
