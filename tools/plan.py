"""`buddyline plan`: predict, before a dive, up to which range two nodes measure well."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from buddyline.node.config import load_node_config
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CameraModel, NodeInfo
from buddyline.tools.bound import pose_bounds
from buddyline.tools.dives import load_info
from buddyline.tools.draw.figures import new_figure, save
from buddyline.tools.evaluation.rotation import Floats, multiply, normalized
from buddyline.tools.newfile import check_new

RANGES_M: Final = (1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0, 25.0, 30.0)
FIELD_OF_VIEW_RAD: Final = math.radians(48.8)
# A black object is visible down to 2 % contrast (Koschmieder): visibility times attenuation is ln 50.
_KOSCHMIEDER: Final = math.log(50.0)
# Light of a dive lamp at 1 m over the faintest light that a detector finds; see `light_reach_m`.
LAMP_MARGIN: Final = 1e6
# Divers face each other with about this error in rotation, and with this tangent off the picture's centre (1 sd).
_TILT_RAD: Final = math.radians(12.0)
_ASIDE: Final = 0.06
_ATTITUDES: Final = 16

# Half of it is planned, too.
LEAST_BASELINE_M: Final = 0.01


@dataclass(frozen=True)
class PlannedRange:
    """The expected RMS errors at one range. azimuth_error_rad: of compass and picture together.

    in_view: both lights fit into the picture. lit: the lights are bright enough for the water. within: all tolerances
    are met, in_view and lit.
    """

    range_m: float
    range_error_m: float
    position_error_m: float
    azimuth_error_rad: float
    rotation_error_rad: float
    in_view: bool
    lit: bool
    within: bool


@dataclass(frozen=True)
class Plan:
    """Errors by range, and the ranges up to which the tolerances are met.

    ends_m: for "range", "position" and "azimuth": the range at which the error exceeds the tolerance; None if it never
    does up to the last range, 0 if it does at the first. reach_m: where the lights become too faint. near_m: at shorter
    ranges the lights do not both fit into the picture. far_m, limit: the smallest of these ends, and its name.
    """

    rows: list[PlannedRange]
    ends_m: dict[str, float | None]
    reach_m: float
    near_m: float
    far_m: float | None
    limit: str


def run(args: argparse.Namespace) -> int:
    """Print the plan; return 0."""
    for name in ("baseline", "visibility", "sigma_px", "range_tolerance", "position_tolerance", "azimuth_tolerance"):
        value = getattr(args, name)
        if value is not None and not 0 < value < math.inf:
            raise BuddylineError(f"--{name.replace('_', '-')} {value}: give a number above 0")
    if args.baseline < LEAST_BASELINE_M:
        raise BuddylineError(f"--baseline {args.baseline}: give {LEAST_BASELINE_M:g} m at least")
    if not 0 <= args.compass_deg < 90:
        raise BuddylineError(f"--compass-deg {args.compass_deg}: give 0 to 90")
    if args.plot is not None:
        check_new(args.plot)
    info = described(args.camera)
    tolerances = {
        "range": args.range_tolerance,
        "position": args.position_tolerance,
        "azimuth": math.radians(args.azimuth_tolerance),
    }
    sigma_px = args.sigma_px or info.sigma_px
    reach_m = math.inf if args.visibility is None else light_reach_m(args.visibility)
    spacings = {}
    for baseline_m in (share * args.baseline for share in (0.5, 0.75, 1.0, 1.5, 2.0)):
        lights = with_baseline(info, baseline_m)
        spacings[baseline_m] = plan(lights, sigma_px, math.radians(args.compass_deg), reach_m, tolerances)
    chosen = spacings[args.baseline]
    if args.json:
        print(json.dumps(as_dict(chosen, spacings), allow_nan=False))
    else:
        print(as_text(chosen, spacings, args.baseline, args.visibility, sigma_px))
    if args.plot is not None:
        draw(spacings, tolerances["position"], reach_m, args.plot)
    return 0


def described(path: str | None) -> NodeInfo:
    """Return the camera's NodeInfo from a node's configuration, a JSON file or a log; None: the default camera."""
    if path is not None and Path(path).suffix != ".toml":
        return load_info(path)
    width_px, height_px = 820, 616
    if path is not None:
        config = load_node_config(path)
        if config.calibration is not None:
            return config.node_info(0, "", "", 0)
        width_px, height_px = config.camera.width_px, config.camera.height_px
    f_px = width_px / 2 / math.tan(FIELD_OF_VIEW_RAD / 2)
    return NodeInfo(
        node="a",
        stamp_ns=0,
        width_px=width_px,
        height_px=height_px,
        camera=CameraModel(
            model="pinhole",
            fx_px=f_px,
            fy_px=f_px,
            cx_px=(width_px - 1) / 2,
            cy_px=(height_px - 1) / 2,
            distortion=[0.0] * 5,
        ),
        light_left_m=(-0.44, 0.0, 0.0),
        light_right_m=(0.44, 0.0, 0.0),
        sigma_px=0.7,
        trigger_period_ns=100_000_000,
    )


def with_baseline(info: NodeInfo, baseline_m: float) -> NodeInfo:
    """Return the node with its lights on the camera's x axis, baseline_m apart."""
    half_m = baseline_m / 2
    return msgspec.structs.replace(info, light_left_m=(-half_m, 0.0, 0.0), light_right_m=(half_m, 0.0, 0.0))


def light_reach_m(visibility_m: float) -> float:
    """Return the range at which a lamp becomes too faint, m.

    Its light falls as exp(-c r) / r^2 (Allard), with c = ln 50 / visibility. In clear water the square of the range
    dominates, in turbid water the attenuation. LAMP_MARGIN covers lamp, exposure and detector, and is a rough guess:
    in turbid water ten times more light gives a seventh more range. In simulated lakes, where scattered light also
    arrives, lights are found 1.5 times as far away.
    """
    attenuation_per_m = _KOSCHMIEDER / visibility_m
    near_m, far_m = 0.01, 1e3
    for _ in range(60):
        middle_m = math.sqrt(near_m * far_m)
        if attenuation_per_m * middle_m + 2.0 * math.log(middle_m) < math.log(LAMP_MARGIN):
            near_m = middle_m
        else:
            far_m = middle_m
    return near_m


def expected(info: NodeInfo, sigma_px: float, ranges_m: Floats) -> Floats:
    """Return RMS errors (n, 4) at ranges (n,): range and position (m), bearing across and rotation (rad).

    They are Cramér-Rao bounds for two equal nodes that face each other, averaged over typical attitudes of divers.
    """
    rng = np.random.default_rng(7)
    direction = np.column_stack([rng.normal(0.0, _ASIDE, (_ATTITUDES, 2)), np.ones(_ATTITUDES)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    tilt_rad = rng.normal(0.0, _TILT_RAD, (_ATTITUDES, 3)) * (0.5, 1.0, 0.5)
    q = normalized(multiply(np.column_stack([0.5 * tilt_rad, np.ones(_ATTITUDES)]), np.array([[0.0, 1.0, 0.0, 0.0]])))
    t_m = ranges_m[:, None, None] * direction
    qs = np.broadcast_to(q, (len(ranges_m), *q.shape))
    covariances = pose_bounds(t_m.reshape(-1, 3), qs.reshape(-1, 4), info, info, sigma_px)
    covariances = covariances.reshape(len(ranges_m), _ATTITUDES, 6, 6)
    along = np.einsum("ai,naij,aj->na", direction, covariances[..., :3, :3], direction)
    position = np.trace(covariances[..., :3, :3], axis1=2, axis2=3)
    across = (position - along) / 2.0 / ranges_m[:, None] ** 2
    rotation = np.trace(covariances[..., 3:, 3:], axis1=2, axis2=3)
    errors: Floats = np.sqrt(np.stack([along, position, across, rotation], axis=-1).mean(axis=1))
    return errors


def plan(info: NodeInfo, sigma_px: float, compass_rad: float, reach_m: float, tolerances: dict[str, float]) -> Plan:
    """Return the plan for two equal nodes. tolerances: RMS, of "range" and "position" (m) and "azimuth" (rad)."""
    length_m = math.dist(info.light_left_m, info.light_right_m)
    near_m = 1.1 * length_m / 2 / math.tan(math.atan(info.width_px / 2 / info.camera.fx_px))
    errors = expected(info, sigma_px, np.array(RANGES_M))
    # The azimuth has the compass's error and the bearing's.
    errors[:, 2] = np.hypot(errors[:, 2], compass_rad)
    rows = []
    for range_m, (along_m, position_m, azimuth_rad, rotation_rad) in zip(RANGES_M, errors.tolist(), strict=True):
        in_view, lit = range_m >= near_m, range_m <= reach_m
        good = all(e <= t for e, t in zip((along_m, position_m, azimuth_rad), tolerances.values(), strict=True))
        within = good and in_view and lit
        rows.append(PlannedRange(range_m, along_m, position_m, azimuth_rad, rotation_rad, in_view, lit, within))
    ends_m = {name: _end_m(errors[:, i].tolist(), limit) for i, (name, limit) in enumerate(tolerances.items())}
    known = {name: end_m for name, end_m in ends_m.items() if end_m is not None}
    if math.isfinite(reach_m):
        known["reach"] = reach_m
    limit = min(known, key=lambda name: known[name], default="")
    return Plan(rows, ends_m, reach_m, near_m, known.get(limit), limit)


def _end_m(errors: list[float], tolerance: float) -> float | None:
    """Return the range at which errors exceed the tolerance, log-interpolated in RANGES_M; None if they never do."""
    if errors[0] > tolerance:
        return 0.0
    for i in range(1, len(errors)):
        if errors[i] > tolerance:
            share = math.log(tolerance / errors[i - 1]) / math.log(errors[i] / errors[i - 1])
            return float(RANGES_M[i - 1] * (RANGES_M[i] / RANGES_M[i - 1]) ** share)
    return None


def as_dict(chosen: Plan, spacings: dict[float, Plan]) -> dict[str, Any]:
    """Return the plan as JSON values; an infinite reach is null."""

    def plain(one: Plan) -> dict[str, Any]:
        return asdict(one) | {"reach_m": one.reach_m if math.isfinite(one.reach_m) else None}

    return plain(chosen) | {
        "by_baseline": [
            {"baseline_m": spacing} | {k: v for k, v in plain(one).items() if k != "rows"}
            for spacing, one in spacings.items()
        ]
    }


def as_text(
    chosen: Plan, spacings: dict[float, Plan], baseline_m: float, visibility_m: float | None, sigma_px: float
) -> str:
    """Return the plan for a person."""
    lines = [
        f"lights {baseline_m:g} m apart, located to {sigma_px:g} px (1 sd; --sigma-px): RMS errors to expect "
        "(the Cramér-Rao bound; azimuth with the compass)",
        f"{'at, m':>9} {'range, m':>9} {'position, m':>12} {'azimuth, deg':>13} {'rotation, deg':>14}",
    ]
    for row in chosen.rows:
        note = "" if row.in_view else "  the lights do not both fit the picture"
        note = note if row.lit else "  too faint"
        lines.append(
            f"{row.range_m:9g} {row.range_error_m:9.3f} {row.position_error_m:12.3f}"
            f" {math.degrees(row.azimuth_error_rad):13.2f} {math.degrees(row.rotation_error_rad):14.2f}"
            f"  {'good' if row.within else '-'}{note}"
        )
    lines += [
        "",
        "where it ends, m, by the spacing of the lights (reach: farther they are too faint)",
        f"{'spacing':>9} {'from':>6} {'range':>7}",
    ]
    lines[-1] += f" {'position':>9} {'azimuth':>8} {'reach':>7}  good up to"
    for spacing, one in spacings.items():
        ends = [_far(one.ends_m[name]) for name in ("range", "position", "azimuth")]
        reach = f"{one.reach_m:.1f}" if math.isfinite(one.reach_m) else "-"
        far = f"{one.far_m:.1f} m, by {one.limit}" if one.far_m is not None else f"more than {RANGES_M[-1]:g} m"
        lines.append(f"{spacing:9g} {one.near_m:6.1f} {ends[0]:>7} {ends[1]:>9} {ends[2]:>8} {reach:>7}  {far}")
    if chosen.limit == "reach":
        geometry = [end_m for end_m in chosen.ends_m.values() if end_m is not None]
        beyond = f"would do up to {min(geometry):.1f} m" if geometry else f"would do beyond {RANGES_M[-1]:g} m"
        lines += [
            "",
            f"where a diver sees {visibility_m:g} m far, the lights reach {chosen.reach_m:.1f} m; "
            f"geometry {beyond}: wider lights gain nothing",
        ]
    return "\n".join(lines)


def _far(end_m: float | None) -> str:
    return f">{RANGES_M[-1]:g}" if end_m is None else f"{end_m:.1f}"


def draw(spacings: dict[float, Plan], tolerance_m: float, reach_m: float, path: Path) -> None:
    """Draw position errors by range, a line for each spacing of the lights."""
    figure, (axis,) = new_figure(7.0, 4.2)
    for spacing, one in spacings.items():
        rows = [row for row in one.rows if row.in_view]
        axis.loglog(
            [row.range_m for row in rows], [row.position_error_m for row in rows], label=f"lights {spacing:g} m"
        )
    axis.axhline(tolerance_m, color="0.4", linestyle="--", label="tolerance")
    if math.isfinite(reach_m):
        axis.axvline(reach_m, color="tab:brown", linestyle=":", label="lights too faint")
    axis.set(xlabel="range, m", ylabel="position error, RMS, m")
    axis.legend()
    save(figure, path)
