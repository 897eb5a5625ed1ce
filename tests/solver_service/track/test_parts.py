"""What a filter's parts of a dive say together: one clock or several, the whole dive or pieces of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
from buddyline.solver_service.track.dive import why_none
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.parts import goes_on, in_pieces, of_one_clock, parts_of
from buddyline.solver_service.track.state import CLOCK

from tests.solver_service.track.dives import Setting, filter_of, make


@pytest.fixture(scope="module")
def part() -> Estimate:
    """What the filter knows after three seconds."""
    dive = make(1, Setting(seconds=4.0))
    first = filter_of(dive.records, dive.fixes)
    first.advance(dive.stamps_ns[0] + 3_000_000_000)
    [found] = parts_of(first)
    return found


@pytest.mark.parametrize(("parts_clock_s", "expected"), [([0.02], False), ([0.02, 0.05], False), ([0.0, 0.2], True)])
def test_tracks_that_disagree_on_the_clocks_are_in_pieces(
    part: Estimate, parts_clock_s: list[float], expected: bool
) -> None:
    parts = [replace(part, state=part.state.with_parts(clock_s=clock_s)) for clock_s in parts_clock_s]
    assert in_pieces(parts) is expected


@pytest.mark.parametrize(
    ("parts_s", "expected"),
    [
        ([], True),
        ([(0.0, 4.0, 0.02)], True),
        # A false start, and the rest of the dive: no other offset of the clocks is worth a try.
        ([(0.0, 1.3, 0.02), (1.2, 60.0, 0.001)], True),
        ([(0.0, 1.3, 0.0), (1.2, 60.0, 0.05)], False),
        # Two logs of a node, with a pause between them, or a track that was lost once: both agree on the clocks.
        ([(0.0, 15.0, 0.0), (45.0, 60.0, 0.0)], True),
        ([(0.0, 15.0, 0.0), (15.0, 60.0, 0.02)], False),
        ([(0.0, 4.0, 0.0), (56.0, 60.0, 0.0)], False),
    ],
)
def test_a_track_of_nearly_all_of_a_dive_goes_on(
    part: Estimate, parts_s: list[tuple[float, float, float]], expected: bool
) -> None:
    parts = [
        replace(part, start_s=start_s, t_s=end_s + 0.5, end_s=end_s, state=part.state.with_parts(clock_s=clock_s))
        for start_s, end_s, clock_s in parts_s
    ]
    for one in parts:
        one.covariance = one.covariance.copy()
        one.covariance[CLOCK, CLOCK] = 0.001**2
    assert goes_on(parts) is expected


@pytest.mark.parametrize(
    ("clocks_s", "evidence", "kept"),
    [
        ([0.001, 0.003], [400.0, 14000.0], [0, 1]),
        ([0.057, 0.0], [400.0, 14000.0], [1]),
        ([0.0, 0.057], [14000.0, 400.0], [0]),
        ([0.0, 0.057, 0.0], [900.0, 400.0, 800.0], [0, 2]),
        # Clocks that drift, and five minutes without a light between two tracks.
        ([0.0, 0.02], [14000.0, 400.0], [0, 1]),
        # What no track knows is not settled by the longest.
        ([0.0, 0.2], [14000.0, 400.0], [0, 1]),
    ],
)
def test_a_track_that_contradicts_the_others_on_the_clocks_is_left_out(
    part: Estimate, clocks_s: list[float], evidence: list[float], kept: list[int]
) -> None:
    covariance = part.covariance.copy()
    covariance[CLOCK, CLOCK] = 0.0025**2
    parts = [
        replace(
            part,
            t_s=part.t_s + (300.0 * k if clock_s == 0.02 else k),
            state=part.state.with_parts(clock_s=clock_s),
            covariance=covariance,
            evidence=explained,
        )
        for k, (clock_s, explained) in enumerate(zip(clocks_s, evidence, strict=True))
    ]
    assert [parts.index(one) for one in of_one_clock(parts)] == kept


def test_why_there_is_no_track_is_laid_on_the_clocks_only_where_they_are_far_apart() -> None:
    assert "their clocks seem some 0.30 s apart" in why_none(0.3)
    assert "clocks" not in why_none(0.001)
    assert "mounted otherwise than stated" in why_none(0.001)
