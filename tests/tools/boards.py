"""Pictures of the calibration board as a known camera would take them."""

from __future__ import annotations

import cv2
import numpy as np
from buddyline.tools.calibration.board import Board
from numpy.typing import NDArray

SIZE = (640, 480)
FOCAL_PX = 520.0
K = np.array([[FOCAL_PX, 0.0, 322.0], [0.0, FOCAL_PX * 1.002, 236.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([0.12, -0.05, 0.0, 0.0, 0.0])  # a flat port in water pulls the corners outwards


def take(board: Board, rvec: NDArray[np.float64], tvec: NDArray[np.float64], seed: int = 0) -> NDArray[np.uint8]:
    """Return a grey picture of the board at a pose (board to camera), with noise of two grey levels."""
    modules = np.where(board.modules(), 30, 220).astype(np.uint8)
    fine = cv2.resize(modules, None, fx=8, fy=8, interpolation=cv2.INTER_NEAREST)
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    rays = cv2.undistortPoints(np.stack([u.ravel(), v.ravel()], -1)[:, None, :], K, DISTORTION).reshape(-1, 2)
    R = cv2.Rodrigues(np.asarray(rvec, float))[0]
    H = np.column_stack([R[:, 0], R[:, 1], tvec])
    on_board = np.linalg.solve(H, np.column_stack([rays, np.ones(len(rays))]).T).T
    xy = on_board[:, :2] / on_board[:, 2:]
    pixels_per_m = fine.shape[1] / (board.columns * board.square_m)
    where = (xy * pixels_per_m - 0.5).astype(np.float32).reshape(SIZE[1], SIZE[0], 2)
    picture = cv2.remap(fine, where, None, cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    picture = cv2.GaussianBlur(picture, (3, 3), 0.7)
    noise = np.random.default_rng(seed).normal(0, 2, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def poses(board: Board, n: int, tilt_rad: float = 0.6, reach: float = 0.75, seed: int = 1):
    """Yield n poses (rvec, tvec): the board's middle all over the picture, tilted every way."""
    rng = np.random.default_rng(seed)
    middle = np.array([board.columns, board.rows, 0.0]) * board.square_m / 2
    for i in range(n):
        tilt = rng.uniform(-tilt_rad, tilt_rad, 3) * [1, 1, 0.5]
        z = rng.uniform(0.26, 0.42)
        across = reach * (np.array([(i * 0.618) % 1, (i * 0.382 + 0.3) % 1]) - 0.5)
        centre = np.array([across[0] * SIZE[0] / FOCAL_PX * z, across[1] * SIZE[1] / FOCAL_PX * z, z])
        yield tilt, centre - cv2.Rodrigues(tilt)[0] @ middle
