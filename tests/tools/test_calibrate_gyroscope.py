"""The gyroscope's bias over its temperature: found, used, and refused where it cannot be told."""

import tomllib

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Imu
from buddyline.tools.calibration.gyroscope import fit
from buddyline.tools.cli import main
from msgspec import UNSET

SLOPE = np.radians([0.05, -0.04, 0.02])
GRAVITY = np.array([0.0, 0.0, -9.81])
START_NS = 1_764_000_000 * S_NS


def warming(seconds=200, span_k=15.0, turned=0.0, seed=1, temperature=True, rate_hz=25):
    """A node that lies still and warms up; turned: rad/s of a sway that is no rest."""
    rng = np.random.default_rng(seed)
    samples = []
    for k in range(int(seconds * rate_hz)):
        t = k / rate_hz
        degc = 5.0 + span_k * (1 - np.exp(-t / (seconds / 3)))
        gyro = np.radians(0.8) + SLOPE * degc + rng.normal(0, np.radians(0.06), 3) + turned * np.sin(t)
        samples.append(
            Imu(
                node="a",
                stamp_ns=START_NS + round(t * S_NS),
                accel_mps2=tuple((rng.normal(0, 0.015, 3) + GRAVITY).tolist()),
                gyro_radps=tuple(gyro.tolist()),
                temperature_degc=round(float(degc), 2) if temperature and k % rate_hz == 0 else UNSET,
            )
        )
    return samples


def test_the_slope_is_found_within_its_sigma():
    off = []
    for seed in range(6):
        found = fit(warming(seed=seed))
        off.append((found.slope_radps_per_k - SLOPE) / found.sigma_radps_per_k)
        assert np.degrees(np.abs(found.slope_radps_per_k - SLOPE)).max() < 0.002
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 2.5
    assert found.span_k > 10


@pytest.mark.parametrize(
    ("conditions", "said"),
    [
        ({"span_k": 2.0}, "changed by .* K only"),
        ({"turned": 0.1}, "rests of 10 s"),
        ({"temperature": False}, "rests of 10 s"),
        ({"seconds": 30}, "rests of 10 s"),
    ],
)
def test_what_is_not_good_enough_is_refused(conditions, said):
    with pytest.raises(BuddylineError, match=said):
        fit(warming(**conditions))


def test_a_bias_that_moves_for_another_reason_is_refused():
    samples = warming()
    jumped = [
        Imu(
            node="a", stamp_ns=one.stamp_ns, accel_mps2=one.accel_mps2, temperature_degc=one.temperature_degc,
            gyro_radps=tuple(rate + (0.005 if (k // 1000) % 2 else 0.0) for rate in one.gyro_radps),
        )
        for k, one in enumerate(samples)
    ]  # fmt: skip
    with pytest.raises(BuddylineError, match="a line leaves"):
        fit(jumped)


def test_the_command_prints_what_goes_into_the_configuration(tmp_path, capsys):
    with DiveLogWriter(tmp_path / "a.mcap") as writer:
        for sample in warming():
            writer.write_message(sample)
    assert main(["calibrate", "gyroscope", str(tmp_path / "a.mcap")]) == 0
    said = capsys.readouterr().out
    assert "[sensors]" in said
    values = np.array(tomllib.loads(said)["sensors"]["gyro_bias_radps_per_k"])
    assert np.degrees(np.abs(values - SLOPE)).max() < 0.002
