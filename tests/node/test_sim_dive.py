"""A simulated dive as a stream of messages."""

import threading
from collections import Counter
from itertools import pairwise

import cv2
import numpy as np
import pytest
from buddyline.node.config import NodeConfig, SimulationConfig
from buddyline.node.sim.devices import SimulatedCamera
from buddyline.node.sim.dive import messages
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS, ManualClock, trigger_index
from buddyline.protocol.codec import encode
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Candidates, CompressedImage, LightTruth, NodeInfo, Truth

START_NS = 1_764_000_000 * S_NS


def _dive(plan, **scenario):
    return list(messages(World(Scenario(seed=3, start_ns=START_NS, **scenario)), plan))


def test_a_dive_holds_every_topic_at_its_rate_in_order_of_time():
    entries = _dive(DivePlan(seconds=4, rate_hz=5, imu=True, lost_share=0.0))
    counts = Counter(key for _, key, _ in entries)
    assert counts.pop("buddyline/pair/a/b/truth") == 19
    assert [counts.pop(f"buddyline/net/main/truth/{node}") for node in "ab"] == [19, 19]
    for node in "ab":
        of_node = {key.rsplit("/", 1)[1]: counts.pop(key) for key in list(counts) if f"/{node}/" in key}
        assert of_node == {
            "info": 1, "attitude": 200, "depth": 40, "imu": 400, "candidates": 19, "light_truth": 19,
        }  # fmt: skip
    assert not counts
    stamps = [stamp_ns for stamp_ns, _, _ in entries]
    assert stamps == sorted(stamps)
    assert stamps[0] == START_NS
    assert isinstance(entries[0][2], NodeInfo)
    assert all(encode(message) for _, _, message in entries)


def test_triggers_follow_the_protocol_and_exposures_have_jitter():
    period_ns = DivePlan(rate_hz=8).period_ns
    entries = _dive(DivePlan(seconds=10, rate_hz=8, lost_share=0.1))
    frames = [m for _, _, m in entries if isinstance(m, Candidates) and m.node == "a"]
    truths = {m.trigger: m for _, _, m in entries if isinstance(m, Truth)}
    lights = [m for _, _, m in entries if isinstance(m, LightTruth) and m.node == "a"]
    strays_ns = np.array([m.stamp_ns - m.trigger * period_ns for m in frames])
    assert 1.0e6 < strays_ns.std() < 2.0e6
    assert 55 < len(frames) < len(truths) == 79
    assert [m.seq for m in frames] == list(range(len(frames)))
    assert all(truths[m.trigger].stamp_ns == m.trigger * period_ns for m in frames)
    assert [(m.stamp_ns, m.trigger) for m in frames] == [(m.stamp_ns, m.trigger) for m in lights]
    assert any(later.trigger - earlier.trigger > 1 for earlier, later in pairwise(frames))


def test_stamps_are_off_the_exposures_that_the_pictures_show():
    world = World(Scenario(seed=3, start_ns=START_NS))
    for _, _, seen in _dive(DivePlan(seconds=3)):
        if isinstance(seen, LightTruth | Candidates):
            taken_ns = seen.stamp_ns - world.stamp_error_ns(seen.node, seen.trigger)
            if isinstance(seen, LightTruth):
                assert seen.lights == world.light_truth(seen.node, taken_ns, seen.trigger).lights
            else:
                assert seen.blobs == world.candidates(seen.node, taken_ns, seen.trigger, seen.seq, seen.boot).blobs
    config = NodeConfig(node="a", simulation=SimulationConfig(seed=3, start_ns=START_NS))
    camera = SimulatedCamera(config, ManualClock(START_NS))
    frames = [camera.next_frame(threading.Event()) for _ in range(3)]
    triggers = [trigger_index(frame.stamp_ns, config.trigger_period_ns) for frame in frames]
    instants_ns = [trigger * config.trigger_period_ns + world.stamp_error_ns("a", trigger) for trigger in triggers]
    assert [frame.stamp_ns for frame in frames] == instants_ns
    errors_ns = np.array([world.stamp_error_ns(node, trigger) for node in "ab" for trigger in range(200)])
    assert errors_ns.std() == pytest.approx(1e6, rel=0.15)
    exact = World(Scenario(seed=3, start_ns=START_NS, stamp_sigma_ns=0))
    assert exact.stamp_error_ns("a", 1) == 0


def test_the_same_seed_is_the_same_dive_to_the_last_bit():
    one, two = (_dive(DivePlan(seconds=2)) for _ in range(2))
    assert [encode(m) for _, _, m in one] == [encode(m) for _, _, m in two]


def test_a_dive_with_images_holds_what_the_camera_saw():
    scenario = {"environment": "lake", "width_px": 410, "height_px": 308}
    pictures = [
        m for _, _, m in _dive(DivePlan(seconds=0.5, images=True), **scenario) if isinstance(m, CompressedImage)
    ]
    assert {m.frame_id for m in pictures} == {"a_camera", "b_camera"}
    world = World(Scenario(seed=3, start_ns=START_NS, **scenario))
    image = cv2.imdecode(np.frombuffer(pictures[0].data, np.uint8), cv2.IMREAD_COLOR)
    seen = world.render(pictures[0].frame_id[0], pictures[0].stamp_ns)
    assert image.shape == seen.shape
    assert np.abs(image.astype(float) - seen).mean() < 2.0


@pytest.mark.parametrize(
    ("wrong", "named"), [({"seconds": 0.0}, "seconds"), ({"rate_hz": -1.0}, "rate_hz"), ({"lost_share": 2.0}, "lost")]
)
def test_what_cannot_be_logged_is_refused_by_name(wrong, named):
    with pytest.raises(BuddylineError, match=named):
        DivePlan(**wrong)
