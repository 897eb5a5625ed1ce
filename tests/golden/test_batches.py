"""How messages are split between calls of the core changes no decision, and no pose by more than rounding."""

from itertools import islice

import pytest
from buddyline.protocol.codec import encode
from buddyline.solver_service.config import SolveConfig
from buddyline.solver_service.core import SolverCore
from buddyline.tools.dives import Dive

from tests.golden import stages
from tests.golden.dives import CAVERN, LAKE
from tests.golden.references import compare_outcomes, differences

TOPICS = ("info", "candidates", "attitude", "depth")


def solve(dive, together):
    """Return the outcomes of a dive handed to the core so many messages at a time."""
    core = SolverCore(SolveConfig().settings("test"), [("a", "b")])
    with Dive(dive.logs) as logs:
        messages = [envelope.message for envelope in logs.messages(*TOPICS)]
    rest, outcomes = iter(messages), []
    while some := list(islice(rest, together)):
        outcomes += core.handle_many(some)
    return stages.outcomes_of_messages([encode(one) for one in outcomes + core.flush()])


@pytest.mark.parametrize("dive", [CAVERN, LAKE], ids=lambda dive: dive.name)
def test_batches_change_nothing(dive):
    one_by_one = solve(dive, 1)
    assert len(one_by_one) > 100
    for together in (7, 100_000):
        assert differences(one_by_one, solve(dive, together), compare_outcomes) == []
