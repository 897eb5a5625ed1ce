"""The panel's tables as node/README.md prints them, and what the state machine makes of a diver's hand."""

import itertools
import math

import pytest
from buddyline.node.underwater.codes import (
    BEEPS,
    CODES,
    FAULT_BEEP,
    HOLDS,
    LEAK_BEEP,
    VERDICT_BEEPS,
    PanelAction,
    Pattern,
    Situation,
    code_of,
    hold_at,
)
from buddyline.node.underwater.machine import PanelInput, PanelState, step
from buddyline.protocol.clock import MS_NS, S_NS

from tests.processes import REPOSITORY

TURN_NS = 20 * MS_NS


def rows(head):
    """The rows of the table in node/README.md that begins with this head."""
    lines = (REPOSITORY / "node/README.md").read_text().splitlines()
    first = lines.index(head) + 2
    last = next(i for i in range(first, len(lines)) if not lines[i].startswith("|"))
    return [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines[first:last]]


def test_the_readmes_table_of_the_button_is_the_codes():
    def words(hold):
        span = f"{hold.from_s:g} to {hold.to_s:g} s" if math.isfinite(hold.to_s) else f"{hold.from_s:g} s and longer"
        actions = dict.fromkeys(action for action in (hold.started, hold.stopped) if action)
        return span, hold.lamp.words if hold.lamp else "as without", "; or ".join(a.value for a in actions) or "nothing"

    assert rows("| held for | the lamp meanwhile | when let go |") == [words(hold) for hold in HOLDS]


def test_the_readmes_table_of_the_lamp_is_the_codes():
    assert rows("| the lamp | the node |") == [(code.lamp.words, code.words) for code in CODES]


def test_the_readmes_table_of_the_buzzer_is_the_codes():
    said = [(pattern.words, action.value) for action, pattern in BEEPS.items()]
    said += [(pattern.words, verdict.value) for verdict, pattern in VERDICT_BEEPS.items()]
    said += [(FAULT_BEEP.words, "a fault begins"), (LEAK_BEEP.words, "water in the housing")]
    assert rows("| the buzzer | when |") == said


def test_every_hold_has_one_row_and_every_situation_a_code():
    for before, after in itertools.pairwise(HOLDS):
        assert before.to_s == after.from_s
    assert (HOLDS[0].from_s, HOLDS[-1].to_s) == (0.0, math.inf)
    assert hold_at(2.0) is HOLDS[1]
    assert code_of(Situation()) is CODES[-1]


@pytest.mark.parametrize("first", range(len(CODES)))
def test_codes_of_different_urgency_look_different(first):
    # A leak and another fault look alike: both end the dive, and the buzzer and the status tell them apart.
    alike = [code.words for code in CODES if code.lamp.words == CODES[first].lamp.words]
    assert len(alike) == (2 if "flickering" in CODES[first].lamp.words else 1)


def test_a_pattern_is_on_and_off_as_it_says():
    twice = Pattern("", (0.1, 0.2, 0.1, 0.6))
    shown = [twice.is_on(t / 100 + 0.005) for t in range(200)]
    assert shown == ([True] * 10 + [False] * 20 + [True] * 10 + [False] * 60) * 2
    once = Pattern("", (0.1,), once=True)
    assert (once.is_on(0.05), once.is_on(0.15), once.is_over(0.05), once.is_over(0.1)) == (True, False, False, True)


class PanelDiver:
    """Presses the button of a state machine, with time passing in turns."""

    def __init__(self):
        self.state, self.now_ns, self.actions = PanelState(), S_NS, []
        self.given = {}
        self.wait(0.1)

    def wait(self, seconds, pressed=False):
        for _ in range(round(seconds * S_NS / TURN_NS)):
            self.now_ns += TURN_NS
            self.state, action = step(self.state, PanelInput(pressed=pressed, **self.given), self.now_ns)
            self.actions += [action] if action else []

    def press(self, seconds):
        self.wait(seconds, pressed=True)
        self.wait(0.2)
        said, self.actions = self.actions, []
        return said


@pytest.mark.parametrize(
    ("held_s", "action"),
    [(0.02, None), (0.1, PanelAction.MARK), (1.9, PanelAction.MARK), (2.1, PanelAction.STOP), (7.9, PanelAction.STOP),
     (8.1, PanelAction.SHUT_DOWN), (19.9, PanelAction.SHUT_DOWN), (20.1, None), (300.0, None)],
)  # fmt: skip
def test_the_length_of_a_hold_says_what_it_means(held_s, action):
    assert PanelDiver().press(held_s) == ([action] if action else [])


def test_stop_and_start_take_turns_and_switch_the_lights():
    diver = PanelDiver()
    assert diver.state.lights
    assert diver.press(3.0) == [PanelAction.STOP]
    assert not diver.state.lights
    assert diver.press(3.0) == [PanelAction.START]
    assert diver.state.lights
    diver.press(9.0)
    assert not diver.state.lights


def test_a_contact_that_bounces_is_one_press():
    diver = PanelDiver()
    for _ in range(3):
        diver.wait(0.02, pressed=True)
        diver.wait(0.02)
    diver.wait(3.0, pressed=True)
    for _ in range(3):
        diver.wait(0.02)
        diver.wait(0.02, pressed=True)
    assert diver.press(0.0) == [PanelAction.STOP]


def test_a_magnet_that_is_there_at_the_start_does_nothing_until_it_has_been_away():
    diver = PanelDiver.__new__(PanelDiver)
    diver.state, diver.now_ns, diver.actions, diver.given = PanelState(), S_NS, [], {}
    assert diver.press(9.0) == []
    assert diver.press(0.5) == [PanelAction.MARK]


def test_the_lamp_counts_along_while_the_button_is_held():
    diver = PanelDiver()
    for seconds, hold in ((1.0, HOLDS[0]), (3.0, HOLDS[1]), (8.0, HOLDS[2])):
        diver.wait(seconds, pressed=True)
        assert diver.state.lamp == hold.lamp
    diver.wait(10.0, pressed=True)
    assert diver.state.lamp == CODES[-1].lamp


@pytest.mark.parametrize(
    ("given", "words"),
    [({}, "records"), ({"sees_other": True}, "sees the other"), ({"timeless": True, "sees_other": True}, "time"),
     ({"booting": True, "timeless": True}, "boots"), ({"fault": True, "booting": True}, "fault"),
     ({"leak": True, "fault": True}, "water")],
)  # fmt: skip
def test_the_lamp_tells_the_most_urgent_first(given, words):
    situation = Situation(**given)
    assert words in code_of(situation).words
    diver = PanelDiver()
    diver.given = given
    diver.wait(0.1)
    assert diver.state.lamp == code_of(situation).lamp


def test_the_buzzer_answers_the_button_names_a_new_fault_once_and_a_leak_until_it_is_dry():
    diver = PanelDiver()
    diver.given = {"fault": True}
    diver.wait(0.1)
    assert diver.state.sound == FAULT_BEEP
    diver.wait(2.0)
    assert diver.state.sound is None
    diver.wait(0.5, pressed=True)
    diver.wait(0.1)
    assert diver.state.sound == BEEPS[PanelAction.MARK]
    diver.given = {"leak": True}
    diver.wait(10.0)
    assert diver.state.sound == LEAK_BEEP
    assert {diver.state.is_buzzer_on(diver.now_ns + i * S_NS // 4) for i in range(4)} == {True, False}
    diver.given = {}
    diver.wait(0.1)
    assert diver.state.sound is None
