"""The panel of a node over gpiozero's mock pins."""

import sys
import threading
from types import SimpleNamespace

import pytest
from buddyline.node.config import CameraConfig, NodeConfig, PanelConfig, PowerConfig, RecordConfig, load_node_config
from buddyline.node.service import NodeService
from buddyline.node.underwater import panel as panel_module
from buddyline.node.underwater import pins as pins_module
from buddyline.node.underwater.codes import VERDICT_BEEPS, PanelAction, Verdict
from buddyline.node.underwater.panel import Panel
from buddyline.node.underwater.pins import PanelPins
from buddyline.protocol.bus import Received
from buddyline.protocol.clock import MS_NS, S_NS, ManualClock
from buddyline.protocol.codec import encode
from buddyline.protocol.config import ConfigError
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.messages import Mark, NodeStatus
from buddyline.protocol.topics import MARK
from msgspec import UNSET
from msgspec.structs import replace

from tests.processes import free_endpoint, until

mock = pytest.importorskip("gpiozero.pins.mock", reason="gpiozero is not installed")

BUTTON, LAMP, BUZZER, LIGHTS, LEAK = 17, 27, 22, 23, 24
ALL = {"button_pin": BUTTON, "lamp_pin": LAMP, "buzzer_pin": BUZZER, "lights_pin": LIGHTS, "leak_pin": LEAK}
TURN_NS = 20 * MS_NS


def status(candidates_hz=10.0, lights_seen=0):
    return NodeStatus(
        node="a",
        stamp_ns=1,
        boot="x",
        software="",
        uptime_s=1.0,
        rates_hz={"candidates": candidates_hz} if candidates_hz else {},
        drops={},
        ages_s={},
        lights_seen=lights_seen,
    )


class PanelRig:
    """A panel, its mock pins, and what it sends."""

    def __init__(self, **table):
        self.factory = mock.MockFactory()
        config = NodeConfig(node="a", panel=PanelConfig(**(table or ALL)))
        self.sent = []
        self.panel = Panel(config, ManualClock(7), self.sent.append, PanelPins(config.panel, self.factory))
        self.now_ns = 0
        self.news = None  # status and problems, which the node shows again and again

    def pin(self, number):
        return self.factory.pin(number)

    def run(self, seconds):
        """Let time pass; return what was on at any turn."""
        shown = set()
        for _ in range(max(round(seconds * S_NS / TURN_NS), 1)):
            self.now_ns += TURN_NS
            if self.news is not None:
                self.panel.show(*self.news)
            self.panel.turn(self.now_ns)
            shown |= {number for number in (LAMP, BUZZER, LIGHTS) if self.pin(number).state}
        return shown

    def press(self, seconds):
        self.pin(BUTTON).drive_low()
        self.run(seconds)
        self.pin(BUTTON).drive_high()
        self.run(0.1)


@pytest.fixture
def rig():
    rig = PanelRig()
    rig.run(0.1)
    yield rig
    rig.panel.close()


def test_the_surveys_verdict_is_shown_for_ten_seconds():
    rig = PanelRig()
    rig.news = (status(), [])
    rig.run(1.0)
    for kind, name, verdict in (("leg", "good", Verdict.GOOD), ("alarm", "sights", Verdict.AGAIN)):
        rig.panel.hear(Received(MARK.key("a"), encode(Mark(node="a", stamp_ns=7, kind=kind, name=name)), 7, ""))
        rig.run(0.1)
        assert rig.panel._state.verdict is verdict
        assert rig.panel._state.sound == VERDICT_BEEPS[verdict]
        rig.run(10.0)
        assert rig.panel._state.verdict is None
    # Two alarms of one leg are one verdict; on the next leg the same verdict sounds again, and an earlier leg's waits.
    beeps = []
    for leg_ns, earlier, after_s in (
        (1, False, 0.1),
        (1, False, 0.1),
        (2, True, 0.1),
        (3, False, 4.0),
        (3, False, 4.0),
    ):
        mark = Mark(node="a", stamp_ns=9, kind="alarm", name="sights", leg_ns=leg_ns, earlier=earlier)
        rig.panel.hear(Received(MARK.key("a"), encode(mark), 7, ""))
        rig.run(after_s)
        beeps.append((rig.panel._state.verdict, rig.panel._state.verdict_ns))
    rig.run(10.0)
    verdicts, begun_ns = zip(*beeps, strict=True)
    assert verdicts == (Verdict.AGAIN,) * 3 + (Verdict.EARLIER, Verdict.AGAIN)
    assert len(set(begun_ns)) == 3
    assert rig.panel._state.verdict is None
    # A mark of a station, the node's own among them, and what is no mark, say nothing of the leg.
    for payload in (encode(Mark(node="a", stamp_ns=7, kind="point")), b"{}"):
        rig.panel.hear(Received(MARK.key("a"), payload, 7, ""))
        rig.run(0.1)
        assert rig.panel._state.verdict is None


def test_a_press_is_a_mark_in_the_contracts_own_kind(rig):
    rig.press(0.5)
    assert rig.sent == [Mark(node="a", stamp_ns=7, kind="point", note="by the button")]
    assert BUZZER in rig.run(0.1)


def test_stop_and_start_switch_the_dive_lights_and_the_pictures_and_are_noted(rig):
    assert rig.pin(LIGHTS).state
    assert rig.panel.takes_pictures
    rig.press(3.0)
    assert not rig.pin(LIGHTS).state
    assert not rig.panel.takes_pictures
    rig.press(3.0)
    assert rig.pin(LIGHTS).state
    assert rig.panel.takes_pictures
    assert [(mark.kind, mark.note) for mark in rig.sent] == [
        ("note", f"button: {action.value}") for action in (PanelAction.STOP, PanelAction.START)
    ]


@pytest.mark.parametrize(
    ("command", "refusal"),
    [([], "shutdown_command is empty"), (["no-such-program"], "No such file"),
     ([sys.executable, "-c", "import sys; sys.exit('not allowed')"], "exit status 1: not allowed")],
)  # fmt: skip
def test_a_shutdown_that_cannot_be_is_said_and_the_dive_goes_on(command, refusal):
    rig = PanelRig(**ALL, shutdown_command=command)
    rig.run(0.1)
    rig.press(9.0)
    assert [problem for problem in rig.panel.problems if refusal in problem]
    assert rig.run(0.1) >= {LIGHTS}
    rig.press(0.5)
    assert rig.panel.problems == []
    rig.panel.close()


def test_a_shutdown_runs_the_command_and_turns_the_lights_off(tmp_path):
    rig = PanelRig(**ALL, shutdown_command=[sys.executable, "-c", f"open({str(tmp_path / 'done')!r}, 'w')"])
    rig.run(0.1)
    rig.press(9.0)
    assert (tmp_path / "done").exists()
    assert not rig.pin(LIGHTS).state
    assert rig.panel.problems == []
    rig.panel.close()


def flashes(rig, seconds=3.0):
    """How often the lamp goes on within a time."""
    count, before = 0, rig.pin(LAMP).state
    for _ in range(round(seconds * S_NS / TURN_NS)):
        rig.run(0.0)
        count += rig.pin(LAMP).state and not before
        before = rig.pin(LAMP).state
    return count


@pytest.mark.parametrize(
    ("shown", "problems", "count"),
    [(status(), [], 1), (status(lights_seen=2), [], 2), (status(), ["clock: not synchronised"], 1.5),
     (status(), ["depth: no answer"], 15), (status(candidates_hz=0.0), [], 0)],
)  # fmt: skip
def test_the_lamp_follows_the_nodes_status(rig, shown, problems, count):
    rig.news = (shown, problems)
    rig.run(0.1)
    assert flashes(rig, 60.0) == pytest.approx(20 * count, abs=1)


def test_a_node_whose_status_stops_shows_a_fault(rig):
    rig.news = (status(), [])
    rig.run(0.1)
    rig.news = None
    assert flashes(rig) == 1
    rig.run(2.0)
    assert flashes(rig) == 15


def test_a_leak_is_named_sounds_and_flickers(rig):
    assert rig.panel.leak is False
    rig.pin(LEAK).drive_high()
    rig.run(0.1)
    assert rig.panel.leak is True
    assert rig.panel.problems == ["LEAK: water in the housing"]
    assert rig.run(1.0) >= {LAMP, BUZZER}


def test_closing_turns_everything_off(rig):
    rig.run(1.0)
    rig.panel.close()
    assert not any(rig.pin(number).state for number in (LAMP, BUZZER, LIGHTS))


def test_a_pin_in_use_is_named_the_others_work_and_it_is_tried_again(monkeypatch):
    monkeypatch.setattr(pins_module, "RETRY_S", 0.0)
    rig = PanelRig()
    from gpiozero import LED

    other = LED(LAMP, pin_factory=rig.factory)
    rig.run(0.1)
    (problem,) = rig.panel.problems
    assert problem.startswith(f"panel: lamp: GPIO {LAMP}: ")
    assert rig.pin(LIGHTS).state
    other.close()
    rig.run(0.1)
    assert rig.panel.problems == []
    rig.panel.close()


class Unsteady:
    """A device that fails at will, also when it is closed."""

    fails = False

    @property
    def value(self):
        if self.fails:
            raise RuntimeError("GPIO busy")
        return 1

    def close(self):
        if self.fails:
            raise RuntimeError("GPIO busy")


def test_a_pin_that_fails_in_mid_dive_is_opened_again(monkeypatch):
    monkeypatch.setattr(pins_module, "RETRY_S", 0.0)
    devices = []

    def opens(number):
        devices.append(Unsteady())
        return devices[-1]

    pin = pins_module.GpioPin("button", BUTTON, opens)
    assert pin.read() is True
    devices[0].fails = True
    assert pin.read() is None
    assert pin.problem == f"GPIO {BUTTON}: GPIO busy"
    assert pin.read() is True
    assert (pin.problem, len(devices)) == ("", 2)


def test_a_machine_without_gpiozero_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gpiozero", None)
    rig = PanelRig()
    rig.run(0.1)
    assert all("needs gpiozero: make install EXTRAS=pi" in problem for problem in rig.panel.problems)
    assert len(rig.panel.problems) == len(ALL)
    rig.panel.close()


def test_a_machine_without_gpio_says_what_it_needs():
    from gpiozero.exc import BadPinFactory

    def opens(number):
        raise BadPinFactory("Unable to load any default pin factory!")

    pin = pins_module.GpioPin("lamp", LAMP, opens)
    pin.write(True)
    assert pin.problem == f"GPIO {LAMP}: cannot be reached: apt install python3-lgpio, and the group gpio"


def test_without_pins_there_is_no_panel_and_all_is_on():
    config = NodeConfig(node="a")
    panel = Panel(config, ManualClock(7), print)
    panel.run(threading.Event())
    assert (panel.takes_pictures, panel.leak, panel.problems) == (True, None, [])
    panel.close()


def test_a_gauges_bus_has_its_pins_too():
    config = NodeConfig(node="a", panel=PanelConfig(lamp_pin=2))
    config.check_pins()
    with pytest.raises(ConfigError, match=r"panel\.lamp_pin = 2: .*I2C"):
        replace(config, power=PowerConfig(battery="ads1115")).check_pins()


@pytest.mark.parametrize(
    ("lines", "said"),
    [("lamp_pin = 40", r"panel\.lamp_pin = 40"),
     ("lamp_pin = 17\nlights_pin = 17", r"panel\.lights_pin = 17: .*panel\.lamp"),
     ("button_pin = 3", r"panel\.button_pin = 3: .*I2C"), ("lamp = 17", "did you mean `lamp_pin`"),
     ("shutdown_command = 'poweroff'", r"panel\.shutdown_command = 'poweroff'")],
)  # fmt: skip
def test_a_panel_that_cannot_be_is_refused_with_file_field_and_value(tmp_path, lines, said):
    path = tmp_path / "a.toml"
    path.write_text(f'node = "a"\n[sensors]\nname = "i2c"\n[panel]\n{lines}\n')
    with pytest.raises(ConfigError, match=f"a.toml: .*{said}"):
        load_node_config(path)


def test_a_whole_node_takes_marks_by_the_button_and_shows_its_status(tmp_path, monkeypatch):
    import gpiozero

    # Each turn of the panel is 20 ms of its time, however long a loaded machine takes for it.
    turns = []
    monkeypatch.setattr(
        panel_module, "time", SimpleNamespace(monotonic_ns=lambda: turns.append(None) or len(turns) * TURN_NS)
    )
    monkeypatch.setattr(gpiozero.Device, "pin_factory", mock.MockFactory())
    config = NodeConfig(
        node="a",
        connect=free_endpoint(),
        camera=CameraConfig(width_px=160, height_px=120),
        record=RecordConfig(directory=str(tmp_path)),
        panel=PanelConfig(**ALL),
    )
    service = NodeService(config)
    service.open()
    try:
        service.start()
        pin = gpiozero.Device.pin_factory.pin
        until(lambda: service.outlet.sent["candidates"] and pin(LIGHTS).function == "output" and pin(LIGHTS).state)
        pin(BUTTON).drive_low()
        pressed = len(turns)
        until(lambda: len(turns) > pressed + 15)
        pin(BUTTON).drive_high()
        until(lambda: service.outlet.sent["mark"])
        until(lambda: service.status_message and service.status_message.lights_seen is not UNSET)
        pin(LEAK).drive_high()
        until(lambda: "LEAK" in service.status_message.problem)
        assert service.status_message.leak is True
    finally:
        assert service.close() == 0
    assert not pin(LIGHTS).state
    with DiveLogReader(service.recorder.path) as reader:
        (mark,) = (record.open().message for record in reader.records(lambda key: key.endswith("/mark")))
    assert mark.kind == "point"
