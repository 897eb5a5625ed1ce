"""A bounded run of every target; `python -m tests.fuzz --minutes N` is the long one."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.clients import ALL_TARGETS

EXAMPLES = {"ros": 60, "digests": 60, "decoders": 200, "logs": 25, "configuration": 150, "solver": 10, "clients": 15}


@pytest.mark.parametrize("name", ALL_TARGETS)
def test_nothing_but_known_errors_comes_out(name):
    run = settings(
        max_examples=EXAMPLES[name], deadline=None, derandomize=True, database=None, suppress_health_check=HealthCheck
    )(given(data=st.data())(ALL_TARGETS[name]))
    run()
