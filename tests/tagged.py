"""Pictures of a station's tag, as a diver holds it before a camera, from near or in passing."""

import numpy as np
from buddyline.node.devices import Frame
from buddyline.node.sim import rotation, tags
from buddyline.node.sim.camera import pinhole, project

WIDTH, HEIGHT = 820, 616
CAMERA = pinhole(WIDTH, HEIGHT)


def picture(rng, shown, side_m=0.06):
    """Return a picture of turbid water; shown: by tag number, its distance in m. All else is random."""
    full = np.full((HEIGHT, WIDTH, 3), 0.10, np.float32)
    for number, away_m in shown.items():
        square_m = np.array([(-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0)]) * side_m
        tilt = rotation.from_euler(*rng.normal(0, 0.35, 2), rng.uniform(-3, 3))
        centre_m = away_m * np.array([rng.uniform(-0.35, 0.35), rng.uniform(-0.2, 0.2), 1.0])
        board_px = project(tags.board(square_m @ tilt.T) + centre_m, CAMERA)
        light = np.full(3, rng.uniform(0.15, 0.5))
        tags.paint(full, tags.SeenTag(number, board_px, light, np.full(3, rng.uniform(0.5, 0.9))))
    return np.clip(255 * full + rng.normal(0, 4, full.shape), 0, 255).astype(np.uint8)


def frame(rng, stamp_ns, shown, *, context=True):
    """Return a frame with these tags."""
    return Frame(picture(rng, shown), stamp_ns, context=context)
