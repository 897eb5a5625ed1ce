"""What the solver tells the nodes: where to look for the other's lights in the next picture."""

import dataclasses

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, Expect
from buddyline.protocol.topics import EXPECT, key_of
from buddyline.solver_service.config import SolverConfig
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.sensors import SENSOR_WAIT_NS
from msgspec.structs import replace

from tests.solver_service.conftest import PERIOD_NS, dive_messages

LIVE = SolverConfig().track.settings


def expected_of(messages, settings=LIVE):
    """Each expectation with the stamp of the message that completed it."""
    core = SolverCore(Settings(), [("a", "b")], track=settings)
    return [
        (one, message.stamp_ns)
        for message in messages
        for one in core.handle(message, message.stamp_ns + S_NS // 50)
        if isinstance(one, Expect)
    ]


def off_px(light, truth):
    true = next(one for one in truth.lights if one.name == light.side)
    return np.array((light.u_px - true.u_px, light.v_px - true.v_px))


@pytest.fixture(scope="module")
def dive():
    return dive_messages(seconds=8.0, imu=True)


@pytest.fixture(scope="module")
def foretold(dive):
    return expected_of(dive[0])


@pytest.mark.parametrize("imu", [True, False], ids=["inertial unit", "attitude only"])
def test_each_next_picture_is_foretold_before_it_is_taken(dive, foretold, imu):
    messages, world = dive if imu else dive_messages(seconds=8.0)
    found = foretold if imu else expected_of(messages)
    # Inertial samples may come later than pictures: so long a track waits for the first of them.
    begin_ns = messages[0].stamp_ns + (0 if imu else SENSOR_WAIT_NS)
    frames = [message for message in messages if isinstance(message, Candidates) and message.stamp_ns > begin_ns]
    assert len(found) > 0.9 * len(frames)
    squares = []
    for one, known_ns in found:
        assert key_of(one) == EXPECT.key(one.node)
        assert {one.node, one.seen} == {"a", "b"}
        assert 0 < one.stamp_ns - known_ns <= PERIOD_NS
        truth = world.light_truth(one.node, one.stamp_ns, 0)
        for light in one.lights:
            uu, uv, vv = light.covariance_px2
            off = off_px(light, truth)
            squares.append(off @ np.linalg.solve([[uu, uv], [uv, vv]], off))
            assert squares[-1] < 16.0
            assert max(uu, vv) < 30.0**2
    # With inertial samples sigma is the diver's freedom to turn. Without, it is the filter's, and wider.
    assert 0.5 * np.mean(squares) > (0.15 if imu else 0.02)


def test_an_expectation_serves_for_the_picture_after_the_next(dive, foretold):
    _, world = dive
    for one, _ in foretold:
        later = world.light_truth(one.node, one.stamp_ns + PERIOD_NS, 0)
        for light in one.lights:
            uu, _, vv = light.covariance_px2
            sigma_px = np.sqrt(max(uu, vv)) + light.sigma_rate_pxps * PERIOD_NS / S_NS
            ahead = off_px(light, later) + np.array(light.rate_pxps) * PERIOD_NS / S_NS
            assert np.hypot(*ahead) < 4.0 * sigma_px
        assert one.valid_ns >= PERIOD_NS


def test_nothing_is_foretold_where_there_is_no_track(dive):
    messages, _ = dive
    blind = [replace(m, blobs=[]) if isinstance(m, Candidates) else m for m in messages]
    assert expected_of(blind) == []


def test_without_lights_the_expectations_end_before_they_are_guesses(dive):
    messages, _ = dive
    blind_ns = messages[0].stamp_ns + 5 * S_NS
    blind = [replace(m, blobs=[]) if isinstance(m, Candidates) and m.stamp_ns > blind_ns else m for m in messages]
    found = expected_of(blind)
    assert any(one.stamp_ns > blind_ns + S_NS // 2 for one, _ in found)
    limit_px2 = (0.04 * 820) ** 2
    for one, _ in found:
        assert all(max(light.covariance_px2[0], light.covariance_px2[2]) < limit_px2 for light in one.lights)


def test_expectations_are_of_the_live_solver_alone(dive):
    messages, _ = dive
    assert expected_of(messages, dataclasses.replace(LIVE, expect=False)) == []


def test_a_pair_without_the_other_nodes_frames_is_told_nothing(dive):
    messages, _ = dive
    half_ns = messages[0].stamp_ns + 4 * S_NS
    alone = [m for m in messages if not (m.node == "b" and isinstance(m, Candidates) and m.stamp_ns > half_ns)]
    # The track waits for b's frames, longer than an expectation reaches ahead.
    found = [one for one, _ in expected_of(alone)]
    for node in ("a", "b"):
        last_ns = max(one.stamp_ns for one in found if one.node == node)
        assert half_ns - S_NS < last_ns < half_ns + S_NS
