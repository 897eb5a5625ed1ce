"""Steps that are integrated together, in each node's own axes, say the same as each by itself."""

from dataclasses import fields

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.ahead import TOLERANCES, steps_ahead
from buddyline.solver_service.track.moving import increments
from buddyline.solver_service.track.samples import Samples
from buddyline.solver_service.track.state import State
from buddyline.solver_service.track.strapdown import Increments

from tests.solver_service.track.test_track_jacobians import a_state

TIMES_S = (1.0, 1.103, 1.2, 1.3004, 1.35)
DELAYS_S = np.array((0.004, -0.0025))


def shaken(rng: np.random.Generator, *, hole: bool = False) -> Samples:
    """Two seconds at 100 Hz, with fast parts; with a hole of 0.1 s within the step from 1.2 s on, if asked for."""
    t = np.arange(0.0, 2.0, 0.01) + rng.uniform(-0.001, 0.001, 200)
    turn = 2.0 * np.pi * t[:, None] * rng.uniform(0.3, 3.0, 6) + rng.uniform(0.0, 6.0, 6)
    values = np.sin(turn) * (3.0, 3.0, 3.0, 0.5, 0.5, 0.5) + (0.0, 0.0, -9.8, 0.0, 0.0, 0.0)
    fast = np.column_stack((0.1 * np.cos(turn), rng.uniform(0.0, 1e-3, 200)))
    kept = (t < 1.21) | (t > 1.29) if hole else np.ones(200, dtype=bool)
    samples = Samples()
    samples.add(t[kept], values[kept], fast[kept])
    samples.shares = np.array((0.3, 0.6))
    return samples


def apart(one: Increments, other: Increments) -> dict[str, float]:
    pairs = {field.name: (getattr(one, field.name), getattr(other, field.name)) for field in fields(Increments)}
    return {name: float(np.abs(np.subtract(a, b, dtype=float)).max()) for name, (a, b) in pairs.items()}


def of_step(samples: list[Samples], about: State, state: State, k: int) -> tuple[Increments, Increments]:
    ahead = steps_ahead(samples, about, TIMES_S, by_shares=True)
    start_s, end_s = TIMES_S[k : k + 2]
    together = ahead.increments(state, ahead.at[start_s, end_s])
    return together, increments(samples, state, start_s, end_s, by_shares=True)


@pytest.mark.parametrize("k", range(len(TIMES_S) - 1))
def test_steps_together_are_each_step(k: int) -> None:
    rng = np.random.default_rng(k)
    samples, state = [shaken(rng), shaken(rng)], a_state(k).with_parts(delay_s=DELAYS_S)
    together, alone = of_step(samples, a_state(9).with_parts(**_constants(state)), state, k)
    assert max(apart(together, alone).values()) < 1e-12
    assert together.by_fast is not None


@pytest.mark.parametrize("k", range(len(TIMES_S) - 1))
def test_constants_that_changed_since_are_made_good(k: int) -> None:
    """What is left is far below a step's noise: 5e-4 rad and 5e-3 m/s of shaking."""
    rng = np.random.default_rng(k)
    samples, state = [shaken(rng), shaken(rng)], a_state(k).with_parts(delay_s=DELAYS_S)
    changed = _constants(state)
    for (name, value), tolerance in zip(changed.items(), TOLERANCES[[0, 3, 6, 9, 12]], strict=True):
        changed[name] = value + tolerance * rng.choice((-1.0, 1.0), value.shape)
    about = state.with_parts(**changed)
    together, alone = of_step(samples, about, state, k)
    off = apart(together, alone)
    unmended = apart(increments(samples, about, *TIMES_S[k : k + 2], by_shares=True), alone)
    for name, most in (("R", 2e-5), ("dv_mps", 2e-3), ("dp_m", 2e-4)):
        assert off[name] < most
        assert off[name] < 0.5 * unmended[name]


def test_a_step_that_samples_do_not_tell_is_left_out() -> None:
    rng = np.random.default_rng(1)
    state = a_state(1).with_parts(delay_s=DELAYS_S)
    ahead = steps_ahead([shaken(rng), shaken(rng, hole=True)], state, TIMES_S, by_shares=False)
    assert sorted(ahead.at) == [(1.0, 1.103), (1.103, 1.2), (1.3004, 1.35)]
    past = steps_ahead([shaken(rng), shaken(rng)], state, (0.0, 0.1, 1.9, 2.0), by_shares=False)
    assert sorted(past.at) == [(0.1, 1.9)]


def _constants(state: State) -> dict[str, Floats]:
    names = ("gyro_bias_radps", "accel_bias_mps2", "mount_rad", "lever_m", "delay_s")
    return {name: getattr(state, name) for name in names}
