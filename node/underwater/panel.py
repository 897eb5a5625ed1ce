"""The panel of a running node: reads the button, drives lamp, buzzer and dive lights, and does what the diver asks."""

from __future__ import annotations

import logging
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from buddyline.node.config import NodeConfig
from buddyline.node.underwater.codes import PanelAction, Verdict
from buddyline.node.underwater.display import Display
from buddyline.node.underwater.machine import PanelInput, PanelState, step
from buddyline.node.underwater.pins import PanelPins
from buddyline.protocol.clock import S_NS, Clock
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.messages import Mark, Message, NodeStatus
from buddyline.protocol.topics import CANDIDATES
from msgspec import UNSET

if TYPE_CHECKING:
    from buddyline.protocol.bus import Received

log = logging.getLogger(__name__)

PERIOD_S: Final = 0.02
# The status comes once a second. Without it the node is stuck, and the lamp must not tell that all is well.
STATUS_WITHIN_NS: Final = 5 * S_NS
COMMAND_WITHIN_S: Final = 10.0
VERDICT_NS: Final = 10 * S_NS
# So long while another verdict waits; so many may wait.
HURRIED_NS: Final = 4 * S_NS
VERDICTS: Final = 4
# A node has two lights.
LIGHTS: Final = 2


class Panel:
    """Runs in a thread of its own; without any pin or display in [panel] it does nothing.

    send: takes the diver's marks. pins: gpiozero's by default. display: luma's by default; drawn in another thread.
    """

    def __init__(
        self,
        config: NodeConfig,
        clock: Clock,
        send: Callable[[Message], None],
        pins: PanelPins | None = None,
        display: Display | None = None,
    ) -> None:
        self._node = config.node
        self._config = config.panel
        self._clock = clock
        self._send = send
        self._pins = pins or PanelPins(config.panel)
        has_display = config.panel.display != "none"
        self.display = display or (Display(config.panel, config.sensors.i2c_bus) if has_display else None)
        self._told: list[str] = []
        self._state = PanelState()
        self._view = PanelInput(booting=True)
        self._leak = False
        self._has_news = False
        self._news_ns: int | None = None
        self._refused = ""
        self._refusals = Refusals(f"node {config.node}")
        # The survey's verdicts, each on a rest: from the bus's thread; the last one; the one shown, and since when.
        self._heard: deque[Verdict] = deque(maxlen=VERDICTS)
        self._last_heard: tuple[Verdict, object] | None = None
        self._verdict: Verdict | None = None
        self._verdict_ns = 0

    @property
    def takes_pictures(self) -> bool:
        """Whether pictures are to be recorded and shown: the diver has not stopped them."""
        return self._state.started

    @property
    def shines(self) -> bool:
        """Whether the dive lights are to be on."""
        return self._state.lights

    @property
    def leak(self) -> bool | None:
        """Whether water is in the housing; None without a probe."""
        return None if self._pins.leak is None else self._leak

    @property
    def problems(self) -> list[str]:
        """What is wrong, in words."""
        found = ["LEAK: water in the housing"] if self._leak else []
        found += [f"panel: {pin.name}: {pin.problem}" for pin in self._pins.all if pin.problem]
        if self.display is not None and self.display.problem:
            found.append(f"panel: display: {self.display.problem}")
        return found + ([f"panel: {self._refused}"] if self._refused else [])

    def show(self, status: NodeStatus, problems: list[str]) -> None:
        """Take the node's newest status, and its problems one by one."""
        timeless = [text for text in problems if text.startswith("clock:")]
        fault = len(problems) > len(timeless)
        self._view = PanelInput(
            fault=fault,
            booting=self._view.booting and not fault and not status.rates_hz.get(CANDIDATES.name),
            timeless=bool(timeless),
            sees_other=status.lights_seen is not UNSET and status.lights_seen >= LIGHTS,
        )
        figures = [
            text.format(value)
            for value, text in ((status.battery_v, "{:.1f} V"), (status.temperature_degc, "{:.0f} C"))
            if value is not UNSET
        ]
        self._told = [" ".join(figures), *problems]
        self._has_news = True

    def hear(self, received: Received) -> None:
        """Take a mark of this node from the bus: the survey's verdict on the leg."""
        envelope = self._refusals.open(received)
        mark = None if envelope is None else envelope.message
        if not isinstance(mark, Mark) or mark.kind not in ("alarm", "leg"):
            return
        verdict = Verdict.GOOD if mark.kind == "leg" else Verdict.EARLIER if mark.earlier else Verdict.AGAIN
        # A rest with two alarms is one verdict; the same verdict on another rest is another one.
        rest = mark.stamp_ns if mark.leg_ns is UNSET else mark.leg_ns
        if self._last_heard != (verdict, rest):
            self._last_heard = verdict, rest
            self._heard.append(verdict)

    def run(self, stop: threading.Event) -> None:
        """Read and drive the pins until stop is set."""
        if not self._pins.all and self.display is None:
            return
        while not stop.wait(PERIOD_S):
            self.turn(time.monotonic_ns())

    def turn(self, now_ns: int) -> None:
        """Read the inputs, take one step, drive the outputs. now_ns: of the monotonic clock."""
        pins, view = self._pins, self._view
        wet = None if pins.leak is None else pins.leak.read()
        # A probe that cannot be read keeps its last state; the failure is a problem of its own.
        self._leak = self._leak if wet is None else wet
        if self._has_news:
            self._has_news, self._news_ns = False, now_ns
        shown_ns = now_ns - self._verdict_ns
        if self._heard and (self._verdict is None or shown_ns >= HURRIED_NS):
            self._verdict, self._verdict_ns = self._heard.popleft(), now_ns
        elif shown_ns >= VERDICT_NS:
            self._verdict = None
        silent = self._news_ns is not None and now_ns - self._news_ns > STATUS_WITHIN_NS
        given = replace(
            view,
            pressed=None if pins.button is None else pins.button.read(),
            leak=self._leak,
            fault=view.fault or silent,
            verdict=self._verdict,
            verdict_ns=self._verdict_ns,
        )
        self._state, action = step(self._state, given, now_ns)
        for pin, on in (
            (pins.lamp, self._state.is_lamp_on(now_ns)),
            (pins.buzzer, self._state.is_buzzer_on(now_ns)),
            (pins.lights, self._state.lights),
        ):
            if pin is not None:
                pin.write(on)
        if self.display is not None:
            self.display.show([self._state.words, *self._told])
        if action is not None:
            self._do(action)

    def _do(self, action: PanelAction) -> None:
        log.info("panel: %s", action.value)
        self._refused = ""
        if action is PanelAction.MARK:
            self._send(Mark(node=self._node, stamp_ns=self._clock.now_ns(), kind="point", note="by the button"))
            return
        self._send(Mark(node=self._node, stamp_ns=self._clock.now_ns(), kind="note", note=f"button: {action.value}"))
        if action is PanelAction.SHUT_DOWN:
            self._refused = self._shut_down()
            if self._refused:
                log.error("panel: %s", self._refused)
                self._state = replace(self._state, ending=False)

    def _shut_down(self) -> str:
        """Run the configured command; return why that failed, "" if it did not. The node's end closes the log."""
        command = self._config.shutdown_command
        if not command:
            return "shut down: panel.shutdown_command is empty"
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, errors="replace", timeout=COMMAND_WITHIN_S, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"shut down: panel.shutdown_command = {command}: {error}"
        if done.returncode == 0:
            return ""
        said = done.stderr.strip().splitlines()[-1:]
        return ": ".join([f"shut down: panel.shutdown_command = {command}: exit status {done.returncode}", *said])

    def close(self) -> None:
        """Free the pins and the display: lamp, dive lights and display go out."""
        self._pins.close()
        if self.display is not None:
            self.display.close()
