"""Steps that are packed come back as they were, and pieces of a dive are the dive."""

from __future__ import annotations

import numpy as np
from buddyline.solver_service.track.parts import parts_of
from buddyline.solver_service.track.records import last_ns
from buddyline.solver_service.track.smoother import smoothed
from buddyline.solver_service.track.trail import PACK, Step, Trail

from tests.solver_service.track.dives import Setting, filter_of, make


def steps_of() -> list[Step]:
    dive = make(1, Setting(seconds=32.0))
    track = filter_of(dive.records, dive.fixes)
    track.advance(last_ns(dive.records))
    (part,) = parts_of(track)
    return list(part.steps.backward())[::-1]


def numbers(step: Step) -> np.ndarray:  # type: ignore[type-arg]
    parts = step.F, step.walk, step.rates_radps, step.before, step.after
    return np.concatenate([np.array((step.t_s, *step.status)), *map(np.ravel, parts)])


def test_packed_steps_come_back() -> None:
    plain = steps_of()
    assert len(plain) > 2 * PACK
    loose, packed = Trail(), Trail()
    for step in plain:
        loose.append(step)
        packed.append(step)
        packed.pack()
    assert len(packed) == len(plain)
    for step, again in zip(plain, list(packed.backward())[::-1], strict=True):
        assert np.array_equal(numbers(step), numbers(again))
        assert np.abs(step.covariance - again.covariance).max() <= 1e-12 * np.abs(step.covariance).max()
        assert np.abs(step.Q - again.Q).max() <= 1e-12 * np.abs(step.Q).max()
        assert step.looks == again.looks
    one, two = smoothed(loose), smoothed(packed)
    assert np.allclose(one.states, two.states, rtol=0.0, atol=1e-9)
    assert np.allclose(one.halves, two.halves, rtol=1e-6, atol=1e-12)

    copy = packed.copy()
    three = smoothed(copy, uses_up=True)
    assert np.array_equal(three.states, two.states)
    assert np.array_equal(three.halves, two.halves)
    assert (len(copy), len(packed)) == (0, len(plain))

    middle_s = plain[PACK // 2].t_s
    copy = packed.copy()
    copy.drop_after(middle_s)
    assert (len(copy), len(packed)) == (PACK // 2 + 1, len(plain))
    assert copy.last.t_s == middle_s
