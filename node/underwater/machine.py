"""The panel's state machine: button and status in, actions, lamp, sound and lights out. Pure; the tables: codes.py."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

from buddyline.node.underwater.codes import (
    BEEPS,
    FAULT_BEEP,
    LEAK_BEEP,
    STEADY,
    VERDICT_BEEPS,
    PanelAction,
    Pattern,
    Situation,
    Verdict,
    code_of,
    hold_at,
)
from buddyline.protocol.clock import MS_NS, S_NS

# A contact bounces for some milliseconds; no diver holds a magnet for less than this.
STEADY_NS: Final = 40 * MS_NS


@dataclass(frozen=True, slots=True)
class PanelInput:
    """pressed: the button now; None without one. verdict_ns: since when it is shown. The rest: see Situation."""

    pressed: bool | None = None
    leak: bool = False
    fault: bool = False
    booting: bool = False
    timeless: bool = False
    sees_other: bool = False
    verdict: Verdict | None = None
    verdict_ns: int = 0


@dataclass(frozen=True, slots=True)
class Contact:
    """A debounced button. pressed_ns: since when it is held; None: it is not.

    released: it has been open once; a button that is closed from the start on does nothing until then.
    """

    released: bool = False
    pressed_ns: int | None = None
    differs_ns: int | None = None

    @property
    def pressed(self) -> bool:
        """Whether it is held."""
        return self.pressed_ns is not None

    def step(self, pressed: bool, now_ns: int) -> Contact:
        """Take a reading; a change counts once it has lasted for STEADY_NS, and from its begin on."""
        if not self.released:
            return self if pressed else Contact(released=True)
        if pressed == self.pressed:
            return replace(self, differs_ns=None)
        if self.differs_ns is None:
            return replace(self, differs_ns=now_ns)
        if now_ns - self.differs_ns < STEADY_NS:
            return self
        return Contact(released=True, pressed_ns=self.differs_ns if pressed else None)


@dataclass(frozen=True, slots=True)
class PanelState:
    """started: lights and pictures are on. ending: the diver has asked to shut down. words: the lamp's
    code. *_ns: begin of lamp and sound.
    """

    started: bool = True
    ending: bool = False
    fault: bool = False
    verdict: Verdict | None = None
    verdict_ns: int = 0
    contact: Contact = field(default_factory=Contact)
    words: str = ""
    lamp: Pattern = STEADY
    lamp_ns: int = 0
    sound: Pattern | None = None
    sound_ns: int = 0

    @property
    def lights(self) -> bool:
        """Whether the dive lights are to be on."""
        return self.started and not self.ending

    def is_lamp_on(self, now_ns: int) -> bool:
        """Return whether the status lamp is to be on."""
        return self.lamp.is_on((now_ns - self.lamp_ns) / S_NS)

    def is_buzzer_on(self, now_ns: int) -> bool:
        """Return whether the buzzer is to sound."""
        return self.sound is not None and self.sound.is_on((now_ns - self.sound_ns) / S_NS)


def step(state: PanelState, given: PanelInput, now_ns: int) -> tuple[PanelState, PanelAction | None]:
    """Take a reading of the button and the node's health; return the next state, and what the diver asks for.

    now_ns: of a clock that is never set. The time between two calls is well below STEADY_NS.
    """
    contact = state.contact if given.pressed is None else state.contact.step(given.pressed, now_ns)
    action = None
    if state.contact.pressed_ns is not None and not contact.pressed:
        # Until the contact opened, which is a little earlier than now.
        held_s = ((state.contact.differs_ns or now_ns) - state.contact.pressed_ns) / S_NS
        hold = hold_at(held_s)
        action = hold.started if state.started else hold.stopped
    started, ending = state.started, state.ending
    if action in (PanelAction.START, PanelAction.STOP):
        started = action is PanelAction.START
    ending = ending or action is PanelAction.SHUT_DOWN
    situation = Situation(
        leak=given.leak,
        ending=ending,
        fault=given.fault,
        booting=given.booting,
        timeless=given.timeless,
        started=started,
        sees_other=given.sees_other,
        verdict=given.verdict,
    )
    code = code_of(situation)
    lamp = code.lamp
    if contact.pressed_ns is not None:
        lamp = hold_at((now_ns - contact.pressed_ns) / S_NS).lamp or lamp
    sound, sound_ns = _sound(state, given, action, now_ns)
    return (
        PanelState(
            started=started,
            ending=ending,
            fault=given.fault,
            verdict=given.verdict,
            verdict_ns=given.verdict_ns,
            contact=contact,
            words=code.words,
            lamp=lamp,
            lamp_ns=state.lamp_ns if lamp == state.lamp else now_ns,
            sound=sound,
            sound_ns=sound_ns,
        ),
        action,
    )


def _sound(state: PanelState, given: PanelInput, action: PanelAction | None, now_ns: int) -> tuple[Pattern | None, int]:
    """Return what sounds, and since when: the leak comes before the button's answer, a new fault, a new verdict."""
    if given.leak:
        return LEAK_BEEP, state.sound_ns if state.sound == LEAK_BEEP else now_ns
    if action is not None:
        return BEEPS[action], now_ns
    if given.fault and not state.fault:
        return FAULT_BEEP, now_ns
    if given.verdict is not None and (given.verdict is not state.verdict or given.verdict_ns != state.verdict_ns):
        return VERDICT_BEEPS[given.verdict], now_ns
    if state.sound is None or not state.sound.once or state.sound.is_over((now_ns - state.sound_ns) / S_NS):
        return None, now_ns
    return state.sound, state.sound_ns
