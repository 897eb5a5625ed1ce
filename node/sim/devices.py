"""A node's camera and sensors, served from the simulated world in real time."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import cast

from buddyline.node.capture.exposure import Exposure
from buddyline.node.config import CameraConfig, NodeConfig
from buddyline.node.devices import Frame
from buddyline.node.sim.scenario import ENVIRONMENTS, Environment, Scenario
from buddyline.node.sim.sensor import DelayedControls
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS, Clock, trigger_index
from buddyline.protocol.config import ConfigError
from buddyline.protocol.messages import Message, NodeInfo

ATTITUDE_HZ = 50
IMU_HZ = 100
DEPTH_HZ = 10


def scenario_of(config: NodeConfig) -> Scenario:
    """Return the scenario that a configuration describes; raise ConfigError for an unknown environment."""
    simulation, camera = config.simulation, config.camera
    if simulation.environment not in ENVIRONMENTS:
        raise ConfigError(f"simulation.environment = {simulation.environment!r}: known are {', '.join(ENVIRONMENTS)}")
    return Scenario(
        environment=cast(Environment, simulation.environment),
        seed=simulation.seed,
        start_ns=simulation.start_ns,
        node_a=simulation.node_a,
        node_b=simulation.node_b,
        more_nodes=tuple(simulation.more_nodes),
        fixed_nodes=tuple(simulation.fixed_nodes),
        blink_slot_ns=config.trigger_period_ns if simulation.blinking else 0,
        width_px=camera.width_px,
        height_px=camera.height_px,
    )


def fixed_exposure(camera: CameraConfig) -> Exposure | None:
    """Return the exposure that a configuration fixes, None where it is to follow the lamps."""
    return None if camera.exposure_us is None else Exposure(camera.exposure_us * 1000, camera.gain)


def next_instant_ns(after_ns: int, period_ns: int) -> int:
    """Return the first multiple of period_ns later than after_ns."""
    return (after_ns // period_ns + 1) * period_ns


def next_after(last_ns: int, now_ns: int, late_ns: int, period_ns: int) -> int:
    """Return the instant after the last one, at most late_ns ago; a clock that was set back is followed at once."""
    return next_instant_ns(max(now_ns - late_ns, min(last_ns, now_ns + period_ns)), period_ns)


class SimulatedCamera:
    """Renders what the node sees at each trigger instant."""

    row_time_ns = 0
    problem = ""

    def __init__(self, config: NodeConfig, clock: Clock) -> None:
        self._fixed = fixed_exposure(config.camera)
        self.exposure_control = None if self._fixed else DelayedControls()
        self._world = World(scenario_of(config))
        self._node = config.node
        self._clock = clock
        self._period_ns = config.trigger_period_ns
        self._info = self._world.info(self._node, clock.now_ns(), self._period_ns)
        self._last_ns = clock.now_ns()
        self.skipped: Counter[str] = Counter()

    def info(self) -> NodeInfo | None:
        """Return the simulated rig."""
        return self._info

    def next_frame(self, stop: threading.Event) -> Frame | None:
        """Wait for the next trigger instant and render it; skip instants that passed since the last call."""
        instant_ns = next_after(self._last_ns, self._clock.now_ns(), self._period_ns // 2, self._period_ns)
        if self._clock.wait_until_ns(instant_ns, stop):
            return None
        self._last_ns = instant_ns
        exposure, context = self._fixed, None
        trigger = trigger_index(instant_ns, self._period_ns)
        if self.exposure_control is not None:
            exposure, context = self.exposure_control.take(trigger)
        picture = self._world.render(self._node, instant_ns, exposure)
        stamp_ns = instant_ns + self._world.stamp_error_ns(self._node, trigger)
        return Frame(picture, stamp_ns, exposure=exposure, context=context)

    def close(self) -> None:
        """Nothing to free."""


class SimulatedSensor:
    """One sensor of the simulated node at a constant rate."""

    read_by = ""
    problem = ""
    retries = 0

    def __init__(self, name: str, rate_hz: int, sample: Callable[[int], Message], clock: Clock) -> None:
        self.name = name
        self._period_ns = S_NS // rate_hz
        self._sample = sample
        self._clock = clock
        self._last_ns = clock.now_ns()

    def next_messages(self, stop: threading.Event) -> list[Message] | None:
        """Wait for the next sample's instant; return the sample, or None if stopped."""
        instant_ns = next_after(self._last_ns, self._clock.now_ns(), S_NS, self._period_ns)
        if self._clock.wait_until_ns(instant_ns, stop):
            return None
        self._last_ns = instant_ns
        return [self._sample(instant_ns)]

    def close(self) -> None:
        """Nothing to free."""


def open_camera(config: NodeConfig, clock: Clock) -> SimulatedCamera:
    """Open the simulated camera."""
    simulation = config.simulation
    known = (simulation.node_a, simulation.node_b, *simulation.more_nodes)
    if config.node not in known:
        raise ConfigError(f"node = {config.node!r}: simulation knows {', '.join(map(repr, known))}")
    return SimulatedCamera(config, clock)


def open_sensors(config: NodeConfig, clock: Clock) -> list[SimulatedSensor]:
    """Open the simulated attitude, depth gauge and inertial unit."""
    world = World(scenario_of(config))
    node = config.node
    return [
        SimulatedSensor("attitude", ATTITUDE_HZ, lambda stamp_ns: world.attitude(node, stamp_ns), clock),
        SimulatedSensor("depth", DEPTH_HZ, lambda stamp_ns: world.depth(node, stamp_ns), clock),
        SimulatedSensor("imu", IMU_HZ, lambda stamp_ns: world.imu(node, stamp_ns), clock),
    ]
