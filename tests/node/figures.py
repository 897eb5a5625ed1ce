"""Figures of the sensors, for a person: `python -m tests.node.figures`. The bus's rates, and the attitude in swell.

The bus is the tests' adapter, on which each byte takes its nine clocks: real smbus2 and drivers above it, without the
Pi's own time between two transfers. The swell is that of the attitude's tests.
"""

from __future__ import annotations

import sys

import numpy as np
import pytest
from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.registry import open_depth, open_imu
from buddyline.protocol.clock import S_NS, ManualClock

from tests.node.drivers import wire
from tests.node.test_attitude import calm_run, disturbed_run

SECONDS = 20
IMU_PERIOD_NS = 10_000_000
SEEDS = range(1, 11)
START_NS = 1_764_000_000 * S_NS
BOARDS = {
    "minimu9_v3": lambda sky, clock: {0x1D: wire.lsm303d(sky), 0x6B: wire.l3gd20h(sky)},
    "minimu9_v5": lambda sky, clock: {0x6B: wire.lsm6ds(sky, 0x69, clock), 0x1E: wire.lis3mdl(sky)},
    "minimu9_v6": lambda sky, clock: {0x6B: wire.lsm6ds(sky, 0x6C, clock), 0x1E: wire.lis3mdl(sky)},
}


def bus_rates(board: str, bit_hz: int) -> str:
    """Run inertial unit and depth on one bus; return what they reach."""
    clock = ManualClock(START_NS)
    adapter = wire.Adapter(clock, bit_hz=bit_hz)
    adapter.chips.update(BOARDS[board](wire.Sky(), clock))
    adapter.chips[0x76] = wire.Ms5837Wire(clock, wire.WORDS_30BA, wire.D1_30BA, wire.D2_30BA)
    with pytest.MonkeyPatch.context() as patch:
        adapter.attach(patch)
        with I2cBus(1) as bus:
            imu, depth = open_imu(bus, board, clock=clock), open_depth(bus, clock=clock)
            began_ns = clock.now_ns()
            for _ in range(200):
                imu.decode(imu.fetch())
            alone_hz = 200 * S_NS / (clock.now_ns() - began_ns)
            began_ns = next_ns = clock.now_ns()
            samples = depths = busy_ns = worst_ns = 0
            while (now_ns := clock.now_ns()) < began_ns + SECONDS * S_NS:
                if next_ns <= now_ns:
                    worst_ns = max(worst_ns, now_ns - next_ns)
                    imu.decode(imu.fetch())
                    samples += 1
                    next_ns += IMU_PERIOD_NS
                elif depth.next_due_ns <= now_ns:
                    depths += depth.step(now_ns) is not None
                else:
                    clock.set_ns(min(next_ns, depth.next_due_ns))
                    continue
                busy_ns += clock.now_ns() - now_ns
    return (
        f"{board} at {bit_hz // 1000} kHz: inertial alone {alone_hz:.0f} Hz at most; together inertial "
        f"{samples / SECONDS:.1f} Hz (at most {worst_ns / 1e6:.2f} ms late), depth {depths / SECONDS:.1f} Hz, "
        f"bus busy {100 * busy_ns / SECONDS / S_NS:.0f} %"
    )


def attitude() -> list[str]:
    """Return the errors in swell, over the seeds: median and worst."""
    calm = [calm_run(seed) for seed in SEEDS]
    hit = [disturbed_run(seed) for seed in SEEDS]
    rows = {
        "tilt in swell, deg RMS": [run.tilt_rms_deg() for run in calm],
        "heading in swell, deg RMS": [run.heading_rms_deg(run.times_s > 10) for run in calm],
        "tilt, dive with a foreign field of 15 uT for 12 s": [run.tilt_rms_deg() for run in hit],
        "heading while it is there": [run.heading_rms_deg(run.disturbed) for run in hit],
        "heading after it has gone": [run.heading_rms_deg(run.times_s > 47) for run in hit],
        "share of it that is flagged": [
            np.mean([bool(problem) for problem in np.array(run.problems, object)[run.disturbed]]) for run in hit
        ],
    }
    return [f"{name}: median {np.median(found):.2f}, worst {np.max(found):.2f}" for name, found in rows.items()]


def main() -> int:
    for board in BOARDS:
        for bit_hz in (100_000, 400_000):
            sys.stdout.write(bus_rates(board, bit_hz) + "\n")
    sys.stdout.write(f"attitude over {len(SEEDS)} dives of 40 to 58 s\n")
    sys.stdout.write("".join(f"  {line}\n" for line in attitude()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
