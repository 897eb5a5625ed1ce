"""When a node's clock seems, and has proved, to be off what a network believes."""

from __future__ import annotations

from typing import Final

from buddyline.solver_service.track.moving import KNOWN_CLOCK_S

# A clock that is further off than this is put right: up to MOST_NUDGED_S at once, beyond that its node begins anew.
NUDGED_S: Final = 0.005
MOST_NUDGED_S: Final = 0.05
# A clock has proved to be off by more than so many sigmas.
SURE_SIGMAS: Final = 4.0
# It seems far off beyond MOST_NUDGED_S and so many: in its first seconds an offset is believed too soon.
SEEMS_SIGMAS: Final = 3.0
# How fast nodes move and turn between two pictures of one stamp.
BETWEEN_MPS: Final = 0.3
BETWEEN_RADPS: Final = 0.3


def seems_far(offset_s: float, sigma_s: float) -> bool:
    """Whether a clock seems too far off for what is made of its node's lights."""
    return abs(offset_s) > MOST_NUDGED_S + SEEMS_SIGMAS * sigma_s


def is_off(offset_s: float, sigma_s: float, limit_s: float = NUDGED_S) -> bool:
    """Whether a clock has proved to be off what is believed by more than a limit."""
    sigmas = SURE_SIGMAS if sigma_s < KNOWN_CLOCK_S else 2.0 * SURE_SIGMAS
    return abs(offset_s) > max(limit_s, sigmas * sigma_s)
