"""A camera that shows rendered pictures again and again, and sensors to go with them: the rest of the node is real.

To render each picture, and to simulate each sample, takes longer than all that is looked at here.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from buddyline.node.capture.exposure import Exposure
from buddyline.node.config import NodeConfig
from buddyline.node.sim.devices import DEPTH_HZ, IMU_HZ, SimulatedCamera, SimulatedSensor, scenario_of
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS, Clock
from buddyline.protocol.messages import Message
from msgspec.structs import replace
from numpy.typing import NDArray

ATTITUDE_HZ = 100
PICTURES = 30
# The dive is played forward for this time, and then backward.
STRETCH_NS = 1 * S_NS


def instant_shown(config: NodeConfig, stamp_ns: int) -> int:
    """Return the instant of the simulated dive that is seen at stamp_ns, ns."""
    return config.simulation.start_ns + abs(stamp_ns % (2 * STRETCH_NS) - STRETCH_NS)


class RenderedBefore(World):
    """A world whose pictures are rendered once."""

    def __init__(self, config: NodeConfig) -> None:
        super().__init__(scenario_of(config))
        self._config = config
        start_ns, step_ns = config.simulation.start_ns, STRETCH_NS // PICTURES
        render = super().render
        self._pictures = [render(config.node, start_ns + i * step_ns) for i in range(PICTURES + 1)]

    def render(self, node: str, stamp_ns: int, exposure: Exposure | None = None) -> NDArray[np.uint8]:
        """Return the picture rendered before, which has the scene's exposure."""
        shown_ns = instant_shown(self._config, stamp_ns) - self._config.simulation.start_ns
        return self._pictures[round(shown_ns * PICTURES / STRETCH_NS)].copy()


class RepeatingCamera(SimulatedCamera):
    def __init__(self, config: NodeConfig, clock: Clock) -> None:
        super().__init__(config, clock)
        self._world = RenderedBefore(config)
        self.exposure_control = None  # its pictures are exposed already


def open_camera(config: NodeConfig, clock: Clock) -> RepeatingCamera:
    return RepeatingCamera(config, clock)


def open_sensors(config: NodeConfig, clock: Clock) -> list[SimulatedSensor]:
    world = World(scenario_of(config))
    start_ns = config.simulation.start_ns

    def sensor(name: str, rate_hz: int, sample: Callable[[str, int], Message]) -> SimulatedSensor:
        step_ns = S_NS // rate_hz
        taken = [sample(config.node, start_ns + i * step_ns) for i in range(STRETCH_NS // step_ns + 1)]

        def at(stamp_ns: int) -> Message:
            shown_ns = instant_shown(config, stamp_ns) - start_ns
            return replace(taken[round(shown_ns / step_ns)], stamp_ns=stamp_ns)

        return SimulatedSensor(name, rate_hz, at, clock)

    return [
        sensor("attitude", ATTITUDE_HZ, world.attitude),
        sensor("depth", DEPTH_HZ, world.depth),
        sensor("imu", IMU_HZ, world.imu),
    ]
