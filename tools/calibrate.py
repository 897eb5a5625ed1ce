"""`buddyline calibrate`: camera, lights and magnetometer of a node, each with a picture, or a refusal; two clocks."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np
from buddyline.protocol.clock import SystemClock
from buddyline.protocol.codec import encode
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CameraModel, NodeInfo, Vector3
from buddyline.tools.client import add_client_arguments, client_config
from buddyline.tools.dives import load_info
from buddyline.tools.newfile import write_new

log = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="WHAT")

    board = kinds.add_parser("board", help="write the calibration board as a PDF to print")
    board.add_argument("-o", "--output", required=True, metavar="BOARD.pdf")
    _board_arguments(board)
    board.set_defaults(calibrate=_board)

    camera = kinds.add_parser("camera", help="intrinsics, out of pictures of the board taken in water")
    camera.add_argument(
        "pictures", nargs="+", metavar="PICTURES", help="folders, pictures, or a dive log with pictures"
    )
    camera.add_argument("--node", help="whose pictures of a log of several nodes")
    _board_arguments(camera)
    _result_arguments(camera, "camera")
    camera.set_defaults(calibrate=_camera)

    lights = kinds.add_parser("lights", help="positions of both nodes' lights, out of a solved dive at taped distances")
    lights.add_argument("dives", nargs="+", metavar="SOLVED.mcap", help="what `buddyline solve` wrote")
    lights.add_argument(
        "--tape",
        nargs=3,
        type=float,
        action="append",
        required=True,
        metavar=("BEGIN_S", "END_S", "METRES"),
        help="while both nodes rested, this far from camera to camera; once for each place",
    )
    lights.add_argument("--pixel-sigma", type=float, default=0.5, metavar="PX", help="of a light's mean; default 0.5")
    lights.add_argument("--tape-sigma-mm", type=float, default=5.0, metavar="MM", help="of a distance; default 5")
    lights.add_argument("--ruler-sigma-mm", type=float, default=10.0, metavar="MM", help="of the entered positions")
    _result_arguments(lights, "lights", pair=True)
    lights.set_defaults(calibrate=_lights)

    magnetometer = kinds.add_parser("magnetometer", help="hard and soft iron, out of a log of the rig turned every way")
    magnetometer.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="a log with the node's inertial samples")
    magnetometer.add_argument("--node", help="whose samples of a log of several nodes")
    magnetometer.add_argument(
        "--position", nargs=2, type=float, metavar=("LAT", "LON"), help="where it was taken: sets the field's strength"
    )
    magnetometer.add_argument("--picture", default="calibrate-magnetometer.png", metavar="OUT.png")
    magnetometer.set_defaults(calibrate=_magnetometer)

    clock = kinds.add_parser("clock", help="offset and drift between two nodes' clocks, before and after a dive")
    clock.add_argument(
        "dives", nargs="*", metavar="DIVE.mcap", help="a dive's logs, both nodes'; default: the nodes that run now"
    )
    clock.add_argument("--seconds", type=float, default=10.0, metavar="S", help="listen for this long; default 10")
    clock.add_argument(
        "--nodes", nargs=2, metavar=("A", "B"), help="this pair alone; default: all that hear each other"
    )
    clock.add_argument("--json", action="store_true", help="print everything as JSON")
    add_client_arguments(clock)
    clock.set_defaults(calibrate=_clock)


def run(args: argparse.Namespace) -> int:
    """Calibrate; what goes into the node's TOML file is printed."""
    status: int | None = args.calibrate(args)
    return status or 0


def _board_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--columns", type=int, default=9, help="squares across; default 9")
    parser.add_argument("--rows", type=int, default=6, help="squares up; default 6")
    parser.add_argument("--square-mm", type=float, default=30.0, help="side of a square, as measured; default 30")


def _result_arguments(parser: argparse.ArgumentParser, kind: str, pair: bool = False) -> None:
    parser.add_argument("--picture", default=f"calibrate-{kind}.png", metavar="OUT.png")
    if pair:
        parser.add_argument(
            "--new-info",
            nargs=2,
            metavar=("A.json", "B.json"),
            help="write both nodes' descriptions anew, for solve --info",
        )
    else:
        parser.add_argument("--info", metavar="FILE", help="the node's description: a log of it, or JSON")
        parser.add_argument("--new-info", metavar="OUT.json", help="write it anew with this result, for solve --info")


def _board(args: argparse.Namespace) -> None:
    from buddyline.tools.calibration.board import Board

    board = Board(args.columns, args.rows, args.square_mm / 1e3)
    board.write_pdf(Path(args.output))
    log.info("%s: %s", args.output, board.caption)


def _camera(args: argparse.Namespace) -> None:
    from buddyline.tools.calibration.board import Board
    from buddyline.tools.calibration.camera import CornerFinder, calibrate, distinct, draw
    from buddyline.tools.calibration.inputs import pictures
    from buddyline.tools.calibration.pictures import write_picture

    if bool(args.info) != bool(args.new_info):
        raise BuddylineError("--info and --new-info go together")
    board = Board(args.columns, args.rows, args.square_mm / 1e3)
    finder = CornerFinder(board)
    seen = [finder.find(name, picture) for name, picture in pictures(args.pictures, args.node)]
    views = [view for view in seen if view is not None]
    if finder.size is None:
        raise BuddylineError(f"{', '.join(args.pictures)}: holds no pictures")
    log.info("board found in %d of %d pictures", len(views), len(seen))
    found = calibrate(distinct(views, finder.size[0]), finder.size, board)
    write_picture(Path(args.picture), draw(found))
    log.info(
        "reprojection error %.2f px, %.0f %% covered, %d views, focal length %.1f +- %.1f px; see %s",
        found.rms_px,
        100 * found.coverage,
        found.views,
        found.camera.fx_px,
        found.sigma_px[0],
        args.picture,
    )
    for name in found.dropped:
        log.info("left out, it does not fit the others: %s", name)
    if args.new_info:
        info = load_info(args.info)
        if (info.width_px, info.height_px) != found.size:
            raise BuddylineError(
                f"{args.info}: describes {info.width_px}x{info.height_px} pixels, the pictures have "
                f"{found.size[0]}x{found.size[1]}: calibrate in the mode that dives"
            )
        _write_info(args.new_info, msgspec.structs.replace(info, camera=found.camera))
    _print(_camera_table(found.camera, found.size))


def _lights(args: argparse.Namespace) -> None:
    from buddyline.solver_service.results import rig_of
    from buddyline.tools.calibration.inputs import stations
    from buddyline.tools.calibration.lights import Noise, fit
    from buddyline.tools.calibration.pictures import draw_lights, write_picture

    places, infos = stations(args.dives, [tuple(tape) for tape in args.tape])
    rigs = rig_of(infos[0]), rig_of(infos[1])
    noise = Noise(args.pixel_sigma, args.tape_sigma_mm / 1e3, args.ruler_sigma_mm / 1e3)
    found = fit(places, (rigs[0].camera, rigs[1].camera), (rigs[0].lights_m, rigs[1].lights_m), noise)
    write_picture(Path(args.picture), draw_lights(found, places))
    log.info("chi2 %.2f, tape within %.1f mm; see %s", found.chi2, 1e3 * np.abs(found.tape_gaps_m).max(), args.picture)
    results = ((found.lights_a_m, found.sigma_a_m), (found.lights_b_m, found.sigma_b_m))
    for i, (info, (lights_m, sigma_m)) in enumerate(zip(infos, results, strict=True)):
        left, right = _vector(lights_m[0]), _vector(lights_m[1])
        _print(
            [
                f"# node {info.node}: bar {np.linalg.norm(lights_m[1] - lights_m[0]):.4f} m "
                f"+- {found.bar_sigma_m[i] * 1e3:.1f} mm",
                "[calibration]",
                f"light_left_m = {list(left)}   # +- {_millimetres(sigma_m[0])} mm",
                f"light_right_m = {list(right)}   # +- {_millimetres(sigma_m[1])} mm",
            ]
        )
        if args.new_info:
            _write_info(args.new_info[i], msgspec.structs.replace(info, light_left_m=left, light_right_m=right))


def _magnetometer(args: argparse.Namespace) -> None:
    from buddyline.node.geomagnetism import earth_field
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
        "%d readings, %.0f %% of directions, field within %.1f %%, headings within %.2f deg; see %s",
        len(found.errors),
        100 * found.coverage,
        100 * found.residual,
        np.degrees(found.heading_sigma_rad),
        args.picture,
    )
    if not found.turned:
        log.warning("too few readings at rest: the accelerometer's axes were not matched; turn the rig slowly")
    rows = ", ".join("[" + ", ".join(f"{value:.6f}" for value in row) + "]" for row in found.matrix.tolist())
    _print(
        [
            f"# node {node}, {found.norm_t * 1e6:.1f} uT",
            "[sensors]",
            "magnetometer_offset_t = [" + ", ".join(f"{value:.4e}" for value in found.offset_t.tolist()) + "]",
            f"magnetometer_matrix = [{rows}]",
        ]
    )


def _clock(args: argparse.Namespace) -> int:
    from buddyline.tools.calibration.clock_report import as_json, as_text, listen, read, reports

    if not 3.0 <= args.seconds <= 3600.0:
        raise BuddylineError(f"--seconds {args.seconds:g}: 3 to 3600")
    heard = read(args.dives) if args.dives else listen(client_config(args), args.seconds)
    found = reports(heard, args.nodes)
    print(as_json(found, heard) if args.json else as_text(found, heard))
    # A dive that is over is what it is: its clocks need not agree, they need to be known.
    return 0 if args.dives else int(any(one.problem() for one in found))


def _camera_table(camera: CameraModel, size: tuple[int, int]) -> list[str]:
    return [
        f"# for pictures of {size[0]}x{size[1]} pixels, in the water that the board was in",
        "[calibration.camera]",
        f'model = "{camera.model}"',
        f"fx_px = {camera.fx_px:.3f}",
        f"fy_px = {camera.fy_px:.3f}",
        f"cx_px = {camera.cx_px:.3f}",
        f"cy_px = {camera.cy_px:.3f}",
        "distortion = [" + ", ".join(f"{value:.6f}" for value in camera.distortion) + "]",
    ]


def _vector(values: np.ndarray) -> Vector3:
    x, y, z = (round(float(value), 5) for value in values)
    return x, y, z


def _millimetres(sigma_m: np.ndarray) -> str:
    return ", ".join(f"{1e3 * float(value):.1f}" for value in sigma_m)


def _write_info(path: str, info: NodeInfo) -> None:
    write_new(path, encode(info))
    log.info("%s: for solve --info %s=%s", path, info.node, path)


def _print(lines: Iterable[str]) -> None:
    print("\n".join(lines))
