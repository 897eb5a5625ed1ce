"""A node's lamp that blinks by a code, over gpiozero's mock pins."""

import threading

import pytest
from buddyline.node.blinker import Blinker
from buddyline.node.config import BlinkConfig, NodeConfig, load_node_config
from buddyline.protocol.blinking import DARK_SLOTS, PERIOD, lit
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.config import ConfigError
from buddyline.protocol.messages import Blink
from msgspec import UNSET

PIN = 23
SLOT_NS = S_NS // 10


@pytest.fixture
def factory():
    mock = pytest.importorskip("gpiozero.pins.mock", reason="gpiozero is not installed")
    return mock.MockFactory()


class Watched(ManualClock):
    """Notes the lamp in each slot, and ends after so many."""

    def __init__(self, factory, slots):
        super().__init__(1_764_000_000 * S_NS)
        self.factory, self.slots, self.seen = factory, slots, []

    def wait_until_ns(self, instant_ns, stop):
        self.seen.append((self.now_ns(), bool(self.factory.pin(PIN).state)))
        if len(self.seen) == self.slots:
            stop.set()
        return super().wait_until_ns(instant_ns, stop)


def test_the_lamp_is_dark_in_its_slots_only(factory):
    clock = Watched(factory, 2 * PERIOD)
    blinker = Blinker(BlinkConfig(code=4, pin=PIN), SLOT_NS, clock, lambda: True, factory)
    blinker.run(threading.Event())
    blink = Blink(code=4, lamp="left", slot_ns=SLOT_NS)
    assert [on for _, on in clock.seen] == [lit(blink, now_ns)[0] for now_ns, _ in clock.seen]
    assert sum(not on for _, on in clock.seen) == 2 * len(DARK_SLOTS[4])
    assert blinker.problem == ""
    blinker.close()
    assert not factory.pin(PIN).state


def test_the_lamp_stays_dark_while_the_diver_wants_no_light(factory):
    clock = Watched(factory, PERIOD)
    Blinker(BlinkConfig(code=0, pin=PIN), SLOT_NS, clock, lambda: False, factory).run(threading.Event())
    assert not any(on for _, on in clock.seen)


def test_the_code_goes_into_node_info(tmp_path):
    from tests.fuzz.samples import SOUND

    info = SOUND[0]
    config = NodeConfig(node="a", rate_hz=20.0, blink=BlinkConfig(code=3, lamp="both", pin=PIN))
    assert config.in_net(info).blink == Blink(code=3, lamp="both", slot_ns=S_NS // 20)
    assert NodeConfig(node="a").in_net(info).blink == info.blink
    assert NodeConfig(node="a").blink is None
    assert info.blink is not UNSET


@pytest.mark.parametrize(
    ("toml", "error"),
    [
        (
            f"[panel]\nlights_pin = {PIN}\n[blink]\ncode = 1\npin = {PIN}",
            r"blink\.pin = 23: this pin is in use",
        ),
        (f"[blink]\ncode = 10\npin = {PIN}", "blink.code"),
        ("[blink]\ncode = 1", "blink"),
    ],
)
def test_a_wrong_table_is_refused(tmp_path, toml, error):
    path = tmp_path / "a.toml"
    path.write_text(f"node = 'a'\n{toml}\n")
    with pytest.raises(ConfigError, match=error):
        load_node_config(path)
