"""The harness: times by turns, what a process takes, tables."""

import itertools
import json
import os

import numpy as np
import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.measure.load import load_of
from buddyline.tools.measure.tables import cells_of, markdown_table, number, percent, text_table, write
from buddyline.tools.measure.turns import by_turns, fastest_s


def test_works_run_by_turns_after_a_warm_up_round():
    done, ticks = [], itertools.count()
    works = {"a": lambda: done.append("a"), "b": lambda: (done.append("b"), next(ticks))}
    times = by_turns(works, 2, clock_s=lambda: float(next(ticks)))
    assert done == ["a", "b"] * 3
    np.testing.assert_array_equal(times["a"], [1.0, 1.0])
    np.testing.assert_array_equal(times["b"], [2.0, 2.0])


def test_the_fastest_of_several_counts():
    clock = iter([0.0, 5.0, 10.0, 11.0, 20.0, 23.0])
    assert fastest_s(lambda: None, 3, lambda: next(clock)) == 1.0


def test_the_load_of_a_process_is_measured():
    before = load_of()
    with open(os.devnull):
        assert load_of().files == before.files + 1
    assert before.rss_mib > 1
    assert before.cpu_s > 0
    with pytest.raises(BuddylineError, match="cannot be measured"):
        load_of(2**22 + 1)


def test_tables_have_aligned_columns(capsys):
    rows = cells_of(
        [{"name": "a", "ms": {"x": 1.25}}, {"name": "longer", "ms": {"x": 10.0}}], {"": "{name}", "ms": "{ms[x]:.1f}"}
    )
    assert text_table(rows).splitlines() == ["          ms", "a        1.2", "longer  10.0"]
    assert markdown_table(("a", "b"), [(1, "x")]) == "| a | b |\n| --- | --- |\n| 1 | x |\n"
    assert (number(None), number(1.0, 1), percent(None), percent(0.125)) == ("-", "1.0", "-", "12.5 %")
    write({"a": 1}, str, as_json=True)
    assert json.loads(capsys.readouterr().out) == {"a": 1}
    write({"a": 1}, lambda _: "text\n", as_json=False)
    assert capsys.readouterr().out == "text\n"
