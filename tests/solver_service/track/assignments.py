"""One picture's assignments of candidates to a bar's two lights."""

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.association import Case, odds_of


def weigh(
    y: Floats, H: Floats, P: Floats, sigma_px: Floats, detection: Floats, clutter_per_px2: float
) -> tuple[list[Case], Floats]:
    """Give the assignments and the logs of their odds; arguments as of `associate`."""
    [odds] = odds_of(y[None], H[None], P[None], sigma_px[None], np.array((clutter_per_px2,)))
    return odds.weighed(detection)
