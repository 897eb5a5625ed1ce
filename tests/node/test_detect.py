"""Every detector: its input, its output, and what it refuses."""

import numpy as np
import pytest
from buddyline.node.choices import DETECTORS, PRESETS
from buddyline.node.detect import ImageError, make_detector
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.errors import BuddylineError

from tests.node.rendered import lamp_picture


@pytest.mark.parametrize(
    ("method", "environment"), [("source", "auto"), *(("paper", environment) for environment in PRESETS)]
)
def test_a_plain_lamp_is_found_first_in_every_environment(method, environment):
    image = lamp_picture([(300.3, 120.6)], seed=3)
    found = make_detector(method, environment).detect(image)
    blob = found[0].blob
    assert np.hypot(blob.u_px - 300.3, blob.v_px - 120.6) < 0.6
    assert blob.sigma_px > 0
    assert 0 <= blob.score <= 1


@pytest.mark.parametrize("method", DETECTORS)
@pytest.mark.parametrize(
    "image",
    [
        np.zeros((1, 1), np.uint8),
        np.zeros((1, 1, 3), np.uint8),
        np.full((1, 700, 3), 7, np.uint8),
        np.zeros((60, 80, 3), np.uint8),
        np.full((60, 80), 128, np.uint8),
    ],
    ids=["1x1 grey", "1x1", "one row", "black", "grey"],
)
def test_an_empty_picture_gives_no_candidates(method, image):
    assert make_detector(method).detect(image) == []


@pytest.mark.parametrize("method", DETECTORS)
def test_an_all_white_picture_gives_no_likely_light(method):
    found = make_detector(method).detect(np.full((120, 160, 3), 255, np.uint8))
    assert all(d.blob.score < 0.5 for d in found)


@pytest.mark.parametrize(
    "image",
    [np.zeros((4, 4), np.uint16), np.zeros((4, 4, 4), np.uint8), np.zeros((0, 4), np.uint8), None],
    ids=["16 bit", "four channels", "empty", "not decoded"],
)
@pytest.mark.parametrize("method", DETECTORS)
def test_an_unusable_picture_is_refused_by_name(method, image):
    with pytest.raises(ImageError, match="picture: "):
        make_detector(method).detect(image)


@pytest.mark.parametrize("method", DETECTORS)
def test_candidates_lie_inside_a_picture_full_of_noise(method):
    image = np.random.default_rng(5).integers(0, 256, (90, 130, 3)).astype(np.uint8)
    for d in make_detector(method).detect(image):
        assert -0.5 <= d.blob.u_px <= 129.5
        assert -0.5 <= d.blob.v_px <= 89.5
        assert d.blob.sigma_px > 0


def test_the_papers_thresholds_of_a_sunlit_basin_keep_its_lamps_and_not_its_glitter():
    world = World(Scenario("basin", seed=31))
    detector = make_detector("paper", "basin")
    near, false = 0, 0
    for i in range(6):
        stamp_ns = 1_000_000_000 + i * 2_300_000_000
        lights = [(x.u_px, x.v_px) for x in world.light_truth("a", stamp_ns, i).lights if x.visible]
        at_px = np.array([(d.blob.u_px, d.blob.v_px) for d in detector.detect(world.render("a", stamp_ns))])
        close = np.hypot(*(at_px[:, None] - lights).transpose(2, 0, 1)) < 8.2
        near += close.any(axis=0).sum() - len(lights)
        false += (~close.any(axis=1)).sum()
    assert near >= -1
    assert false / 6 < 3.0


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(BuddylineError, match="source"):
        make_detector("sauce")
    with pytest.raises(BuddylineError, match="night_reef"):
        make_detector("source", "pond")
    # It adapts by itself: every water is the same to it.
    assert make_detector("source", "lake").detect(np.zeros((308, 410), np.uint8)) == make_detector("source").detect(
        np.zeros((308, 410), np.uint8)
    )
    with pytest.raises(BuddylineError, match="value_min"):
        make_detector("paper", "lake", {"value_mix": 3.0})
    with pytest.raises(BuddylineError, match="focal_px = -1"):
        make_detector(focal_px=-1.0)
    with pytest.raises(BuddylineError, match="finite"):
        make_detector("paper", "lake", {"value_min": float("nan")})
