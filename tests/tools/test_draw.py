"""What the tools draw: figures, marked pictures, pages."""

from __future__ import annotations

import json
import sys
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from buddyline.node.choices import DETECTORS
from buddyline.node.detect import make_detector
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.draw import errors, figures
from buddyline.tools.draw.marks import mark_candidates, mark_lights, marked_svg
from buddyline.tools.draw.page import data_block, page, section, table

from tests.node.rendered import lamp_picture
from tests.tools.evaluated import OFFSET_PX, frame
from tests.tools.watched import at, image


class TestMarks:
    @pytest.mark.parametrize("method", DETECTORS)
    @pytest.mark.parametrize("grey", [False, True])
    def test_candidates_are_marked_on_a_copy(self, method: str, grey: bool) -> None:
        picture = lamp_picture([(80.0, 60.0)], size=(160, 120), seed=1)
        picture = picture[:, :, 1].copy() if grey else picture
        before = picture.copy()
        marked = mark_candidates(picture, make_detector(method).detect(picture), truth=[(80.0, 60.0)])
        assert marked.shape == (120, 160, 3)
        assert np.array_equal(picture, before)
        assert np.any(marked[55:66, 75:86] != np.atleast_3d(before)[55:66, 75:86])

    def test_chosen_lights_are_circled_red_left_and_green_right(self) -> None:
        picture = np.zeros((616, 820, 3), np.uint8)
        blobs = frame("a", 0).blobs
        marked = mark_lights(picture, blobs, (0, -1)).astype(int)
        assert marked[round(blobs[0].v_px), round(blobs[0].u_px) + 22, 2] > 200
        assert not marked[:, :, 1].max() > 100
        assert not picture.any()

    def test_the_chosen_pair_is_named_left_and_right(self) -> None:
        root = ET.fromstring(marked_svg(None, frame("a", 0), (1, 0)))
        named = {text.text: float(text.attrib["x"]) for text in root.iter("text")}
        assert named["L"] == pytest.approx(409.5 - OFFSET_PX, abs=30)
        assert named["R"] == pytest.approx(409.5 + OFFSET_PX, abs=30)
        assert len(list(root.iter("circle"))) == 3

    def test_if_one_light_is_chosen_only_that_one_is_named(self) -> None:
        drawn = marked_svg(None, frame("a", 0), (-1, 0))
        assert [text.text for text in ET.fromstring(drawn).iter("text")] == ["R"]

    def test_a_picture_of_an_unknown_kind_is_not_passed_on(self) -> None:
        drawn = marked_svg(image("a", at(0), 'svg+xml;"><script>'), frame("a", 0))
        assert "script" not in drawn
        assert "<image" not in drawn


class TestFigures:
    def test_panels_of_trajectories_can_be_read_however_far_aside_a_diver_is(self) -> None:
        from buddyline.tools.draw.errors import trajectories

        pytest.importorskip("matplotlib")
        forward_m = np.linspace(1.5, 9.0, 40)
        near_m = np.stack([np.sin(forward_m), 0.5 * np.cos(forward_m), forward_m], axis=1)
        aside_m, far_m = near_m.copy(), 20.0 * near_m
        aside_m[-3:, 0] = -6.4, 4.0, 3.0
        figure = trajectories({"near": (near_m, []), "aside": (aside_m, []), "far": (far_m, [])})
        figure.draw_without_rendering()
        (legend,) = figure.legends
        for axis in figure.axes:
            assert not legend.get_window_extent().overlaps(axis.get_window_extent())
            for labels in (axis.get_xticklabels(), axis.get_yticklabels()):
                boxes = [label.get_window_extent() for label in labels if label.get_text()]
                assert len(boxes) > 1
                assert not any(one.overlaps(other) for one, other in pairwise(boxes))
            across_m, along_m = (abs(high - low) for low, high in (axis.get_ylim(), axis.get_xlim()))
            assert across_m < 1.6 * along_m
        # All that lies aside is in the panel, and the way forward fills most of it.
        low_m, high_m = figure.axes[2].get_xlim()
        assert high_m - low_m < 14.0

    def test_an_inline_figure_contains_its_text_and_makes_no_request(self) -> None:
        figure, (axis,) = figures.new_figure(4.0, 3.0)
        axis.plot(*figures.broken(np.array([0.0, 1.0, 9.0]), np.array([1.0, 2.0, 3.0])))
        axis.set_title("<range> & $cost$", parse_math=False)
        drawn = figures.inline_svg(figure, 'a "figure"')
        assert "http" not in drawn
        assert 'aria-label="a &quot;figure&quot;"' in drawn
        assert "&lt;range&gt; &amp; $cost$" in drawn

    def test_the_same_data_give_the_same_file(self) -> None:
        drawn = set()
        for _ in range(2):
            figure, (axis,) = figures.new_figure(4.0, 3.0)
            axis.plot([0.0, 1.0], [0.0, 1.0], "o-")
            drawn.add((figures.svg(figure), figures.pdf([figure])))
        assert len(drawn) == 1

    def test_a_gap_in_time_breaks_the_line(self) -> None:
        t_s, values = figures.broken(np.array([0.0, 0.5, 3.0]), np.array([1.0, 2.0, 3.0]))
        np.testing.assert_array_equal(np.isnan(values), [False, False, True, False])
        np.testing.assert_array_equal(np.isnan(t_s), np.isnan(values))

    def test_without_matplotlib_the_error_says_what_to_install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        with pytest.raises(BuddylineError, match="make install EXTRAS=plots"):
            figures.new_figure(1.0, 1.0)

    def test_a_figure_that_cannot_be_written_is_named(self, tmp_path: Path) -> None:
        figure, _ = figures.new_figure(1.0, 1.0)
        with pytest.raises(BuddylineError, match="cannot be written"):
            figures.save(figure, tmp_path / "none" / "f.png")


class TestPage:
    def test_text_on_a_page_cannot_become_markup(self) -> None:
        assert "<b>" not in table([["<b>", "<b>\n<b>"]], ("<b>",)) + section("<b>", "x") + page("<b>")

    def test_a_section_without_content_has_no_heading(self) -> None:
        assert section("Pictures", "", "") == ""

    def test_alarms_are_marked(self) -> None:
        assert table([["a"], ["b"]], alarms=[1]).count('class="alarm"') == 1


def test_medians_are_drawn_beside_the_bounds_median_not_its_rms():
    bound = [{"from_m": 2.0, "to_m": 4.0, "bound_median_m": 0.01, "bound_rms_m": 0.03}]
    rows = [{"from_m": 2.0, "to_m": 4.0, "position_median_m": 0.02, "position_rmse_m": 0.5}]
    (axis,) = errors.medians_over_range({"ours": rows, "none": []}, bound).axes
    drawn = {line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in axis.lines}
    assert drawn["Cramér-Rao bound, median"] == ([3.0], [0.01])
    assert drawn["ours"] == ([3.0], [0.02])
    assert "none" not in drawn
    assert "median" in axis.get_ylabel()


def test_a_far_value_does_not_stretch_an_axis():
    values = np.linspace(2.0, 3.0, 101)
    assert figures.inner_limits(values) is None
    assert figures.inner_limits(np.array([2.0, 50.0])) is None
    low, high = figures.inner_limits(np.append(values, 50.0))
    assert 1.4 < low < 2.0
    assert 3.0 < high < 3.6


def test_data_in_a_page_cannot_change_where_its_script_ends():
    title = "<!--<script>alert(1)</script> \u2028"
    block = data_block("numbers", {"title": title})
    inside = block.removeprefix('<script type="application/json" id="numbers">').removesuffix("</script>")
    assert "<" not in inside
    assert json.loads(inside) == {"title": title}
