"""Stored dives: played from any instant, surveyed, and reported on one page."""

from __future__ import annotations

import html.parser
import json
import re
import threading
from pathlib import Path

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Message
from buddyline.tools.dives import Dive
from buddyline.tools.monitor.coverage import Coverage
from buddyline.tools.monitor.playback import LEAD_NS, Playback, cover
from buddyline.tools.monitor.report import report_html
from buddyline.tools.monitor.summary import summarize
from buddyline.tools.pairs import solved_pair
from mcap.reader import make_reader

from tests.tools.evaluated import INFOS, frame, info, pose, rejection, track, truth, write_log
from tests.tools.watched import at, image, tick, watched

TICKS = 600


def dive_messages(ticks: int = TICKS) -> list[Message]:
    messages: list[Message] = list(INFOS.values())
    for k in range(ticks):
        said = tick(k)
        if 200 <= k < 230:
            said = [rejection(k) if message == pose(k) else message for message in said]
        messages += said
    return messages


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_log(tmp_path_factory.mktemp("dive") / "dive.mcap", *dive_messages(), image("a", at(300)))


class TestPlayback:
    def test_playing_on_gives_what_was_known_then(self, dive: str) -> None:
        with Dive([dive]) as opened:
            playback = Playback(opened)
            for k in range(0, 60, 7):
                playback.advance(at(k))
            playback.advance(at(59))
            expected = watched(60)
            assert playback.picture.pose == expected.pose
            assert playback.picture.points == expected.points
            assert playback.picture.nodes["b"].depth == expected.nodes["b"].depth

    def test_a_jump_ends_where_playing_on_would(self, dive: str) -> None:
        with Dive([dive]) as one, Dive([dive]) as other:
            played, jumped = Playback(one), Playback(other)
            played.advance(at(450))
            jumped.seek(at(500))
            jumped.seek(at(450))
            assert jumped.picture.pose == played.picture.pose
            assert jumped.picture.nodes["a"].info == INFOS["a"]
            begin_ns = jumped.picture.points[0].at_ns
            assert at(450) - LEAD_NS <= begin_ns <= at(450) - LEAD_NS + S_NS
            assert list(jumped.picture.points) == [p for p in played.picture.points if p.at_ns >= begin_ns]

    def test_a_jump_past_the_ends_stays_inside(self, dive: str) -> None:
        with Dive([dive]) as opened:
            playback = Playback(opened)
            playback.seek(0)
            assert playback.position_ns == playback.start_ns
            playback.seek(2**62)
            assert playback.position_ns == playback.end_ns == at(TICKS - 1)

    def test_a_log_without_messages_is_refused(self, tmp_path: Path) -> None:
        with DiveLogWriter(tmp_path / "empty.mcap"):
            pass
        with Dive([tmp_path / "empty.mcap"]) as opened, pytest.raises(BuddylineError, match="no message"):
            Playback(opened)

    def test_the_survey_finds_the_stretch_without_poses(self, dive: str) -> None:
        coverage = Coverage(at(0), at(TICKS - 1))
        assert not coverage.complete
        cover(coverage, [dive], ("a", "b"), threading.Event())
        assert coverage.complete
        (stretch,) = coverage.without()
        assert stretch.reasons == {"ambiguous": 30}
        assert (stretch.begin_ns, stretch.end_ns) == (at(199), at(230))


class TestReadingFromATime:
    def test_earlier_chunks_and_other_topics_are_not_read(self, tmp_path: Path) -> None:
        path = tmp_path / "d.mcap"
        with DiveLogWriter(path) as writer:
            writer.write_message(INFOS["a"], at(0))
            writer.flush()
            for k in range(100):
                writer.write_message(pose(k), at(k))
                if k % 10 == 9:
                    writer.flush()
        with open(path, "r+b") as file:
            summary = make_reader(file).get_summary()
            assert summary is not None
            file.seek(summary.chunk_indexes[4].chunk_start_offset + 100)
            file.write(bytes(16))
        # The reader of the broken chunk reports it.
        for wanted, since_ns, expected, damaged in (
            (None, None, 91, True),
            (lambda key: key.endswith("/info"), None, 1, False),
            (None, at(85), 15, False),
        ):
            with DiveLogReader(path) as reader:
                assert len(list(reader.records(wanted, since_ns))) == expected
                assert bool(reader.damage) == damaged


class TestReport:
    def test_the_page_is_complete_and_makes_no_request(self, dive: str) -> None:
        with Dive([dive]) as opened:
            page = report_html(opened, solved_pair(opened, None))
        outside = _Addresses()
        outside.feed(page)
        assert [address for address in outside.found if not address.startswith(("data:", "#"))] == []
        assert "default-src 'none'" in page
        assert not re.search(r"https?://", page)
        for text in (
            "570 (95%)",
            "the log holds no track of this pair",
            "for 3.1 s: more than one arrangement fits (30)",
            "light spacing",
            "3.00 to 3.00 m",
        ):
            assert text in page

    def test_the_replay_has_the_poses(self, dive: str) -> None:
        with Dive([dive]) as opened:
            page = report_html(opened, solved_pair(opened, None))
        frames = json.loads(re.search(r"FRAMES=(\[.*?\]);\n", page).group(1))  # type: ignore[union-attr]
        times = np.array([keyframe[0] for keyframe in frames])
        np.testing.assert_allclose(frames[0][1], (3.0, 0.0, 0.0), atol=1e-4)
        assert times[-1] == pytest.approx((TICKS - 2) / 10, abs=0.2)
        assert [keyframe[4] for keyframe in frames].count(False) == 2

    def test_the_track_is_reported_beside_the_poses(self, tmp_path: Path) -> None:
        messages: list[Message] = [*INFOS.values(), pose(0), pose(99), *map(truth, range(100))]
        # Without a light from 3 s to 5 s; the track is too uncertain to count from 4 s on.
        for k in range(100):
            age_s, sigma_m = (k - 30) / 10 if 30 <= k < 50 else 0.0, 0.3 if 40 <= k < 50 else 0.01
            messages.append(track(k, (0.0, 0.0, 3.01), sigma_m, age_s=age_s))
        with Dive([write_log(tmp_path / "t.mcap", *messages)]) as opened:
            summary = summarize(opened, ("a", "b"))
            page = report_html(opened, ("a", "b"))
        assert summary.dark_s == pytest.approx(2.0, abs=0.11)
        assert summary.covered() == pytest.approx(0.9, abs=0.03)
        assert summary.track_coverage is not None
        (stretch,) = summary.track_coverage.without()
        assert (stretch.begin_ns - at(40), stretch.end_ns - at(50)) == (pytest.approx(0, abs=3e8),) * 2
        (figures,) = summary.track_figures()
        assert (figures.wrong, figures.samples) == (0, 50)
        for text in (
            "longest time without a light",
            "position of the track",
            "Line: the track",
            '"what": "track"',
        ):
            assert text in page
        frames = json.loads(re.search(r"FRAMES=(\[.*?\]);\n", page).group(1))  # type: ignore[union-attr]
        assert len(frames) == 50

    def test_another_pair_s_track_is_not_drawn(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "t.mcap", *INFOS.values(), pose(0), track(0, (0.0, 0.0, 9.0), node_b="c"))
        with Dive([path]) as opened:
            assert summarize(opened, ("a", "b")).tracks == []

    def test_figures_against_truth(self, tmp_path: Path) -> None:
        messages = [*INFOS.values(), *(pose(k, (0.0, 0.0, 3.02)) for k in range(5)), *(truth(k) for k in range(5))]
        with Dive([write_log(tmp_path / "t.mcap", *messages)]) as opened:
            errors = summarize(opened, ("a", "b")).errors()
        np.testing.assert_allclose([errors.translation_m, errors.range_m], [[0.02] * 5] * 2, atol=1e-9)

    def test_pictures_are_shown_with_their_outcomes(self, dive: str) -> None:
        with Dive([dive]) as opened:
            shots = summarize(opened, ("a", "b")).shots
        assert list(shots) == ["a"]
        assert shots["a"].words.startswith("Pose at 3.00 m")

    def test_the_chosen_pair_is_reported_and_the_others_are_named(self, tmp_path: Path) -> None:
        others = [pose(k, (0.0, 0.0, 7.0), node_b="c") for k in range(9)]
        path = write_log(tmp_path / "three.mcap", *INFOS.values(), info("c"), *map(pose, range(5)), *others)
        with Dive([path]) as opened:
            first = report_html(opened, solved_pair(opened, None))
            chosen = report_html(opened, solved_pair(opened, ("c", "a")))
            with pytest.raises(BuddylineError, match="nothing of pair b/c; pairs: a/b, a/c"):
                solved_pair(opened, ("b", "c"))
        assert "3.00 to 3.00 m" in first
        assert "poses of other pairs are not reported: a and c" in first
        assert "7.00 to 7.00 m" in chosen
        assert "poses of other pairs are not reported: a and b" in chosen

    def test_a_log_without_poses_is_reported_and_says_so(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "raw.mcap", *INFOS.values(), *(frame("a", k) for k in range(20)))
        with Dive([path]) as opened:
            page = report_html(opened, solved_pair(opened, None))
        assert "this log holds no pose; solve it first" in page

    def test_names_in_a_log_cannot_become_markup(self, tmp_path: Path) -> None:
        bad = info("a", software="</script><img src=http://x>")
        with Dive([write_log(tmp_path / "x.mcap", bad, pose(0))]) as opened:
            page = report_html(opened, solved_pair(opened, None))
        assert "<img src=http" not in page


class _Addresses(html.parser.HTMLParser):
    """Collects what a page would load."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "action")]
