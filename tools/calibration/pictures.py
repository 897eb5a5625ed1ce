"""Pictures that show the quality of a calibration; drawn with OpenCV, written as PNG or JPEG."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.calibration.ellipsoid import EllipsoidFit
from buddyline.tools.calibration.lights import LightsFit, TapedPlace
from buddyline.tools.newfile import write_new
from numpy.typing import NDArray

Image = NDArray[np.uint8]

DISC_PX: Final = 190
ROW_PX: Final = 34
BLACK: Final = (0, 0, 0)
GREY: Final = (170, 170, 170)
RED: Final = (40, 40, 210)
BLUE: Final = (190, 110, 20)


def write_picture(path: Path, picture: Image) -> None:
    """Write a new picture; raise BuddylineError if the file exists or cannot be written."""
    try:
        _, data = cv2.imencode(path.suffix, picture)
    except cv2.error as error:
        raise BuddylineError(f"{path}: give a name that ends in .png or .jpg") from error
    write_new(path, data.tobytes())


def draw_magnetometer(found: EllipsoidFit) -> Image:
    """Return both halves of the sphere of directions, from below and from above, coloured by the error of strength.

    Blue: no error. Red: 3 % or more. White: no readings.
    """
    size = 2 * DISC_PX + 40
    picture = np.full((size + 40, 2 * size, 3), 255, np.uint8)
    for half, name in ((0, "field towards the body's down"), (1, "towards its up")):
        centre = (half * size + size // 2, size // 2)
        cv2.circle(picture, centre, DISC_PX, GREY, 1, cv2.LINE_AA)
        _text(picture, name, (half * size + 10, 18))
    for direction, error in zip(found.directions, found.errors, strict=True):
        x, y, z = direction.tolist()
        half = 0 if z >= 0 else 1
        reach = DISC_PX * np.sqrt(1 - abs(z)) / max(np.hypot(x, y), 1e-9)
        at = (round(half * size + size / 2 + reach * y), round(size / 2 - reach * x))
        share = min(abs(error) / 0.03, 1.0)
        colour = tuple(round(b + share * (r - b)) for b, r in zip(BLUE, RED, strict=True))
        cv2.circle(picture, at, 3, colour, cv2.FILLED, cv2.LINE_AA)
    _text(
        picture,
        f"{len(found.errors)} readings, {found.coverage:.0%} of directions, strength within {found.residual:.1%}, "
        f"heading within {np.degrees(found.heading_sigma_rad):.2f} deg",
        (10, size + 22),
    )
    return picture


def draw_lights(found: LightsFit, places: list[TapedPlace]) -> Image:
    """Return a bar chart of each place's pixel residual (blue) and tape gap (red)."""
    width, left = 760, 200
    picture = np.full((ROW_PX * (len(places) + 2), width, 3), 255, np.uint8)
    _text(picture, "pixels rms (blue, full: 2 px)   tape gap (red, full: 20 mm)", (10, 20))
    for i, place in enumerate(places):
        y = ROW_PX * (i + 1)
        pixel_px, gap_m = float(found.pixel_rms_px[i]), float(found.tape_gaps_m[i])
        _text(picture, f"{place.name}: {place.distance_m:.3f} m", (10, y + 18))
        room = width - left - 130
        for row, share, colour in ((4, pixel_px / 2, BLUE), (16, abs(gap_m) / 0.02, RED)):
            end = left + round(room * min(share, 1.0))
            cv2.rectangle(picture, (left, y + row), (end, y + row + 8), colour, cv2.FILLED)
        _text(picture, f"{pixel_px:.2f} px {gap_m * 1e3:+.1f} mm", (width - 125, y + 18))
    a_mm, b_mm = (1e3 * np.linalg.norm(found.lights_m[:, 1] - found.lights_m[:, 0], axis=1)).tolist()
    _text(
        picture,
        f"bars {a_mm:.1f} +- {found.bar_sigma_m[0] * 1e3:.1f} mm, "
        f"{b_mm:.1f} +- {found.bar_sigma_m[1] * 1e3:.1f} mm, chi2 {found.chi2:.2f}",
        (10, ROW_PX * (len(places) + 1) + 18),
    )
    return picture


def _text(picture: Image, text: str, at: tuple[int, int]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, BLACK, 1, cv2.LINE_AA)
