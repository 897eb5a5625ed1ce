"""What can be chosen of the solver: known without loading what it names."""

from typing import Final

METHODS: Final = ("refined", "exact", "paper", "paper_midpoint", "paper_literal")
CHECKS: Final = ("range", "twist", "attitude", "depth")
TRACKS: Final = ("smooth", "lag", "filter", "none")
