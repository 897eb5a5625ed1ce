"""Simulated surveys: two nodes leapfrog along a line, solved by the true solver, with truth beside it.

Candidates come from node.sim's forward camera; sensors err as cheap ones do: a compass with what calibration
leaves of its iron, slow wander and noise, at some stations disturbed; a gauge that drifts.
"""

from __future__ import annotations

import math
import subprocess
from dataclasses import dataclass, field

import numpy as np
from buddyline.node.sim import rotation
from buddyline.node.sim.camera import pinhole, project
from buddyline.node.sim.rig import Q_BODY_CAMERA, R_BODY_CAMERA
from buddyline.protocol.messages import Attitude, Blob, Candidates, Depth, Imu, Mark, NodeInfo
from buddyline.solver_service.config import SolveConfig
from buddyline.solver_service.core import SolverCore
from buddyline.tools.survey.derive import Derived
from buddyline.tools.survey.gauges import adjust_gauges
from buddyline.tools.survey.project import About, AdjustSettings, Leg, Project
from msgspec.structs import replace

from tests.processes import PATIENCE_S

PERIOD_NS = 500_000_000
START_NS = 1_777_629_600_000_000_000  # 2026-05-01T10:00:00Z
WIDTH, HEIGHT = 820, 616
NODES = ("a", "b")
FIELD_T, DIP_RAD = 48e-6, math.radians(60)


@dataclass(frozen=True)
class Flaws:
    """What is wrong with the sensors, all 1 sd. compass_deg: of an azimuth, all its causes together, as stated."""

    sigma_px: float = 0.7
    calibration_m: float = 0.001
    centering_m: float = 0.01
    compass_deg: float = 1.5
    tilt_deg: float = 1.0
    depth_m: float = 0.025
    disturbed_share: float = 0.0
    false_lights: int = 2


@dataclass
class SurveyCourse:
    """Stations (n, 3), NED metres by magnetic north, and legs (from, to, rear node) by index, in order."""

    stations_m: np.ndarray
    legs: list[tuple[int, int, int]]
    names: list[str]
    marks: dict[tuple[int, int], str] = field(default_factory=dict)  # (leg number, node): station's name

    @property
    def length_m(self):
        return sum(float(np.linalg.norm(self.stations_m[j] - self.stations_m[i])) for i, j, _ in self.legs)


def line(rng, legs):
    """An open traverse that wanders, as a cave line does."""
    heading, places = rng.uniform(-math.pi, math.pi), [np.array([0.0, 0.0, 12.0])]
    for _ in range(legs):
        heading += rng.normal(0, 0.5)
        places.append(_next(rng, places[-1], heading, rng.uniform(3.0, 9.0)))
    return SurveyCourse(np.array(places), [(k, k + 1, k % 2) for k in range(legs)], [str(k) for k in range(legs + 1)])


def _next(rng, place, heading, range_m):
    climb = float(np.clip(rng.normal(0, 0.18), -0.4, 0.4))
    step = range_m * np.array(
        [math.cos(heading) * math.cos(climb), math.sin(heading) * math.cos(climb), -math.sin(climb)]
    )
    there = place + step
    there[2] = np.clip(there[2], 4.0, 30.0)
    return there


def loop(rng, legs):
    """A closed traverse: the last leg ends at the first station, which a mark says."""
    radius = 6.0 / (2 * math.sin(math.pi / legs))
    turn = rng.uniform(-math.pi, math.pi)
    angles = turn + 2 * math.pi * (np.arange(legs) + rng.uniform(-0.2, 0.2, legs)) / legs
    radii = radius * rng.uniform(0.85, 1.15, legs)
    depth = 12 + rng.normal(0, 0.9, legs)
    places = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), depth])
    steps = [(k, (k + 1) % legs, k % 2) for k in range(legs)]
    # The front node of the last leg closes the loop: it is at the first station.
    return SurveyCourse(places, steps, [str(k) for k in range(legs)], {(legs - 1, 1 - (legs - 1) % 2): "0"})


class _Slow:
    """A wandering error: Ornstein-Uhlenbeck, unit variance, that forgets within tau_s."""

    def __init__(self, rng, tau_s):
        self.rng, self.tau_s, self.value, self.t_s = rng, tau_s, rng.normal(), 0.0

    def at(self, t_s):
        keep = math.exp(-(t_s - self.t_s) / self.tau_s)
        self.value = keep * self.value + math.sqrt(max(1 - keep**2, 0)) * self.rng.normal()
        self.t_s = t_s
        return self.value


class _Node:
    def __init__(self, rng, index, flaws):
        self.rng, self.name, self.flaws = rng, NODES[index], flaws
        self.lights = np.array([[-0.44, 0, 0], [0.44, 0, 0]]) + rng.normal(0, 0.004, (2, 3))
        self.port = np.array([0.0, 0.06, -0.12])
        self.camera = pinhole(WIDTH, HEIGHT)
        yaw = math.radians(flaws.compass_deg)
        # Shares of the variance: constant, turning with the heading, slow, new in every sample.
        self.offset = rng.normal(0, yaw * math.sqrt(0.1))
        self.iron = rng.normal(0, yaw * math.sqrt(0.4), 2)
        self.slow = _Slow(rng, 60.0)
        self.tilts = [_Slow(rng, 15.0), _Slow(rng, 15.0)]
        # Zeroed at the surface, a gauge errs by drift and noise more than by a constant.
        self.gauge = rng.normal(0, flaws.depth_m * math.sqrt(0.1))
        self.drift = _Slow(rng, 120.0)
        self.disturbance = 0.0
        # Of its own, so that the other errors stay the same without it: zero 0.1 deg/s that wanders, scale 0.3 %.
        self.felt = np.random.default_rng(int(1e9 * abs(self.lights).sum()))
        self.gyro_zero, self.gyro_scale = self.felt.normal(0, math.radians(0.1), 3), self.felt.normal(1, 0.003)
        self.gyro_wander = [_Slow(self.felt, 300.0) for _ in range(3)]
        self.turned = None
        calibrated = self.lights + rng.normal(0, flaws.calibration_m, (2, 3))
        self.info = NodeInfo(
            node=self.name,
            stamp_ns=START_NS,
            width_px=WIDTH,
            height_px=HEIGHT,
            camera=self.camera,
            light_left_m=tuple(calibrated[0].tolist()),
            light_right_m=tuple(calibrated[1].tolist()),
            sigma_px=flaws.sigma_px,
            trigger_period_ns=PERIOD_NS,
            q_body_camera_xyzw=Q_BODY_CAMERA,
            depth_port_m=tuple(self.port.tolist()),
        )

    def arrive(self, disturbance):
        """Be held again, at a place whose iron turns the compass by so many degrees (None: at random)."""
        self.disturbance = disturbance or 0.0
        if disturbance is None and self.rng.random() < self.flaws.disturbed_share:
            self.disturbance = float(self.rng.choice([-1, 1]) * self.rng.uniform(6, 20))

    def sensors(self, stamp_ns, place, R_ned_body):
        t_s, rng, flaws = (stamp_ns - START_NS) / 1e9, self.rng, self.flaws
        yaw, tilt = math.radians(flaws.compass_deg), math.radians(flaws.tilt_deg)
        heading = math.atan2(R_ned_body[1, 0], R_ned_body[0, 0])
        error = self.offset + self.iron @ [math.cos(heading), math.sin(heading)]
        error += yaw * (math.sqrt(0.4) * self.slow.at(t_s) + math.sqrt(0.1) * rng.normal())
        error += math.radians(self.disturbance)
        tilts = [tilt * (math.sqrt(0.7) * slow.at(t_s) + math.sqrt(0.3) * rng.normal()) for slow in self.tilts]
        R = rotation.from_euler(0, 0, error) @ R_ned_body @ rotation.from_euler(tilts[0], tilts[1], 0)
        attitude = Attitude(
            node=self.name, stamp_ns=stamp_ns, q_ned_body_xyzw=rotation.to_quaternion(R), sigma_rad=(tilt, tilt, yaw)
        )
        port_m = place[2] + float((R_ned_body @ R_BODY_CAMERA @ self.port)[2])
        wrong = self.gauge + flaws.depth_m * (math.sqrt(0.6) * self.drift.at(t_s) + math.sqrt(0.3) * rng.normal())
        depth = Depth(node=self.name, stamp_ns=stamp_ns, depth_m=port_m + wrong, sigma_m=flaws.depth_m)
        strength = FIELD_T * (1 + 0.008 * abs(self.disturbance) + 0.01 * rng.normal())
        dip = DIP_RAD + math.radians(0.5 * self.disturbance + 0.5 * rng.normal())
        mag = strength * (R_ned_body.T @ [math.cos(dip), 0.0, math.sin(dip)])
        accel = R_ned_body.T @ [0.0, 0.0, -9.80665] + rng.normal(0, 0.05, 3)
        rng.normal(size=3)  # So that the other errors stay those of earlier figures.
        gyro = self.gyro(t_s, R_ned_body)
        imu = Imu(
            node=self.name,
            stamp_ns=stamp_ns,
            accel_mps2=tuple(accel.tolist()),
            gyro_radps=tuple(gyro.tolist()),
            mag_t=tuple(mag.tolist()),
        )
        return attitude, depth, imu

    def gyro(self, t_s, R_ned_body):
        """The mean rate since the last sample, with this gyroscope's errors."""
        before_s, before = self.turned or (t_s - PERIOD_NS / 1e9, R_ned_body)
        self.turned = t_s, R_ned_body
        step_s = t_s - before_s
        x, y, z, w = rotation.to_quaternion(before.T @ R_ned_body)
        axis, angle = np.array([x, y, z]), 2 * math.atan2(math.hypot(x, y, z), w)
        rate = axis / max(np.linalg.norm(axis), 1e-12) * angle / step_s
        slow = math.radians(0.003) * np.array([one.at(t_s) for one in self.gyro_wander])
        noise = math.radians(0.01) / math.sqrt(step_s) * self.felt.normal(size=3)
        return self.gyro_scale * rate + self.gyro_zero + slow + noise

    def frame(self, stamp_ns, seq, place, R_ned_body, other, other_place, other_R):
        """What its camera sees of the other's lights, among other things."""
        lights_ned = other_place + other.lights @ (other_R @ R_BODY_CAMERA).T
        pixels = project((lights_ned - place) @ (R_ned_body @ R_BODY_CAMERA), self.camera)
        rng, flaws = self.rng, self.flaws
        gross = (rng.random((2, 1)) < 0.03) * rng.normal(0, 6.0, (2, 2))
        pixels = pixels + rng.normal(0, flaws.sigma_px, (2, 2)) + gross
        pixels = np.concatenate(
            [pixels[rng.random(2) > 0.03], rng.uniform((0, 0), (WIDTH - 1, HEIGHT - 1), (flaws.false_lights, 2))]
        )
        inside = [(u, v) for u, v in pixels.tolist() if -0.5 <= u <= WIDTH - 0.5 and -0.5 <= v <= HEIGHT - 0.5]
        blobs = [
            Blob(u_px=u, v_px=v, sigma_px=flaws.sigma_px, area_px=60.0, peak=255.0, elongation=1.0) for u, v in inside
        ]
        return replace(self.dark(stamp_ns, seq), blobs=blobs)

    def dark(self, stamp_ns, seq):
        """A frame without candidates."""
        return Candidates(
            node=self.name,
            stamp_ns=stamp_ns,
            trigger=stamp_ns // PERIOD_NS,
            seq=seq,
            boot="x",
            width_px=WIDTH,
            height_px=HEIGHT,
            blobs=[],
        )


def dive(course, rng, flaws=None, rest_s=10.0, swim_s=8.0, disturb=None, pause_s=0.0):
    """Return all messages of a leapfrog survey along a course, poses and rejections of the true solver included.

    disturb: of a node's index and a station's, to its compass's error there (degrees). After each rest the nodes
    see nothing of each other for swim_s, and for pause_s more, of which there are no messages.
    """
    flaws = flaws or Flaws()
    nodes = [_Node(rng, 0, flaws), _Node(rng, 1, flaws)]
    core = SolverCore(SolveConfig().settings("test"), [("a", "b")])
    out = []

    def take(*messages):
        for message in messages:
            out.append(message)
            if not isinstance(message, Imu | Mark):
                out.extend(core.handle(message))

    take(*(node.info for node in nodes))
    stamp_ns, seq = START_NS, 0
    stands = [None, None]
    for number, (start, end, rear) in enumerate(course.legs):
        front = 1 - rear
        for index, station in ((rear, start), (front, end)):
            if stands[index] != station:
                stands[index] = station
                nodes[index].arrive(disturb and disturb(index, station))
        held = {i: course.stations_m[stands[i]] + rng.normal(0, flaws.centering_m, 3) for i in (0, 1)}
        way = held[1] - held[0]
        facing = {}
        for i, sign in ((0, 1.0), (1, -1.0)):
            look = sign * way
            facing[i] = rotation.from_euler(
                rng.normal(0, 0.07),
                math.atan2(-look[2], math.hypot(look[0], look[1])) + rng.normal(0, 0.06),
                math.atan2(look[1], look[0]) + rng.normal(0, 0.08),
            )
        # The front node swims up to its station for the last three seconds, in sight; then both rest.
        for k in range(round((3.0 + rest_s) * 1e9 / PERIOD_NS)):
            late_s = 3.0 - k * PERIOD_NS / 1e9
            place = dict(held)
            if late_s > 0:
                place[front] = held[front] - 0.4 * late_s * (held[front] - held[rear]) / np.linalg.norm(way)
            sway = {i: rotation.from_euler(*rng.normal(0, 0.01, 3)) for i in (0, 1)}
            R = {i: facing[i] @ sway[i] for i in (0, 1)}
            for i in (0, 1):
                take(*nodes[i].sensors(stamp_ns, place[i], R[i]))
            if late_s <= 0 and k == 10:
                for i in (0, 1):
                    if (name := course.marks.get((number, i))) is not None:
                        take(Mark(node=NODES[i], stamp_ns=stamp_ns, name=name))
            for i in (0, 1):
                take(nodes[i].frame(stamp_ns, seq, place[i], R[i], nodes[1 - i], place[1 - i], R[1 - i]))
            stamp_ns += PERIOD_NS
            seq += 1
        # While one node passes the other they see nothing of each other.
        for _ in range(round(swim_s * 1e9 / PERIOD_NS)):
            for i in (0, 1):
                take(*nodes[i].sensors(stamp_ns, held[i], facing[i]), nodes[i].dark(stamp_ns, seq))
            stamp_ns += PERIOD_NS
            seq += 1
        stamp_ns += round(pause_s * 1e9 / PERIOD_NS) * PERIOD_NS
    out.extend(core.flush())
    return out


def by_hand(course, rng, disturbed_deg=None, compass_deg=1.5, tape_m=0.086, depth_m=0.1):
    """Return all stations as compass, tape and gauge give them, NED, by index: one foresight a leg (MNemoLink's sds).

    disturbed_deg: stations' indices to the error of any compass there. A loop's end is not made to close.
    """
    disturbed_deg = disturbed_deg or {}
    place = course.stations_m[course.legs[0][0]].copy()
    found = {course.legs[0][0]: place.copy()}
    depths = {k: z + rng.normal(0, depth_m) for k, z in enumerate(course.stations_m[:, 2])}
    for start, end, _ in course.legs:
        way = course.stations_m[end] - course.stations_m[start]
        tape = np.linalg.norm(way) + rng.normal(0, tape_m)
        wrong_deg = rng.normal(0, compass_deg) + disturbed_deg.get(start, 0.0)
        azimuth = math.atan2(way[1], way[0]) + math.radians(wrong_deg)
        rise = depths[end] - depths[start]
        run = math.sqrt(max(tape**2 - rise**2, 0))
        place += (run * math.cos(azimuth), run * math.sin(azimuth), rise)
        found[end] = place.copy()
    return found


def readings_of(course, rng, compass_deg=1.0, tape_m=0.02, depth_m=0.02):
    """Return a course's legs as Leg rows with normal errors of exactly these sds, without cameras or solver."""
    legs = []
    for number, (start, end, rear) in enumerate(course.legs):
        way = course.stations_m[end] - course.stations_m[start]
        azimuth = math.degrees(math.atan2(way[1], way[0]))
        distance = float(np.linalg.norm(way))
        slope = math.degrees(math.asin(-way[2] / distance))
        legs.append(
            Leg(
                from_=course.names[start],
                to=course.names[end],
                from_node=NODES[rear],
                to_node=NODES[1 - rear],
                start_ns=START_NS + number * 60 * 10**9,
                end_ns=START_NS + number * 60 * 10**9 + 10**10,
                distance_m=float(distance + tape_m * rng.normal()),
                distance_sigma_m=max(tape_m, 1e-4),
                azimuth_deg=float(azimuth + compass_deg * rng.normal()) % 360,
                azimuth_sigma_deg=max(compass_deg, 0.01),
                back_azimuth_deg=float(azimuth + 180 + compass_deg * rng.normal()) % 360,
                back_azimuth_sigma_deg=max(compass_deg, 0.01),
                inclination_deg=slope + 0.5 * (compass_deg > 0) * rng.normal(),
                inclination_sigma_deg=0.5,
                back_inclination_deg=-slope + 0.5 * (compass_deg > 0) * rng.normal(),
                back_inclination_sigma_deg=0.5,
                depth_from_m=float(course.stations_m[start][2] + depth_m * rng.normal()),
                depth_from_sigma_m=max(depth_m, 1e-4),
                depth_to_m=float(course.stations_m[end][2] + depth_m * rng.normal()),
                depth_to_sigma_m=max(depth_m, 1e-4),
                fixes=30,
            )
        )
    return legs


def project_of(legs, depth="absolute", points=(), **tables):
    """Return a project of these legs, its stations with them."""
    derived = Derived()
    derived.legs = list(legs)
    tables.setdefault("survey", About(name="demo", title="Demo cave", team=["A. Diver", "B. Diver"]))
    return Project(
        leg=list(legs),
        point=list(points),
        station=derived.stations(adjust_gauges(derived.legs).depths),
        adjust=AdjustSettings(depth=depth),
        **tables,
    )


def enu(vector_ned):
    """Return east, north, up of north, east, down."""
    return np.array([vector_ned[1], vector_ned[0], -vector_ned[2]])


def cavern(directory, text, name="survey.svx"):
    """Run the real cavern: its warnings, (H, V) of its loop or None, and coordinates by station."""
    (directory / name).write_text(text, newline="")
    done = subprocess.run(
        ["cavern", "-w", "-q", name], cwd=directory, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    said = [row for row in (done.stdout + done.stderr).splitlines() if "warning" in row or "error" in row]
    stem = name.rpartition(".")[0]
    words = (directory / f"{stem}.err").read_text().split() if done.returncode == 0 else []
    ratios = [(float(words[i + 1]), float(words[i + 3])) for i, word in enumerate(words) if word == "H:"]
    return said, ratios, coordinates(directory / f"{stem}.3d") if done.returncode == 0 else {}


def coordinates(file):
    """Return the stations of a .3d file by their last name (survex writes them to the centimetre)."""
    dump = subprocess.run(["dump3d", str(file)], capture_output=True, text=True, timeout=PATIENCE_S, check=True).stdout
    found = {}
    for row in dump.splitlines():
        if row.startswith("NODE"):
            name = row.partition("[")[2].partition("]")[0].partition("@")[0].rpartition(".")[2]
            found[name] = np.array([float(word) for word in row.split()[1:4]])
    return found


def renamed(message, **names):
    """Return a message of other nodes: names of the old ones to the new."""
    fields = {
        field: names.get(value, value)
        for field in ("node", "node_a", "node_b")
        if (value := getattr(message, field, None))
    }
    return replace(message, **fields)
