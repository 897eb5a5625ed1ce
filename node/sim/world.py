"""The simulated world of nodes: a function of (scenario, node, time).

Two processes with the same Scenario see the same world, at any time and in any order.
Stamps are on the given node's own clock (all but the first node's are off by Scenario.clock_offset_ns). A pair's truth
is stamped midway between both nodes' clocks, as poses and tracks are.
"""

from __future__ import annotations

from typing import Final, Literal, TypeAlias

import numpy as np
from buddyline.node.capture.exposure import Exposure
from buddyline.node.sim import candidates, rotation, tags
from buddyline.node.sim.glow import core_px
from buddyline.node.sim.inertial import STEP_S
from buddyline.node.sim.picture import Painter
from buddyline.node.sim.randomness import generator
from buddyline.node.sim.rig import LEFT, Q_BODY_CAMERA, R_BODY_CAMERA, RIGHT
from buddyline.node.sim.rotation import Matrix, Vector
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.scene import Lamp, Scene
from buddyline.node.sim.sensors import SensorModel
from buddyline.node.sim.tags import Tag
from buddyline.node.sim.trajectory import NodesMotion
from buddyline.protocol.messages import (
    ArTag,
    Attitude,
    Candidates,
    Depth,
    FixedPlace,
    Imu,
    LightTruth,
    NodeInfo,
    NodePose,
    TrueLight,
    Truth,
)
from msgspec import UNSET
from numpy.typing import NDArray

Triple: TypeAlias = tuple[float, float, float]

SOFTWARE = "buddyline simulator"
# Of a fixed node's stated place and attitude, 1 sd of each coordinate.
SURVEY_SIGMA_M: Final = 1e-4
SURVEY_SIGMA_RAD: Final = 1e-4


class World:
    """Nodes in water, as their cameras and sensors see each other. motion: None for the scenario's own."""

    def __init__(self, scenario: Scenario, motion: NodesMotion | None = None) -> None:
        self.scenario = scenario
        self._scene = Scene(scenario, motion)
        self._sensors = [SensorModel(scenario, self._scene, i) for i in range(len(scenario.nodes))]
        self._painters: dict[int, Painter] = {}

    def info(self, node: str, stamp_ns: int, trigger_period_ns: int) -> NodeInfo:
        """Return a node's description, with the true places of its lights."""
        s, index = self.scenario, self.scenario.index(node)
        rig = self._scene.rigs[index]
        carried = [ArTag(id=tag.id, corners_m=_corners(tag.corners_m), family=tags.FAMILY) for tag in self.tags(node)]
        return NodeInfo(
            node=node,
            stamp_ns=stamp_ns,
            width_px=s.width_px,
            height_px=s.height_px,
            camera=rig.camera,
            light_left_m=_triple(rig.lights_m[LEFT]),
            light_right_m=_triple(rig.lights_m[RIGHT]),
            sigma_px=s.sigma_px,
            trigger_period_ns=trigger_period_ns,
            row_time_ns=s.row_time_ns,
            q_body_camera_xyzw=Q_BODY_CAMERA,
            depth_port_m=_triple(rig.depth_port_m),
            software=SOFTWARE,
            tags=carried or UNSET,
            imu_m=_triple(self._sensors[index].unit.stated_lever_m),
            fixed=self._place(node, stamp_ns) if node in s.fixed_nodes else UNSET,
            blink=s.blink(index) or UNSET,
        )

    def _place(self, node: str, stamp_ns: int) -> FixedPlace:
        """Return where a fixed node stands by its survey, which is off as its sigmas say."""
        R, position_m = self.T_ned_camera(node, stamp_ns)
        off = generator(self.scenario.seed, "survey", self.scenario.index(node)).standard_normal(6)
        return FixedPlace(
            p_m=_triple(position_m + SURVEY_SIGMA_M * off[:3]),
            q_xyzw=rotation.to_quaternion(rotation.from_euler(*(SURVEY_SIGMA_RAD * off[3:])) @ R),
            sigma_m=SURVEY_SIGMA_M,
            sigma_rad=SURVEY_SIGMA_RAD,
        )

    def T_ned_camera(self, node: str, stamp_ns: int) -> tuple[Matrix, Vector]:
        """Return R (3, 3) and t (3,), metres: from a node's camera frame to NED, with its origin at the surface."""
        index = self.scenario.index(node)
        placement = self._scene.motion.placement(index, self._seconds(index, stamp_ns))
        return placement.R_ned_body @ R_BODY_CAMERA, placement.position_ned_m

    def stamp_error_ns(self, node: str, trigger: int) -> int:
        """Return how much later the stamp of a node's picture is than its exposure."""
        rng = generator(self.scenario.seed, "stamps", self.scenario.index(node), trigger)
        return round(max(-5.0, min(5.0, float(rng.standard_normal()))) * self.scenario.stamp_sigma_ns)

    def truth(self, stamp_ns: int, trigger: int, pair: tuple[str, str] | None = None) -> Truth:
        """Return a pair's true T_a_b at stamp_ns, midway between their clocks; pair: None for the first two nodes."""
        of_a, of_b = (self.scenario.index(node) for node in pair or self.scenario.nodes[:2])
        t_s = self._seconds_between(of_a, of_b, stamp_ns)
        a, b = (self._scene.motion.placement(index, t_s) for index in (of_a, of_b))
        R_camera_a_ned = (a.R_ned_body @ R_BODY_CAMERA).T
        t_a_b_m = R_camera_a_ned @ (b.position_ned_m - a.position_ned_m)
        R_a_b = R_camera_a_ned @ b.R_ned_body @ R_BODY_CAMERA
        return Truth(
            stamp_ns=stamp_ns,
            trigger=trigger,
            t_a_b_m=_triple(t_a_b_m),
            q_a_b_xyzw=rotation.to_quaternion(R_a_b),
        )

    def node_truth(self, node: str, stamp_ns: int, net: str) -> NodePose:
        """Return a node's true pose in NED, with its origin at the surface, at stamp_ns on its clock."""
        index = self.scenario.index(node)
        t_s = self._seconds(index, stamp_ns)
        before, now, after = (self._scene.motion.placement(index, t_s + step) for step in (-STEP_S, 0.0, STEP_S))
        return NodePose(
            net=net,
            node=node,
            stamp_ns=stamp_ns,
            p_m=_triple(now.position_ned_m),
            q_xyzw=rotation.to_quaternion(now.R_ned_body @ R_BODY_CAMERA),
            v_mps=_triple((after.position_ned_m - before.position_ned_m) / (2 * STEP_S)),
            covariance=[0.0] * 36,
            fixed=node in self.scenario.fixed_nodes,
            mode="truth",
            age_s=0.0,
        )

    def light_truth(self, node: str, stamp_ns: int, trigger: int) -> LightTruth:
        """Return the true places of the other nodes' lights in the picture taken at stamp_ns.

        A light without a projection, such as one behind the camera, is left out.
        """
        index = self.scenario.index(node)
        view = self._scene.view(index, self._seconds(index, stamp_ns))
        names: tuple[Literal["left", "right"], Literal["left", "right"]] = ("left", "right")
        lights = []
        for other, bar in zip(self._scene.others(index), view.bars, strict=True):
            merged = self._merged(index, *bar)
            lights += [
                TrueLight(
                    name=name,
                    u_px=float(lamp.pixel[0]),
                    v_px=float(lamp.pixel[1]),
                    visible=candidates.visible(self._scene, index, view, lamp),
                    merged=merged,
                    node=self.scenario.nodes[other] if len(self.scenario.nodes) > 2 else UNSET,
                )
                for name, lamp in zip(names, bar, strict=True)
                if not np.isnan(lamp.pixel).any()
            ]
        return LightTruth(node=node, stamp_ns=stamp_ns, trigger=trigger, lights=lights)

    def lamps(self, node: str, stamp_ns: int) -> list[tuple[float, float, bool]]:
        """Return where every lamp, of anyone, is in the picture taken at stamp_ns: (u, v, visible), px."""
        index = self.scenario.index(node)
        view = self._scene.view(index, self._seconds(index, stamp_ns))
        return [
            (float(lamp.pixel[0]), float(lamp.pixel[1]), candidates.visible(self._scene, index, view, lamp))
            for lamp in (*view.lights, *view.others)
            if lamp.stretch == 1.0 and not np.isnan(lamp.pixel).any()
        ]

    def render(self, node: str, stamp_ns: int, exposure: Exposure | None = None) -> NDArray[np.uint8]:
        """Return the picture taken at stamp_ns, (H, W, 3) uint8, blue green red. exposure: None for the scene's own."""
        index = self.scenario.index(node)
        t_s = self._seconds(index, stamp_ns)
        return self._painter(index).paint(self._scene.view(index, t_s), t_s, stamp_ns, exposure)

    def tags(self, node: str) -> tuple[Tag, ...]:
        """Return the AR tags that a node carries; empty where the scenario has no tags."""
        return tags.layout(self.scenario.index(node)) if self.scenario.tags else ()

    def imu(self, node: str, stamp_ns: int) -> Imu:
        """Return the inertial sample at stamp_ns."""
        index = self.scenario.index(node)
        return self._sensors[index].imu(stamp_ns, self._seconds(index, stamp_ns))

    def attitude(self, node: str, stamp_ns: int) -> Attitude:
        """Return the attitude filter's output at stamp_ns."""
        index = self.scenario.index(node)
        return self._sensors[index].attitude(stamp_ns, self._seconds(index, stamp_ns))

    def depth(self, node: str, stamp_ns: int) -> Depth:
        """Return the depth gauge's output at stamp_ns."""
        index = self.scenario.index(node)
        return self._sensors[index].depth(stamp_ns, self._seconds(index, stamp_ns))

    def candidates(self, node: str, stamp_ns: int, trigger: int, seq: int, boot: str) -> Candidates:
        """Return synthetic light candidates of the picture taken at stamp_ns, without rendering it."""
        s, index = self.scenario, self.scenario.index(node)
        view = self._scene.view(index, self._seconds(index, stamp_ns))
        blobs, truncated = candidates.blobs(self._scene, index, view, stamp_ns)
        return Candidates(
            node=node,
            stamp_ns=stamp_ns,
            trigger=trigger,
            seq=seq,
            boot=boot,
            width_px=s.width_px,
            height_px=s.height_px,
            blobs=blobs,
            truncated=truncated,
        )

    def _seconds(self, index: int, stamp_ns: int) -> float:
        """Return seconds since the start for a stamp on a node's clock."""
        return self._seconds_between(index, index, stamp_ns)

    def _seconds_between(self, one: int, other: int, stamp_ns: int) -> float:
        """Return seconds since the start for a stamp midway between two nodes' clocks."""
        share = 0.5 * ((one > 0) + (other > 0))
        offset_ns = round(share * self.scenario.clock_offset_ns)
        own_s = (stamp_ns - offset_ns - self.scenario.start_ns) * 1e-9
        return own_s / (1.0 + share * self.scenario.clock_drift)

    def _merged(self, index: int, left: Lamp, right: Lamp) -> bool:
        """Return whether the clipped cores of two lights overlap."""
        f_px = self._scene.rigs[index].camera.fx_px
        cores_px = [core_px(lamp, self.scenario.water, f_px) for lamp in (left, right)]
        return bool(np.linalg.norm(left.pixel - right.pixel) < sum(cores_px))

    def _painter(self, index: int) -> Painter:
        if index not in self._painters:
            self._painters[index] = Painter(self.scenario, self._scene, index)
        return self._painters[index]


def _corners(corners_m: Vector) -> tuple[Triple, Triple, Triple, Triple]:
    top_left, top_right, bottom_right, bottom_left = map(_triple, corners_m)
    return top_left, top_right, bottom_right, bottom_left


def _triple(vector: Vector) -> Triple:
    return float(vector[0]), float(vector[1]), float(vector[2])
