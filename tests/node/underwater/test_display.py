"""The panel's display over luma's own stand-in for a device."""

import sys

import numpy as np
import pytest
from buddyline.node.config import NodeConfig, PanelConfig
from buddyline.node.underwater.codes import CODES
from buddyline.node.underwater.display import CHARACTERS, LINES, Display
from buddyline.node.underwater.panel import Panel
from buddyline.protocol.clock import S_NS, ManualClock
from msgspec.structs import replace

from tests.node.underwater.test_panel import status

luma = pytest.importorskip("luma.core.device", reason="luma.oled is not installed: make install EXTRAS=display")
CONFIG = PanelConfig(display="ssd1306")


class Screen(luma.dummy):
    """Luma's stand-in; broken: what it raises in place of showing."""

    def __init__(self):
        super().__init__(width=128, height=64, mode="1")
        self.broken = None
        self.pictures = 0

    def display(self, image):
        if self.broken is not None:
            raise self.broken
        self.pictures += 1
        super().display(image)

    @property
    def last_column(self):
        return np.asarray(self.image)[:, -1]

    @property
    def points(self):
        return np.count_nonzero(np.asarray(self.image))


def test_a_text_is_drawn_once_and_again_when_it_changes():
    screen = Screen()
    display = Display(CONFIG, 1, lambda *_: screen)
    for turn in range(3):
        display.show(["records", "11.8 V"])
        display.turn(float(turn))
    assert screen.pictures == 1
    some = screen.points
    assert some > 50
    display.show(["records", "11.8 V", "depth: nothing for 3.1 s"])
    display.turn(3.0)
    assert screen.points > some
    assert display.problem == ""


@pytest.mark.parametrize("code", CODES, ids=lambda code: code.words[:12])
def test_each_code_s_words_fit(code):
    screen = Screen()
    display = Display(CONFIG, 1, lambda *_: screen)
    display.show([code.words])
    display.turn(0.0)
    assert not screen.last_column.any()  # no line is cut
    assert len(code.words) <= CHARACTERS * LINES


def test_a_display_that_fails_is_named_and_opened_again():
    screen, opened = Screen(), []

    def opens(_config, bus):
        opened.append(bus)
        return screen

    display = Display(CONFIG, 1, opens)
    screen.broken = OSError(121, "Remote I/O error")
    display.show(["records"])
    display.turn(0.0)
    assert "ssd1306" in display.problem
    assert "Remote I/O error" in display.problem
    display.turn(1.0)
    assert opened == [1]
    screen.broken = None
    display.turn(2.5)
    assert opened == [1, 1]
    assert display.problem == ""
    assert screen.pictures == 1


def test_a_machine_without_luma_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "luma.oled", None)
    display = Display(CONFIG, 1)
    display.show(["boots"])
    display.turn(0.0)
    assert "make install EXTRAS=display" in display.problem


def test_a_panel_of_a_display_alone_shows_the_code_the_figures_and_the_problems():
    screen = Screen()
    display = Display(CONFIG, 1, lambda *_: screen)
    panel = Panel(NodeConfig(node="a", panel=CONFIG), ManualClock(7), list().append, display=display)
    panel.turn(S_NS)
    assert display.lines == ["boots"]
    now = replace(status(lights_seen=2), battery_v=11.81, temperature_degc=54.2)
    panel.show(now, [])
    panel.turn(2 * S_NS)
    assert display.lines == ["records, and sees the", "other node's lights", "11.8 V 54 C"]
    panel.show(now, ["depth: nothing for 3.1 s"])
    panel.turn(3 * S_NS)
    assert display.lines[0] == "fault: the status"
    assert "depth: nothing for" in display.lines
    display.turn(0.0)
    assert screen.points > 100
