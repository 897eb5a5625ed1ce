"""Which lamps are dark: expected in the picture for long and never there, while the other lamp of the bar was."""

from __future__ import annotations

from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats

# A diver or a rope hides a lamp for a second or two, chance misses it in a picture or two.
DARK_S: Final = 6.0
DARK_PICTURES: Final = 15
# From here on it is worth a word where there is no pose.
UNSEEN_S: Final = 0.4
UNSEEN_PICTURES: Final = 5
# A lamp that is seen makes up for so many pictures without it; a false candidate in its place does no more.
SIGHTING: Final = 5
# Probability from which on a lamp counts as seen.
SEEN: Final = 0.9


class LampWatch:
    """Follows the lamps of nodes a (0) and b (1), left (0) and right (1)."""

    def __init__(self) -> None:
        self._since_s = np.full((2, 2), np.nan)
        self._last_s = np.full((2, 2), np.nan)
        self._missed = np.zeros((2, 2), dtype=int)
        self._taken_s = np.full(2, -np.inf)

    def take(self, node: int, t_s: float, seen: Floats) -> None:
        """Take a picture of a node's bar whose lamps (2,) should both be in it, and the probability that each is.

        Those of a time that has been taken are left out: a replay shows pictures again.
        """
        if t_s <= self._taken_s[node]:
            return
        self._taken_s[node] = t_s
        for light in (0, 1):
            if seen[light] > SEEN:
                self._missed[node, light] = max(min(self._missed[node, light], 2 * DARK_PICTURES) - SIGHTING, 0)
                if self._missed[node, light] == 0:
                    self._since_s[node, light] = np.nan
            elif seen[light] < 1.0 - SEEN and seen[1 - light] > SEEN:
                if self._missed[node, light] == 0:
                    self._since_s[node, light] = t_s
                self._missed[node, light] += 1
                self._last_s[node, light] = t_s

    def dark(self, after_s: float = DARK_S, pictures: int = DARK_PICTURES) -> list[tuple[int, int, float]]:
        """Return node, light and for how long (s) of each lamp that is dark: not seen for after_s and in pictures."""
        duration_s = self._last_s - self._since_s
        with np.errstate(invalid="ignore"):
            found = np.argwhere((duration_s >= after_s) & (self._missed >= pictures))
        return [(node, light, float(duration_s[node, light])) for node, light in found.tolist()]
