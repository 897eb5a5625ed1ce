"""What reaches the live solver from outside: broken, hostile, old or from another time; the healthy go on."""

import tracemalloc

import pytest
from buddyline.protocol.bus import Received
from buddyline.protocol.clock import ManualClock
from buddyline.protocol.codec import MAX_MESSAGE_BYTES, encode
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    Depth,
    NodeInfo,
    Rejected,
    RelativePose,
    SolverStatus,
    Track,
)
from buddyline.protocol.topics import key_of
from buddyline.solver_service.config import SolverConfig
from buddyline.solver_service.core import MAX_NODES
from buddyline.solver_service.service import SolverService
from msgspec.structs import replace

from tests.fuzz.targets import Capture
from tests.solver_service.conftest import dive_messages

HOUR_NS = 3_600_000_000_000


@pytest.fixture(scope="module")
def messages():
    return dive_messages(seconds=2.5, seed=7)[0]


class Solver:
    """The service's own handler, and what comes out of it."""

    def __init__(self):
        self.bus = Capture()
        # Its clock stands still: nothing here may depend on how long a test takes.
        self.service = SolverService(SolverConfig(nodes=["a", "b"]), clock=ManualClock())
        self.service.attach(self.bus)

    def take(self, message, key=None):
        payload = message if isinstance(message, bytes) else encode(message)
        self.service.receive(Received(key or key_of(message), payload, 0, ""))

    def results(self):
        self.service._publish(self.service.core.flush())
        return [m for m in self.bus.published if isinstance(m, RelativePose | Rejected)]

    def track_stamps(self):
        return [m.stamp_ns for m in self.bus.published if isinstance(m, Track) and m.mode == "filter"]

    def status(self):
        self.service.report()
        return next(m for m in reversed(self.bus.published) if isinstance(m, SolverStatus))


def solved(messages):
    solver = Solver()
    for message in messages:
        solver.take(message)
    return [encode(result) for result in solver.results()]


@pytest.fixture(scope="module")
def healthy(messages):
    found = solved(messages)
    assert any(b'"range_m"' in payload for payload in found)
    return found


BLOB = b'{"u_px":1.0,"v_px":2.0,"sigma_px":0.5,"area_px":9.0,"peak":255.0,"elongation":1.0}'
FRAME = b'{"node":"a","stamp_ns":5,"trigger":0,"seq":0,"boot":"x","width_px":820,"height_px":616,"blobs":[%s]%s}'
KEY = "buddyline/node/a/candidates"
HOSTILE = {
    "10 MB of nothing": (KEY, bytes(10_000_000), "malformed"),
    "10 MB of a sound frame": (KEY, FRAME % (BLOB, b',"boot2":"' + b"x" * 10_000_000 + b'"'), None),
    "more than a message may be": (KEY, FRAME % (BLOB, b',"x":"' + bytes(MAX_MESSAGE_BYTES) + b'"'), "at most"),
    "10,000 blobs": (KEY, FRAME % (b",".join([BLOB] * 10_000), b""), "blobs"),
    "nested 100,000 deep": (KEY, FRAME % (BLOB, b',"x":' + b"[" * 100_000 + b"]" * 100_000), "Candidates"),
    "nested 100,000 deep, cut": (KEY, FRAME % (BLOB, b',"x":' + b'{"a":' * 100_000), "Candidates"),
    "another node's": (KEY, FRAME.replace(b'"node":"a"', b'"node":"b"') % (BLOB, b""), "node 'b' on key"),
    "no JSON": ("buddyline/node/b/attitude", b"\xff\xfe\x00", "malformed"),
    "another kind": ("buddyline/node/b/info", FRAME % (BLOB, b""), "NodeInfo"),
    "not finite": ("buddyline/node/b/depth", b'{"node":"b","stamp_ns":1,"depth_m":NaN,"sigma_m":0.1}', "finite"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_messages_are_counted_and_said_and_the_healthy_go_on(name, messages, healthy):
    key, payload, says = HOSTILE[name]
    solver = Solver()
    for i, message in enumerate(messages):
        if says is not None and i % 40 == 7:
            solver.take(payload, key)
        solver.take(message)
    assert [encode(result) for result in solver.results()] == healthy
    if says is not None:
        status = solver.status()
        assert status.bad_messages == len(range(7, len(messages), 40))
        assert key in status.problem
        assert says in status.problem
        assert len(encode(status)) < 5_000
        assert solver.status().problem == ""


def test_a_big_sound_message_is_taken_for_what_is_known_of_it():
    key, payload, _ = HOSTILE["10 MB of a sound frame"]
    solver = Solver()
    solver.take(payload, key)
    assert solver.status().bad_messages == 0
    assert solver.status().received_a == 1


def beyond_measure(message, what):
    least_or_most = {"sigma_px": 1e-300, "area_px": 1e308, "lasting_s": 3600.0}
    if isinstance(message, Candidates) and what in least_or_most:
        return replace(message, blobs=[replace(blob, **{what: least_or_most[what]}) for blob in message.blobs])
    if isinstance(message, Depth) and what in ("depth_m", "sigma_m"):
        return replace(message, **{what: 1e308})
    if isinstance(message, Attitude) and what == "sigma_rad":
        return replace(message, sigma_rad=(1e200, 1e200, 1e200))
    return message


@pytest.mark.parametrize("what", ["sigma_px", "area_px", "lasting_s", "depth_m", "sigma_m", "sigma_rad"])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_numbers_beyond_all_measure_cost_no_more_than_their_own_triggers(what):
    messages, _ = dive_messages(seconds=5.0, seed=7)
    solver = Solver()
    start_ns = messages[0].stamp_ns
    for message in messages:
        wild = message.node == "b" and 1.0e9 < message.stamp_ns - start_ns < 1.6e9
        solver.take(beyond_measure(message, what) if wild else message)
    results = solver.results()
    triggers = [m.trigger for m in messages if isinstance(m, Candidates) and m.node == "a"]
    assert [result.trigger for result in results] == triggers
    after = [r for r in results if r.stamp_ns - start_ns > 2.6e9]
    assert sum(isinstance(r, RelativePose) for r in after) > 0.6 * len(after)


def test_old_triggers_again_change_nothing_and_are_counted(messages, healthy):
    solver = Solver()
    frames = []
    for message in messages:
        solver.take(message)
        if isinstance(message, Candidates):
            frames.append(message)
            solver.take(frames[len(frames) // 2])
            solver.take(frames[0])
    assert [encode(result) for result in solver.results()] == healthy
    status = solver.status()
    assert status.duplicates + status.late == 2 * len(frames)


def test_frames_of_a_time_an_hour_ahead_take_nothing_from_the_others(messages, healthy):
    """Fewer than would be believed in a row: the clock was not set, someone sends nonsense."""
    solver = Solver()
    strange = 0
    for i, message in enumerate(messages):
        solver.take(message)
        if isinstance(message, Candidates) and i > len(messages) // 2 and i % 5 == 0:
            ahead = replace(message, stamp_ns=message.stamp_ns + HOUR_NS, trigger=message.trigger + 36_000)
            solver.take(ahead)
            strange += 1
    results = solver.results()
    told = [encode(result) for result in results]
    assert [payload for payload in told if payload in set(healthy)] == healthy
    rest = [result for result, payload in zip(results, told, strict=True) if payload not in set(healthy)]
    assert {result.reason for result in rest} == {"late"}
    assert strange == len(rest) > 3


def test_a_frame_an_hour_ahead_leaves_the_track_where_it_is():
    messages, _ = dive_messages(seconds=4.0, seed=7, imu=True)
    solver, undisturbed = Solver(), Solver()
    frames = [message for message in messages if isinstance(message, Candidates)]
    middle = frames[len(frames) // 2]
    for message in messages:
        undisturbed.take(message)
        solver.take(message)
        if message is middle:
            solver.take(replace(message, stamp_ns=message.stamp_ns + HOUR_NS, trigger=message.trigger + 36_000))
    assert len(solver.results()) == len(undisturbed.results()) + 1
    assert solver.track_stamps() == undisturbed.track_stamps()
    assert undisturbed.track_stamps()


def test_a_node_whose_clock_is_an_hour_ahead_is_named(messages):
    solver = Solver()
    frames = 0
    for message in messages:
        frames += isinstance(message, Candidates)
        changes = {"trigger": message.trigger + 36_000} if isinstance(message, Candidates) else {}
        ahead = replace(message, stamp_ns=message.stamp_ns + HOUR_NS, **changes)
        solver.take(ahead if message.node == "b" else message)
    results = solver.results()
    assert len(results) == frames
    assert {result.reason for result in results} == {"unmatched"}
    assert "frames of b are 3600.0 s ahead of those of a: do their clocks agree?" in solver.status().problem


def test_memory_is_bounded_whatever_comes(messages):
    """Floods of frames without partners, of far times, of calibrations, of samples from the future."""
    frame = next(m for m in messages if isinstance(m, Candidates))
    info = next(m for m in messages if isinstance(m, NodeInfo) and m.node == "a")
    solver = Solver()
    frame_text, info_text = encode(frame), encode(info)

    def flood(begin, count):
        for i in range(begin, begin + count):
            tree = b'"stamp_ns":%d' % (frame.stamp_ns + i * 7_000_000_000)
            solver.take(frame_text.replace(b'"stamp_ns":%d' % frame.stamp_ns, tree), key_of(frame))
            ahead = frame_text.replace(b'"trigger":%d' % frame.trigger, b'"trigger":%d' % (frame.trigger + i))
            solver.take(ahead, key_of(frame))
            solver.take(info_text.replace(b'"stamp_ns":%d' % info.stamp_ns, tree), key_of(info))
            for kind in ("attitude", "depth"):
                sample = next(m for m in messages if m.node == "a" and key_of(m).endswith(kind))
                solver.take(replace(sample, stamp_ns=sample.stamp_ns + i * 1_000_003))
        solver.bus.published.clear()

    flood(0, 1000)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        flood(1000, 600)
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert solver.status().pending <= 513
    assert after - before < 3_000_000


def test_a_stream_of_unknown_nodes_is_bounded_and_takes_no_ones_place(messages, healthy):
    solver = Solver()
    frame = next(m for m in messages if isinstance(m, Candidates))
    for i in range(2000):
        solver.take(replace(frame, node=f"x{i}"))
    for message in messages:
        solver.take(message)
    assert [encode(result) for result in solver.results()] == healthy
    assert sum(solver.service.core.unused.values()) == MAX_NODES
    assert len(solver.status().unused) == MAX_NODES
    assert solver.status().problem == ""


def test_the_frame_that_tells_of_a_new_time_does_not_end_its_trigger_again(messages):
    """A node's first frame is of another time; of its true ones, one comes twice and makes up their number."""
    frames = [m for m in messages if isinstance(m, Candidates) and m.node == "b"][:4]
    far = replace(frames[0], stamp_ns=frames[0].stamp_ns + HOUR_NS, trigger=frames[0].trigger + 36_000)
    solver = Solver()
    for frame in [far, *frames, frames[0]]:
        solver.take(frame)
    triggers = [result.trigger for result in solver.results()]
    assert len(triggers) == len(set(triggers))
    assert {frame.trigger for frame in frames} <= set(triggers)
