"""One pair's solver: splitting its triggers into calls changes nothing, and absurd values spoil no other trigger."""

from dataclasses import replace

import numpy as np
import pytest
from buddyline.protocol.messages import Candidates
from buddyline.solver_service import pair
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.observation import Settings
from buddyline.solver_service.geometry.trigger import Fix, NoFix, TriggerReadings
from buddyline.solver_service.pair import PairSolver
from buddyline.solver_service.prior import PosePrior

from tests.solver_service.conftest import dive_messages


class Collecting(PairSolver):
    def __init__(self):
        super().__init__(Settings())
        self.seen = []

    def solve(self, matched):
        self.seen += matched
        return super().solve(matched)


@pytest.fixture(scope="module")
def matched():
    """Triggers with all four lights, with three, and with an unknown lamp beside them; a calibration changes."""
    messages, _ = dive_messages(seconds=8.0, seed=5)
    core = SolverCore(Settings(), [("a", "b")])
    (pair,) = core.pairs.values()
    pair.solver = Collecting()
    for k, message in enumerate(messages):
        short = isinstance(message, Candidates) and message.node == "b" and k % 3 == 0
        core.handle(message if not short else _without_the_first(message))
    core.flush()
    seen = pair.solver.seen
    return seen[:30] + [replace(one, rig_b=replace(one.rig_b)) for one in seen[30:]]


def _without_the_first(frame):
    return type(frame)(**{name: getattr(frame, name) for name in frame.__struct_fields__} | {"blobs": frame.blobs[1:]})


def solve(matched, size):
    solver = PairSolver(Settings())
    return [fix for start in range(0, len(matched), size) for fix in solver.solve(matched[start : start + size])]


def assert_same(found, expected):
    for one, other in zip(found, expected, strict=True):
        if isinstance(other, NoFix):
            assert one == other
            continue
        for name in ("method", "pair_a", "pair_b", "checks", "hypotheses"):
            assert getattr(one, name) == getattr(other, name)
        sigma = np.sqrt(other.covariance.diagonal())
        assert np.abs(one.T_a_b.minus(other.T_a_b) / sigma).max() < 1e-9
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-9, atol=1e-9 * sigma.max() ** 2)
        for name in ("chi2", "probability", "range_a_m", "range_b_m", "twist_gap_rad"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("size", [7, 1000])
def test_how_triggers_are_split_into_calls_changes_nothing(matched, size):
    expected = solve(matched, 1)
    assert {"refined", "three_lights"} <= {fix.method for fix in expected if isinstance(fix, Fix)}
    assert any(isinstance(fix, NoFix) for fix in expected)
    assert_same(solve(matched, size), expected)


@pytest.mark.parametrize(
    "absurd",
    [{"depth_m": 1e308}, {"q_ned_body_xyzw": np.full(4, 1e200)}, {"sigma_rad": np.full(3, 1e300)}],
    ids=["depth", "attitude", "sigma"],
)
def test_an_absurd_value_spoils_no_other_trigger(matched, absurd):
    spoiled = [*matched[:20], replace(matched[20], sensed_a=replace(matched[20].sensed_a, **absurd)), *matched[21:]]
    together = solve(spoiled, 1000)
    assert_same(together, solve(spoiled, 1))
    assert_same(together[:20], solve(matched, 1)[:20])
    assert sum(isinstance(fix, Fix) for fix in together[21:]) > 30


@pytest.mark.parametrize("place", ["read", "decide", "remember"])
def test_only_what_absurd_values_lead_to_is_a_rejection(matched, monkeypatch, place):
    """A fault of this program must not look like a lack of data."""

    def fail_with(error):
        def fails(*_):
            raise error

        owner, name = {
            "read": (pair, "read_triggers"),
            "decide": (TriggerReadings, "decide"),
            "remember": (PosePrior, "update"),
        }[place]
        monkeypatch.setattr(owner, name, fails)

    fail_with(np.linalg.LinAlgError("Singular matrix"))
    found = solve(matched[:4], 4)
    assert not any(isinstance(one, Fix) for one in found)
    said = "degenerate", "values from a or b are out of numeric range (Singular matrix)"
    assert said in {(one.reason, one.detail) for one in found}
    fail_with(ValueError("a fault"))
    with pytest.raises(ValueError, match="a fault"):
        solve(matched[:4], 4)
