"""The demo's text about a running pair: the track between fixes, its age, and errors against the truth."""

from __future__ import annotations

import io
import os
import re
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.codec import encode
from buddyline.protocol.envelope import open_envelope
from buddyline.protocol.messages import Message
from buddyline.protocol.topics import key_of
from buddyline.tools.demo import command
from buddyline.tools.demo.command import _show
from buddyline.tools.demo.dashboard import Dashboard, summary_text
from buddyline.tools.draw.above import ASCII_ARROWS
from buddyline.tools.progress import terminal_size
from msgspec.structs import replace

from tests.tools.evaluated import pose, rejection, track
from tests.tools.watched import START_NS, at, solver_status, status

OFF_M = np.array((0.0, 0.0, 0.02))
NED = {"azimuth_rad": 1.0, "inclination_rad": 0.1}
SIGMAS = {"sigma_azimuth_rad": 0.05, "sigma_inclination_rad": 0.01}
WORLD = World(Scenario(environment="cavern", seed=1, start_ns=START_NS))


class WatchedPair:
    """A dashboard, and a clock that stands still."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.dashboard = Dashboard("cavern", 1, START_NS, 10.0, lambda: self.now_s)

    def take(self, message: Message) -> None:
        self.dashboard.take(open_envelope(key_of(message), encode(message), at(0)))


def estimate(k: int, off_m: float = 1.0) -> dict[str, object]:
    """The truth at trigger k, as an estimate that is off by so many times OFF_M."""
    true = WORLD.truth(at(k), k)
    t_m = np.array(true.t_a_b_m) + off_m * OFF_M
    return {"t_a_b_m": tuple(t_m), "q_a_b_xyzw": true.q_a_b_xyzw, "range_m": float(np.linalg.norm(t_m))}


def running() -> WatchedPair:
    """Eleven poses, twenty rejections, and a track that goes on; one sample of it is wrong."""
    watch = WatchedPair()
    for k in range(31):
        watch.take(pose(k, **estimate(k, 2.0)) if k % 3 == 0 else rejection(k))
        for mode in ("filter", "lag"):
            watch.take(
                track(k, mode=mode, age_s=0.7 * (k == 30), **estimate(k, 100.0 if k == 20 else 1.0), **NED, **SIGMAS)
            )
    return watch


def test_the_line_shows_the_track_with_its_sigma_and_how_long_it_saw_no_light():
    watch = running()
    watch.now_s = 0.5
    line = watch.dashboard.line()
    assert "azimuth  57.30 ± 2.86 deg  inclination  +5.73 ± 0.57 deg" in line
    assert "off   20.0 mm" in line
    assert "no light for 1.2 s" in line
    assert "track 100% of the time, poses 35% of triggers" in line
    assert "no light for 1.2 s" in watch.dashboard.screen(100, 40)


def test_a_stale_track_is_replaced_by_the_last_pose_with_a_note():
    watch = running()
    watch.now_s = 2.0
    line = watch.dashboard.line()
    assert "off   40.0 mm" in line
    assert "no track, the last pose, STALE: 2.0 s old" in line
    assert "no track, the last pose" in watch.dashboard.screen(80, 24)


def test_a_track_without_poses_is_shown():
    watch = WatchedPair()
    assert "no pose yet" in watch.dashboard.line()
    assert "no pose yet" in watch.dashboard.screen(80, 24)
    watch.take(track(0, **estimate(0)))
    assert "off   20.0 mm" in watch.dashboard.line()


@pytest.mark.parametrize("size", [(60, 14), (80, 24), (200, 60)])
def test_the_screen_fits_its_terminal(size):
    watch = running()
    for node in "ab":
        watch.take(replace(status(node, at(30)), lights_seen=2))
    text = watch.dashboard.screen(*size)
    # Never cleared as a whole, which flickers; each line clears its own rest, and the end what is below.
    assert "\x1b[2J" not in text
    assert text.startswith("\x1b[H")
    assert text.endswith("\x1b[K\x1b[J")
    lines = text.removeprefix("\x1b[H").removesuffix("\x1b[K\x1b[J").split("\x1b[K\n")
    assert len(lines) <= size[1]
    assert all(len(line) < size[0] for line in lines)
    assert "from above; a row is" in text
    assert "range" in text
    assert "last without a pose: " in text
    assert "deg  lights: a 2, b 2" in text
    assert ("latency" in text) == (size[1] > 24)


@pytest.mark.parametrize("size", [(1, 1), (2, 1), (3, 2), (10, 3), (1, 60), (300, 1)])
def test_a_tiny_terminal_gets_what_fits(size):
    watch = running()
    text = watch.dashboard.screen(*size)
    lines = text.removeprefix("\x1b[H").removesuffix("\x1b[K\x1b[J").split("\x1b[K\n")
    assert len(lines) <= max(size[1], 1)
    assert all(len(line) < size[0] for line in lines)


def test_a_terminal_that_nobody_gave_a_size_counts_as_80_by_24(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.delenv("LINES", raising=False)
    monkeypatch.setattr(os, "get_terminal_size", lambda *_: os.terminal_size((0, 0)))
    assert terminal_size() == (80, 24)


class Terminal(io.StringIO):
    """A terminal that keeps what is written to it."""

    def isatty(self) -> bool:
        return True


def test_screens_follow_each_other_without_a_line_s_end(monkeypatch):
    """It would move a full screen up by a line, its title out of sight."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    assert _show(SimpleNamespace(stop=threading.Event()), running().dashboard, 0.3)
    text = terminal.getvalue()
    assert text.count("\x1b[J\x1b[H") >= 1
    assert text.count("\x1b[J\n") == 1
    assert text.endswith("\x1b[J\n")


def test_the_seconds_count_from_both_nodes_first_pictures(monkeypatch):
    watch, looks = WatchedPair(), []

    def wait(_: float) -> bool:
        looks.append(None)
        assert len(looks) < 9
        if len(looks) in (2, 4):
            watch.take(rejection(0, "unmatched" if len(looks) == 2 else "ambiguous"))
        return False

    service = SimpleNamespace(stop=SimpleNamespace(wait=wait))
    assert _show(service, watch.dashboard, 1e-9)
    assert len(looks) >= 4
    monkeypatch.setattr(command, "BEGINS_WITHIN_S", 0.0)
    looks.clear()
    assert _show(service, WatchedPair().dashboard, 1e-9), "nothing came: it is over all the same"
    assert len(looks) < 4


@pytest.mark.parametrize("no_color", ["", "1"])
def test_no_color_is_respected(no_color, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("NO_COLOR", no_color)
    assert _show(SimpleNamespace(stop=threading.Event()), running().dashboard, 0.3)
    assert bool(re.search(r"\x1b\[[0-9;]+m", terminal.getvalue())) == (not no_color)


def test_colours_are_left_out_where_nobody_wants_them():
    watch = running()
    plain = watch.dashboard.screen(80, 24, arrows=ASCII_ARROWS)
    assert not re.search(r"\x1b\[[0-9;]*m", plain)
    assert all(character.isascii() or character == "±" for character in plain)
    coloured = watch.dashboard.screen(80, 24, coloured=True)
    assert "\x1b[36mA" in coloured
    assert "\x1b[33mrange" in coloured, "no light for a while: not all is well"


def test_triggers_with_all_lights_in_view_are_counted_apart():
    watch = running()
    in_view = [
        k
        for k in range(31)
        if all(
            sum(light.visible and not light.merged for light in WORLD.light_truth(node, at(k), k).lights) == 2
            for node in "ab"
        )
    ]
    assert 0 < len(in_view) <= 31
    with_pose = sum(k % 3 == 0 for k in in_view)
    watch.now_s = 1.0
    summary = watch.dashboard.summary({})
    assert summary["solved_share_in_view"] == pytest.approx(with_pose / len(in_view))
    assert "of those with all four lights in view" in summary_text(summary)


def test_the_summary_has_the_track_s_errors_beside_the_poses():
    watch = running()
    watch.now_s = 1.0
    summary = watch.dashboard.summary({})
    assert summary["solved_share"] == pytest.approx(11 / 31)
    assert summary["position_error_m"] == pytest.approx(0.04)
    assert set(summary["tracks"]) == {"filter", "lag"}
    found = summary["tracks"]["filter"]
    # Every second of the 31 is kept.
    assert (found["samples"], found["wrong_samples"], found["covered_share"]) == (16, 1, 1.0)
    assert found["position_error_m"] == pytest.approx(0.02)
    assert found["worst_position_error_m"] == pytest.approx(2.0)
    text = summary_text(summary)
    assert "track: covers 100% of the time; median error: position 20.0 mm" in text
    assert "worst position 2000 mm; 1 of 16 samples wrong" in text
    assert "track with a second of delay (lag): covers" in text


def test_a_run_without_a_track_has_no_track_figures():
    watch = WatchedPair()
    watch.now_s = 1.0
    assert summary_text(watch.dashboard.summary({})).startswith("no pose in 1 s")
    watch.take(pose(0, **estimate(0)))
    summary = watch.dashboard.summary({})
    assert summary["tracks"] == {}
    assert "track" not in summary_text(summary)


def test_what_the_solver_tells_the_divers_is_what_to_do():
    watch = running()
    watch.take(solver_status(at(31), advice=["turn b 20 deg left", "come 1.5 m closer"]))
    assert "; turn b 20 deg left, come 1.5 m closer" in watch.dashboard.screen(200, 60)


def test_a_machine_that_is_too_slow_is_named_and_none_that_is_not() -> None:
    for every, unmatched, share in ((1, False, 1.0), (2, False, 16 / 31), (1, True, 21 / 31)):
        watch = WatchedPair()
        for k in range(0, 31, every):
            refused = rejection(k, reason="unmatched" if unmatched else "ambiguous")
            watch.take(refused if k % 3 == 1 else pose(k, **estimate(k)))
        summary = watch.dashboard.summary({})
        assert summary["pictured_share"] == pytest.approx(share)
        assert ("this machine is busy" in summary_text(summary)) == (share < 0.9)
    watch = WatchedPair()
    for k in (0, 20):
        watch.take(rejection(k, reason="unmatched"))
    assert "both pictures came for 0% of the triggers" in summary_text(watch.dashboard.summary({}))
