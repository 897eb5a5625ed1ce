"""A node's configuration: one TOML file, strict, with defaults where possible."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from buddyline.node.geomagnetism import EarthField, MagnetometerCalibration, earth_field
from buddyline.protocol.blinking import DARK_SLOTS
from buddyline.protocol.config import Config, ConfigError, Namespace, load_config
from buddyline.protocol.messages import (
    ArTag,
    Blink,
    CameraModel,
    FixedPlace,
    NodeId,
    NodeInfo,
    Positive,
    Quaternion,
    Role,
    Vector3,
)
from buddyline.protocol.messages.fields import check_unit
from buddyline.protocol.messages.node import check_apart
from buddyline.protocol.security import Tls
from msgspec import UNSET, Meta, UnsetType, field
from msgspec.structs import replace

# By BCM number, as on the 40-pin header; 0 and 1 are the HAT's memory.
Pin = Annotated[int, Meta(ge=2, le=27)]
I2C_PINS = {1: (2, 3)}
# By the address pins of the chips.
GAUGE_ADDRESSES = {"none": range(0), "ina219": range(0x40, 0x50), "ads1115": range(0x48, 0x4C)}

Fraction = Annotated[float, Meta(ge=0, le=1)]

# Filters and reading delay samples by some milliseconds; a tenth of a second is a wrong unit.
MAX_IMU_DELAY_NS = 100_000_000
# Largest distance of a principal point from the middle, of the picture's size: real lenses stay within a third of it.
OFF_CENTRE = 0.15
# No diver carries a longer bar: it is given in millimetres.
LONGEST_BAR_M = 20.0


class CameraConfig(Config, frozen=True, kw_only=True):
    """[camera]: its name and fixed settings. path: pictures of the `stored` camera.

    exposure_us: fixes the exposure, with this gain; without it, exposure and gain follow [exposure].
    focus_dioptres: of a camera that has a focus; 0.5, two metres, is sharp from one metre to infinity.
    colour: of the Pi's camera. Luminance alone is a third of the memory; in caverns and lakes it loses lights.
    """

    name: str = "simulated"
    path: str = ""
    width_px: Annotated[int, Meta(ge=1, le=65535)] = 820
    height_px: Annotated[int, Meta(ge=1, le=65535)] = 616
    exposure_us: Annotated[int, Meta(ge=1)] | None = None
    gain: Positive = 2.0
    focus_dioptres: Annotated[float, Meta(ge=0, le=32)] = 0.5
    colour: bool = True
    sync: Literal["off", "server", "client"] = "off"


class ExposureConfig(Config, frozen=True, kw_only=True):
    """[exposure]: the loop that locks the exposure to the other node's lamps.

    target: light of the brighter lamp's core, as a share of what clips. context_every: one of so many triggers has
    the scene's exposure; 0: none. flicker_hz: of lamps that are dimmed by pulses; exposures are whole periods of it.
    longest_us, gain_max: bounds for both kinds of frames.
    """

    target: Annotated[float, Meta(gt=0, le=0.9)] = 0.6
    context_every: Annotated[int, Meta(ge=0)] = 20
    flicker_hz: Annotated[float, Meta(ge=0)] = 0.0
    longest_us: Annotated[int, Meta(ge=10)] = 25_000
    gain_max: Annotated[float, Meta(ge=1)] = 4.0


class DetectorConfig(Config, frozen=True, kw_only=True):
    """[detector]: method, and single values that replace its own.

    environment: selects the thresholds of the `paper` method; the others adapt to the water. guided: look first where
    the solver, or the last pictures, expect the lights. masks: polygons of the picture that are never searched; corners
    [u, v] as shares of its width and height, two for a rectangle.
    """

    method: str = "source"
    environment: str = "auto"
    overrides: dict[str, float] = field(default_factory=dict)
    guided: bool = True
    masks: list[Annotated[list[tuple[Fraction, Fraction]], Meta(min_length=2)]] = field(default_factory=list)


class SensorsConfig(Config, frozen=True, kw_only=True):
    """[sensors]: source of attitude and depth, "simulated", "stored", "i2c" or "none".

    imu, depth: which chips, "auto" or "none". mount_xyzw: board to body. position_deg: latitude and longitude of
    the dive, for the declination of its day (in place of calibration.declination_rad) and the field's strength.
    magnetometer: field = matrix (reading - offset), body frame. gyro_bias_radps_per_k: how the gyroscope's bias moves
    with its temperature, body frame.
    """

    name: str = "simulated"
    imu: str = "auto"
    depth: str = "auto"
    i2c_bus: Annotated[int, Meta(ge=0)] = 1
    mount_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)
    position_deg: tuple[float, float] | None = None
    water_density_kgpm3: Positive = 997.0
    gyro_bias_radps_per_k: Vector3 = (0.0, 0.0, 0.0)
    magnetometer_offset_t: Vector3 = (0.0, 0.0, 0.0)
    magnetometer_matrix: tuple[Vector3, Vector3, Vector3] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    def __post_init__(self) -> None:
        """Check the mount's quaternion."""
        check_unit("mount_xyzw", self.mount_xyzw)

    @property
    def magnetometer_calibration(self) -> MagnetometerCalibration:
        """The calibration of the magnetometer; one that changes nothing where none is configured."""
        return MagnetometerCalibration(np.array(self.magnetometer_offset_t), np.array(self.magnetometer_matrix))


class CalibrationConfig(Config, frozen=True, kw_only=True):
    """[calibration]: what NodeInfo carries. Metres and the camera frame: x right, y down, z forward.

    imu_m: place of the inertial unit. imu_delay_ns: stamp of an inertial sample minus its true time.
    """

    camera: CameraModel
    light_left_m: Vector3
    light_right_m: Vector3
    sigma_px: Positive = 0.7
    q_body_camera_xyzw: Quaternion = (0.5, 0.5, 0.5, 0.5)
    depth_port_m: Vector3 = (0.0, 0.0, 0.0)
    imu_m: Vector3 | None = None
    imu_delay_ns: Annotated[int, Meta(ge=-MAX_IMU_DELAY_NS, le=MAX_IMU_DELAY_NS)] | None = None
    declination_rad: float = 0.0
    tags: list[ArTag] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Check what NodeInfo would refuse."""
        check_unit("q_body_camera_xyzw", self.q_body_camera_xyzw)
        check_apart(self.light_left_m, self.light_right_m)
        apart_m = math.dist(self.light_left_m, self.light_right_m)
        if apart_m > LONGEST_BAR_M:
            raise ValueError(f"light_left_m, light_right_m: {apart_m:.6g} m apart; are they in millimetres?")


class RecordConfig(Config, frozen=True, kw_only=True):
    """[record]: the node's own log. Pictures: at most images_hz of them, JPEG of this quality.

    encoder: "camera" for the JPEG encoder that Pis before 5 have beside their camera; it costs no processor time.
    min_free_mb: where less is free, the oldest pictures are deleted, those of earlier dives first; 0: never.
    """

    directory: str = "dives"
    images_hz: Annotated[float, Meta(ge=0)] = 1.0
    image_quality: Annotated[int, Meta(ge=1, le=100)] = 90
    encoder: Literal["software", "camera"] = "software"
    min_free_mb: Annotated[int, Meta(ge=0)] = 200


class PreviewConfig(Config, frozen=True, kw_only=True):
    """[preview]: small pictures on the bus for a viewer."""

    rate_hz: Annotated[float, Meta(ge=0, le=10)] = 1.0
    width_px: Annotated[int, Meta(ge=16, le=1640)] = 410
    quality: Annotated[int, Meta(ge=1, le=100)] = 70


class StationTagsConfig(Config, frozen=True, kw_only=True):
    """[station_tags]: printed tags on line markers, which name the node's station. side_m: of the black square; 0: off.

    within_m: a tag further away is another station's.
    """

    side_m: Annotated[float, Meta(ge=0, le=1)] = 0.06
    within_m: Positive = 1.0


class PanelConfig(Config, frozen=True, kw_only=True):
    """[panel]: one button, lamp, buzzer, dive lights and leak probe at the Pi's pins, and a display; all optional.

    display: its chip, on the sensors' I2C bus.
    shutdown_command: the words of what a long hold of the button runs; [] for nothing.
    """

    button_pin: Pin | None = None
    lamp_pin: Pin | None = None
    buzzer_pin: Pin | None = None
    lights_pin: Pin | None = None
    leak_pin: Pin | None = None
    display: Literal["none", "ssd1306", "sh1106"] = "none"
    display_address: Annotated[int, Meta(ge=0x3C, le=0x3D)] = 0x3C
    shutdown_command: list[str] = field(default_factory=list)

    @property
    def pins(self) -> dict[str, int]:
        """The configured pins by field."""
        names = ("button_pin", "lamp_pin", "buzzer_pin", "lights_pin", "leak_pin")
        return {name: number for name in names if (number := getattr(self, name)) is not None}


class BlinkConfig(Config, frozen=True, kw_only=True):
    """[blink]: a lamp that blinks by a code, so that others know whose it is (protocol/blinking.py).

    code: another one for each node. lamp: which of the two is switched. pin: of its switch.
    """

    code: Annotated[int, Meta(ge=0, lt=len(DARK_SLOTS))]
    lamp: Literal["left", "right", "both"] = "left"
    pin: Pin


class FixedConfig(Config, frozen=True, kw_only=True):
    """[fixed]: a node that stands still, such as one on a tripod: its place and attitude in the frame of a net.

    p_m: of the camera's centre, north-east-down; q_xyzw: camera to north-east-down. sigma_m, sigma_rad: how well both
    are known, 1 sd of each axis. `buddyline net init` writes this table out of a short dive.
    """

    net: NodeId = "main"
    p_m: Vector3
    q_xyzw: Quaternion
    sigma_m: Annotated[float, Meta(ge=0)] = 0.003
    sigma_rad: Annotated[float, Meta(ge=0)] = 0.002

    def __post_init__(self) -> None:
        """Check the quaternion's norm."""
        check_unit("q_xyzw", self.q_xyzw)

    @property
    def place(self) -> FixedPlace:
        """The place as NodeInfo carries it."""
        return FixedPlace(
            net=self.net, p_m=self.p_m, q_xyzw=self.q_xyzw, sigma_m=self.sigma_m, sigma_rad=self.sigma_rad
        )


class PlaceConfig(Config, frozen=True, kw_only=True):
    """A file of a node's place alone, as `buddyline net init` writes it."""

    fixed: FixedConfig


class PowerConfig(Config, frozen=True, kw_only=True):
    """[power]: the battery gauge on sensors.i2c_bus, and what is left out when the node gets hot.

    address: of the chip; by default the first of its kind. shunt_ohm: of an INA219. channel, divider: of an ADS1115:
    its input, and the battery's voltage over the input's. cells: lithium-ion cells in series, to judge the charge.
    lower_load: leave out pictures, then every second trigger, before the processor slows down.
    """

    battery: Literal["none", "ina219", "ads1115"] = "none"
    address: int | None = None
    shunt_ohm: Positive = 0.1
    channel: Annotated[int, Meta(ge=0, le=3)] = 0
    divider: Annotated[float, Meta(ge=1)] = 1.0
    cells: Annotated[int, Meta(ge=1, le=20)] | None = None
    lower_load: bool = True

    @property
    def gauge_address(self) -> int:
        """The gauge's address on the bus."""
        return GAUGE_ADDRESSES[self.battery][0] if self.address is None else self.address

    def check(self) -> None:
        """Raise ConfigError for an address that the gauge cannot have."""
        known = GAUGE_ADDRESSES[self.battery]
        if self.address is not None and self.address not in known:
            allowed = f"0x{known[0]:02x} to 0x{known[-1]:02x}" if known else "no address"
            raise ConfigError(f"power.address = 0x{self.address:02x}: battery = {self.battery!r} takes {allowed}")


class SimulationConfig(Config, frozen=True, kw_only=True):
    """[simulation]: the world of the simulated camera and sensors; the same for all nodes.

    more_nodes: further nodes. fixed_nodes: which of all stand still. blinking: whether each node's left lamp blinks by
    a code of its own.
    """

    environment: str = "cavern"
    seed: Annotated[int, Meta(ge=0)] = 1
    start_ns: Annotated[int, Meta(ge=0)] = 1_764_000_000_000_000_000
    node_a: NodeId = "a"
    node_b: NodeId = "b"
    more_nodes: list[NodeId] = field(default_factory=list)
    fixed_nodes: list[NodeId] = field(default_factory=list)
    blinking: bool = False


class NodeConfig(Config, frozen=True, kw_only=True):
    """A whole node. status_file: its health report; "": in the runtime directory (protocol/statusfile.py).

    role: "camera" for a node without lamps. (A node of lamps alone runs no program: its NodeInfo comes from a file.)
    """

    node: NodeId
    role: Literal["full", "camera"] = "full"
    fixed: FixedConfig | None = None
    blink: BlinkConfig | None = None
    connect: str = "tcp/127.0.0.1:7447"
    namespace: Namespace = ""
    tls: Tls | None = None
    status_file: str = ""
    rate_hz: Annotated[float, Meta(ge=1e-6, le=200)] = 10.0
    camera: CameraConfig = field(default_factory=CameraConfig)
    exposure: ExposureConfig = field(default_factory=ExposureConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    calibration: CalibrationConfig | None = None
    record: RecordConfig = field(default_factory=RecordConfig)
    preview: PreviewConfig = field(default_factory=PreviewConfig)
    station_tags: StationTagsConfig = field(default_factory=StationTagsConfig)
    panel: PanelConfig = field(default_factory=PanelConfig)
    power: PowerConfig = field(default_factory=PowerConfig)
    simulation: SimulationConfig = field(default_factory=SimulationConfig)

    @property
    def trigger_period_ns(self) -> int:
        """Time between triggers."""
        return round(1e9 / self.rate_hz)

    @property
    def uses_i2c(self) -> bool:
        """Whether sensors or a battery gauge are on the I2C bus."""
        return self.sensors.name == "i2c" or self.power.battery != "none"

    def earth_field(self, stamp_ns: int) -> EarthField | None:
        """Return the Earth's field at sensors.position_deg; None if that is not given."""
        position_deg = self.sensors.position_deg
        return None if position_deg is None else earth_field(*position_deg, stamp_ns)

    def declination_rad(self, stamp_ns: int) -> float:
        """Return the declination: from position and day, else as configured."""
        here = self.earth_field(stamp_ns)
        if here is not None:
            return here.declination_rad
        return self.calibration.declination_rad if self.calibration else 0.0

    def _check_resolution(self, camera: CameraModel) -> None:
        """Raise for intrinsics of another picture size, which their principal point shows."""
        for name, found_px, size_px in (
            ("cx_px", camera.cx_px, self.camera.width_px),
            ("cy_px", camera.cy_px, self.camera.height_px),
        ):
            if abs(found_px - (size_px - 1) / 2) > OFF_CENTRE * size_px:
                raise ConfigError(
                    f"node {self.node}: calibration.camera.{name} = {found_px:g} is not near the middle of pictures "
                    f"of {self.camera.width_px}x{self.camera.height_px}: calibrate in the mode that dives"
                )

    def check_pins(self) -> None:
        """Raise ConfigError for a pin with two uses."""
        used = {number: "the I2C bus" for number in I2C_PINS.get(self.sensors.i2c_bus, ()) if self.uses_i2c}
        pins = {f"panel.{name}": number for name, number in self.panel.pins.items()}
        if self.blink is not None:
            pins["blink.pin"] = self.blink.pin
        for name, number in pins.items():
            if number in used:
                raise ConfigError(f"{name} = {number}: this pin is in use by {used[number]}")
            used[number] = name

    def node_info(self, stamp_ns: int, software: str, sha256: str, row_time_ns: int) -> NodeInfo:
        """Return NodeInfo from [calibration]; raise ConfigError if there is none."""
        calibration = self.calibration
        if calibration is None:
            raise ConfigError(
                f"node {self.node}: camera {self.camera.name!r} needs a [calibration] table "
                "(camera, light_left_m, light_right_m); see node/examples"
            )
        self._check_resolution(calibration.camera)
        return NodeInfo(
            node=self.node,
            stamp_ns=stamp_ns,
            width_px=self.camera.width_px,
            height_px=self.camera.height_px,
            camera=calibration.camera,
            light_left_m=calibration.light_left_m,
            light_right_m=calibration.light_right_m,
            sigma_px=calibration.sigma_px,
            trigger_period_ns=self.trigger_period_ns,
            row_time_ns=row_time_ns,
            q_body_camera_xyzw=calibration.q_body_camera_xyzw,
            depth_port_m=calibration.depth_port_m,
            imu_m=UNSET if calibration.imu_m is None else calibration.imu_m,
            imu_delay_ns=UNSET if calibration.imu_delay_ns is None else calibration.imu_delay_ns,
            declination_rad=self.declination_rad(stamp_ns),
            software=software,
            config_sha256=sha256,
            tags=calibration.tags or UNSET,
        )

    def in_net(self, info: NodeInfo) -> NodeInfo:
        """Return a NodeInfo with the configured role, place and blinking, where they are not the usual ones."""
        role: Role | UnsetType = info.role if self.role == "full" else self.role
        blink: Blink | UnsetType = info.blink
        if self.blink is not None:
            blink = Blink(code=self.blink.code, lamp=self.blink.lamp, slot_ns=self.trigger_period_ns)
        return replace(info, role=role, fixed=info.fixed if self.fixed is None else self.fixed.place, blink=blink)

    def check_encoder(self) -> None:
        """Raise ConfigError for an encoder that the camera does not have."""
        if self.record.encoder == "camera" and self.camera.name != "picamera2":
            raise ConfigError(f"record.encoder = 'camera': camera {self.camera.name!r} has none, only 'picamera2' has")


def load_node_config(path: Path | str) -> NodeConfig:
    """Read a node's TOML file; raise ConfigError naming file, field and value."""
    config = load_config(path, NodeConfig)
    try:
        config.check_pins()
        config.check_encoder()
        config.power.check()
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return config if config.tls is None else replace(config, tls=config.tls.beside(path))
