"""Phase lock against simulated cameras: clocks that differ, controls that come late, lines, jitter, lost frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest
from buddyline.node.trigger import LATENCY_FRAMES, LOCKED_NS, FrameChooser, PhaseLock, frames_per_trigger
from buddyline.protocol.clock import MS_NS, S_NS

START_NS = 1_764_000_000 * S_NS
PERIOD_NS = 100 * MS_NS
IMX219_LINE_NS = 18_904.0


@dataclass
class FreeCamera:
    """Runs on its own clock; a control takes `latency` frames; a frame lasts whole lines. Times in ns."""

    ppm: float = 0.0
    latency: int = LATENCY_FRAMES
    line_ns: float = IMX219_LINE_NS
    jitter_ns: float = 15_000.0
    min_ns: int = 24 * MS_NS
    lost: float = 0.0
    seed: int = 1
    asked_ns: list[int] = field(default_factory=list)

    def run(
        self, lock: PhaseLock, seconds: float, period_ns: int, step: tuple[float, int] | None = None, frames: int = 1
    ):
        """Return when (s) and how far off the grid (ns) the middle of each exposure was.

        step: (s, ns), the wall clock is set by so much at that time.
        """
        rng = np.random.default_rng(self.seed)
        asked_ns = lock.duration_ns
        queue_ns = [asked_ns] * self.latency
        start_ns = t_ns = START_NS + int(rng.uniform(0, period_ns))
        times, offs = [], []
        while t_ns - start_ns < seconds * S_NS:
            now_s = (t_ns - start_ns) / 1e9
            shift_ns = step[1] if step and now_s >= step[0] else 0
            wall_ns = t_ns + shift_ns
            times.append(now_s)
            after_ns = wall_ns % period_ns
            offs.append(after_ns - round(after_ns * frames / period_ns) * period_ns / frames)
            if rng.uniform() >= self.lost:
                answer_ns = lock.update(wall_ns + int(rng.normal(0, self.jitter_ns)))
                if answer_ns is not None:
                    asked_ns = answer_ns
                    self.asked_ns.append(asked_ns)
            queue_ns.append(asked_ns)
            made_ns = queue_ns.pop(0) // 1000 * 1000  # controls are in whole microseconds
            made_ns = max(self.min_ns, int(made_ns // self.line_ns * self.line_ns))
            t_ns += round(made_ns * (1 + self.ppm * 1e-6))
        return np.array(times), np.array(offs)


def lock_for(camera: FreeCamera, period_ns: int = PERIOD_NS, frames: int = 1) -> PhaseLock:
    return PhaseLock(period_ns, frames, camera.min_ns, camera.line_ns)


@pytest.mark.parametrize("ppm", [-40.0, -10.0, 0.0, 25.0, 40.0])
@pytest.mark.parametrize("line_ns", [1000.0, IMX219_LINE_NS, 31_000.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_phase_locks_within_two_seconds_and_stays(ppm, line_ns, seed):
    camera = FreeCamera(ppm=ppm, line_ns=line_ns, seed=seed)
    times_s, off_ns = camera.run(lock_for(camera), 60.0, PERIOD_NS)
    assert np.abs(off_ns[times_s >= 2.0]).max() <= LOCKED_NS


@pytest.mark.parametrize(("rate_hz", "frames"), [(7, 2), (3, 4), (30, 1), (10, 2)])
def test_the_phase_locks_at_any_rate_and_number_of_frames(rate_hz, frames):
    """A seventh of a second is no whole number of ns: the rounding must not accumulate since 1970."""
    period_ns = round(1e9 / rate_hz)
    camera = FreeCamera(ppm=30.0)
    times_s, off_ns = camera.run(lock_for(camera, period_ns, frames), 20.0, period_ns, frames=frames)
    assert np.abs(off_ns[times_s >= 2.0]).max() <= LOCKED_NS


@pytest.mark.parametrize("latency", [1, 3, 6, 10])
def test_a_shorter_latency_than_assumed_does_no_harm(latency):
    camera = FreeCamera(ppm=30.0, latency=latency)
    times_s, off_ns = camera.run(lock_for(camera), 30.0, PERIOD_NS)
    assert np.abs(off_ns[times_s >= 2.0]).max() <= LOCKED_NS


def test_without_the_lock_a_drift_of_forty_ppm_accumulates():
    """Without the lock the simulated camera drifts away: the other tests are not trivial."""
    camera = FreeCamera(ppm=40.0)
    lock = lock_for(camera)
    lock.update = lambda stamp_ns: None  # type: ignore[method-assign]
    _, off_ns = camera.run(lock, 60.0, PERIOD_NS)
    assert np.ptp(off_ns) > 2 * LOCKED_NS


def test_one_frame_is_stretched_and_the_next_is_not():
    camera = FreeCamera(ppm=-40.0)
    camera.run(lock_for(camera), 10.0, PERIOD_NS)
    asked_ns = np.array(camera.asked_ns)
    assert len(asked_ns) % 2 == 0
    assert (np.abs(asked_ns[1::2] - PERIOD_NS) <= 2 * camera.line_ns).all()
    assert np.abs(asked_ns[0] - PERIOD_NS) > 2 * camera.line_ns


def test_no_frame_is_asked_to_be_shorter_than_the_camera_can():
    for seed in range(20):
        camera = FreeCamera(min_ns=95 * MS_NS, seed=seed)
        times_s, off_ns = camera.run(lock_for(camera), 4.0, PERIOD_NS)
        assert min(camera.asked_ns) >= camera.min_ns
        assert np.abs(off_ns[times_s >= 2.0]).max() <= LOCKED_NS


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_lost_frames_delay_the_lock_without_disturbing_it(seed):
    camera = FreeCamera(ppm=40.0, lost=0.1, seed=seed)
    times_s, off_ns = camera.run(lock_for(camera), 30.0, PERIOD_NS)
    assert np.abs(off_ns[times_s >= 3.0]).max() <= 1.5 * LOCKED_NS


@pytest.mark.parametrize("step_ns", [37 * MS_NS, -S_NS - 12 * MS_NS, 50 * MS_NS])
def test_a_clock_that_is_set_is_locked_onto_again(step_ns):
    camera = FreeCamera(ppm=20.0)
    lock = lock_for(camera)
    times_s, off_ns = camera.run(lock, 16.0, PERIOD_NS, step=(8.0, step_ns))
    assert np.abs(off_ns[times_s >= 13.0]).max() <= LOCKED_NS
    assert lock.locked


def test_residual_is_reported_before_and_after_the_lock():
    camera = FreeCamera()
    lock = lock_for(camera)
    assert lock.residual_ns is None
    assert not lock.locked
    camera.run(lock, 0.6, PERIOD_NS)
    assert lock.residual_ns is not None
    assert abs(lock.residual_ns) > LOCKED_NS
    lock = lock_for(camera)
    camera.run(lock, 6.0, PERIOD_NS)
    assert lock.locked


@pytest.mark.parametrize(("rate_hz", "frames"), [(10, 1), (20, 1), (5, 2), (1, 10), (7, 2), (30, 1)])
def test_frames_are_short_enough_to_lock_in_time(rate_hz, frames):
    assert frames_per_trigger(round(1e9 / rate_hz)) == frames


def choose(stamps_ns: list[int], frame_period_ns: int) -> list[int]:
    chooser = FrameChooser(PERIOD_NS, frame_period_ns)
    return [stamp_ns for stamp_ns in stamps_ns if chooser.is_nearest(stamp_ns)]


@pytest.mark.parametrize("frames", [1, 2, 4])
@pytest.mark.parametrize("phase_ms", [-49, -11, -1, 0, 7, 24, 49])
def test_one_frame_an_instant_and_it_is_the_nearest(frames, phase_ms):
    frame_ns = PERIOD_NS // frames
    stamps_ns = [START_NS + phase_ms * MS_NS + i * frame_ns for i in range(20 * frames)]
    chosen = choose(stamps_ns, frame_ns)
    triggers = [round(stamp_ns / PERIOD_NS) for stamp_ns in chosen]
    assert len(chosen) in (19, 20, 21)
    assert all(b - a == 1 for a, b in pairwise(triggers))
    for stamp_ns in chosen:
        off_ns = [abs(s - round(stamp_ns / PERIOD_NS) * PERIOD_NS) for s in stamps_ns]
        assert abs(stamp_ns - round(stamp_ns / PERIOD_NS) * PERIOD_NS) == min(off_ns)


def test_an_instant_whose_frame_was_lost_has_none():
    stamps_ns = [START_NS + i * PERIOD_NS // 4 for i in range(40)]
    chosen = choose([s for s in stamps_ns if s != START_NS + PERIOD_NS], PERIOD_NS // 4)
    assert START_NS + PERIOD_NS not in chosen
    assert len(chosen) == 9


def test_a_clock_set_back_does_not_silence_the_camera():
    stamps_ns = [START_NS + i * PERIOD_NS for i in range(10)]
    stamps_ns += [START_NS + i * PERIOD_NS - 30 * S_NS for i in range(10, 20)]
    assert choose(stamps_ns, PERIOD_NS) == stamps_ns
