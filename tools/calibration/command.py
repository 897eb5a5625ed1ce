"""`buddyline calibrate`: a node's camera, lights, magnetometer and gyroscope, and two nodes' clocks.

Poor data is refused.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.options import above_zero, finite
from buddyline.tools.arguments import subcommand
from buddyline.tools.client import add_client_arguments, client_config
from buddyline.tools.newfile import check_new, write_new

if TYPE_CHECKING:
    import numpy as np
    from buddyline.protocol.messages import NodeInfo
    from buddyline.tools.calibration.board import Board

log = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="WHAT")

    def add(text: str, runs: Callable[[argparse.Namespace], int | None], example: str) -> argparse.ArgumentParser:
        name = example.split(maxsplit=1)[0]
        kind = subcommand(kinds, name, text, f"calibrate {example}")
        kind.set_defaults(calibrate=runs)
        if runs in (_board, _camera):
            kind.add_argument("--columns", type=int, default=9, help="squares across; default 9")
            kind.add_argument("--rows", type=int, default=6, help="squares up; default 6")
            kind.add_argument(
                "--square-mm", type=finite, default=30.0, help="side of a square, as measured; default 30"
            )
        if runs in (_camera, _lights, _magnetometer):
            kind.add_argument(
                "--picture",
                default=f"calibrate-{name}.png",
                metavar="OUT.png",
                help="a new file that shows the fit; default: %(default)s",
            )
        return kind

    board = add("write the calibration board as a PDF to print", _board, "board -o board.pdf")
    board.add_argument("-o", "--output", required=True, metavar="BOARD.pdf", help="must not exist yet")

    camera = add(
        "find the camera's focal length, centre and distortion from pictures of the board, taken in water",
        _camera,
        "camera pictures/ --square-mm 30",
    )
    camera.add_argument(
        "pictures", nargs="+", metavar="PICTURES", help="folders, pictures, or a dive log with pictures"
    )
    camera.add_argument("--node", help="whose pictures, of a log of several nodes")
    camera.add_argument(
        "--info", metavar="FILE", help="with --new-info: the node's NodeInfo so far, as JSON or its log"
    )
    camera.add_argument(
        "--new-info", metavar="OUT.json", help="write its NodeInfo with this result, for `solve --info`"
    )

    lights = add(
        "find the places of two nodes' lights from a solved dive in which both rested at taped distances",
        _lights,
        "lights solved.mcap --tape 10 40 2.00 --tape 60 90 3.00 --tape 110 140 4.00 --tape 160 190 5.00 "
        "--tape 210 240 6.00",
    )
    lights.add_argument("dives", nargs="+", metavar="SOLVED.mcap", help="what `buddyline solve` wrote")
    lights.add_argument(
        "--tape",
        nargs=3,
        type=finite,
        action="append",
        required=True,
        metavar=("BEGIN_S", "END_S", "METRES"),
        help="both rested from BEGIN_S to END_S seconds after the dive's start, METRES from camera to camera; once for "
        "each place, five at least",
    )
    lights.add_argument("--nodes", nargs=2, metavar=("A", "B"), help="which pair, of a dive of several")
    lights.add_argument(
        "--pixel-sigma", type=finite, default=0.5, metavar="PX", help="1 sd of a light's mean place; default: 0.5"
    )
    lights.add_argument(
        "--tape-sigma-mm", type=finite, default=5.0, metavar="MM", help="1 sd of a taped distance; default: 5"
    )
    lights.add_argument(
        "--ruler-sigma-mm", type=finite, default=10.0, metavar="MM", help="1 sd of the configured places; default: 10"
    )
    lights.add_argument(
        "--new-info",
        nargs=2,
        metavar=("A.json", "B.json"),
        help="write both nodes' NodeInfo with this result, for `solve --info`",
    )

    magnetometer = add(
        "find what the rig's own iron adds to the field (hard and soft iron), from a log of it being turned every way",
        _magnetometer,
        "magnetometer a.mcap --position 59.9 10.8",
    )
    magnetometer.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="a log with the node's inertial samples")
    magnetometer.add_argument("--node", help="whose samples, of a log of several nodes")
    magnetometer.add_argument(
        "--position", nargs=2, type=finite, metavar=("LAT", "LON"), help="where it was taken: sets the field's strength"
    )

    gyroscope = add(
        "find how the gyroscope's bias moves with its temperature, from a log of a node that lies still and warms up",
        _gyroscope,
        "gyroscope a.mcap",
    )
    gyroscope.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="a log with the node's inertial samples")
    gyroscope.add_argument("--node", help="whose samples, of a log of several nodes")

    clock = add("find offset and drift between the nodes' clocks, before and after a dive", _clock, "clock")
    clock.add_argument(
        "dives", nargs="*", metavar="DIVE.mcap", help="a dive's logs, every node's; default: the nodes that run now"
    )
    clock.add_argument("--seconds", type=above_zero, default=10.0, metavar="S", help="listen for this long; default 10")
    clock.add_argument(
        "--nodes", nargs=2, metavar=("A", "B"), help="this pair alone; default: all that hear each other"
    )
    clock.add_argument("--json", action="store_true", help="print everything as JSON")
    add_client_arguments(clock)


def run(args: argparse.Namespace) -> int:
    """Calibrate; what goes into the node's TOML file is printed."""
    if getattr(args, "picture", None):
        check_new(args.picture)
    status: int | None = args.calibrate(args)
    return status or 0


def _the_board(args: argparse.Namespace) -> Board:
    from buddyline.tools.calibration.board import Board

    return Board(args.columns, args.rows, args.square_mm / 1e3)


def _board(args: argparse.Namespace) -> None:
    board = _the_board(args)
    board.write_pdf(Path(args.output))
    log.info("%s: %s", args.output, board.caption)


def _camera(args: argparse.Namespace) -> None:
    from buddyline.tools.calibration.camera import GOOD_RMS_PX, CornerFinder, calibrate, distinct, draw
    from buddyline.tools.calibration.inputs import pictures
    from buddyline.tools.calibration.pictures import write_picture
    from msgspec.structs import replace

    if bool(args.info) != bool(args.new_info):
        raise BuddylineError("--info and --new-info go together")
    info = _info_so_far(args.info, args.node) if args.info else None
    if info is not None:
        check_new(args.new_info)
    board = _the_board(args)
    finder = CornerFinder(board)
    seen = [finder.find(name, picture) for name, picture in pictures(args.pictures, args.node)]
    views = [view for view in seen if view is not None]
    if finder.size is None:
        raise BuddylineError(f"{', '.join(args.pictures)}: holds no pictures")
    width_px, height_px = finder.size
    if info is not None and (info.width_px, info.height_px) != finder.size:
        raise BuddylineError(
            f"{args.info}: describes {info.width_px}x{info.height_px} pixels, the pictures have "
            f"{width_px}x{height_px}: calibrate in the mode that dives"
        )
    log.info("board found in %d of %d pictures", len(views), len(seen))
    found = calibrate(distinct(views, width_px), finder.size, board)
    write_picture(Path(args.picture), draw(found))
    log.info(
        f"reprojection error {found.rms_px:.2f} px, {found.coverage:.0%} covered, {found.views} views, focal length "
        f"{found.camera.fx_px:.1f} +- {found.sigma_px[0]:.1f} px; see {args.picture}"
    )
    for name in found.dropped:
        log.info("left out, it does not fit the others: %s", name)
    if found.rms_px > GOOD_RMS_PX:
        log.warning(
            f"all views fit poorly: {found.rms_px:.2f} px, good ones stay below {GOOD_RMS_PX} px; take sharper "
            "pictures of a flat board, held still"
        )
    if info is not None:
        _write_info(args.new_info, replace(info, camera=found.camera))
    camera = found.camera
    _print(
        [
            f"# for pictures of {width_px}x{height_px} pixels, in the water that the board was in",
            "[calibration.camera]",
            f'model = "{camera.model}"',
            *(f"{name} = {getattr(camera, name):.3f}" for name in ("fx_px", "fy_px", "cx_px", "cy_px")),
            f"distortion = {_numbers(camera.distortion, '.6f')}",
        ]
    )


def _info_so_far(path: str, node: str | None) -> NodeInfo:
    """Return a node's NodeInfo from JSON or its log; raise BuddylineError where it is not clear which node's."""
    from buddyline.tools.dives import Dive, load_info

    if node is None and path.endswith(".mcap"):
        with Dive([path]) as dive:
            nodes = list(dive.infos())
        if len(nodes) > 1:
            raise BuddylineError(f"{path}: describes nodes {', '.join(nodes)}; choose one with --node")
    info = load_info(path, node)
    if node not in (None, info.node):
        raise BuddylineError(f"{path}: describes node {info.node}, not {node}")
    return info


def _lights(args: argparse.Namespace) -> None:
    import numpy as np
    from buddyline.solver_service.results import rig_of
    from buddyline.tools.calibration.inputs import places
    from buddyline.tools.calibration.lights import CalibrationNoise, fit
    from buddyline.tools.calibration.pictures import draw_lights, write_picture
    from msgspec.structs import replace

    taped, infos = places(args.dives, [tuple(tape) for tape in args.tape], args.nodes)
    rigs = rig_of(infos[0]), rig_of(infos[1])
    noise = CalibrationNoise(args.pixel_sigma, args.tape_sigma_mm / 1e3, args.ruler_sigma_mm / 1e3)
    found = fit(taped, (rigs[0].camera, rigs[1].camera), (rigs[0].lights_m, rigs[1].lights_m), noise)
    write_picture(Path(args.picture), draw_lights(found, taped))
    log.info("chi2 %.2f, tape within %.1f mm; see %s", found.chi2, 1e3 * np.abs(found.tape_gaps_m).max(), args.picture)
    for i, info in enumerate(infos):
        left, right = found.lights_m[i].round(5).tolist()
        sigmas = [_numbers(1e3 * sigma_m, ".1f")[1:-1] for sigma_m in found.sigma_m[i]]
        length_m = np.linalg.norm(found.lights_m[i, 1] - found.lights_m[i, 0])
        _print(
            [
                f"# node {info.node}: bar {length_m:.4f} m +- {found.bar_sigma_m[i] * 1e3:.1f} mm",
                "[calibration]",
                f"light_left_m = {left}   # +- {sigmas[0]} mm",
                f"light_right_m = {right}   # +- {sigmas[1]} mm",
            ]
        )
        if args.new_info:
            _write_info(args.new_info[i], replace(info, light_left_m=tuple(left), light_right_m=tuple(right)))


def _magnetometer(args: argparse.Namespace) -> None:
    import numpy as np
    from buddyline.node.geomagnetism import earth_field
    from buddyline.protocol.clock import SystemClock
    from buddyline.tools.calibration.ellipsoid import fit
    from buddyline.tools.calibration.inputs import inertial
    from buddyline.tools.calibration.pictures import draw_magnetometer, write_picture

    node, mags_t, accels_mps2 = inertial(args.dives, args.node)
    norm_t = None
    if args.position:
        latitude_deg, longitude_deg = args.position
        norm_t = earth_field(latitude_deg, longitude_deg, SystemClock().now_ns()).norm_t
    found = fit(mags_t, accels_mps2, norm_t)
    write_picture(Path(args.picture), draw_magnetometer(found))
    log.info(
        f"{len(found.errors)} readings, {found.coverage:.0%} of directions, field within {found.residual:.1%}, "
        f"headings within {np.degrees(found.heading_sigma_rad):.2f} deg; see {args.picture}"
    )
    if not found.turned:
        log.warning("too few readings at rest: the accelerometer's axes were not matched; turn the rig slowly")
    _print(
        [
            f"# node {node}, {found.norm_t * 1e6:.1f} uT",
            "[sensors]",
            f"magnetometer_offset_t = {_numbers(found.offset_t, '.4e')}",
            f"magnetometer_matrix = [{', '.join(_numbers(row, '.6f') for row in found.matrix)}]",
        ]
    )


def _gyroscope(args: argparse.Namespace) -> None:
    import numpy as np
    from buddyline.tools.calibration.gyroscope import fit
    from buddyline.tools.calibration.inputs import inertial_samples

    node, samples = inertial_samples(args.dives, args.node)
    found = fit(samples)
    log.info(
        f"{found.rests} rests over {found.span_k:.1f} K; the line leaves {np.degrees(found.left_radps):.4f} deg/s rms; "
        f"1 sd {_numbers(np.degrees(found.sigma_radps_per_k), '.5f')} deg/s per K"
    )
    _print(
        [
            f"# node {node}: {_numbers(np.degrees(found.slope_radps_per_k), '.4f')} deg/s per K",
            "[sensors]",
            f"gyro_bias_radps_per_k = {_numbers(found.slope_radps_per_k, '.3e')}",
        ]
    )


def _clock(args: argparse.Namespace) -> int:
    from buddyline.tools.calibration.clock_report import as_json, as_text, listen, read, reports

    if not 3.0 <= args.seconds <= 3600.0:
        raise BuddylineError(f"--seconds {args.seconds:g}: 3 to 3600")
    heard = read(args.dives) if args.dives else listen(client_config(args), args.seconds)
    found = reports(heard, args.nodes, args.dives)
    print(as_json(found, heard) if args.json else as_text(found, heard))
    # After a dive the clocks need not agree: their offset only has to be known.
    return 0 if args.dives else int(any(one.problem() for one in found))


def _numbers(values: Iterable[float] | np.ndarray, form: str) -> str:
    return f"[{', '.join(format(float(value), form) for value in values)}]"


def _write_info(path: str, info: NodeInfo) -> None:
    from buddyline.protocol.codec import encode

    write_new(path, encode(info))
    log.info("%s: for solve --info %s=%s", path, info.node, path)


def _print(lines: Iterable[str]) -> None:
    print("\n".join(lines))
