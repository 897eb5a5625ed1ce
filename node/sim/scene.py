"""What a camera sees at one time: lamps in its frame and in its picture, and what hides them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from buddyline.node.sim import tags
from buddyline.node.sim.camera import project
from buddyline.node.sim.randomness import Sway, generator
from buddyline.node.sim.rig import LEFT, R_BODY_CAMERA, RIGHT, SimulatedRig, beam, build
from buddyline.node.sim.rotation import Matrix, Vector
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.tags import SeenTag
from buddyline.node.sim.team import TeamMotion
from buddyline.node.sim.trajectory import NodesMotion, PairMotion, Placement
from buddyline.protocol.blinking import lit
from buddyline.protocol.clock import S_NS

LAMP_RADIUS_M = 0.02
PASSING_PERIOD_S = 12.0
PASSING_SHARE = 0.6
STROBE_SHOWS_S = 0.02
STROBE_INTENSITY = 40.0


@dataclass(frozen=True)
class LightSource:
    """A lamp in the water, in NED. intensity: on its axis; beam_rad: 1 sd of its beam.

    stretch: factor by which ripples lengthen its image vertically (a reflection); 1 for a direct view.
    """

    position_ned_m: Vector
    aim_ned: Vector
    intensity: float
    beam_rad: float
    stretch: float = 1.0


@dataclass(frozen=True)
class Lamp:
    """A LightSource as one camera sees it. position_m, aim: camera frame; pixel: (2,) in the distorted picture."""

    position_m: Vector
    aim: Vector
    pixel: Vector
    intensity: float
    beam_rad: float
    stretch: float = 1.0

    @property
    def range_m(self) -> float:
        """Distance from the camera."""
        return float(np.linalg.norm(self.position_m))

    @property
    def towards_camera(self) -> float:
        """Intensity in the camera's direction."""
        return self.intensity * float(beam(np.array(-self.position_m @ self.aim / self.range_m), self.beam_rad))


@dataclass(frozen=True)
class Passer:
    """A dark thing that passes before a lamp: an ellipse in the picture, pixels and radians."""

    centre_px: Vector
    radii_px: Vector
    angle_rad: float

    def hides(self, pixel: Vector) -> bool:
        """Return whether a pixel is covered by it."""
        c, s = math.cos(self.angle_rad), math.sin(self.angle_rad)
        along, across = np.array([[c, s], [-s, c]]) @ (pixel - self.centre_px) / self.radii_px
        return bool(along**2 + across**2 < 1.0)


@dataclass(frozen=True)
class SceneView:
    """All that one camera sees at one time.

    lights: the left and right of each other node, in the nodes' order. others: lamps of other divers and reflections.
    """

    placement: Placement
    lights: tuple[Lamp, ...]
    others: tuple[Lamp, ...]
    passers: tuple[Passer, ...]
    tags: tuple[SeenTag, ...] = ()

    @property
    def R_ned_camera(self) -> Matrix:
        """Rotation from the camera frame to NED."""
        return self.placement.R_ned_body @ R_BODY_CAMERA

    def hidden(self, pixel: Vector) -> bool:
        """Return whether a passing thing covers a pixel."""
        return any(passer.hides(pixel) for passer in self.passers)

    @property
    def bars(self) -> list[tuple[Lamp, Lamp]]:
        """The left and right light of each other node."""
        return list(zip(self.lights[::2], self.lights[1::2], strict=True))


class Scene:
    """All rigs, other divers, the surface, and passing things. Times in seconds since the start.

    motion: of the nodes; None for the scenario's own.
    """

    def __init__(self, scenario: Scenario, motion: NodesMotion | None = None) -> None:
        self.scenario = scenario
        own = TeamMotion if scenario.is_team else PairMotion
        self.motion: NodesMotion = own(scenario) if motion is None else motion
        nodes = scenario.nodes
        self._dead = {
            (i, s) for i, node in enumerate(nodes) for s in (LEFT, RIGHT) if _named(node, s) in scenario.dead_lamps
        }
        self.rigs: list[SimulatedRig] = [build(scenario, index) for index in range(len(nodes))]
        rng = generator(scenario.seed, "divers")
        self._divers = [_Diver(scenario, rng) for _ in range(scenario.other_lamps)]
        # The picture, the candidates and the truth of a frame need the same view.
        self.view = lru_cache(maxsize=4)(self._view)
        self._ripple = [[Sway(rng, 0.4, 3.0) for _ in range(2)] for _ in range(2)]

    def _view(self, index: int, t_s: float) -> SceneView:
        """Return what a node sees at t_s; each light's pixel is the one at its own row's exposure."""
        placement = self.motion.placement(index, t_s)
        lights = tuple(
            self._light(index, placement, other, side, t_s) for other in self.others(index) for side in (LEFT, RIGHT)
        )
        other_a_b = self.motion.placement(0, t_s), self.motion.placement(1, t_s)
        sources = [diver.source(other_a_b, t_s) for diver in self._divers]
        if self.scenario.water.surface > 0:
            sources += [self._reflection(other, side, t_s) for other in self.others(index) for side in (LEFT, RIGHT)]
        if self.scenario.strobe_s > 0 and t_s % self.scenario.strobe_s < STROBE_SHOWS_S:
            sources.append(self._strobe(other_a_b))
        others = tuple(self._seen(index, placement, source) for source in sources)
        seen_tags = self._tags(index, placement, t_s) if self.scenario.tags else ()
        return SceneView(placement, lights, others, self._passers(index, t_s, lights), seen_tags)

    def others(self, index: int) -> list[int]:
        """Return the indices of all other nodes."""
        return [other for other in range(len(self.rigs)) if other != index]

    def _light(self, index: int, placement: Placement, other: int, side: int, t_s: float) -> Lamp:
        lamp = self._seen(index, placement, self._source(other, side, t_s))
        row_time_ns = self.scenario.row_time_ns
        if row_time_ns == 0 or math.isnan(lamp.pixel[1]):
            return lamp
        for _ in range(2):
            row_s = t_s + self.row_delay_s(float(lamp.pixel[1]))
            lamp = self._seen(index, self.motion.placement(index, row_s), self._source(other, side, row_s))
        return lamp

    def row_delay_s(self, v_px: float) -> float:
        """Return the exposure time of a row minus that of the middle row, s."""
        return (v_px - (self.scenario.height_px - 1) / 2) * self.scenario.row_time_ns * 1e-9

    def _source(self, index: int, side: int, t_s: float) -> LightSource:
        """Return one light of a node."""
        placement, rig = self.motion.placement(index, t_s), self.rigs[index]
        R_ned_camera = placement.R_ned_body @ R_BODY_CAMERA
        return LightSource(
            placement.position_ned_m + R_ned_camera @ rig.lights_m[side],
            R_ned_camera @ rig.aims[side],
            float(rig.intensities[side]) if self._is_lit(index, side, t_s) else 0.0,
            float(rig.beams_rad[side]),
        )

    def _is_lit(self, index: int, side: int, t_s: float) -> bool:
        if (index, side) in self._dead:
            return False
        scenario = self.scenario
        blink = scenario.blink(index)
        if blink is None:
            return True
        # All clocks but the first node's have an offset.
        own_s = t_s * (1.0 + scenario.clock_drift) if index else t_s
        offset_ns = scenario.clock_offset_ns if index else 0
        return lit(blink, scenario.start_ns + offset_ns + round(own_s * S_NS))[0 if side == LEFT else 1]

    def _reflection(self, index: int, side: int, t_s: float) -> LightSource:
        """Return a light's mirror image in the surface; ripples move it and lengthen it."""
        source = self._source(index, side, t_s)
        mirror = np.array([1.0, 1.0, -1.0])
        across_m, up_m = (0.05 * ripple(t_s) for ripple in self._ripple[side])
        return replace(
            source,
            position_ned_m=source.position_ned_m * mirror + [across_m, across_m, up_m],
            aim_ned=source.aim_ned * mirror,
            intensity=0.25 * source.intensity,
            stretch=3.0,
        )

    @staticmethod
    def _strobe(nodes: tuple[Placement, Placement]) -> LightSource:
        """Return a flash a little above the middle between the nodes, which lights all directions."""
        position_m = (nodes[0].position_ned_m + nodes[1].position_ned_m) / 2 - np.array([0.0, 0.0, 0.2])
        return LightSource(position_m, np.array([0.0, 0.0, 1.0]), STROBE_INTENSITY, 2.0)

    def _seen(self, index: int, placement: Placement, source: LightSource) -> Lamp:
        """Return a lamp as a node sees it."""
        R_camera_ned = (placement.R_ned_body @ R_BODY_CAMERA).T
        position_m = R_camera_ned @ (source.position_ned_m - placement.position_ned_m)
        pixel = project(position_m[None], self.rigs[index].camera)[0]
        return Lamp(position_m, R_camera_ned @ source.aim_ned, pixel, source.intensity, source.beam_rad, source.stretch)

    def _tags(self, index: int, placement: Placement, t_s: float) -> tuple[SeenTag, ...]:
        """Return the other nodes' tags, lit by the sun and by the observer's lights."""
        return tuple(tag for other in self.others(index) for tag in self._tags_of(other, index, placement, t_s))

    def _tags_of(self, carrier: int, index: int, placement: Placement, t_s: float) -> list[SeenTag]:
        water, rig, other = self.scenario.water, self.rigs[index], self.motion.placement(carrier, t_s)
        R_camera_ned = (placement.R_ned_body @ R_BODY_CAMERA).T
        R_camera_other = R_camera_ned @ other.R_ned_body @ R_BODY_CAMERA
        t_camera_other_m = R_camera_ned @ (other.position_ned_m - placement.position_ned_m)
        k = np.array(water.absorption_per_m) + np.array(water.scattering_per_m)
        seen = []
        for tag in tags.layout(carrier):
            corners_m = tags.board(tag.corners_m) @ R_camera_other.T + t_camera_other_m
            pixels = project(corners_m, rig.camera)
            if np.isnan(pixels).any():
                continue
            centre_m = corners_m.mean(axis=0)
            path_m = centre_m - rig.lights_m
            far_m = np.linalg.norm(path_m, axis=1)
            rays = path_m / far_m[:, None]
            facing = np.clip(-rays @ R_camera_other[:, 2], 0.0, None)
            on_axis = np.array([beam(ray @ aim, b) for ray, aim, b in zip(rays, rig.aims, rig.beams_rad, strict=True)])
            lit = (rig.intensities * on_axis * facing / far_m**2) @ np.exp(-np.outer(far_m, k)) / math.pi
            through = np.exp(-k * np.linalg.norm(centre_m))
            light = water.lamp_gain * lit + 1.2 * np.array(water.ambient)
            seen.append(SeenTag(tag.id, pixels, light, through))
        return seen

    def _passers(self, index: int, t_s: float, lights: tuple[Lamp, ...]) -> tuple[Passer, ...]:
        if not self.scenario.interruptions or self.scenario.trajectory == "rest":
            return ()
        passing = _passing(self.scenario.seed, index, math.floor(t_s / PASSING_PERIOD_S))
        if passing is None or abs(t_s - passing.middle_s) > 1.5 * passing.covers_s:
            return ()
        lamp = lights[passing.side + 2 * (math.floor(t_s / PASSING_PERIOD_S) % (len(lights) // 2))]
        if np.isnan(lamp.pixel).any():
            return ()
        size_px = self.rigs[index].camera.fx_px * passing.size_m / (0.6 * lamp.range_m)
        radii_px = size_px * np.array([passing.aspect, 1.0])
        way = 2 * (t_s - passing.middle_s) / passing.covers_s * size_px
        heading = np.array([-math.sin(passing.angle_rad), math.cos(passing.angle_rad)])
        return (Passer(lamp.pixel + way * heading, radii_px, passing.angle_rad),)


@dataclass(frozen=True)
class _Passing:
    middle_s: float
    covers_s: float
    side: int
    size_m: float
    aspect: float
    angle_rad: float


@lru_cache(maxsize=64)
def _passing(seed: int, index: int, window: int) -> _Passing | None:
    """Return the thing that passes before one light in a window of time; None if nothing does."""
    if window < 0:
        return None
    rng = generator(seed, "passing", index, window)
    covers_s = float(rng.uniform(0.4, 1.6))
    begin_s = window * PASSING_PERIOD_S
    passing = _Passing(
        middle_s=begin_s + float(rng.uniform(3.0, PASSING_PERIOD_S - 3.0)),
        covers_s=covers_s,
        side=int(rng.integers(2)),
        size_m=float(rng.uniform(0.05, 0.14)),
        aspect=float(rng.uniform(1.2, 2.6)),
        angle_rad=float(rng.uniform(-math.pi, math.pi)),
    )
    return passing if rng.random() < PASSING_SHARE else None


def _named(node: str, side: int) -> str:
    return f"{node}.{'right' if side == RIGHT else 'left'}"


class _Diver:
    """Another diver with one lamp, who swims back and forth beside the line between the nodes."""

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        self._intensity = float(rng.uniform(0.3, 1.0))
        self._beam_rad = math.radians(rng.uniform(8, 20))
        self._along = float(rng.uniform(0.2, 0.9))
        self._side_m = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 2.2))
        self._climb_m = float(rng.uniform(-0.8, 0.8))
        self._ways = [Sway(rng, 12.0, 40.0) for _ in range(3)]
        self._aims = [Sway(rng, 6.0, 25.0) for _ in range(2)]

    def source(self, nodes: tuple[Placement, Placement], t_s: float) -> LightSource:
        """Return the lamp."""
        start_m, end_m = (node.position_ned_m for node in nodes)
        line_m = end_m - start_m
        right = np.array([-line_m[1], line_m[0], 0.0]) / math.hypot(line_m[0], line_m[1])
        ways = [way(t_s) for way in self._ways]
        position_m = start_m + line_m * (self._along + 0.3 * ways[0]) + right * (self._side_m + ways[1])
        position_m[2] = max(position_m[2] + self._climb_m + 0.5 * ways[2], 0.3)
        azimuth = math.pi * 2 * self._aims[0](t_s)
        tilt = 0.6 * self._aims[1](t_s)
        aim = np.array([math.cos(azimuth) * math.cos(tilt), math.sin(azimuth) * math.cos(tilt), math.sin(tilt)])
        return LightSource(position_m, aim, self._intensity, self._beam_rad)
