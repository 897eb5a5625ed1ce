"""One node's calibration, and what follows from it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp
from buddyline.solver_service.geometry.se3 import SE3

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
        """The distance of the bar's middle from the camera."""
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
    def R_bar_camera(self) -> Floats:
        """From the camera frame to the bar frame (3, 3): x along the bar, y as near to the camera's y as possible."""
        x = self.axis
        y = np.array([0.0, 1.0, 0.0]) if abs(x[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
        y = y - x * (x @ y)
        y = y / np.linalg.norm(y)
        return np.array((x, y, np.cross(x, y)))

    @cached_property
    def usable(self) -> bool:
        """Whether the lights are finite and apart."""
        return bool(np.isfinite(self.lights_m).all()) and self.length_m >= 1e-3


@dataclass(frozen=True, eq=False)
class RigPair:
    """What follows from two rigs together; arrays hold A's value first.

    rigs: as given. R_bar_camera (2, 3, 3). lights_m (2, 2, 3), middle_m (2, 3): bar frames.
    port_m (2, 3): bar frames. lights_in_camera_m, port_in_camera_m: camera frames. length_m (2,): of the bars. size_px
    (2, 2): width and height of the pictures. solid_angle_sr (2,): of the pictures. offset_m: of both bars' middles from
    their cameras, together. gap_per_bearing_m2: half the sum of the bars' lengths^-2, the variance of a gap over that
    of a bearing and range^2.
    """

    rigs: tuple[Rig, Rig]
    R_bar_camera: Floats
    lights_m: Floats
    lights_in_camera_m: Floats
    middle_m: Floats
    port_m: Floats
    port_in_camera_m: Floats
    length_m: Floats
    size_px: Floats
    solid_angle_sr: Floats
    offset_m: float
    gap_per_bearing_m2: float

    @cached_property
    def area_px2(self) -> Floats:
        """Both pictures' areas (2,)."""
        area: Floats = self.size_px.prod(1)
        return area

    @cached_property
    def views_sr2(self) -> float:
        """The product of both solid angles."""
        return float(self.solid_angle_sr.prod())

    @cached_property
    def one_lens(self) -> bool:
        """Whether both cameras turn pixels into the same bearings."""
        return self.rigs[0].camera.same_as(self.rigs[1].camera)

    @cached_property
    def R_body_camera(self) -> Floats:
        """From the cameras' frames to the bodies (2, 3, 3)."""
        return np.array([rig.R_body_camera for rig in self.rigs])

    @cached_property
    def R_ned_upright(self) -> Floats:
        """From the cameras' frames to NED (2, 3, 3) where the attitude is unknown: the bar level, looking north."""
        upright: Floats = NOMINAL_R_BODY_CAMERA @ self.R_bar_camera
        return upright

    @cached_property
    def R_magnetic_ned(self) -> Floats:
        """From the north that each node's headings are given from to the magnetic one (2, 3, 3)."""
        return rotation_exp(np.array([(0.0, 0.0, -rig.declination_rad) for rig in self.rigs]))

    def between_cameras(self, T_a_b: SE3) -> SE3:
        """Bring poses from the bar frames into the cameras'."""
        turn_a, turn_b = self.R_bar_camera
        return SE3(turn_a.T @ T_a_b.R @ turn_b, T_a_b.t_m @ turn_a)


@lru_cache(maxsize=16)
def pair_of(rig_a: Rig, rig_b: Rig) -> RigPair:
    """Give what two rigs have together, once for each two."""
    rigs = rig_a, rig_b
    lights_m = np.array([rig.lights_m @ rig.R_bar_camera.T for rig in rigs])
    return RigPair(
        rigs=rigs,
        R_bar_camera=np.array([rig.R_bar_camera for rig in rigs]),
        lights_m=lights_m,
        lights_in_camera_m=np.array([rig.lights_m for rig in rigs]),
        middle_m=(lights_m[:, 0] + lights_m[:, 1]) / 2.0,
        port_m=np.array([rig.R_bar_camera @ rig.depth_port_m for rig in rigs]),
        port_in_camera_m=np.array([rig.depth_port_m for rig in rigs]),
        length_m=np.array([rig.length_m for rig in rigs]),
        size_px=np.array([(rig.camera.width_px, rig.camera.height_px) for rig in rigs], dtype=np.float64),
        solid_angle_sr=np.array([rig.camera.solid_angle_sr for rig in rigs]),
        offset_m=rig_a.offset_m + rig_b.offset_m,
        gap_per_bearing_m2=0.5 * (rig_a.length_m**-2 + rig_b.length_m**-2),
    )
