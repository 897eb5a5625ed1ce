"""The state of a pair, and its place on the page."""

from __future__ import annotations

import base64
import math
import threading
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.envelope import Refusals, envelope_of
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.messages import Mark, Message
from buddyline.protocol.topics import ATTITUDE, INFO, POSE, TRACK
from buddyline.tools.health.pair import findings
from buddyline.tools.monitor import panel
from buddyline.tools.monitor.coverage import Coverage, clock_words
from buddyline.tools.monitor.live import subscribe
from buddyline.tools.monitor.overview import Overview
from buddyline.tools.monitor.picture import KEPT_NS, PairPicture, columns
from buddyline.tools.monitor.scene import R_LEVEL, ellipsoid, frame_of
from msgspec.structs import replace

from tests.tools.evaluated import FACING, INFOS, frame, pose, rejection, track
from tests.tools.watched import at, attitude, feed, image, solver_status, status, take, unsolved, watched, words

HALF = math.sqrt(0.5)


class TestPicture:
    def test_a_level_camera_that_looks_north_sees_b_in_the_north(self) -> None:
        frame_a = frame_of(INFOS["a"], attitude("a", 0))
        np.testing.assert_allclose(frame_a.R_s_a, R_LEVEL, atol=1e-12)
        assert frame_a.levelled
        np.testing.assert_allclose(frame_a.place(pose(0)), (3.0, 0.0, 0.0), atol=1e-12)

    def test_a_camera_that_looks_east_sees_b_in_the_east_and_its_right_is_south(self) -> None:
        frame_a = frame_of(INFOS["a"], attitude("a", 0, (0.0, 0.0, HALF, HALF)))
        np.testing.assert_allclose(frame_a.place(pose(0)), (0.0, 3.0, 0.0), atol=1e-12)
        np.testing.assert_allclose(frame_a.R_s_a @ (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), atol=1e-12)

    def test_two_nodes_that_face_each_other_look_in_opposite_directions(self) -> None:
        frame_a = frame_of(INFOS["a"], attitude("a", 0))
        ahead = np.array([0.0, 0.0, 1.0])
        np.testing.assert_allclose(frame_a.turn_b(pose(0)) @ ahead, -(frame_a.R_s_a @ ahead), atol=1e-12)
        assert FACING == (0.0, 1.0, 0.0, 0.0)

    def test_without_an_attitude_the_scene_says_that_it_is_drawn_level(self) -> None:
        assert not frame_of(INFOS["a"], None).levelled
        assert not frame_of(None, attitude("a", 0)).levelled

    def test_b_is_where_the_solver_says_where_it_knows_north(self) -> None:
        picture = watched(1)
        take(picture, pose(1, t_ned_m=(1.0, 2.0, 3.0), azimuth_rad=1.1, inclination_rad=-0.9), at(5))
        assert picture.points[-1].t_m == (1.0, 2.0, 3.0)

    def test_a_silent_track_is_stale_within_a_second(self) -> None:
        picture = watched(5)
        assert not picture.is_stale(at(4) + S_NS // 2)
        assert picture.is_stale(at(4) + S_NS)
        assert PairPicture().is_stale(0)

    def test_trail_keeps_minutes_and_no_more(self) -> None:
        picture = PairPicture()
        for k in range(0, 4000, 2):
            take(picture, pose(k), at(k))
        assert picture.points[-1].at_ns - picture.points[0].at_ns <= KEPT_NS
        assert len(picture.points) == KEPT_NS // (2 * (at(1) - at(0))) + 1
        assert len(picture.results) <= 128

    def test_another_pair_s_poses_are_named_and_not_shown(self) -> None:
        picture = watched(3)
        take(picture, pose(3, node_b="c", range_m=99.0), at(3))
        assert picture.pose is not None
        assert picture.pose.range_m == 3.0
        assert "another pair, a and c" in words(picture, at(3))

    def test_the_pair_that_was_chosen_is_shown_whatever_comes_first(self) -> None:
        picture = PairPicture(("a", "c"))
        for k in range(3):
            take(picture, pose(k), at(k))
            take(picture, pose(k, node_b="c", range_m=9.0), at(k))
        assert picture.ends() == ("a", "c")
        assert (picture.pose.range_m if picture.pose else None, picture.solved) == (9.0, 3)

    def test_latency_of_a_log_solved_offline_is_unknown(self) -> None:
        picture = PairPicture()
        take(picture, pose(0), at(0))
        take(picture, pose(10), at(10) + S_NS // 20)
        assert [point.latency_s for point in picture.points] == [pytest.approx(math.nan, nan_ok=True), 0.05]


class TestTrack:
    def test_the_track_is_shown_with_the_time_since_the_last_light(self) -> None:
        picture = watched()
        take(picture, track(29, (0.0, 0.0, 3.5), age_s=1.0), at(29))
        shown = picture.shown(at(31))
        assert shown is not None
        assert (shown.estimate.range_m, shown.stale, shown.note) == (3.5, False, "no light for 1.2 s")
        drawn = panel.figures(picture, at(31))
        assert "3.50 m" in drawn
        assert "No light for 1.2 s." in drawn

    def test_a_stale_track_is_replaced_by_the_last_pose_with_words(self) -> None:
        picture = watched(20)
        take(picture, track(19, (0.0, 0.0, 3.5)), at(19))
        for k in range(20, 31):
            feed(picture, k)
        shown = picture.shown(at(30))
        assert shown is not None
        assert (shown.estimate.range_m, shown.stale) == (3.0, False)
        assert shown.note == "no track for 1.1 s, the last pose"
        assert "The track has ended, for 1.1 s." in words(picture, at(30))

    def test_without_a_track_the_last_pose_is_shown(self) -> None:
        shown = watched().shown(at(29))
        assert shown is not None
        assert (shown.estimate, shown.note) == (pose(29), "no track, the last pose")
        assert "track" not in words(watched(), at(29))

    def test_both_stale_the_newest_is_shown_as_old(self) -> None:
        picture = watched(20)
        take(picture, track(25, (0.0, 0.0, 3.5)), at(25))
        shown = picture.shown(at(45))
        assert shown is not None
        assert (shown.estimate.range_m, shown.stale, shown.note) == (3.5, True, "STALE: 2.0 s old")

    def test_a_track_before_the_first_pose_is_shown(self) -> None:
        picture = PairPicture()
        take(picture, track(0), at(0))
        assert not picture.is_stale(at(1))

    def test_sigmas_stand_beside_what_is_shown(self) -> None:
        picture = watched()
        angles = {"azimuth_rad": 1.0, "sigma_azimuth_rad": 0.05, "inclination_rad": 0.1, "sigma_inclination_rad": 0.01}
        take(picture, track(29, t_ned_m=(1.5, 2.5, 0.3), sigma_ned_m=(0.11, 0.08, 0.02), **angles), at(29))
        drawn = panel.figures(picture, at(29))
        for text in ("± 5.8 mm", "57.3°", "± 2.9°", "± 0.6°", "north +1.50 ± 0.11 m, east +2.50 ± 0.08 m, down +0.30"):
            assert text in drawn

    def test_an_uncertain_track_is_judged_by_its_share_of_the_range(self) -> None:
        picture = watched()
        take(picture, track(29, sigma_m=0.149), at(29))
        assert "uncertain" not in words(picture, at(29))
        take(picture, track(29, sigma_m=0.16), at(29))
        assert "The track is uncertain: by 0.16 m (1 sd) at 3.00 m." in words(picture, at(29))

    def test_no_pose_is_a_warning_while_the_track_goes_on(self) -> None:
        picture = watched()
        for k in range(30, 60):
            for message in (frame("a", k), frame("b", k), rejection(k), track(k)):
                take(picture, message, at(k))
            take(picture, solver_status(at(k)), at(k))
        (said,) = [finding for finding in findings(picture, at(59)) if finding.name == "pair"]
        assert (said.level, said.text.endswith("The track goes on without.")) == ("warning", True)
        assert panel.figures(picture, at(59)).count("3.00 m") == 1

    @pytest.mark.parametrize("live", [True, False])
    def test_the_solvers_problem_is_shown(self, live: bool) -> None:
        picture = watched()
        take(picture, solver_status(at(29), "the inertial unit of a is mounted otherwise"), at(29))
        assert "The solver reports: the inertial unit of a" in words(picture, at(29), live=live)


class TestLive:
    def test_messages_update_the_picture_and_bad_ones_change_nothing(self) -> None:
        network = LocalNetwork(ManualClock(at(30)))
        overview, refusals = Overview(), Refusals("t")
        with network.connect() as nodes, network.connect() as topside:
            nodes.publisher(INFO, "a").put(INFOS["a"])
            subscribe(topside, refusals, overview, threading.Lock())
            poses = nodes.publisher(POSE, "a", "b")
            poses.put(pose(0))
            poses.put_bytes(b'{"range_m": "far"}')
            poses.put(pose(1))
            nodes.publisher(TRACK, "a", "b").put(track(1))
            nodes.publisher(ATTITUDE, "a").put(attitude("a", at(1)))
            # All subscriptions have handed on what they hold when they are closed.
            topside.close()
        picture = overview.picture()
        assert (picture.pose, picture.solved) == (pose(1), 2)
        assert picture.track == track(1)
        assert picture.nodes["a"].info == INFOS["a"]
        assert picture.nodes["a"].attitude == attitude("a", at(1))
        assert refusals.count == 1

    def test_a_process_that_leaves_the_bus_is_noticed(self) -> None:
        network, overview = LocalNetwork(ManualClock(at(30))), Overview()
        with network.connect() as topside:
            with network.connect() as node:
                node.declare_alive("node/b")
                subscribe(topside, Refusals("t"), overview, threading.Lock())
            topside.close()
        assert overview.nodes["b"].left_ns == at(30)


class TestPanel:
    def test_stale_figures_are_struck_through_and_said_to_be_old(self) -> None:
        picture = watched()
        fresh, old = panel.figures(picture, at(29)), panel.figures(picture, at(29) + S_NS)
        assert "STALE" not in fresh
        assert 'class="grid old"' in old
        assert "STALE: 1.0 s old" in old

    def test_words_from_the_bus_cannot_become_markup(self) -> None:
        picture = watched()
        take(picture, status("a", at(30), "<script>alert(1)</script>"), at(30))
        take(picture, replace_detail("<img src=x>"), at(30))
        for drawn in (panel.figures, panel.health):
            assert "<script>alert" not in drawn(picture, at(31))
        assert "<img" not in panel.camera(picture, picture.nodes["a"], at(30))

    def test_a_picture_is_shown_with_its_own_candidates(self) -> None:
        picture = watched(5)
        take(picture, image("a", at(2)), at(4))
        drawn = panel.camera(picture, picture.nodes["a"], at(4))
        assert "data:image/png;base64," in drawn
        assert "Pose at 3.00 m" in drawn
        assert "STALE" in panel.camera(picture, picture.nodes["a"], at(4) + 4 * S_NS)

    def test_a_rejection_is_said_on_the_picture(self) -> None:
        picture = watched(5)
        take(picture, frame("a", 5), at(5))
        take(picture, rejection(5), at(5))
        words = panel.judged_picture(picture, picture.nodes["a"])[1]
        assert "more than one arrangement fits (two, alike)" in words

    def test_the_chosen_lights_of_a_pose_are_given_by_node(self) -> None:
        solved = pose(0, blobs_a=(1, 0), blobs_b=(0, -1))
        assert [panel.chosen_lights(solved, node) for node in "abc"] == [(1, 0), (0, -1), (-1, -1)]

    def test_azimuths_are_plotted_across_north_without_a_jump(self) -> None:
        picture = PairPicture()
        for k in range(0, 40, 2):
            azimuth_rad = math.radians((350 + k) % 360)
            take(picture, pose(k, azimuth_rad=azimuth_rad, inclination_rad=0.0), at(k))
        found = columns(list(picture.points), at(0))
        (drawn,) = (column.values for title, column in found.items() if title.startswith("Azimuth"))
        np.testing.assert_allclose(np.diff(drawn), 2.0, atol=1e-9)

    def test_what_is_not_known_is_not_plotted(self) -> None:
        found = columns(list(watched(9).points), at(0))
        assert {title.split(",")[0] for title in found} == {
            "Range",
            "Position's 1 sd",
            "Gap between both nodes' ranges",
        }

    def test_the_surveys_verdict_on_a_leg_is_shown_for_a_minute(self) -> None:
        picture = watched(9)
        for kind, name, said in (("leg", "good", "the leg is good"), ("alarm", "sights", "leg again (sights)")):
            for node in "ab":
                mark = Mark(node=node, stamp_ns=at(9), kind=kind, name=name, note="<5 m>")  # type: ignore[arg-type]
                picture.take(envelope_of(mark, at(9)))
            assert panel.health(picture, at(20)).count(f"{said}: &lt;5 m&gt;") == 1
        picture.take(envelope_of(Mark(node="a", stamp_ns=at(10), kind="point"), at(10)))
        assert "leg again" in panel.health(picture, at(20))
        assert "Survey" not in panel.health(picture, at(9) + 61 * S_NS)

    @pytest.mark.parametrize("draw", [panel.figures, panel.health])
    def test_every_state_can_be_drawn(self, draw: Callable[[PairPicture, int], str]) -> None:
        for picture in (PairPicture(), watched(1), watched(30), unsolved()):
            assert draw(picture, at(30)).startswith("<div")


def replace_detail(detail: str) -> Message:
    return replace(rejection(29), detail=detail)


class TestScene:
    def test_the_ellipsoid_s_longest_axis_lies_along_the_line_of_sight(self) -> None:
        half_m, R_s_axes = ellipsoid(pose(0), frame_of(INFOS["a"], attitude("a", 0)))
        longest = int(np.argmax(half_m))
        assert half_m[longest] == pytest.approx(2.795 * 0.02)
        np.testing.assert_allclose(np.abs(R_s_axes[:, longest]), (1.0, 0.0, 0.0), atol=1e-9)
        assert np.linalg.det(R_s_axes) == pytest.approx(1.0)


class TestCoverage:
    def test_stretches_without_poses_are_found_with_their_reasons(self) -> None:
        coverage = Coverage(0, 100 * S_NS)
        for k in range(100):
            coverage.add(k * S_NS, "ambiguous" if 40 <= k < 60 else None)
        assert coverage.without() == []
        coverage.complete = True
        (stretch,) = coverage.without()
        assert (stretch.begin_ns, stretch.end_ns) == (39 * S_NS, 60 * S_NS)
        assert coverage.words(stretch) == "from 0:39.0 for 21 s: more than one arrangement fits (20)"

    def test_the_strip_shows_each_bin_s_colour_and_where_playback_stands(self) -> None:
        coverage = Coverage(0, 100 * S_NS)
        for k in range(100):
            coverage.add(k * S_NS, "ambiguous" if k >= 50 else None)
        strip = coverage.strip(25 * S_NS)
        assert 'style="left:25.00%"' in strip
        data = base64.b64decode(strip.split("base64,")[1].split('"')[0])
        colours = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(int)
        assert colours.shape == (1, 100, 3)
        assert (colours[0, :50, 1] > 120).all()
        assert (colours[0, 50:, 2] > 180).all()

    def test_times_are_shown_in_minutes_and_hours(self) -> None:
        assert [clock_words(s) for s in (0.0, 59.96, 61.5, 3661.0)] == ["0:00.0", "1:00.0", "1:01.5", "1:01:01.0"]
