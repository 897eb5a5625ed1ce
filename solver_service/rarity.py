"""How rarely all four lights are found: where they hardly ever are, what looks like all four is likely chance.

With a dead or hidden lamp no trigger shows four lights. In a dive of thousands of triggers, false lights such as
another diver's lamp still fit in some. A single trigger cannot tell.
"""

from __future__ import annotations

from typing import Final

from buddyline.solver_service.geometry.fix import Fix, NoFix

# What was found so many triggers ago counts e times less.
MEMORY: Final = 300.0
# Both counts before the first trigger.
START: Final = 0.5
# Another lamp stays in view from picture to picture, unlike evenly scattered candidates: the odds count to this power.
PERSISTENCE: Final = 2.0


class Rarity:
    """Counts the triggers of a pair with four lights, and those without."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all triggers."""
        self._full, self._other = START, START

    @property
    def factor(self) -> float:
        """How many times rarer four lights are taken to be than where they are mostly found; 1 or more."""
        return float(max(self._other / self._full, 1.0) ** PERSISTENCE)

    def take(self, found: Fix | NoFix) -> None:
        """Count a trigger by how likely it shows all four lights, whatever came of it."""
        if isinstance(found, NoFix) and found.silent:
            return
        kept = 1.0 - 1.0 / MEMORY
        self._full = START + kept * (self._full - START) + found.all_four
        self._other = START + kept * (self._other - START) + 1.0 - found.all_four
