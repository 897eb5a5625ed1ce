"""How much the node does: less when it gets hot or the supply gives way, before the firmware slows it down. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from buddyline.protocol.health import POWER_NOW, SLOWED_NOW

LoadLevel = Literal["full", "no_pictures", "half_rate"]
LEVELS: Final[tuple[LoadLevel, ...]] = ("full", "no_pictures", "half_rate")
WORDS: Final[dict[LoadLevel, str]] = {
    "full": "",
    "no_pictures": "no pictures are recorded or shown",
    "half_rate": "no pictures are recorded or shown, and every second trigger is left out",
}
# The firmware slows a Pi down at 80 degrees. The load is lowered from these temperatures on, and raised this far below.
STEPS_DEGC: Final = (74.0, 77.0)
BACK_DEGC: Final = 6.0
# The firmware's present bits that cause each step. A weak supply alone, often a thin cable, costs pictures only.
STEPS_BITS: Final = (POWER_NOW, SLOWED_NOW)
# A sealed housing's processor takes some ten seconds to follow its load, and minutes to cool.
LOWER_AFTER_S: Final = 15.0
RAISE_AFTER_S: Final = 120.0


@dataclass(frozen=True, slots=True)
class NodeLoad:
    """level: what the node does. since_s: when it was set. calm_s: since when nothing asks for it; None: needed."""

    level: LoadLevel = "full"
    since_s: float = float("-inf")
    calm_s: float | None = None


def next_load(load: NodeLoad, temperature_degc: float | None, throttled_bits: int | None, now_s: float) -> NodeLoad:
    """Return the load from now on: one step at a time, down after LOWER_AFTER_S, up after RAISE_AFTER_S of calm.

    Each step has a temperature and bits of the firmware that ask for it. None: not known, asks for nothing.
    """
    index = LEVELS.index(load.level)
    bits, degc = throttled_bits or 0, -273.0 if temperature_degc is None else temperature_degc
    if index < len(STEPS_DEGC) and (bits & STEPS_BITS[index] or degc >= STEPS_DEGC[index]):
        if now_s - load.since_s < LOWER_AFTER_S:
            return NodeLoad(load.level, load.since_s)
        return NodeLoad(LEVELS[index + 1], now_s)
    if index == 0 or bits & STEPS_BITS[index - 1] or degc > STEPS_DEGC[index - 1] - BACK_DEGC:
        return NodeLoad(load.level, load.since_s)
    calm_s = now_s if load.calm_s is None else load.calm_s
    if now_s - calm_s >= RAISE_AFTER_S:
        return NodeLoad(LEVELS[index - 1], now_s)
    return NodeLoad(load.level, load.since_s, calm_s)
