"""Clocks that drift, are slewed and are set: stored dives get their true times back."""

import json

import numpy as np
import pytest
from buddyline.node.sim.dive import messages
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import MS_NS, S_NS, trigger_index
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.envelope import open_envelope
from buddyline.protocol.messages import (
    Candidates,
    ClockBeacon,
    ClockSet,
    CompressedImage,
    FoxgloveTime,
    HeardClock,
    Imu,
    NodeInfo,
    RelativePose,
)
from buddyline.solver_service.clock_curve import ClockCurve
from buddyline.tools.cli import main
from buddyline.tools.clock_curves import beacon_curve
from buddyline.tools.dives import Dive
from msgspec import UNSET

START_NS = 1_764_000_000 * S_NS
DRIFT = 100e-6


class Machine:
    """A node's clock: its quartz drifts, its stamps are slewed by slew_s at the times of `at_s`, within a second."""

    def __init__(self, drift=0.0, offset_s=0.0, slews=()):
        self.drift, self.offset_s, self.slews = drift, offset_s, slews

    def raw_ns(self, true_s):
        return 77 * S_NS + round(true_s * (1.0 + self.drift) * S_NS)

    def stamp_ns(self, true_s):
        slewed_s = sum(by_s * min(max(true_s - at_s, 0.0), 1.0) for at_s, by_s in self.slews)
        return START_NS + round((self.offset_s + true_s * (1.0 + self.drift) + slewed_s) * S_NS)


def beacons(machines, spans_s, heard_s, *, raw=True, seed=0):
    """Give the nodes' beacons four times a second; they hear each other during heard_s."""
    rng = np.random.default_rng(seed)
    newest, said = {}, []
    for begin_s, end_s in spans_s:
        for true_s in np.arange(begin_s, end_s, 0.25):
            for node, other, later_s in (("a", "b", 0.0), ("b", "a", 0.11)):
                own, at_s = machines[node], float(true_s) + later_s
                link = any(first <= at_s < last for first, last in heard_s)
                heard = [newest[node]] if link and node in newest else []
                raw_ns = own.raw_ns(at_s) if raw else UNSET
                said.append(ClockBeacon(node=node, stamp_ns=own.stamp_ns(at_s), boot="x", heard=heard, raw_ns=raw_ns))
                newest[other] = HeardClock(
                    node=node,
                    boot="x",
                    sent_ns=own.stamp_ns(at_s),
                    received_ns=machines[other].stamp_ns(at_s + 2e-4 + rng.exponential(1e-4)),
                )
    return said


def error_ms(curve, machines, true_s):
    """Give by how much the curve is off at a true time."""
    at_ns = machines["b"].stamp_ns(true_s)
    return (curve.offset_ns(at_ns) - (at_ns - machines["a"].stamp_ns(true_s))) / MS_NS


@pytest.mark.parametrize("seconds", [360, 3600])
def test_beacons_before_and_after_a_dive_give_the_clock_between_them(seconds):
    machines = {"a": Machine(), "b": Machine(10e-6, offset_s=-0.002)}
    ends_s = [(0, 15), (seconds - 15, seconds)]
    found = beacon_curve(beacons(machines, ends_s, ends_s, raw=False), "a", "b", (START_NS, START_NS + seconds * S_NS))
    assert found.covers
    assert max(abs(error_ms(found.curve, machines, t)) for t in np.linspace(-5, seconds + 5, 50)) < 0.2


def test_a_slew_after_the_dive_does_not_hide_what_the_clocks_had_drifted():
    """chrony takes 36 ms away within a second of the cable being plugged in, before most beacons have been sent."""
    machines = {"a": Machine(), "b": Machine(60e-6, slews=((600.0, -0.036),))}
    spans_s, heard_s = [(0, 640)], [(0, 15), (600.5, 640)]
    found = beacon_curve(beacons(machines, spans_s, heard_s), "a", "b", (START_NS, START_NS + 640 * S_NS))
    assert found.covers
    assert max(abs(error_ms(found.curve, machines, t)) for t in (0, 100, 300, 500, 599, 600.5, 610, 639)) < 0.3
    assert found.curve.offset_ns(START_NS + 599 * S_NS) == pytest.approx(35.9 * MS_NS, abs=0.3 * MS_NS)
    bare = beacons(machines, spans_s, heard_s, raw=False)
    assert abs(error_ms(beacon_curve(bare, "a", "b", (START_NS, START_NS + 640 * S_NS)).curve, machines, 590)) > 20


def test_beacons_at_one_end_do_not_cover_a_dive_and_none_tell_nothing():
    machines, span_ns = {"a": Machine(), "b": Machine()}, (START_NS, START_NS + 900 * S_NS)
    one_end = beacons(machines, [(0, 900)], [(0, 15)])
    found = beacon_curve(one_end, "a", "b", span_ns)
    assert not found.covers
    assert found.curve.largest_s < 0.001
    assert beacon_curve(beacons(machines, [(0, 900)], []), "a", "b", span_ns) is None
    assert beacon_curve([], "a", "b", span_ns) is None


def test_a_curve_is_exact_at_its_points_and_level_beyond_them():
    curve = ClockCurve.of([START_NS, START_NS + S_NS], [0, 1000])
    stamps_ns = [START_NS - S_NS, START_NS, START_NS + S_NS // 2, START_NS + 9 * S_NS]
    assert [curve.offset_ns(stamp_ns) for stamp_ns in stamps_ns] == [0, 0, 500, 1000]
    for stamps_ns, offsets_ns in (([], []), ([1, 1], [0, 0]), ([1], [0, 0])):
        with pytest.raises(ValueError, match="curve"):
            ClockCurve.of(stamps_ns, offsets_ns)


SECONDS = 30.0


@pytest.fixture(scope="module")
def drifted(tmp_path_factory):
    """Both nodes' own logs of a dive in which B's clock gains 100 us a second from 20 ms on, with beacons around it."""
    folder = tmp_path_factory.mktemp("drifted")
    machines = {"a": Machine(), "b": Machine(DRIFT, offset_s=0.02)}
    scenario = Scenario(seed=8, start_ns=START_NS, clock_offset_ns=20 * MS_NS, clock_drift=DRIFT, interruptions=False)
    dive = [message for _, _, message in messages(World(scenario), DivePlan(seconds=SECONDS))]
    ends_s = [(-10, 0), (SECONDS, SECONDS + 10)]
    said = beacons(machines, ends_s, ends_s)
    for node in "ab":
        with DiveLogWriter(folder / f"{node}.mcap", metadata={"node": node}) as writer:
            for message in [*dive, *said]:
                if getattr(message, "node", "") == node:
                    writer.write_message(message)
    return folder


def solved(folder, out, *words):
    assert (
        main(["solve", str(folder / "a.mcap"), str(folder / "b.mcap"), "--track", "none", "-o", str(out), *words]) == 0
    )
    with Dive([out]) as dive:
        return {
            one.message.trigger: one.message for one in dive.messages("pose") if isinstance(one.message, RelativePose)
        }


def test_solve_takes_the_clock_from_the_beacons_or_from_a_file(drifted, tmp_path):
    by_beacons = solved(drifted, tmp_path / "beacons.mcap")
    told = {"node_a": "a", "node_b": "b", "offset_s": 0.02 + DRIFT * 15, "drift": DRIFT, "at_ns": START_NS + 15 * S_NS}
    (tmp_path / "clocks.json").write_text(json.dumps(told))
    by_file = solved(drifted, tmp_path / "file.mcap", "--clocks", str(tmp_path / "clocks.json"))
    without = solved(drifted, tmp_path / "without.mcap", "--clock-offset", "0")
    common = sorted(by_beacons.keys() & by_file.keys() & without.keys())
    assert len(common) > 150
    # The same frames, whose stamps are 20 ms apart at the start and 23 ms at the end.
    by_beacons_ms, by_file_ms, without_ms = (
        np.array([found[k].skew_ns for k in common]) / MS_NS for found in (by_beacons, by_file, without)
    )
    true_ms = 20.0 + 0.1 * (np.array(common) / 10 - START_NS / S_NS)
    assert np.abs(by_beacons_ms - without_ms - true_ms).max() < 0.2
    assert np.abs(by_file_ms - without_ms - true_ms).max() < 0.05


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ("{", "is not what `buddyline align --json` writes"),
        ('{"node_a": "b", "node_b": "a", "offset_s": 0.1}', "is of nodes b and a, not of a and b"),
        ("[]", "is not what"),
        ("{}", "is not what `buddyline align --json` writes (it has no node_a)"),
        ("\x89MCAP0", "clocks.json: is a dive log; name what `buddyline align --json` writes here"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(drifted, tmp_path, capsys, told, words):
    (tmp_path / "clocks.json").write_text(told, encoding="latin-1")
    logs = [str(drifted / "a.mcap"), str(drifted / "b.mcap")]
    assert main(["solve", *logs, "-o", str(tmp_path / "o.mcap"), "--clocks", str(tmp_path / "clocks.json")]) == 2
    assert words in capsys.readouterr().err
    assert main(["solve", *logs, "-o", str(tmp_path / "o.mcap"), "--clocks", str(tmp_path / "none.json")]) == 2
    assert "cannot be read" in capsys.readouterr().err


PERIOD_NS = 100 * MS_NS


def write_set_log(path, steps, *, node="b"):
    """Write a node's log whose clock is set: steps: (after how many samples, by how much s)."""
    moved_ns, due = 0, dict(steps)
    info = NodeInfo(
        node=node,
        stamp_ns=START_NS,
        width_px=820,
        height_px=616,
        camera={
            "model": "pinhole",
            "fx_px": 700.0,
            "fy_px": 700.0,
            "cx_px": 410.0,
            "cy_px": 308.0,
            "distortion": [0.0] * 5,
        },
        light_left_m=(-0.4, 0.0, 0.0),
        light_right_m=(0.4, 0.0, 0.0),
        sigma_px=0.7,
        trigger_period_ns=PERIOD_NS,
    )
    with DiveLogWriter(path, metadata={"node": node}) as writer:
        writer.write_message(info)
        for k in range(100):
            if k in due:
                moved_ns += round(due[k] * S_NS)
                stamp_ns = START_NS + k * PERIOD_NS + moved_ns
                writer.write_message(
                    ClockSet(node=node, stamp_ns=stamp_ns, boot="x", moved_ns=round(due[k] * S_NS)), stamp_ns
                )
            stamp_ns = START_NS + k * PERIOD_NS + moved_ns
            writer.write_message(
                Imu(node=node, stamp_ns=stamp_ns, accel_mps2=(float(k), 0.0, 0.0), gyro_radps=(0.0, 0.0, 0.0)), stamp_ns
            )
            writer.write_message(
                Candidates(
                    node=node, stamp_ns=stamp_ns, trigger=trigger_index(stamp_ns, PERIOD_NS), seq=k, boot="x",
                    width_px=820, height_px=616, blobs=[],
                ),
                stamp_ns,
            )  # fmt: skip
    return moved_ns


@pytest.mark.parametrize(
    "steps",
    [[(40, 3600.0)], [(40, -3.0)], [(40, -3600.0)], [(20, 5.0), (60, -2.0)], [(20, -1.0), (50, -1.0), (70, 4.0)]],
)
def test_a_clock_that_was_set_in_mid_dive_leaves_no_gap_and_no_doubled_time(tmp_path, steps):
    moved_ns = write_set_log(tmp_path / "b.mcap", steps)
    with Dive([tmp_path / "b.mcap"]) as dive:
        found = list(dive.messages("imu", "candidates", "clock_set"))
        assert (dive.start_ns, dive.seconds) == (START_NS + moved_ns, pytest.approx(9.9))
        later = list(dive.messages("imu", since_ns=START_NS + moved_ns + 5 * S_NS))
    assert len(found) == 200
    assert len(later) == 50
    for topic in ("imu", "candidates"):
        of_topic = [one for one in found if one.topic.name == topic]
        assert [one.message.stamp_ns for one in of_topic] == [START_NS + moved_ns + k * PERIOD_NS for k in range(100)]
        assert all(one.time_ns == one.message.stamp_ns for one in of_topic)
        # The payload, which `solve` copies, says the same.
        assert all(open_envelope(one.key, one.payload).message == one.message for one in of_topic)
    assert [one.message.accel_mps2[0] for one in found if isinstance(one.message, Imu)] == list(range(100))
    triggers = [one.message.trigger for one in found if isinstance(one.message, Candidates)]
    assert np.diff(triggers).tolist() == [1] * 99
    assert triggers[0] == trigger_index(START_NS + moved_ns, PERIOD_NS)


def test_a_recording_of_others_keeps_its_own_times_and_moves_the_stamps(tmp_path):
    """The recorder's clock was not set, and its log has no word of it: the node's own log has."""
    moved_ns = write_set_log(tmp_path / "b.mcap", [(40, 100.0)])
    with Dive([tmp_path / "b.mcap"]) as dive:
        before = [one.message for one in dive.messages("imu")]
    with DiveLogWriter(tmp_path / "topside.mcap") as writer:
        for k in range(100):
            stamp_ns = START_NS + k * PERIOD_NS + (moved_ns if k >= 40 else 0)
            writer.write_message(
                Imu(node="b", stamp_ns=stamp_ns, accel_mps2=(float(k), 0.0, 0.0), gyro_radps=(0.0, 0.0, 0.0)),
                7 * S_NS + k * PERIOD_NS,
            )
    with Dive([tmp_path / "topside.mcap", tmp_path / "b.mcap"]) as dive:
        heard = [one for one in dive.messages("imu") if one.time_ns < START_NS]
    assert [one.message for one in heard] == before
    assert [one.time_ns for one in heard] == [7 * S_NS + k * PERIOD_NS for k in range(100)]


def test_pictures_beside_the_log_move_with_it(tmp_path):
    """Their files have no word of the setting; their stamps say on which side of it they are."""
    moved_ns = write_set_log(tmp_path / "b.mcap", [(40, 100.0)])
    (tmp_path / "b.pictures").mkdir()
    with DiveLogWriter(tmp_path / "b.pictures" / "000000.mcap", metadata={"node": "b"}) as writer:
        for k in range(0, 100, 10):
            seconds, left_ns = divmod(START_NS + k * PERIOD_NS + (moved_ns if k >= 40 else 0), S_NS)
            image = CompressedImage(
                timestamp=FoxgloveTime(sec=seconds, nsec=left_ns), frame_id="b_camera", data=b"\xff\xd8", format="jpeg"
            )
            writer.write_message(image, image.stamp_ns)
    with Dive([tmp_path / "b.mcap"]) as dive:
        found = list(dive.messages("image"))
        assert dive.seconds == pytest.approx(9.9)
    assert [one.message.stamp_ns for one in found] == [START_NS + moved_ns + k * PERIOD_NS for k in range(0, 100, 10)]
    assert all(one.time_ns == one.message.stamp_ns for one in found)
