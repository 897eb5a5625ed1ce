"""Who is who by blinking: the code tells a node's lamp from strange ones, and no pose takes one for a dark lamp."""

from __future__ import annotations

import numpy as np
import pytest
from buddyline.node.sim import dive as simulation
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.blinking import lit
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Blink, Candidates, Depth, NodeInfo, RelativePose
from buddyline.solver_service.blinking import MOST, LampFollower
from buddyline.solver_service.config import SolveConfig
from buddyline.solver_service.core import SolverCore

SLOT_NS = S_NS // 10
START_NS = 1_764_000_000 * S_NS
WIDTH_PX, HEIGHT_PX = 820, 616
CODE = Blink(code=1, lamp="left", slot_ns=SLOT_NS)
# Sigma of candidates; shares of lamps that are missed, and that are off by a gross error; false candidates a picture.
NOISE_PX, GROSS_PX = 0.7, 6.0
MISSED = GROSS = 0.03
FALSE = 3


class Lamps:
    """A node's lamps (the first two; the first blinks) and strange ones, in pictures of a camera that sways."""

    def __init__(self, seed: int, strange: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.place = rng.uniform((60, 60), (WIDTH_PX - 60, HEIGHT_PX - 60), (strange + 2, 2))
        self.speed = rng.normal(0.0, 25.0, (strange + 2, 2))
        self.sway = rng.uniform(20.0, 80.0, 2), rng.uniform(0.2, 0.6, 2), rng.uniform(0.0, 6.0, 2)

    def picture(self, slot: int) -> tuple[np.ndarray, int | None]:
        """Return the candidates of a slot's picture, and which of them is the lamp that blinks."""
        t_s, rng = 0.1 * slot, self.rng
        width, hz, phase = self.sway
        place = self.place + t_s * self.speed + width * np.sin(2.0 * np.pi * hz * t_s + phase)
        place = place + rng.normal(0.0, NOISE_PX, place.shape)
        place += (rng.random((len(place), 1)) < GROSS) * rng.normal(0.0, GROSS_PX, place.shape)
        shown = rng.random(len(place)) > MISSED
        shown[0] &= lit(CODE, START_NS + slot * SLOT_NS)[0]
        false = rng.uniform((0, 0), (WIDTH_PX, HEIGHT_PX), (FALSE, 2))
        order = rng.permutation(int(shown.sum()) + FALSE)
        found = np.concatenate((place[shown], false))[order]
        return found, int(np.flatnonzero(order == 0)[0]) if shown[0] else None


def test_among_eight_strange_lamps_a_second_tells_which_is_whose() -> None:
    right = told = 0
    for seed in range(120):
        lamps, follower = Lamps(seed, strange=8), LampFollower()
        last = None
        # The pictures of one second; the last of them with the lamp.
        for slot in range(seed, seed + 11):
            pixels, own = lamps.picture(slot)
            seen = follower.take(START_NS + slot * SLOT_NS, pixels, WIDTH_PX, CODE)
            if own is not None:
                last = own, seen.log_ratio[:, 0]
        assert last is not None
        own, log_ratio = last
        right += int(log_ratio.argmax()) == own
        told += log_ratio[own] > np.log(0.9 * np.exp(log_ratio).sum())
    assert right >= 0.99 * 120
    assert told >= 0.85 * 120


def test_a_candidate_in_place_of_a_dark_lamp_is_another() -> None:
    follower, dark = LampFollower(), 0
    pixels = np.array([(200.0, 300.0), (500.0, 310.0)])
    for slot in range(20):
        seen = follower.take(START_NS + slot * SLOT_NS, pixels, WIDTH_PX, CODE)
        assert seen.dark == (not lit(CODE, START_NS + slot * SLOT_NS)[0], False)
        dark += seen.dark[0]
        if seen.dark[0]:
            assert seen.log_ratio[:, 0] == pytest.approx(seen.log_ratio[0, 0])
            assert -MOST <= seen.log_ratio[0, 0] < -2.0
            assert np.abs(seen.log_ratio[:, 1]).max() < 0.1
    assert dark == 6


@pytest.mark.parametrize("count", [0, 1, 64])
def test_any_number_of_candidates_can_be_followed(count: int) -> None:
    rng, follower = np.random.default_rng(1), LampFollower()
    for slot in (0, 1, 2, 3, 90, 89, 91):
        pixels = rng.uniform((0, 0), (WIDTH_PX, HEIGHT_PX), (count, 2))
        seen = follower.take(START_NS + slot * SLOT_NS, pixels, WIDTH_PX, CODE, whole=slot % 2 == 0)
        assert seen.log_ratio.shape == (count, 2)
        assert np.isfinite(seen.log_ratio).all()


def test_poses_of_a_pair_that_blinks_never_take_a_stranger_for_a_dark_lamp() -> None:
    plan = DivePlan(seconds=8.0)
    world = World(Scenario(seed=2, start_ns=START_NS, other_lamps=8, interruptions=False, blink_slot_ns=plan.period_ns))
    core = SolverCore(SolveConfig().settings("test"))
    infos: dict[str, NodeInfo] = {}
    poses = []
    for _, _, message in simulation.messages(world, plan):
        if isinstance(message, NodeInfo):
            infos[message.node] = message
        if isinstance(message, NodeInfo | Candidates | Attitude | Depth):
            poses += [one for one in core.handle(message) if isinstance(one, RelativePose)]
    of_dark = 0
    for pose in poses:
        for other, blobs in (("b", pose.blobs_a), ("a", pose.blobs_b)):
            if not lit(infos[other].blink, pose.trigger * plan.period_ns)[0]:
                of_dark += 1
                assert blobs[0] == -1
    assert of_dark > 20
    assert len(poses) > 50
