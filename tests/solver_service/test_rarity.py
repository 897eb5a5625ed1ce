"""How rarely four lights are found decides what passes for four lights."""

import numpy as np
import pytest
from buddyline.protocol.messages import RelativePose
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.fix import Fix, NoFix
from buddyline.solver_service.geometry.observation import Observation, Settings
from buddyline.solver_service.geometry.trigger import read_triggers
from buddyline.solver_service.rarity import Rarity

from tests.solver_service.conftest import dive_messages
from tests.solver_service.scenes import random_scene


def four_lights(rarity):
    """Solve a scene with false candidates, where four lights are so much rarer than usual."""
    rng = np.random.default_rng(4)
    scene = random_scene(rng, 5.0)
    (a, _), (b, _) = scene.views(rng, sigma_px=0.7, false=3)
    seen = Observation(a, b, *scene.sensed(rng))
    return read_triggers([seen], scene.rig_a, scene.rig_b, Settings()).decide(0, None, None, rarity)


def test_rare_four_lights_must_be_likelier():
    assert isinstance(four_lights(1.0), Fix)
    found = four_lights(1e12)
    assert isinstance(found, NoFix)
    assert found.reason == "ambiguous"


def test_four_lights_are_rare_only_after_many_triggers_without():
    rarity = Rarity()
    assert rarity.factor == 1.0
    lost, fix = NoFix("ambiguous", ""), four_lights(1.0)
    for k in range(200):
        rarity.take(fix if k % 3 else lost)
    for _ in range(30):
        rarity.take(lost)
    assert rarity.factor < 2.0
    for _ in range(1000):
        rarity.take(lost)
    assert rarity.factor > 1e3
    rarity.take(fix)
    assert rarity.factor < 1e5


@pytest.mark.parametrize("reason", ["too_few_candidates", "degenerate", "out_of_range"])
def test_triggers_that_say_nothing_of_the_lamps_do_not_count(reason):
    rarity = Rarity()
    for _ in range(100):
        rarity.take(NoFix(reason, ""))
    assert rarity.factor == 1.0


def test_triggers_that_cannot_choose_among_fours_do_not_make_four_lights_rare():
    """Cameras alone often leave two poses: that says nothing against all four lights."""
    rarity = Rarity()
    for _ in range(1000):
        rarity.take(NoFix("ambiguous", "", all_four=0.9))
    assert rarity.factor == 1.0


def test_a_dive_that_only_ranges_check_keeps_its_poses(monkeypatch):
    messages, _ = dive_messages(seconds=40.0)

    def poses():
        core = SolverCore(Settings(checks=frozenset({"range"})), [("a", "b")])
        found = core.handle_many(messages) + core.flush()
        return sum(isinstance(one, RelativePose) for one in found)

    with_rarity = poses()
    monkeypatch.setattr(Rarity, "factor", 1.0)
    assert 0 < poses() <= 1.1 * with_rarity
