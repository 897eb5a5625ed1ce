"""Fit a camera's intrinsics to pictures of the board, and check that they are good enough for a dive."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from buddyline.protocol.messages import CameraModel
from buddyline.tools.calibration.board import Board
from buddyline.tools.calibration.leastsquares import Floats, PoorCalibration, require
from numpy.typing import NDArray

Image = NDArray[np.uint8]

LEAST_CORNERS: Final = 8
LEAST_VIEWS: Final = 8
MOST_VIEWS: Final = 60
MOVED_SHARE: Final = 0.03
GRID: Final = (8, 6)
LEAST_COVERAGE: Final = 0.6
MOST_RMS_PX: Final = 1.0
# What sharp pictures of a flat board stay below. A view that does is never left out; a fit that does not is told.
GOOD_RMS_PX: Final = 0.5
LEAST_TILT_RAD: Final = np.radians(7.0)
MOST_FOCAL_SIGMA: Final = 0.005
OUTLIER_VIEWS: Final = 2.5
_BOARD: Final = "is the board flat and sharp, and --columns, --rows and --square-mm those of the print?"


@dataclass(frozen=True)
class BoardView:
    """The board's corners in one picture: name, ids (n,), points_px (n, 2)."""

    name: str
    ids: NDArray[np.int32]
    points_px: Floats


@dataclass(frozen=True)
class CameraFit:
    """Intrinsics, and their quality.

    size: (width, height) px. rms_px: of all reprojection errors. sigma_px: of fx, fy, cx, cy, 1 sd. coverage: share of
    the picture's cells with a corner. tilt_rad: tilt of the board over the views, 1 sd. residuals_px: (n, 2), of the
    corners points_px (n, 2). dropped: names of the views left out.
    """

    camera: CameraModel
    size: tuple[int, int]
    rms_px: float
    sigma_px: tuple[float, float, float, float]
    coverage: float
    tilt_rad: float
    views: int
    points_px: Floats
    residuals_px: Floats
    dropped: tuple[str, ...]


class CornerFinder:
    """Finds the board in pictures of one size."""

    def __init__(self, board: Board) -> None:
        self._detector: Any = cv2.aruco.CharucoDetector(board.charuco())
        self.size: tuple[int, int] | None = None

    def find(self, name: str, image: Image) -> BoardView | None:
        """Return the board's corners; None if too few are seen. Raises PoorCalibration for another picture size."""
        size = (image.shape[1], image.shape[0])
        if self.size is not None and size != self.size:
            raise PoorCalibration(f"{name}: {size[0]}x{size[1]}, the others are {self.size[0]}x{self.size[1]}")
        self.size = size
        grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < LEAST_CORNERS:
            return None
        # OpenCV 4 has a dimension more here than OpenCV 5.
        points = np.asarray(corners, np.float32).reshape(-1, 2)
        return BoardView(name, np.asarray(ids, np.int32).reshape(-1), _refined(grey, points))


def _refined(grey: Image, points: NDArray[np.float32]) -> Floats:
    """Return corners (n, 2) with an accuracy of 0.1 px; the detector's own have 0.5 px.

    The search window does not reach the markers' edges, which begin 0.15 squares away.
    """
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    half = int(np.clip(0.07 * np.median(apart.min(axis=1)), 2, 10))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    refined = cv2.cornerSubPix(grey, points.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), criteria)
    return np.asarray(refined, np.float64).reshape(-1, 2)


def distinct(views: Iterable[BoardView], width_px: int) -> list[BoardView]:
    """Return the views in which the board has moved since the last kept view; at most MOST_VIEWS, evenly chosen."""
    kept: list[BoardView] = []
    for view in views:
        if not kept or _moved_px(kept[-1], view) > MOVED_SHARE * width_px:
            kept.append(view)
    if len(kept) > MOST_VIEWS:
        kept = [kept[i] for i in np.linspace(0, len(kept) - 1, MOST_VIEWS).astype(int)]
    return kept


def _moved_px(one: BoardView, other: BoardView) -> float:
    _, i, j = np.intersect1d(one.ids, other.ids, return_indices=True)
    if len(i) < LEAST_CORNERS // 2:
        return float("inf")
    return float(np.linalg.norm(one.points_px[i] - other.points_px[j], axis=1).mean())


def calibrate(views: list[BoardView], size: tuple[int, int], board: Board) -> CameraFit:
    """Fit a pinhole with OpenCV's k1 k2 p1 p2 k3; raise PoorCalibration if the views do not determine it well."""
    require(
        (
            len(views) >= LEAST_VIEWS,
            f"the board is found in {len(views)} different views, but {LEAST_VIEWS} are needed: "
            "move and tilt it between pictures, with all of it sharp and lit",
        )
    )
    corners = np.asarray(board.charuco().getChessboardCorners(), np.float32)
    dropped: list[str] = []
    while True:
        found, per_view_px = _solve(views, size, corners, tuple(dropped))
        worst = int(per_view_px.argmax())
        if per_view_px[worst] < max(OUTLIER_VIEWS * np.median(per_view_px), GOOD_RMS_PX):
            break
        require(
            (
                len(views) > LEAST_VIEWS,
                f"{views[worst].name} does not fit the others ({per_view_px[worst]:.1f} px), and without it there are "
                f"fewer than {LEAST_VIEWS} views: take more",
            )
        )
        dropped.append(views[worst].name)
        views = views[:worst] + views[worst + 1 :]
    focal_share = max(found.sigma_px[0] / found.camera.fx_px, found.sigma_px[1] / found.camera.fy_px)
    require(
        (
            len(dropped) <= len(views),
            f"{len(dropped)} of {len(dropped) + len(views)} views do not fit the others: {_BOARD}",
        ),
        (
            found.rms_px <= MOST_RMS_PX,
            f"reprojection error {found.rms_px:.2f} px, allowed are {MOST_RMS_PX:.1f} px: {_BOARD}",
        ),
        (
            found.coverage >= LEAST_COVERAGE,
            f"corners in {found.coverage:.0%} of the picture, {LEAST_COVERAGE:.0%} are needed: "
            "bring the board into all edges and corners",
        ),
        (
            bool(found.tilt_rad >= LEAST_TILT_RAD),
            f"the board was tilted by {np.degrees(found.tilt_rad):.0f} deg, {np.degrees(LEAST_TILT_RAD):.0f} deg at "
            "least: tilt the board more, both ways",
        ),
        (
            focal_share <= MOST_FOCAL_SIGMA,
            f"focal length known to {focal_share:.1%} only, {MOST_FOCAL_SIGMA:.1%} at most: tilt the board more",
        ),
    )
    return found


def coverage(points_px: Floats, size: tuple[int, int]) -> float:
    """Return the share of the picture's cells with at least one corner. size: (width, height) px."""
    return float((cells(points_px, size) > 0).mean())


def cells(points_px: Floats, size: tuple[int, int]) -> NDArray[np.int64]:
    """Return the number of corners in each cell of the picture, (rows, columns)."""
    columns, rows = GRID
    column = np.clip((points_px[:, 0] + 0.5) / size[0] * columns, 0, columns - 1).astype(int)
    row = np.clip((points_px[:, 1] + 0.5) / size[1] * rows, 0, rows - 1).astype(int)
    counts = np.zeros((rows, columns), np.int64)
    np.add.at(counts, (row, column), 1)
    return counts


def _solve(
    views: list[BoardView], size: tuple[int, int], corners: NDArray[np.float32], dropped: tuple[str, ...]
) -> tuple[CameraFit, Floats]:
    """Return the fit of these views and each view's reprojection error (n,), px."""
    objects = [corners[view.ids] for view in views]
    images = [view.points_px.astype(np.float32) for view in views]
    try:
        rms, K, distortion, turns, shifts, deviations, _, per_view = cv2.calibrateCameraExtended(
            objects, images, size, np.eye(3), np.zeros(5)
        )
    except cv2.error as error:
        raise PoorCalibration(f"the views do not determine the camera: {error.err}") from error
    residuals = [
        image - cv2.projectPoints(points, turn, shift, K, distortion)[0].reshape(-1, 2)
        for points, image, turn, shift in zip(objects, images, turns, shifts, strict=True)
    ]
    fx_px, fy_px, cx_px, cy_px = (float(K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    points = np.vstack([view.points_px for view in views])
    sigmas = np.asarray(deviations, np.float64).ravel().tolist()
    found = CameraFit(
        camera=CameraModel(
            model="pinhole",
            fx_px=fx_px,
            fy_px=fy_px,
            cx_px=cx_px,
            cy_px=cy_px,
            distortion=np.asarray(distortion, np.float64).ravel()[:5].tolist(),
        ),
        size=size,
        rms_px=float(rms),
        sigma_px=(sigmas[0], sigmas[1], sigmas[2], sigmas[3]),
        coverage=coverage(points, size),
        tilt_rad=_tilt(turns),
        views=len(views),
        points_px=points,
        residuals_px=np.vstack(residuals).astype(np.float64),
        dropped=dropped,
    )
    return found, np.asarray(per_view, np.float64).ravel()


def _tilt(turns: Any) -> float:
    """Return the variation of the board's normal, rad, 1 sd, in the direction of its least variation."""
    normals = np.array([cv2.Rodrigues(turn)[0][:2, 2] for turn in turns])
    return float(np.sqrt(max(np.linalg.eigvalsh(normals.T @ normals / len(normals))[0], 0.0)))


def draw(found: CameraFit, enlarged: float = 20.0) -> Image:
    """Return a picture of the corners, each with its enlarged residual; cells without corners are dark."""
    empty = (cells(found.points_px, found.size) == 0).astype(np.uint8)
    shade = 255 - 105 * cv2.resize(empty, found.size, interpolation=cv2.INTER_NEAREST)
    picture = np.repeat(np.asarray(shade, np.uint8)[..., None], 3, axis=2)
    for point, residual in zip(found.points_px, found.residuals_px, strict=True):
        begin = (round(float(point[0])), round(float(point[1])))
        end = tuple(round(float(v)) for v in point + enlarged * residual)
        cv2.line(picture, begin, (end[0], end[1]), (0, 0, 200), 1, cv2.LINE_AA)
        cv2.circle(picture, begin, 2, (160, 90, 0), cv2.FILLED, cv2.LINE_AA)
    text = (
        f"rms {found.rms_px:.2f} px (lines x{enlarged:g}), {found.views} views, {found.coverage:.0%} covered, "
        f"f {found.camera.fx_px:.1f} +- {found.sigma_px[0]:.1f}"
    )
    cv2.putText(picture, text, (8, found.size[1] - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return picture
