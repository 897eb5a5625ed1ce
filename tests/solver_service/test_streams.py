"""One node's windows: in order of time, bounded, read by many and emptied by none."""

import msgspec
import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, Imu, NodeInfo
from buddyline.solver_service.sensors import HORIZON_NS, KEPT_NS, MAX_SAMPLES, ImuWindow
from buddyline.solver_service.streams import FIRST_WAIT_NS, MAX_FRAME_BYTES, Arrival, NodeStream

STEP_NS = 10_000_000


def sample(stamp_ns, value=0.0):
    return Imu(node="a", stamp_ns=stamp_ns, accel_mps2=(value, 0.0, 9.8), gyro_radps=(0.0, 0.0, value))


@pytest.fixture
def frames(dive):
    return [m for m in dive[0] if isinstance(m, Candidates) and m.node == "a"]


def test_inertial_samples_are_kept_in_order_and_once():
    window, order = ImuWindow(), np.random.default_rng(1).permutation(200)
    for k in [*order, 3, 77]:
        window.add(sample(int(k) * STEP_NS, float(k)))
    stamps, values = window.between(10 * STEP_NS, 19 * STEP_NS)
    assert stamps.tolist() == [k * STEP_NS for k in range(10, 20)]
    assert values[:, 0].tolist() == values[:, 5].tolist() == list(range(10, 20))
    assert len(window) == 200


def test_inertial_samples_are_bounded_in_time_and_number():
    window = ImuWindow()
    for k in range(3 * MAX_SAMPLES):
        window.add(sample(k * 1_000_000))
    assert len(window) == MAX_SAMPLES
    assert window.between(0, 2**62)[0][-1] == (3 * MAX_SAMPLES - 1) * 1_000_000
    newest_ns = 3 * MAX_SAMPLES * 1_000_000 + 2 * KEPT_NS
    window.add(sample(newest_ns))
    assert window.between(0, 2**62)[0].tolist() == [newest_ns]


def test_an_inertial_clock_that_is_set_back_is_believed_once_it_goes_on():
    window = ImuWindow()
    for k in range(100):
        window.add(sample(100 * S_NS + k * STEP_NS))
    window.add(sample(100 * S_NS - 2 * HORIZON_NS))
    assert len(window) == 100
    for k in range(10):
        window.add(sample(10 * S_NS + k * STEP_NS))
    stamps, _ = window.between(0, 2**62)
    assert stamps.tolist() == [10 * S_NS + k * STEP_NS for k in range(10 - stamps.size, 10)]
    assert stamps.size > 5


def test_frames_stay_in_the_window_until_it_is_full(frames):
    stream = NodeStream("a")
    for frame in frames:
        assert stream.add_frame(frame, (), None) is Arrival.FRESH
    start_ns, end_ns = frames[5].stamp_ns, frames[9].stamp_ns
    for _ in range(2):
        assert stream.frames.between(start_ns, end_ns) == frames[5:10]
    long = [msgspec.structs.replace(frame, boot="x" * (MAX_FRAME_BYTES // 4)) for frame in frames]
    stream = NodeStream("a")
    for frame in long:
        stream.add_frame(frame, (), None)
        assert stream.frames.bytes <= MAX_FRAME_BYTES
    assert stream.frames.between(0, 2**62) == long[-3:]


def test_a_frame_far_from_the_others_is_believed_where_another_node_is_there_too(frames):
    for others_ns, arrival in (((), Arrival.FAR), ((frames[0].stamp_ns + 61 * S_NS,), Arrival.FRESH)):
        stream = NodeStream("a")
        stream.add_frame(frames[0], (), None)
        later = msgspec.structs.replace(frames[1], stamp_ns=frames[0].stamp_ns + 60 * S_NS, trigger=10**9)
        assert stream.add_frame(later, others_ns, None) is arrival


def test_words_of_a_calibration_take_no_memory(dive):
    stream = NodeStream("a")
    info = next(m for m in dive[0] if isinstance(m, NodeInfo))
    stream.add_info(msgspec.structs.replace(info, software="x" * 1_000_000))
    known, _ = stream.calibration(info.stamp_ns)
    assert known == msgspec.structs.replace(info, software="", config_sha256="", tags=msgspec.UNSET)


def test_a_live_sensor_that_was_never_heard_is_waited_for_for_a_second(frames):
    stream, first_ns = NodeStream("a"), frames[0].stamp_ns
    covered = {}
    for frame in frames:
        stream.add_frame(frame, (), frame.stamp_ns, live=True)
        covered[frame.stamp_ns - first_ns] = stream.sensors_cover(first_ns)
    assert {after_ns for after_ns, done in covered.items() if not done} == {ns for ns in covered if ns <= FIRST_WAIT_NS}
    assert any(covered.values())
