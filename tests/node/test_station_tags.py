"""Station tags in pictures: what is read, and what is not."""

import numpy as np
import pytest
from buddyline.node.config import StationTagsConfig
from buddyline.node.devices import Frame
from buddyline.node.station_tags import WITHIN_NS, StationTags
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Mark

from tests.tagged import CAMERA, frame

NEAR = {117: 0.6}


def reader(**table):
    return StationTags("a", StationTagsConfig(**table), CAMERA.fx_px)


def marks(tags, shown, context=True, step_ns=2 * S_NS):
    """What is read of pictures, one after the other; shown: each one's tags."""
    rng = np.random.default_rng(3)
    frames = [frame(rng, (k + 1) * step_ns, one, context=context) for k, one in enumerate(shown)]
    return [tags.read(one) for one in frames]


def test_a_near_tag_in_three_pictures_names_the_station():
    # One picture that does not show it is no harm.
    *before, third, fourth = marks(reader(), [NEAR, {}, NEAR, NEAR, NEAR])
    assert before == [None] * 3
    assert third == Mark(node="a", stamp_ns=8 * S_NS, name="T117", note=third.note, tag=117)
    assert fourth.stamp_ns == 10 * S_NS
    assert float(third.note.split()[2]) == pytest.approx(0.6, abs=0.11)


@pytest.mark.parametrize(
    "shown",
    [
        [NEAR, NEAR, {}],  # swum past
        [NEAR, NEAR, {118: 0.6}, NEAR],  # two tags
        [{117: 1.6}] * 3,  # another station's, far away
        [{117: 0.6, 118: 0.7}] * 3,  # which of the two?
        [{3: 0.6}] * 3,  # a tag on a node
        [{}] * 3,
    ],
)
def test_what_is_not_clearly_shown_names_nothing(shown):
    assert marks(reader(), shown) == [None] * len(shown)


def test_a_tag_far_behind_the_near_one_does_not_matter():
    assert marks(reader(), [{117: 0.45, 118: 0.9}] * 3)[2].tag == 117


def test_only_pictures_of_the_scene_are_looked_at():
    assert marks(reader(), [NEAR] * 3, context=False) == [None] * 3
    assert marks(reader(side_m=0), [NEAR] * 3) == [None] * 3
    assert marks(reader(), [NEAR] * 3, step_ns=WITHIN_NS) == [None] * 3
    # Where all pictures are alike, one in two seconds is looked at.
    read = marks(reader(), [NEAR] * 9, context=None, step_ns=S_NS // 2)
    assert [k for k, one in enumerate(read) if one] == [8]


def test_a_large_or_grey_picture_gives_the_same_distance():
    tags, rng = StationTags("a", StationTagsConfig(), 2 * CAMERA.fx_px), np.random.default_rng(3)
    for k in (1, 2, 3):
        one = frame(rng, k * S_NS, NEAR)
        large = np.kron(one.image[..., 1], np.ones((2, 2), np.uint8))
        mark = tags.read(Frame(large, one.stamp_ns, context=True))
    assert float(mark.note.split()[2]) == pytest.approx(0.6, abs=0.11)
