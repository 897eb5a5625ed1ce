"""Two teams of two far apart, each looking at a bar at the same range: all bars look alike."""

from __future__ import annotations

import math

import numpy as np
import pytest
from buddyline.protocol.messages import Message, NodePose
from buddyline.solver_service.config import SolveConfig, track_settings
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.network.belief import Member
from buddyline.solver_service.network.estimate import CONFIRMED, EACH, GIVEN_UP, Candidate, NetEstimate, PairFix
from buddyline.solver_service.network.filter import MOST_DISPUTED, disputed
from buddyline.solver_service.track.intake import TrackIntake
from buddyline.solver_service.tracking import Coming, PairTracker

from tests.solver_service.scenes import project, upright
from tests.solver_service.third_bar import (
    BAR_M,
    CAMERA,
    HEIGHT,
    PERIOD_NS,
    SIGMA_PX,
    START_NS,
    WIDTH,
    frame,
    info,
    sensors,
)

# Node: where it stands, and where it looks, degrees from north. So b and c look as if at each other.
PLACES = {"a": ((0.0, 0.0), 0.0), "b": ((3.0, 0.1), 180.0), "c": ((20.0, 8.0), 0.0), "d": ((23.0, 8.1), 180.0)}


@pytest.fixture(autouse=True)
def no_tracks_of_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, told in (("follow", Coming()), ("tell", []), ("finish", [])):
        monkeypatch.setattr(PairTracker, name, lambda *_, told=told: told)


def two_teams(seed: int, triggers: int) -> list[Message]:
    """Give all messages of four nodes that hover at PLACES."""
    rng = np.random.default_rng(seed)
    sigma_rad = math.radians(3.5)
    bias_rad = {name: 0.6 * sigma_rad * rng.standard_normal() for name in PLACES}
    messages: list[Message] = [info(name) for name in PLACES]
    for k in range(triggers):
        stamp_ns = START_NS + k * PERIOD_NS
        stands: dict[str, tuple[Floats, Floats]] = {}
        for n, (name, ((north_m, east_m), toward_deg)) in enumerate(PLACES.items()):
            sway = 0.02 * np.sin(0.4 * k + np.array((0.0, 1.0, 2.0)) + n)
            R = upright(math.radians(toward_deg) + sway[0], 0.5 * sway[1], 0.5 * sway[2])
            stands[name] = R, np.array((north_m, east_m, 0.1 * n)) + sway
        for name, (R, at) in stands.items():
            lamps = [BAR_M @ R_other.T + at_other for other, (R_other, at_other) in stands.items() if other != name]
            pixels = project(CAMERA, (np.concatenate(lamps) - at) @ R)
            pixels = pixels[np.isfinite(pixels).all(1)]
            pixels = pixels + SIGMA_PX * rng.standard_normal(pixels.shape)
            inside = ((pixels > 0) & (pixels < (WIDTH - 1, HEIGHT - 1))).all(1)
            messages += sensors(name, stamp_ns, R, at, bias_rad[name], rng, sigma_rad)
            messages.append(frame(name, stamp_ns, k, rng.permutation(pixels[inside])))
    return messages


@pytest.mark.parametrize("seed", range(4))
def test_two_teams_that_do_not_see_each_other_are_told_apart(seed: int) -> None:
    core = SolverCore(SolveConfig().settings("test"), None, track=track_settings("filter", 10.0))
    poses = [one for one in core.handle_many(two_teams(seed, 30)) + core.flush() if isinstance(one, NodePose)]
    assert {one.node for one in poses} in ({"a", "b"}, {"c", "d"})
    assert len(poses) > 40


def pose(node: int, other: int, *candidates: Candidate) -> PairFix:
    return PairFix(0, np.zeros(3), np.eye(3), np.eye(6), node, other, 0, frozenset(candidates))


def test_of_poses_that_use_a_candidate_twice_those_that_explain_most_are_right() -> None:
    """Nodes 0 and 1 see each other, and so do 2 and 3; 1 and 2 might."""
    of_0, of_1, of_2, of_3 = ([(node, 0), (node, 1)] for node in range(4))
    one, wrong, two = pose(0, 1, *of_0, *of_1), pose(1, 2, *of_1, *of_2), pose(2, 3, *of_2, *of_3)
    assert [disputed(each, [one, wrong, two]) for each in (one, wrong, two)] == [False, True, False]
    # With one of them alone either may be right, if it explains as much.
    assert [disputed(each, [one, wrong]) for each in (one, wrong)] == [True, True]
    three_lights = pose(1, 2, *of_1, (2, 0))
    assert [disputed(each, [one, three_lights]) for each in (one, three_lights)] == [False, True]
    assert not disputed(one, [one, two])
    assert not disputed(one, [])
    many = [pose(0, 1 + k, (0, 0), (1, k)) for k in range(MOST_DISPUTED + 1)]
    assert all(disputed(each, many) for each in many)


@pytest.mark.parametrize(
    ("seen", "sees", "stays", "confirmed"),
    [
        (CONFIRMED, EACH + 1.0, True, True),
        # It sees a bar where another node stands, which does not see it.
        (0.0, 10.0 * CONFIRMED, True, False),
        (10.0 * CONFIRMED, EACH - 1.0, True, False),
        (GIVEN_UP - 1.0, 10.0 * CONFIRMED, False, False),
        (10.0 * CONFIRMED, GIVEN_UP - 1.0, False, False),
    ],
)
def test_a_node_is_confirmed_where_it_is_seen_and_sees(seen: float, sees: float, stays: bool, confirmed: bool) -> None:
    estimate = NetEstimate(TrackIntake([]))
    estimate.places[0] = None  # type: ignore[assignment]
    estimate.t_s = 1.0
    new = Member(1, 0.5, confirmed=False, light_s=1.0, evidence=(seen, sees))
    estimate.members = [Member(0, 0.0, confirmed=True, light_s=1.0), new]
    removed: list[int] = []
    estimate.remove = removed.append  # type: ignore[method-assign]
    estimate._judge()
    assert (removed == []) == stays
    assert new.confirmed == confirmed
