"""The description of a simulated dive: with its seed, it determines everything."""

from __future__ import annotations

from dataclasses import dataclass
from string import ascii_lowercase
from typing import Final, Literal, TypeAlias, get_args

from buddyline.protocol.blinking import DARK_SLOTS
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Blink, CameraModel
from buddyline.protocol.topics import check_node_id

Environment: TypeAlias = Literal["cavern", "night_reef", "lake", "basin", "day_reef"]
Trajectory: TypeAlias = Literal["circles", "rest"]
InertialGrade: TypeAlias = Literal["good", "fair", "poor"]
Decoy: TypeAlias = Literal["walls", "shells", "slabs", "bubbles", "lasers", "clock"]
PictureExposure: TypeAlias = Literal["fixed", "auto"]
ENVIRONMENTS: Final[tuple[str, ...]] = get_args(Environment)
TRAJECTORIES: Final[tuple[str, ...]] = get_args(Trajectory)
INERTIAL_GRADES: Final[tuple[str, ...]] = get_args(InertialGrade)
EXPOSURES: Final[tuple[str, ...]] = get_args(PictureExposure)
DECOYS: Final[tuple[str, ...]] = get_args(Decoy)

Bgr: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True)
class Water:
    """Optics and layout of an environment; colours in the order of OpenCV: blue, green, red.

    absorption_per_m, scattering_per_m: coefficients of each colour. peak_share: share of scattered light in a narrow
    forward peak (small in turbid water); forwardness: Henyey-Greenstein's g of the rest.
    ambient: radiance of the open water as a share of full scale (0: dark). lamp_gain: exposure, as the radiance
    (share of full scale) per steradian of a lamp of unit intensity. noise: sd in grey levels.
    depth_m: of A. floor_depth_m: of the sea floor, 0 where none is in view. density_kgpm3: for pressure.
    snow: particles in view. caustics, surface: contrast of both, 0 without sun. range_max_m: B's greatest range.
    """

    absorption_per_m: Bgr
    scattering_per_m: Bgr
    peak_share: float
    forwardness: float
    ambient: Bgr
    lamp_gain: float
    noise: float
    depth_m: float
    floor_depth_m: float
    density_kgpm3: float
    snow: int
    caustics: float
    surface: float
    range_max_m: float


WATERS: Final[dict[str, Water]] = {
    "cavern": Water(
        (0.05, 0.06, 0.40), (0.03, 0.03, 0.03), 0.5, 0.85, (0.0, 0.0, 0.0), 5.0, 2.4, 13.0, 0.0, 998.0, 12, 0, 0, 9.0
    ),
    "night_reef": Water(
        (0.06, 0.07, 0.42), (0.12, 0.12, 0.12), 0.5, 0.85, (0.0, 0.0, 0.0), 0.4, 2.4, 8.0, 0.0, 1025.0, 30, 0, 0, 9.0
    ),
    "lake": Water(
        (0.75, 0.22, 0.45), (0.9, 0.9, 0.9), 0.1, 0.75, (0.12, 0.28, 0.21), 0.22, 1.2, 2.6, 0.0, 998.0, 18, 0, 0, 4.5
    ),
    "basin": Water(
        (0.05, 0.05, 0.22), (0.08, 0.08, 0.08), 0.5, 0.85, (0.12, 0.11, 0.06), 0.12, 1.4, 2.2, 5.0, 998.0, 8, 1.0,
        1.0, 10.0,
    ),
    "day_reef": Water(
        (0.05, 0.08, 0.40), (0.10, 0.10, 0.10), 0.5, 0.85, (0.24, 0.20, 0.02), 0.10, 1.4, 8.0, 11.0, 1025.0, 14, 0.8,
        0.0, 9.0,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Scenario:
    """Nodes in some water: the complete description of a simulated dive.

    more_nodes: further nodes; with them, or with fixed nodes, the nodes move as two groups that face each other.
    fixed_nodes: which stand still. start_ns: epoch of t = 0. camera_a, camera_b: None for the default pinhole; further
    nodes have A's and B's cameras and baselines by turns. rig_sigma_m: 1 sd of the lights' distance from the ideal bar
    (NodeInfo has their true places). range_max_m: 0 for the environment's own. sigma_px: noise of synthetic
    candidates. gross_share: share of them with a gross error, gross_px (1 sd per axis).
    miss_share: share of lights that give no candidate. false_lights: false candidates in each picture.
    other_lamps: other divers' lamps in the water. tags: whether each node carries two AR tags.
    interruptions: whether nodes look away and things pass before lights. clock_offset_ns: B's clock minus A's at
    the start. clock_drift: what B's clock gains, s a second. Further nodes have B's clock. stamp_sigma_ns: how far a
    picture's stamp is off its exposure, 1 sd. magnetometer_off_rad: constant error of B's heading that its sigma does
    not include. inertial: quality of the inertial units. dead_lamps: lights that are dark for the whole dive, such as
    "b.left".
    blink_slot_ns: length of the slots in which each node's left lamp blinks by a code of its own; 0: no lamp blinks.
    pwm_hz: frequency at which the lights are dimmed by pulses (0: steady); a picture shows it, with a rolling shutter
    in its rows. pwm_depth: how far their light swings from its mean, as a share of it.
    strobe_s: time between the flashes of a third diver's strobe between the nodes; 0: none.
    decoys: what pictures show that may be taken for lamps.
    """

    environment: Environment = "cavern"
    seed: int = 0
    start_ns: int = 0
    node_a: str = "a"
    node_b: str = "b"
    more_nodes: tuple[str, ...] = ()
    fixed_nodes: tuple[str, ...] = ()
    width_px: int = 820
    height_px: int = 616
    camera_a: CameraModel | None = None
    camera_b: CameraModel | None = None
    row_time_ns: int = 0
    baseline_a_m: float = 0.88
    baseline_b_m: float = 0.88
    rig_sigma_m: float = 0.004
    trajectory: Trajectory = "circles"
    range_min_m: float = 1.5
    range_max_m: float = 0.0
    sigma_px: float = 0.7
    gross_share: float = 0.03
    gross_px: float = 6.0
    miss_share: float = 0.03
    false_lights: int = 3
    other_lamps: int = 1
    tags: bool = False
    interruptions: bool = True
    clock_offset_ns: int = 0
    clock_drift: float = 0.0
    stamp_sigma_ns: int = MS_NS
    magnetometer_off_rad: float = 0.0
    inertial: InertialGrade = "good"
    dead_lamps: tuple[str, ...] = ()
    blink_slot_ns: int = 0
    pwm_hz: float = 0.0
    pwm_depth: float = 0.5
    strobe_s: float = 0.0
    decoys: tuple[Decoy, ...] = ()

    def __post_init__(self) -> None:
        """Raise BuddylineError, naming the field, for what cannot be simulated."""
        for node in self.nodes:
            check_node_id(node)
        if self.node_a == self.node_b:
            raise BuddylineError(f"node_b: {self.node_b!r} is also node_a; the nodes need different names")
        for i, node in enumerate(self.more_nodes):
            if node in self.nodes[: 2 + i]:
                raise BuddylineError(f"more_nodes: {node!r} is there already; the nodes need different names")
        for node in self.fixed_nodes:
            if node not in self.nodes:
                raise BuddylineError(f"fixed_nodes: {node!r} is none of {', '.join(self.nodes)}")
        for name, known in (
            ("environment", ENVIRONMENTS),
            ("trajectory", TRAJECTORIES),
            ("inertial", INERTIAL_GRADES),
        ):
            if getattr(self, name) not in known:
                raise BuddylineError(f"{name}: {getattr(self, name)!r} is none of {', '.join(known)}")
        lamps = [f"{node}.{side}" for node in self.nodes for side in ("left", "right")]
        for lamp in self.dead_lamps:
            if lamp not in lamps:
                raise BuddylineError(f"dead_lamps: {lamp!r} is none of {', '.join(lamps)}")
        for decoy in self.decoys:
            if decoy not in DECOYS:
                raise BuddylineError(f"decoys: {decoy!r} is none of {', '.join(DECOYS)}")
        for name, lowest in _LOWEST.items():
            if not getattr(self, name) >= lowest:
                raise BuddylineError(f"{name}: {getattr(self, name)} is below {lowest}")
        for name in ("gross_share", "miss_share", "pwm_depth"):
            if getattr(self, name) > 1:
                raise BuddylineError(f"{name}: {getattr(self, name)} is above 1")
        if self.far_m < self.range_min_m:
            raise BuddylineError(f"range_max_m: {self.far_m} is below range_min_m, {self.range_min_m}")

    @property
    def nodes(self) -> tuple[str, ...]:
        """All nodes, A and B first."""
        return (self.node_a, self.node_b, *self.more_nodes)

    @property
    def is_team(self) -> bool:
        """Whether the nodes move as two groups, not as a pair."""
        return bool(self.more_nodes or self.fixed_nodes)

    @property
    def water(self) -> Water:
        """Optics of the environment."""
        return WATERS[self.environment]

    @property
    def far_m(self) -> float:
        """Return the longest range."""
        return self.range_max_m or max(self.water.range_max_m, self.range_min_m)

    def index(self, node: str) -> int:
        """Return 0 for A, 1 for B, and so on."""
        if node not in self.nodes:
            *first, last = self.nodes
            raise BuddylineError(f"node {node!r} is not simulated: {', '.join(first)} and {last} are")
        return self.nodes.index(node)

    def camera(self, index: int) -> CameraModel:
        """Return the camera of a node; further nodes have A's and B's by turns."""
        own = (self.camera_a, self.camera_b)[index % 2]
        if own is not None:
            return own
        # Imported here: commands name the environments in their help, which must not take the time to load numpy.
        from buddyline.node.sim.camera import pinhole

        return pinhole(self.width_px, self.height_px)

    def baseline_m(self, index: int) -> float:
        """Return the baseline of a node, metres; further nodes have A's and B's by turns."""
        return (self.baseline_a_m, self.baseline_b_m)[index % 2]

    def blink(self, index: int) -> Blink | None:
        """Return how a node's lamp blinks, None where it does not."""
        if not self.blink_slot_ns:
            return None
        return Blink(code=index % len(DARK_SLOTS), lamp="left", slot_ns=self.blink_slot_ns)


def more_nodes(count: int) -> tuple[str, ...]:
    """Return the names of the nodes beside a and b: c, d, ...; raise BuddylineError for a count out of range."""
    if not 2 <= count <= len(ascii_lowercase):
        raise BuddylineError(f"--nodes {count}: give 2 to {len(ascii_lowercase)}")
    return tuple(ascii_lowercase[2:count])


_LOWEST: Final = {
    "seed": 0,
    "start_ns": 0,
    "width_px": 32,
    "height_px": 32,
    "row_time_ns": 0,
    "baseline_a_m": 0.05,
    "baseline_b_m": 0.05,
    "rig_sigma_m": 0.0,
    "range_min_m": 0.5,
    "range_max_m": 0.0,
    "sigma_px": 1e-6,
    "gross_share": 0.0,
    "gross_px": 0.0,
    "miss_share": 0.0,
    "false_lights": 0,
    "other_lamps": 0,
    "blink_slot_ns": 0,
    "pwm_hz": 0.0,
    "pwm_depth": 0.0,
    "strobe_s": 0.0,
}


@dataclass(frozen=True)
class DivePlan:
    """Which messages of a dive are logged. images: pictures in place of synthetic candidates. imu: inertial samples.

    exposure: of pictures: `fixed` for the scene's own, `auto` for what the node's loop makes of its detector's finds.
    exposure_sigma_ns: distance of exposures from their trigger instants, 1 sd. lost_share: share of lost frames.
    """

    seconds: float = 60.0
    rate_hz: float = 10.0
    images: bool = False
    exposure: PictureExposure = "fixed"
    imu: bool = False
    exposure_sigma_ns: int = MS_NS
    lost_share: float = 0.03

    def __post_init__(self) -> None:
        """Raise BuddylineError, naming the field, for a value out of range."""
        if not 0 < self.seconds < 1e6:
            raise BuddylineError(f"seconds: {self.seconds} is not above 0 and below 1e6")
        if not 0 < self.rate_hz <= 200:
            raise BuddylineError(f"rate_hz: {self.rate_hz} is not above 0 and at most 200")
        if self.exposure not in EXPOSURES:
            raise BuddylineError(f"exposure: {self.exposure!r} is none of {', '.join(EXPOSURES)}")
        if not 0 <= self.lost_share <= 1:
            raise BuddylineError(f"lost_share: {self.lost_share} is not between 0 and 1")

    @property
    def period_ns(self) -> int:
        """Time between triggers."""
        return round(S_NS / self.rate_hz)
