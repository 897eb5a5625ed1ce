"""The board, its corners in pictures, and the camera out of them, against a camera that is known."""

from __future__ import annotations

import argparse
import logging
import re
from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from buddyline.node.config import CalibrationConfig
from buddyline.protocol.codec import decode, encode
from buddyline.protocol.config import parse_config
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CameraModel, NodeInfo
from buddyline.tools.calibration import camera
from buddyline.tools.calibration import command as calibrate
from buddyline.tools.calibration.board import Board
from buddyline.tools.calibration.camera import BoardView, CornerFinder, coverage, distinct, draw
from buddyline.tools.calibration.leastsquares import PoorCalibration

from tests.tools import boards

BOARD = Board()
CORNERS = np.asarray(BOARD.charuco().getChessboardCorners(), float)


def views(n: int = 16, noise_px: float = 0.1, **how: float) -> list[BoardView]:
    """Corners as a known camera sees them."""
    rng = np.random.default_rng(4)
    seen = []
    for i, (rvec, tvec) in enumerate(boards.poses(BOARD, n, **how)):
        points = cv2.projectPoints(CORNERS, rvec, tvec, boards.K, boards.DISTORTION)[0].reshape(-1, 2)
        inside = ((points > 5) & (points < np.array(boards.SIZE) - 5)).all(axis=1)
        points = points[inside] + rng.normal(0, noise_px, (int(inside.sum()), 2))
        seen.append(BoardView(f"view {i}", np.flatnonzero(inside).astype(np.int32), points))
    return seen


def bearings(model: CameraModel, pixels: np.ndarray) -> np.ndarray:
    K = np.array([[model.fx_px, 0, model.cx_px], [0, model.fy_px, model.cy_px], [0, 0, 1.0]])
    flat = cv2.undistortPoints(pixels[:, None, :], K, np.array(model.distortion)).reshape(-1, 2)
    rays = np.column_stack([flat, np.ones(len(flat))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def test_focal_length_and_bearings_are_recovered():
    found = camera.calibrate(views(), boards.SIZE, BOARD)
    assert found.camera.fx_px == pytest.approx(boards.FOCAL_PX, rel=0.002)
    assert abs(found.camera.fx_px - boards.FOCAL_PX) < 4 * found.sigma_px[0]
    assert found.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.15)
    truth = CameraModel(
        model="pinhole",
        fx_px=float(boards.K[0, 0]),
        fy_px=float(boards.K[1, 1]),
        cx_px=float(boards.K[0, 2]),
        cy_px=float(boards.K[1, 2]),
        distortion=[float(v) for v in boards.DISTORTION],
    )
    grid = np.stack(np.meshgrid(np.linspace(60, 580, 9), np.linspace(50, 430, 7)), -1).reshape(-1, 2)
    # What a turn of the whole camera explains goes into the mount, not into the picture.
    one, other = bearings(truth, grid), bearings(found.camera, grid)
    U, _, Vt = np.linalg.svd(other.T @ one)
    off = np.degrees(np.linalg.norm(other @ (U @ Vt) - one, axis=1))
    assert off.max() < 0.05


def test_the_detector_finds_corners_to_a_fraction_of_a_pixel():
    finder = CornerFinder(BOARD)
    errors = []
    for i, (rvec, tvec) in enumerate(boards.poses(BOARD, 2)):
        view = finder.find("picture", boards.take(BOARD, rvec, tvec, i))
        assert view is not None
        truth = cv2.projectPoints(CORNERS[view.ids], rvec, tvec, boards.K, boards.DISTORTION)[0].reshape(-1, 2)
        errors.append(view.points_px - truth)
    assert np.sqrt((np.vstack(errors) ** 2).mean()) < 0.25


def test_a_picture_without_the_board_has_no_corners_and_colour_is_as_good():
    finder = CornerFinder(BOARD)
    rvec, tvec = next(boards.poses(BOARD, 1))
    picture = cv2.cvtColor(boards.take(BOARD, rvec, tvec), cv2.COLOR_GRAY2BGR)
    assert finder.find("colour", picture) is not None
    assert finder.find("empty", np.full_like(picture, 90)) is None
    with pytest.raises(PoorCalibration, match="320x240, the others are 640x480"):
        finder.find("small", picture[::2, ::2].copy())


def test_too_few_views_are_refused():
    with pytest.raises(PoorCalibration, match="different views"):
        camera.calibrate(views(5), boards.SIZE, BOARD)


def test_a_board_in_the_middle_only_is_refused():
    with pytest.raises(PoorCalibration, match="edges and corners"):
        camera.calibrate(views(reach=0.0), boards.SIZE, BOARD)


@pytest.mark.parametrize("tilt_rad", [0.02, 0.1])
def test_a_board_hardly_tilted_is_refused(tilt_rad):
    """At 0.02 rad the fit says 303 px in place of 520, and that it is sure to 0.02 px."""
    with pytest.raises(PoorCalibration, match="tilt the board"):
        camera.calibrate(views(tilt_rad=tilt_rad), boards.SIZE, BOARD)


def test_another_board_than_the_print_is_refused():
    """Rows and columns swapped: the corners' numbers mean other places."""
    with pytest.raises(PoorCalibration):
        camera.calibrate(views(8), boards.SIZE, Board(columns=6, rows=9))


def test_one_bent_view_is_left_out_and_named():
    seen = views()
    bent = seen[3]
    seen[3] = BoardView("bent", bent.ids, bent.points_px + 6 * np.sin(bent.points_px / 40))
    found = camera.calibrate(seen, boards.SIZE, BOARD)
    assert found.dropped == ("bent",)
    assert found.camera.fx_px == pytest.approx(boards.FOCAL_PX, rel=0.003)


def test_good_views_of_an_excellent_set_are_kept():
    seen = views(noise_px=0.02)
    seen[3] = replace(seen[3], points_px=views(noise_px=0.2)[3].points_px)
    assert camera.calibrate(seen, boards.SIZE, BOARD).dropped == ()


def bent(view: BoardView, by_px: float) -> BoardView:
    return replace(view, points_px=view.points_px + by_px * np.sin(view.points_px / 40))


def test_a_view_that_does_not_fit_is_refused_where_it_cannot_be_left_out():
    seen = views(8)
    seen[3] = bent(seen[3], 6.0)
    with pytest.raises(PoorCalibration, match=r"view 3 does not fit the others .* take more"):
        camera.calibrate(seen, boards.SIZE, BOARD)


def test_a_set_of_which_most_is_left_out_is_refused():
    seen = [bent(view, 3.0 * 2.0 ** (i - 10) if i > 10 else 0.0) for i, view in enumerate(views(30))]
    with pytest.raises(PoorCalibration, match=r"of 30 views do not fit the others: is the board flat"):
        camera.calibrate(seen, boards.SIZE, BOARD)


def test_pictures_of_a_board_at_rest_count_once():
    seen = views(4)
    still = [BoardView(f"{v.name} again {k}", v.ids, v.points_px + 0.1 * k) for v in seen for k in range(10)]
    assert len(distinct(still, 640)) == 4


def test_coverage_of_cells():
    assert coverage(np.array([[0.0, 0.0]]), (640, 480)) == 1 / 48
    everywhere = np.stack(np.meshgrid(np.arange(640), np.arange(480)), -1).reshape(-1, 2).astype(float)
    assert coverage(everywhere, (640, 480)) == 1.0


def test_the_picture_shows_residuals_and_empty_cells():
    found = camera.calibrate(views(), boards.SIZE, BOARD)
    picture = draw(found)
    assert picture.shape == (480, 640, 3)
    assert (picture == 150).all(axis=2).any() == (found.coverage < 1)
    assert ((picture[..., 2] > 150) & (picture[..., 0] < 60)).any()


def rectangles(pdf: bytes) -> np.ndarray:
    return np.array([[float(v) for v in m] for m in re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re", pdf)])


@pytest.mark.parametrize("board", [Board(), Board(5, 7, 0.04), Board(3, 3, 0.1)])
def test_the_page_has_the_boards_true_size_and_is_found_as_that_board(tmp_path, board):
    path = tmp_path / "board.pdf"
    board.write_pdf(path)
    data = path.read_bytes()
    assert data.startswith(b"%PDF-1.4")
    assert data.endswith(b"%%EOF\n")
    start = int(re.search(rb"startxref\n(\d+)", data)[1])
    assert data[start : start + 4] == b"xref"
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n", data), 1):
        assert data[int(offset) :].startswith(b"%d 0 obj" % number)
    mm = rectangles(data) * 25.4 / 72
    width = (mm[:, 0] + mm[:, 2]).max() - mm[:, 0].min()
    assert width == pytest.approx(board.columns * board.square_m * 1e3, rel=1e-3)
    scale = 4.0  # pixels a millimetre
    page = [float(v) * 25.4 / 72 * scale for v in re.search(rb"MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", data).groups()]
    drawn = np.full((round(page[1]), round(page[0])), 255, np.uint8)
    for x, y, w, h in mm * scale:
        top = page[1] - y - h
        drawn[round(top) : round(top + h), round(x) : round(x + w)] = 0
    view = CornerFinder(board).find("page", drawn)
    if board.columns * board.rows < 12:
        assert view is None  # fewer corners than a view needs
        return
    assert len(view.ids) == (board.columns - 1) * (board.rows - 1)
    _, i, _ = np.intersect1d(view.ids, [0, 1], return_indices=True)
    apart_mm = np.linalg.norm(view.points_px[i[1]] - view.points_px[i[0]]) / scale
    assert apart_mm == pytest.approx(board.square_m * 1e3, rel=0.01)


@pytest.mark.parametrize(("columns", "rows", "square_m"), [(2, 6, 0.03), (30, 30, 0.03), (9, 6, 0.001)])
def test_boards_that_cannot_be_made_are_refused(columns, rows, square_m):
    with pytest.raises(BuddylineError, match="board"):
        Board(columns, rows, square_m)


def arguments(*text: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    calibrate.add_arguments(parser)
    return parser.parse_args(text)


def info(width_px: int = 640) -> NodeInfo:
    return NodeInfo(
        node="a",
        stamp_ns=5,
        width_px=width_px,
        height_px=480,
        camera=CameraModel(model="pinhole", fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, distortion=[0.0] * 5),
        light_left_m=(-0.44, 0.0, 0.0),
        light_right_m=(0.44, 0.0, 0.0),
        sigma_px=0.7,
        trigger_period_ns=100_000_000,
    )


@pytest.fixture
def folder(tmp_path, monkeypatch, request):
    """A folder of pictures in which the board is where the known camera sees it, with noise as asked for."""
    seen = iter(views(noise_px=getattr(request, "param", 0.1)))

    def find(self, name, image):
        self.size = boards.SIZE
        return next(seen)

    monkeypatch.setattr(CornerFinder, "find", find)
    for i in range(16):
        cv2.imwrite(str(tmp_path / f"{i:02d}.png"), np.zeros((480, 640), np.uint8))
    return tmp_path


def test_command_writes_what_the_node_and_the_solver_take(folder, capsys):
    old, new, picture = folder / "a.json", folder / "new.json", folder / "result.jpg"
    old.write_bytes(encode(info()))
    args = ("--info", str(old), "--new-info", str(new), "--picture", str(picture))
    assert calibrate.run(arguments("camera", *(str(p) for p in sorted(folder.glob("*.png"))), *args)) == 0
    table = capsys.readouterr().out
    lights = "light_left_m = [-0.44, 0.0, 0.0]\nlight_right_m = [0.44, 0.0, 0.0]\n"
    printed = parse_config(
        lights + table.replace("[calibration.camera]", "[camera]"), CalibrationConfig, "printed"
    ).camera
    written = decode(new.read_bytes(), NodeInfo)
    assert printed.fx_px == pytest.approx(boards.FOCAL_PX, rel=0.002)
    assert written.camera.fx_px == pytest.approx(printed.fx_px, abs=1e-3)
    assert msgspec.structs.replace(written, camera=info().camera) == info()
    assert cv2.imread(str(picture)) is not None
    with pytest.raises(BuddylineError, match="exists"):
        calibrate._write_info(str(new), written)


def test_command_changes_the_node_that_is_asked_for(folder):
    """And none where a log of several nodes leaves it open: it took the first one's lights for all."""
    log = folder / "log.mcap"
    with DiveLogWriter(log) as writer:
        for node in ("a", "b"):
            writer.write_message(msgspec.structs.replace(info(), node=node))
    new, pictures = folder / "new.json", [str(p) for p in sorted(folder.glob("*.png"))]
    words = ["camera", *pictures, "--info", str(log), "--new-info", str(new), "--picture", str(folder / "p.jpg")]
    with pytest.raises(BuddylineError, match="describes nodes a, b; choose one with --node"):
        calibrate.run(arguments(*words))
    assert calibrate.run(arguments(*words, "--node", "b")) == 0
    assert decode(new.read_bytes(), NodeInfo).node == "b"


@pytest.mark.parametrize(("folder", "poor"), [(0.1, False), (0.5, True)], indirect=["folder"])
def test_command_says_that_all_views_fit_poorly(folder, poor, caplog):
    pictures = map(str, sorted(folder.glob("*.png")))
    assert calibrate.run(arguments("camera", *pictures, "--picture", str(folder / "result.jpg"))) == 0
    warned = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert [text.startswith("all views fit poorly: 0.") for text in warned] == [True] * poor


def test_command_refuses_a_calibration_of_another_resolution(folder):
    old = folder / "a.json"
    old.write_bytes(encode(info(width_px=820)))
    with pytest.raises(BuddylineError, match=r"describes 820x480 pixels, the pictures have\s+640x480"):
        calibrate.run(
            arguments(
                "camera", *(str(p) for p in sorted(folder.glob("*.png"))), "--info", str(old),
                "--new-info", str(folder / "new.json"), "--picture", str(folder / "p.png"),
            )
        )  # fmt: skip


def test_command_names_what_is_not_there(tmp_path):
    with pytest.raises(BuddylineError, match="no such picture"):
        calibrate.run(arguments("camera", str(tmp_path / "none")))
    (tmp_path / "unreadable.png").mkdir()
    with pytest.raises(BuddylineError, match=r"unreadable\.png: cannot be read: Is a directory"):
        calibrate.run(arguments("camera", str(tmp_path)))
    (tmp_path / "empty").mkdir()
    with pytest.raises(BuddylineError, match="holds no pictures"):
        calibrate.run(arguments("camera", str(tmp_path / "empty")))
    with pytest.raises(BuddylineError, match="go together"):
        calibrate.run(arguments("camera", str(tmp_path / "empty"), "--info", "a.json"))


def test_board_command(tmp_path):
    path = tmp_path / "board.pdf"
    assert calibrate.run(arguments("board", "-o", str(path), "--columns", "7", "--rows", "5")) == 0
    assert b"7 x 5 squares of 30 mm" in path.read_bytes()
    with pytest.raises(BuddylineError, match="exists"):
        calibrate.run(arguments("board", "-o", str(path)))
