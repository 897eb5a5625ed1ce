"""The sigma of located lights against their errors, in the sample dives, which another renderer made.

No term of sigma is fitted to these dives. But the choice between fits was made by their poses, so they are a guard
against a worse sigma, and no independent proof of a good one.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from buddyline.node.detect import make_detector
from buddyline.node.drivers.stored import decode_picture
from buddyline.protocol.clock import trigger_index
from buddyline.tools.dives import Dive

DIVES = Path(__file__).parents[3] / "shared" / "data" / "dives"
WATERS = ("cavern", "night_reef", "lake", "basin")

pytestmark = pytest.mark.skipif(not DIVES.exists(), reason="needs the sample dives in ../shared")


class Found(NamedTuple):
    """A light that a candidate is within 1 % of the width of. square: its squared error over the variance per axis."""

    square: float
    radius_px: float
    border_px: float
    range_m: float
    peak: float


@pytest.fixture(scope="module")
def found():
    lights = []
    for water in WATERS:
        with Dive([str(DIVES / f"{water}.mcap"), str(DIVES / f"{water}.truth.mcap")]) as dive:
            infos = dive.infos()
            detectors = {node: make_detector(focal_px=info.camera.fx_px) for node, info in infos.items()}
            true, range_m = {}, {}
            for envelope in dive.messages("light_truth", "truth"):
                said = envelope.message
                if envelope.topic.name == "truth":
                    range_m[said.trigger] = float(np.linalg.norm(said.t_a_b_m))
                else:
                    true[said.node, said.trigger] = [(x.u_px, x.v_px) for x in said.lights if x.visible]
            for envelope in dive.messages("image"):
                trigger = trigger_index(envelope.message.stamp_ns, infos[envelope.node].trigger_period_ns)
                picture = decode_picture(envelope.message.data, "picture")
                blobs = [d.blob for d in detectors[envelope.node].detect(picture)]
                height, width = picture.shape[:2]
                for u_px, v_px in true.get((envelope.node, trigger), []):
                    blob = min(blobs, key=lambda b: np.hypot(b.u_px - u_px, b.v_px - v_px))
                    away_px = np.hypot(blob.u_px - u_px, blob.v_px - v_px)
                    if away_px <= 0.01 * width:
                        border_px = min(blob.u_px, blob.v_px, width - 1 - blob.u_px, height - 1 - blob.v_px)
                        radius_px = np.sqrt(blob.area_px / np.pi)
                        square = (away_px / blob.sigma_px) ** 2
                        lights.append(Found(square, radius_px, border_px, range_m.get(trigger, np.nan), blob.peak))
    assert len(lights) > 700
    return lights


def beyond(lights):
    """Return the share of lights whose error is beyond the circle that should hold 99.73 % (3 sigma in 1D)."""
    assert len(lights) > 20
    return np.mean([light.square > 11.83 for light in lights])


@pytest.mark.slow
def test_errors_are_as_large_as_sigma_says(found):
    assert 0.7 < np.mean([light.square for light in found]) / 2 < 1.3


@pytest.mark.parametrize(("from_m", "to_m"), [(0, 2), (2, 3), (3, 5), (5, 20)])
def test_few_errors_are_beyond_sigma_at_any_range(found, from_m, to_m):
    assert beyond([light for light in found if from_m <= light.range_m < to_m]) < 0.05


def test_few_errors_are_beyond_sigma_with_and_without_a_clipped_core(found):
    assert beyond([light for light in found if light.peak >= 240]) < 0.05
    assert beyond([light for light in found if light.peak < 240]) < 0.05


def test_few_errors_are_beyond_sigma_where_the_border_cuts_the_light(found):
    assert beyond([light for light in found if light.border_px < light.radius_px + 5.0]) < 0.05
