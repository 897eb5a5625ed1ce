"""Stretches without a pose: one definition, whatever the log's times are."""

from __future__ import annotations

from pathlib import Path

import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.tools.dives import Dive
from buddyline.tools.evaluation.stretches import Outcome, stretches
from buddyline.tools.evaluation.triggers import trigger_figures
from buddyline.tools.monitor.report import report_html
from buddyline.tools.monitor.summary import summarize
from hypothesis import given
from hypothesis import strategies as st

from tests.tools.evaluated import INFOS, pose, rejection
from tests.tools.watched import at

LOST = range(40, 63)


def outcome(k: int, reason: str | None = None) -> Outcome:
    return Outcome(at(k), at(k), reason)


def test_a_stretch_reaches_from_pose_to_pose() -> None:
    (found,) = stretches([outcome(k, "depth" if k in LOST else None) for k in range(100)])
    assert (found.begin_ns, found.end_ns, found.reasons) == (at(39), at(63), {"depth": 23})
    assert found.seconds == pytest.approx(2.4)


def test_the_ends_of_the_dive_count_too() -> None:
    first, last = stretches([outcome(k, None if 20 <= k < 80 else "no_info") for k in range(100)])
    assert (first.begin_ns, first.end_ns) == (at(0), at(20))
    assert (last.begin_ns, last.end_ns) == (at(79), at(99))
    (whole,) = stretches([outcome(k, "no_info") for k in range(100)])
    assert whole.seconds == pytest.approx(9.9)


def test_triggers_that_never_came_are_a_stretch_without_reasons() -> None:
    (found,) = stretches([outcome(k) for k in range(100) if k not in LOST])
    assert (found.seconds, found.reasons) == (pytest.approx(2.4), {})
    assert stretches([outcome(k) for k in range(100)]) == []
    assert stretches([]) == stretches([outcome(0)]) == []


@given(st.lists(st.booleans(), min_size=2, max_size=60), st.randoms())
def test_the_order_of_outcomes_does_not_matter_and_no_pose_lies_within(solved: list[bool], rng: object) -> None:
    outcomes = [outcome(k, None if is_solved else "late") for k, is_solved in enumerate(solved)]
    found = stretches(outcomes)
    rng.shuffle(outcomes)  # type: ignore[attr-defined]
    assert stretches(outcomes) == found
    for stretch in found:
        assert not any(stretch.begin_ns < each.stamp_ns < stretch.end_ns for each in outcomes if each.reason is None)
    assert sum(stretch.reasons.total() for stretch in found) == solved.count(False)


def test_report_and_evaluate_give_one_length_though_the_log_s_times_are_others(tmp_path: Path) -> None:
    """A dive that was played ten times as fast, and recorded: 2.4 s without a pose are 0.24 s of receive time."""
    results = [rejection(k) if k in LOST else pose(k) for k in range(100)]
    path = tmp_path / "replayed.mcap"
    with DiveLogWriter(path) as writer:
        for info in INFOS.values():
            writer.write_message(info, at(0))
        for k, result in enumerate(results):
            writer.write_message(result, at(0) + k * S_NS // 100)
    with Dive([path]) as dive:
        summary = summarize(dive, ("a", "b"))
        page = report_html(dive, ("a", "b"))
    (stretch,) = summary.coverage.without()
    figures = trigger_figures(summary.poses, summary.rejected, {})
    assert stretch.seconds == figures.gap_s == pytest.approx(2.4)
    assert "<td>longest time without a pose</td><td>2.4 s</td>" in page.replace("\n", "")
    assert "for 2.4 s: more than one arrangement fits (23)" in page
