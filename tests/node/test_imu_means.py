"""Means of inertial samples: what they turn and push, and when they are made."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from buddyline.node.imu_means import MEANS, PACKING_NS, SPAN_NS, ImuPacker, mean_motion
from buddyline.node.outlet import Outlet
from buddyline.protocol.clock import MS_NS, S_NS, ManualClock
from buddyline.protocol.local_bus import LocalBus, LocalNetwork
from buddyline.protocol.messages import Imu
from buddyline.protocol.recorder import Recorder
from buddyline.protocol.topics import IMU, IMU_MEANS
from buddyline.solver_service.geometry.rotation import rotation_exp
from numpy.typing import NDArray

BEGIN_NS = 1_764_000_000 * S_NS
STEP_NS = 10 * MS_NS


def sample(stamp_ns: int, rate: tuple[float, float, float] = (0.1, 0.0, 0.0)) -> Imu:
    return Imu(node="a", stamp_ns=stamp_ns, accel_mps2=(0.0, 0.0, -9.8), gyro_radps=rate)


def done(forces: NDArray[np.float64], rates: NDArray[np.float64], dt_s: float) -> NDArray[np.float64]:
    """Return the turn (as a matrix) and the change of velocity of constant forces and rates, in fine steps."""
    R, v = np.eye(3), np.zeros(3)
    fine_s = dt_s / 20
    for force, rate in zip(forces, rates, strict=True):
        for _ in range(20):
            v = v + R @ rotation_exp(0.5 * fine_s * rate) @ force * fine_s
            R = R @ rotation_exp(fine_s * rate)
    return np.column_stack((R, v))


def test_a_mean_turns_and_pushes_as_its_samples_do() -> None:
    """A rate and a force whose axes turn by 1.5 rad within the span: the plain means are more than ten times worse."""
    angles = np.linspace(0.0, 1.5, 5)
    rates = 2.0 * np.column_stack((np.cos(angles), np.sin(angles), 0.2 * angles))
    forces = 9.8 * np.column_stack((np.sin(angles), 0.3 * angles, np.cos(angles)))
    truth = done(forces, rates, 0.01)
    force, rate = mean_motion(forces, rates, 0.01)
    off = np.abs(done(force[None], rate[None], 0.05) - truth)
    plain = np.abs(done(forces.mean(0)[None], rates.mean(0)[None], 0.05) - truth)
    assert off[:, :3].max() < 0.1 * plain[:, :3].max()
    assert off[:, 3].max() < 0.1 * plain[:, 3].max()


def test_the_means_in_a_message_stand_in_the_middle_of_their_samples() -> None:
    packer = ImuPacker()
    made = [packer.add(sample(BEGIN_NS + k * STEP_NS, rate=(k // 5 * 1.0, 0.0, 0.0))) for k in range(5 * MEANS + 1)]
    (means,) = [one for one in made if one is not None]
    assert made[-1] is means
    assert [one.stamp_ns - BEGIN_NS for one in means.samples()] == [20 * MS_NS + k * SPAN_NS for k in range(MEANS)]
    assert [one.gyro_radps[0] for one in means.samples()] == pytest.approx(list(range(MEANS)))


def test_a_clock_that_is_set_back_begins_anew() -> None:
    packer = ImuPacker()
    stamps = [BEGIN_NS + k * STEP_NS for k in range(5 * MEANS - 2)] + [
        BEGIN_NS - S_NS + k * STEP_NS for k in range(5 * MEANS + 10)
    ]
    made = [packer.add(sample(stamp_ns)) for stamp_ns in stamps]
    (means,) = [one for one in made if one is not None]
    assert means.stamp_ns < BEGIN_NS


def test_a_link_that_leaves_samples_out_gets_means_for_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Never both of one time: what is newer than samples that are still to come would be taken without them."""
    clock = ManualClock(BEGIN_NS)
    full = range(100, 200)
    count = round(1.2 * PACKING_NS / STEP_NS)
    with closing(Recorder(tmp_path / "a.mcap")) as recorder, LocalBus(LocalNetwork(clock)) as bus:
        outlet = Outlet("a", recorder, clock)
        got: list[tuple[str, int]] = []
        outlet.connect(bus)
        taken = {topic: outlet._publisher(topic) for topic in (IMU, IMU_MEANS)}
        now = 0
        for topic, publisher in taken.items():

            def put(payload: bytes, topic: object = topic) -> bool:
                if topic is IMU and now in full:
                    return False
                got.append(("means" if topic is IMU_MEANS else "imu", now))
                return True

            monkeypatch.setattr(publisher, "put_bytes", put)
        for now in range(count):
            outlet.send(sample(BEGIN_NS + now * STEP_NS))
    raw = [at for name, at in got if name == "imu"]
    packed = [at for name, at in got if name == "means"]
    assert raw[:100] == list(range(100))
    assert raw[100] == packed[-1] + 1
    assert raw[100:] == list(range(raw[100], count))
    assert PACKING_NS <= (raw[100] - 100) * STEP_NS <= PACKING_NS + 2 * MEANS * SPAN_NS
    assert len(packed) == pytest.approx(PACKING_NS / (MEANS * SPAN_NS), abs=2)
