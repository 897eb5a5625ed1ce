"""The panel's tables: what the button means, what the lamp shows, when the buzzer sounds; node/README.md has them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final


class PanelAction(Enum):
    """What the diver asks for with the button."""

    MARK = "mark a point"
    START = "start: lights and pictures on"
    STOP = "stop: lights and pictures off"
    SHUT_DOWN = "shut down"


@dataclass(frozen=True, slots=True)
class Pattern:
    """A pattern of light or sound. steps_s: on, off, on, off ...; repeated unless once."""

    words: str
    steps_s: tuple[float, ...]
    once: bool = False

    def is_on(self, since_s: float) -> bool:
        """Return whether it is on, since_s after its begin."""
        if not self.once:
            since_s %= sum(self.steps_s)
        for i, step_s in enumerate(self.steps_s):
            if since_s < step_s:
                return i % 2 == 0
            since_s -= step_s
        return False

    def is_over(self, since_s: float) -> bool:
        """Return whether a pattern that is not repeated has ended."""
        return self.once and since_s >= sum(self.steps_s)


DARK: Final = Pattern("dark", (0.0, 1.0))
STEADY: Final = Pattern("steady", (1.0,))
ONE_FLASH: Final = Pattern("one flash every 3 s", (0.15, 2.85))
TWO_FLASHES: Final = Pattern("two flashes every 3 s", (0.15, 0.25, 0.15, 2.45))
THREE_FLASHES: Final = Pattern("three flashes every 3 s", (0.15, 0.25, 0.15, 0.25, 0.15, 2.05))
SLOW: Final = Pattern("1 s on, 1 s off", (1.0, 1.0))
BLINKING: Final = Pattern("blinking, twice a second", (0.25, 0.25))
FLICKERING: Final = Pattern("flickering, five times a second", (0.1, 0.1))
TWO_GAPS: Final = Pattern("two short gaps every 2 s", (1.4, 0.2, 0.2, 0.2))
WINKING: Final = Pattern("on, with a short gap every second", (0.9, 0.1))

LONG: Final = Pattern("2 s on, half a second off", (2.0, 0.5))

ONE_BEEP: Final = Pattern("1 short", (0.1,), once=True)
TWO_BEEPS: Final = Pattern("2 short", (0.1, 0.15, 0.1), once=True)
THREE_BEEPS: Final = Pattern("3 short", (0.1, 0.15, 0.1, 0.15, 0.1), once=True)
FOUR_BEEPS: Final = Pattern("4 short", (0.1, 0.15) * 3 + (0.1,), once=True)
LONG_AND_SHORT: Final = Pattern("1 long, 1 short", (1.0, 0.15, 0.1), once=True)
FIVE_BEEPS: Final = Pattern("5 short", (0.1, 0.15) * 4 + (0.1,), once=True)
SHORT_AND_LONG: Final = Pattern("1 short, 1 long", (0.1, 0.15, 1.0), once=True)
LONG_BEEP: Final = Pattern("1 long", (1.0,), once=True)
ALARM: Final = Pattern("on and off, until it is dry", (0.5, 0.5))


@dataclass(frozen=True, slots=True)
class Hold:
    """What a hold of the button means if it ends from from_s to to_s. lamp: meanwhile; None: as without a hold."""

    from_s: float
    to_s: float
    lamp: Pattern | None
    started: PanelAction | None
    stopped: PanelAction | None


# The last row: a magnet that has stuck to the housing does nothing, whenever it falls off.
HOLDS: Final = (
    Hold(0.0, 2.0, STEADY, PanelAction.MARK, PanelAction.MARK),
    Hold(2.0, 8.0, BLINKING, PanelAction.STOP, PanelAction.START),
    Hold(8.0, 20.0, DARK, PanelAction.SHUT_DOWN, PanelAction.SHUT_DOWN),
    Hold(20.0, math.inf, None, None, None),
)


class Verdict(Enum):
    """What the survey says of the leg that the node has just measured."""

    GOOD = "the leg is good: go on"
    AGAIN = "measure the leg again"
    EARLIER = "measure an earlier leg again: the monitor names it"


@dataclass(frozen=True, slots=True)
class Situation:
    """What decides the lamp: the node's own status, the survey's verdict, and what the diver has asked for."""

    leak: bool = False
    ending: bool = False
    fault: bool = False
    booting: bool = False
    timeless: bool = False
    started: bool = True
    sees_other: bool = False
    verdict: Verdict | None = None


@dataclass(frozen=True, slots=True)
class LampCode:
    """One code of the lamp."""

    words: str
    applies: Callable[[Situation], bool]
    lamp: Pattern


# The first that applies is shown.
CODES: Final = (
    LampCode("shuts down: wait until it is dark", lambda s: s.ending, WINKING),
    LampCode("water in the housing", lambda s: s.leak, FLICKERING),
    LampCode("fault: the status names it", lambda s: s.fault, FLICKERING),
    LampCode("boots", lambda s: s.booting, STEADY),
    LampCode("waits for time: the clock cannot be trusted", lambda s: s.timeless, SLOW),
    LampCode(
        "stopped: no lights, no pictures; sensors and candidates are recorded", lambda s: not s.started, THREE_FLASHES
    ),
    LampCode(f"survey, for 10 s: {Verdict.AGAIN.value}", lambda s: s.verdict is Verdict.AGAIN, BLINKING),
    LampCode(f"survey, for 10 s: {Verdict.EARLIER.value}", lambda s: s.verdict is Verdict.EARLIER, TWO_GAPS),
    LampCode(f"survey, for 10 s: {Verdict.GOOD.value}", lambda s: s.verdict is Verdict.GOOD, LONG),
    LampCode("records, and sees the other node's lights", lambda s: s.sees_other, TWO_FLASHES),
    LampCode("records", lambda _: True, ONE_FLASH),
)

BEEPS: Final[dict[PanelAction, Pattern]] = {
    PanelAction.MARK: ONE_BEEP,
    PanelAction.START: TWO_BEEPS,
    PanelAction.STOP: THREE_BEEPS,
    PanelAction.SHUT_DOWN: LONG_BEEP,
}
VERDICT_BEEPS: Final[dict[Verdict, Pattern]] = {
    Verdict.GOOD: SHORT_AND_LONG,
    Verdict.AGAIN: FOUR_BEEPS,
    Verdict.EARLIER: LONG_AND_SHORT,
}
FAULT_BEEP: Final = FIVE_BEEPS
LEAK_BEEP: Final = ALARM


def hold_at(held_s: float) -> Hold:
    """Return the row of HOLDS for a hold of this length."""
    return next(hold for hold in HOLDS if hold.from_s <= held_s < hold.to_s)


def code_of(situation: Situation) -> LampCode:
    """Return the first row of CODES that applies."""
    return next(code for code in CODES if code.applies(situation))
