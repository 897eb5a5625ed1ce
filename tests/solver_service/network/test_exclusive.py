"""Each candidate is one lamp's at most."""

import math

import numpy as np
import pytest
from buddyline.solver_service.network.exclusive import share
from buddyline.solver_service.track.association import associate

from tests.solver_service.track.assignments import weigh

P = np.diag([4.0, 4.0])
CLUTTER = 4 / (820 * 616)
SIGMA = np.full(4, 0.7)
DETECTION = np.array((0.9, 0.9))


def bar(*lights):
    """Residuals of four candidates from a bar's two lights, which are expected at (u, v) px each."""
    candidates = np.array(((100.0, 50.0), (200.0, 50.0), (300.0, 60.0), (400.0, 60.0)))
    y = candidates[:, None, :] - np.array(lights)[None]
    H = np.broadcast_to(np.eye(2), (4, 2, 2, 2))
    return y, H, P, SIGMA, DETECTION, CLUTTER


LEFT, RIGHT = bar((100.5, 50.2), (199.8, 49.9)), bar((300.3, 59.5), (400.1, 60.4))


def test_bars_that_want_different_candidates_are_as_if_alone():
    shared = share([weigh(*LEFT), weigh(*RIGHT)], SIGMA)
    alone = [associate(*LEFT), associate(*RIGHT)]
    assert [one[:3] for one in shared.chosen] == [(0, 0, 0), (1, 0, 1), (2, 1, 0), (3, 1, 1)]
    for i, one in enumerate(alone):
        assert shared.seen[i] == pytest.approx(one.seen, abs=1e-6)
        assert shared.evidence[i] == pytest.approx(one.evidence, abs=1e-6)
    assert shared.total == pytest.approx(sum(one.evidence for one in alone), abs=1e-6)


def test_what_one_bar_explains_is_no_evidence_for_another():
    """A second bar is expected where the first one is, but less exactly: its own lights must be elsewhere."""
    other = bar((109.0, 50.2), (209.0, 49.9))
    shared = share([weigh(*LEFT), weigh(*other)], SIGMA)
    assert {(k, b) for k, b, _, _ in shared.chosen} == {(0, 0), (1, 0)}
    assert shared.evidence[1] < 0.0 < shared.evidence[0]
    assert shared.seen[1].max() < 0.05
    assert associate(*other).evidence > 3.0


def test_of_two_bars_alike_neither_gets_a_candidate():
    shared = share([weigh(*LEFT), weigh(*LEFT)], SIGMA)
    assert shared.chosen == ()
    assert shared.seen == pytest.approx(np.full((2, 2), 0.5), abs=0.02)
    # One of them shows both lights and the other none, either way round, or each shows one.
    ways = math.exp(shared.total - associate(*LEFT).evidence - 2 * math.log(0.1))
    assert 2.0 < ways < 4.0
