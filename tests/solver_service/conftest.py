"""A short simulated dive as messages, in the order they were made."""

import msgspec
import pytest
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import trigger_index

START_NS = 1_764_000_000_000_000_000
PERIOD_NS = 100_000_000


def dive_messages(seconds=6.0, seed=3, sensors=True, period_ns=PERIOD_NS, imu=False, **changes):
    world = World(Scenario(environment="basin", seed=seed, start_ns=START_NS, interruptions=False, **changes))
    timed = []
    for node in ("a", "b"):
        timed.append((START_NS, 0, world.info(node, START_NS, period_ns)))
        for k in range(2, int(seconds * 1e9 / period_ns)):
            stamp_ns = START_NS + k * period_ns
            trigger = trigger_index(stamp_ns, period_ns)
            timed.append((stamp_ns + 20_000_000, 2, world.candidates(node, stamp_ns, trigger, k, "test")))
        if sensors:
            for i in range(int(seconds * 50)):
                stamp_ns = START_NS + i * 20_000_000
                timed.append((stamp_ns, 1, world.attitude(node, stamp_ns)))
                if i % 5 == 0:
                    timed.append((stamp_ns, 1, world.depth(node, stamp_ns)))
        if imu:
            for i in range(int(seconds * 100)):
                stamp_ns = START_NS + i * 10_000_000
                timed.append((stamp_ns, 1, world.imu(node, stamp_ns)))
    timed.sort(key=lambda item: item[:2])
    return [message for _, _, message in timed], world


def assert_same_outcomes(found, expected):
    """What is solved together differs from what is solved alone by the order of sums, and by no more."""
    found, expected = list(found), list(expected)
    assert [type(one) for one in found] == [type(one) for one in expected]
    for one, other in zip(map(msgspec.to_builtins, found), map(msgspec.to_builtins, expected), strict=True):
        assert one.keys() == other.keys()
        for field, value in one.items():
            is_number = isinstance(value, float) or (isinstance(value, tuple | list) and "blobs" not in field)
            wanted = (
                pytest.approx(other[field], rel=1e-8, abs=1e-9) if is_number and field != "checks" else other[field]
            )
            assert value == wanted, field


@pytest.fixture(scope="session")
def dive():
    return dive_messages()
