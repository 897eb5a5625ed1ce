"""One node's calibration, and what follows from it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rotation import Floats

# Camera to body for the nominal mount: x forward is z, y right is x, z down is y.
NOMINAL_R_BODY_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Rig:
    """One node's calibration.

    lights_m: (2, 3), left and right, in the camera frame. R_body_camera: camera to body. depth_port_m: in the
    camera frame. declination_rad: what its headings have been corrected by; 0: they are magnetic.
    """

    camera: Camera
    lights_m: Floats
    R_body_camera: Floats = field(default_factory=NOMINAL_R_BODY_CAMERA.copy)
    depth_port_m: Floats = field(default_factory=lambda: np.zeros(3))
    declination_rad: float = 0.0

    @cached_property
    def middle_m(self) -> Floats:
        """The bar's middle (3,), camera frame."""
        middle: Floats = (self.lights_m[0] + self.lights_m[1]) / 2.0
        return middle

    @cached_property
    def offset_m(self) -> float:
        """How far the bar's middle stands off the camera."""
        return float(np.linalg.norm(self.middle_m))

    @cached_property
    def length_m(self) -> float:
        """The distance between the lights."""
        return float(np.linalg.norm(self.lights_m[1] - self.lights_m[0]))

    @cached_property
    def axis(self) -> Floats:
        """The unit vector (3,) from the left to the right light, camera frame."""
        axis: Floats = (self.lights_m[1] - self.lights_m[0]) / self.length_m
        return axis

    @cached_property
    def R_level_camera(self) -> Floats:
        """The turn (3, 3) of the camera's frame that lays the x axis along the bar, y as near to y as it goes."""
        x = self.axis
        y = np.array([0.0, 1.0, 0.0]) if abs(x[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
        y = y - x * (x @ y)
        y = y / np.linalg.norm(y)
        return np.array((x, y, np.cross(x, y)))

    @cached_property
    def both_level_camera(self) -> Floats:
        """The same turn (6, 6) of a position and a small rotation."""
        both = np.zeros((6, 6))
        both[:3, :3] = both[3:, 3:] = self.R_level_camera
        return both

    @cached_property
    def level(self) -> Rig:
        """The same rig in a frame whose x axis is the bar's. Its camera still gives bearings in the camera's frame."""
        turn = self.R_level_camera
        return Rig(
            camera=self.camera,
            lights_m=self.lights_m @ turn.T,
            R_body_camera=self.R_body_camera @ turn.T,
            depth_port_m=turn @ self.depth_port_m,
            declination_rad=self.declination_rad,
        )

    @cached_property
    def usable(self) -> bool:
        """Whether the lights are finite and apart."""
        return bool(np.isfinite(self.lights_m).all()) and self.length_m >= 1e-3


@dataclass(frozen=True, eq=False)
class RigPair:
    """What follows from two rigs together; arrays hold A's value first.

    levels: the rigs in their level frames. length_m (2,): of the bars. area_px2 (4,): of
    the picture that each of B's left and right light and A's left and right light is seen in. views_sr: product of
    both solid angles. middle_m (2, 3): of the bars, level frames; offset_m: of both together. one_camera:
    whether both cameras have the same parameters. ported: whether a depth port stands off its camera.
    gap_per_bearing_m2: half the sum of the bars' lengths^-2, the variance of a gap over that of a bearing and range^2.
    turns (2, 3, 3): from the level frames to the cameras'. size_px (2, 2): width and height of A's and of B's picture.
    """

    rigs: tuple[Rig, Rig]
    levels: tuple[Rig, Rig]
    length_m: Floats
    middle_m: Floats
    area_px2: Floats
    views_sr: float
    offset_m: float
    one_camera: bool
    ported: bool
    gap_per_bearing_m2: float
    turns: Floats
    size_px: Floats


@lru_cache(maxsize=16)
def pair_of(rig_a: Rig, rig_b: Rig) -> RigPair:
    """Give what two rigs have together, once for each two."""
    a, b = rig_a.camera.area_px2, rig_b.camera.area_px2
    levels = rig_a.level, rig_b.level
    return RigPair(
        rigs=(rig_a, rig_b),
        levels=levels,
        length_m=np.array((rig_a.length_m, rig_b.length_m)),
        middle_m=np.array([level.middle_m for level in levels]),
        area_px2=np.array((a, a, b, b)),
        views_sr=rig_a.camera.solid_angle_sr * rig_b.camera.solid_angle_sr,
        offset_m=rig_a.offset_m + rig_b.offset_m,
        one_camera=rig_a.camera.same_as(rig_b.camera),
        ported=any(bool(rig.depth_port_m.any()) for rig in (rig_a, rig_b)),
        gap_per_bearing_m2=0.5 * (rig_a.length_m**-2 + rig_b.length_m**-2),
        turns=np.array((rig_a.R_level_camera.T, rig_b.R_level_camera.T)),
        size_px=np.hstack((rig_a.camera.size_px, rig_b.camera.size_px)),
    )
