"""The solver's benchmarks run and print what they claim to measure."""

import json

import numpy as np
import pytest
from buddyline.tools.bench import accuracy, solve
from buddyline.tools.bench.__main__ import main
from buddyline.tools.bench.triggers import images, simulate


def test_the_times_of_the_solver_come_with_those_of_eq_1(capsys, monkeypatch):
    monkeypatch.setattr(solve, "TRIGGERS", 2)
    monkeypatch.setattr(solve, "EVALUATIONS", 1000)
    assert main(["solve", "--candidates", "2", "3", "--repeats", "1", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert [row["hypotheses"] for row in figures["solver"]] == [4, 36]
    assert all(row["sensors_ms"] > 0 and row["sensors_solved"] == 1.0 for row in figures["solver"])
    assert figures["eq1_numpy_ns"] > 0
    table = solve.table(figures | {"growth_16_to_64": 1.0})
    assert "Eq. 1 alone" in table
    assert "number to the 1.00" in table


def test_errors_are_compared_with_the_bound_and_choices_with_the_range_gap(capsys, monkeypatch):
    monkeypatch.setattr(accuracy, "RANGES_M", (2.0,))
    monkeypatch.setattr(accuracy, "BANDS_M", ((2.0, 4.0),))
    monkeypatch.setattr(accuracy, "FALSE", (2,))
    assert main(["accuracy", "--triggers", "8", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    for row in figures["errors"]:
        assert 0.5 < row["over_bound"]["refined"][0] < 1.6
        assert row["over_bound"]["paper_literal"][0] > row["over_bound"]["refined"][0]
    assert figures["choices"][0]["sensors"] >= 0.8
    assert "RMSE over the bound" in accuracy.table(figures)


def test_simulated_lights_project_to_their_stated_places():
    trigger = simulate(np.random.default_rng(1), (3.0, 3.0), false=3, sigma_px=0.0)
    seen = [view.pixels[list(pair)] for view, pair in zip(trigger.views, (trigger.pair_a, trigger.pair_b), strict=True)]
    np.testing.assert_allclose(np.concatenate(seen), images(trigger.t_a_b_m, trigger.R_a_b))


@pytest.mark.parametrize(
    "argv", [["solve", "--candidates", "1"], ["solve", "--repeats", "0"], ["accuracy", "--triggers", "0"]]
)
def test_bad_arguments_give_a_one_line_error(argv, capsys):
    assert main(argv) == 2
    error = capsys.readouterr().err
    assert error.startswith("bench: ")
    assert error.count("\n") == 1


def test_help_names_the_benchmarks(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "detect" in capsys.readouterr().out
