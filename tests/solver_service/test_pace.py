"""A solver of many nodes that is behind leaves out triggers, pictures and rows, then tracks, then the network."""

from __future__ import annotations

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, Expect, Message, NodePose, Rejected, RelativePose, Track
from buddyline.solver_service import core
from buddyline.solver_service.config import SolveConfig
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.pace import BEHIND_NS, FAR_NS, JUDGED_NS, NO_NETWORK, NO_TRACK, STOPPED_NS, Pace
from buddyline.solver_service.resting import LOOKS, NO_TIME
from buddyline.solver_service.tracking import TrackSettings

from tests.solver_service.conftest import dive_messages

LIVE = TrackSettings(frozenset(("filter", "lag")), 20.0, expect=True)


class FakeFollower:
    def __init__(self) -> None:
        self.going = True

    def stop(self) -> None:
        self.going = False

    def go_on(self) -> None:
        self.going = True


def test_what_is_followed_ends_by_halves_until_the_solver_catches_up() -> None:
    pace, tracks = Pace(), [FakeFollower() for _ in range(5)]

    def take(behind_ns: int, now_s: float) -> list[bool]:
        pace.take(behind_ns, round(now_s * S_NS), [one for one in tracks if one.going])
        return [one.going for one in tracks]

    assert all(take(BEHIND_NS - 1, 0.0))
    assert pace.one_in == 1
    assert all(take(BEHIND_NS, 1.0))
    assert all(take(FAR_NS, 1.5))
    assert pace.one_in == LOOKS * LOOKS
    halved = [False, True, False, True, False]
    assert take(FAR_NS + 1, 2.0) == halved
    # Not judged anew yet, then less behind than before.
    assert take(2 * FAR_NS, 2.0 + 0.9 * JUDGED_NS / S_NS) == halved
    assert take(FAR_NS, 3.1) == halved
    assert take(FAR_NS + 3, 3.2) == [False, False, False, True, False]
    assert take(FAR_NS + 2, 4.3) == [False, False, False, True, False]
    assert not any(take(FAR_NS + 2, 5.4))
    # Half a minute has passed, but it is still behind.
    assert not any(take(BEHIND_NS, 3.2 + STOPPED_NS / S_NS))
    assert pace.one_in == LOOKS
    assert all(take(0, 3.3 + STOPPED_NS / S_NS))
    assert pace.one_in == 1


@pytest.fixture(scope="module")
def inertial() -> tuple[list[Message], object]:
    return dive_messages(seconds=12.0, imu=True)


def played(
    messages: list[Message], behind_ns: dict[float, int], monkeypatch: pytest.MonkeyPatch, crowd: int = 2
) -> tuple[list[Message], list[str]]:
    """Solve messages of a dive as a solver that is so far behind from these seconds on; give its problems then, too."""
    monkeypatch.setattr(core, "CROWD", crowd)
    solver = SolverCore(SolveConfig().settings("test"), None, track=LIVE)
    results: list[Message] = []
    problems = []
    due, start_ns = dict(behind_ns), messages[0].stamp_ns
    for message in messages:
        if due and message.stamp_ns >= start_ns + min(due) * S_NS:
            solver.keep_up(due.pop(min(due)), message.stamp_ns)
            results += solver.handle(message)
            problems += [one.problem for one in solver.report(message.stamp_ns, message.stamp_ns, 0, [])]
        else:
            results += solver.handle(message)
    return results + solver.flush(), problems


def seconds(results: list[Message], start_ns: int, kind: type, mode: str = "") -> list[float]:
    return [
        (one.stamp_ns - start_ns) / S_NS for one in results if isinstance(one, kind) and (not mode or one.mode == mode)
    ]


def test_a_track_of_one_in_five_pictures_is_honest(inertial, monkeypatch) -> None:
    messages, world = inertial
    start_ns = messages[0].stamp_ns
    results, _ = played(messages, {5: BEHIND_NS, 10: 0}, monkeypatch)
    triggers = {one.trigger for one in messages if isinstance(one, Candidates)}
    told = [one for one in results if isinstance(one, RelativePose | Rejected)]
    assert sorted(one.trigger for one in told) == sorted(triggers)
    left_out = {one.trigger for one in told if isinstance(one, Rejected) and one.detail == NO_TIME}
    assert left_out
    assert all(trigger % LOOKS for trigger in left_out)
    rows = [one for one in results if isinstance(one, Track) and one.mode == "filter"]
    times = np.array(seconds(rows, start_ns, Track))
    assert np.sum((times > 6.01) & (times < 9.01)) == 60 / LOOKS
    assert np.sum((times > 2.01) & (times < 4.01)) == 40
    assert not [at_s for at_s in seconds(results, start_ns, Track, "lag") if 5.5 < at_s < 9.5]
    assert not [at_s for at_s in seconds(results, start_ns, Expect) if 5.5 < at_s < 9.5]
    late = [one for one in rows if 6.0 < (one.stamp_ns - start_ns) / S_NS < 10.0]
    squared = []
    for one in late:
        e = np.subtract(world.truth(one.stamp_ns, 0).t_a_b_m, one.t_a_b_m)
        squared.append(e @ np.linalg.solve(np.array(one.covariance).reshape(6, 6)[:3, :3], e) / 3.0)
    assert np.mean(squared) < 2.5


def test_a_track_that_is_not_served_ends_says_so_and_begins_anew(inertial, monkeypatch) -> None:
    messages, _ = inertial
    monkeypatch.setattr("buddyline.solver_service.pace.STOPPED_NS", 2 * S_NS)
    results, (then, after) = played(messages, {5: FAR_NS + 1, 8: 0}, monkeypatch)
    rows = seconds(results, messages[0].stamp_ns, Track)
    assert [at_s for at_s in rows if at_s < 5.0]
    assert not [at_s for at_s in rows if 5.2 < at_s < 8.0]
    assert len([at_s for at_s in rows if at_s > 9.0]) > 40
    assert NO_TRACK in then
    assert NO_TRACK not in after


def test_with_fewer_nodes_nothing_is_left_out(inertial, monkeypatch) -> None:
    """However far behind."""
    messages = [one for one in inertial[0] if one.stamp_ns < inertial[0][0].stamp_ns + 5 * S_NS]
    late, _ = played(messages, {2: 2 * FAR_NS}, monkeypatch, crowd=3)
    never, _ = played(messages, {}, monkeypatch, crowd=3)
    assert late == never


@pytest.mark.slow
def test_the_network_ends_last(monkeypatch) -> None:
    from tests.solver_service.network.test_network import dive

    _, messages = dive(21, 9.0, more_nodes=("c",))
    monkeypatch.setattr("buddyline.solver_service.pace.STOPPED_NS", 2 * S_NS)
    far: dict[float, int] = {3.0: FAR_NS + 1, 4.1: FAR_NS + 2, 5.2: FAR_NS + 3, 6.3: FAR_NS + 4, 7.5: 0}
    results, said = played(messages, far, monkeypatch)
    rows = seconds(results, messages[0].stamp_ns, NodePose)
    assert [at_s for at_s in rows if 3.0 < at_s < 4.0], "tracks end first"
    assert not [at_s for at_s in rows if 5.5 < at_s < 6.4], "it begins anew a second before"
    assert [at_s for at_s in rows if at_s > 8.5]
    assert not any(NO_NETWORK in one for one in said[:3])
    assert any(NO_NETWORK in one for one in said[9:12])
    assert not any(NO_NETWORK in one or NO_TRACK in one for one in said[12:])
