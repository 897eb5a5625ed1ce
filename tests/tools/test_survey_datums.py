"""Datum points by tapes and depths alone: a free network, as good as its distances."""

import argparse
import csv
import io
import itertools
import re

import numpy as np
import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey import command, tables
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.old.joining import joined
from buddyline.tools.survey.old.readers import read_old
from buddyline.tools.survey.project import AdjustSettings, Project
from buddyline.tools.survey.sheet import Sheet

from tests.processes import REPOSITORY

TAPE_M, DEPTH_M = 0.015, 0.02
SEEDS = range(12)
HEAD = "from,to,distance_m,sigma_m,depth_from_m,depth_to_m,depth_sigma_m"
PAIRS = list(itertools.combinations(range(6), 2))


def site(seed):
    """Six places (6, 3), down positive, depths as read (6,), and all distances as read, by pair."""
    rng = np.random.default_rng(seed)
    around = np.arange(6) * np.pi / 3 + rng.uniform(-0.3, 0.3, 6)
    places = np.column_stack([9 * np.cos(around), 7 * np.sin(around), rng.uniform(18, 20, 6)])
    depths = places[:, 2] + DEPTH_M * rng.normal(size=6)
    return places, depths, {(i, j): np.linalg.norm(places[i] - places[j]) + TAPE_M * rng.normal() for i, j in PAIRS}


def adjusted_of(folder, depths, tapes):
    rows = [f"{i},{j},{d:.5f},{TAPE_M},{depths[i]:.5f},{depths[j]:.5f},{DEPTH_M}" for (i, j), d in tapes.items()]
    (folder / "d.csv").write_text("\n".join([HEAD, *rows]))
    return adjust(joined(Project(adjust=AdjustSettings(datum="free")), [read_old(folder / "d.csv")]))


def laid_over(found, truth):
    """Errors (n, 2) on the map, and the turn (2, 2) that lays what was found, mirrored if need be, over the truth."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    return a @ (u @ vt) - b, u @ vt


def optimum(places, depths, tapes):
    """The distances' own optimum on the map, by an independent least squares from the true places."""
    optimize = pytest.importorskip("scipy.optimize")
    rises = depths[:, None] - depths[None, :]

    def off(x):
        at = x.reshape(6, 2)
        return [np.hypot(np.linalg.norm(at[i] - at[j]), rises[i, j]) - d for (i, j), d in tapes.items()]

    return optimize.least_squares(off, places[:, :2].ravel()).x.reshape(6, 2)


def test_six_datums_with_all_pairs_are_as_good_as_their_distances(tmp_path):
    ours, best, factors, chi2 = [], [], [], []
    for seed in SEEDS:
        places, depths, tapes = site(seed)
        adjusted = adjusted_of(tmp_path, depths, tapes)
        at = [adjusted.positions[str(i)] for i in range(6)]
        errors, turn = laid_over(np.array([one.position_m[:2] for one in at]), places[:, :2])
        ours.append(np.mean(errors**2))
        best.append(np.mean(laid_over(optimum(places, depths, tapes), places[:, :2])[0] ** 2))
        factors.append(adjusted.fit.factor)
        assert adjusted.fit.freedom == 15 - (12 - 3)
        assert not adjusted.blunders
        for one, error in zip(at, errors, strict=True):
            chi2.append(error @ np.linalg.solve(turn.T @ one.covariance[:2, :2] @ turn, error))
    assert max(np.sqrt(np.array(ours) / best)) < 1.1
    # Of 12 x 6 degrees of freedom the factor has sd 0.17; of chi^2 with 2 the mean is 2, of 72 dependent ones sd 0.3.
    assert 0.5 < np.mean(factors) < 1.5
    assert 1.2 < np.mean(chi2) < 3.0


def test_a_misread_tape_is_named_and_stands_out_in_the_residuals(tmp_path):
    _, depths, tapes = site(3)
    tapes[1, 4] += 0.5
    adjusted = adjusted_of(tmp_path, depths, tapes)
    assert adjusted.blunders[0].cause == "leg 1-4: distance"
    rows = list(csv.DictReader(io.StringIO(tables.residuals_csv(Sheet(Project(), adjusted)))))
    of_tapes = [row for row in rows if row["observation"] == "distance"]
    assert len(of_tapes) == 15
    assert {row["unit"] for row in rows if row["leg"]} == {"m"}
    assert max(of_tapes, key=lambda row: abs(float(row["w"])))["leg"] == "1-4"
    assert sum(float(row["redundancy"]) for row in rows) == pytest.approx(adjusted.fit.freedom, abs=0.01)


@pytest.mark.parametrize("seed", range(6))
def test_a_tape_misread_by_a_metre_is_named_first(tmp_path, seed):
    _, depths, tapes = site(seed)
    i, j = PAIRS[seed * 5 % 15]
    tapes[i, j] += 1.0
    blunders = adjusted_of(tmp_path, depths, tapes).blunders
    assert [one.cause for one in blunders] == [f"leg {i}-{j}: distance"]
    assert blunders[0].off == pytest.approx(1.0, abs=0.15)


def test_a_free_network_has_no_datum_point_that_is_exact(tmp_path):
    _, depths, tapes = site(1)
    adjusted = adjusted_of(tmp_path, depths, tapes)
    sizes = [one.ellipse[0] for one in adjusted.positions.values()]
    assert min(sizes) > 0.4 * max(sizes)


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("1,2,1.0,0.01,3,5,0.02", "d.csv:2: distance: 1 m is less than the difference of depth"),
        ("1,2,9.0,0.01,,5,0.02", "d.csv:2: '1,2,9.0,0.01,,5,0.02': no azimuth"),
        ("1,2,9.0,0,3,5,0.02", "a standard deviation is above zero"),
    ],
)
def test_bad_tapes_are_refused(tmp_path, row, said):
    (tmp_path / "d.csv").write_text(f"{HEAD}\n{row}\n")
    with pytest.raises(BuddylineError) as refused:
        read_old(tmp_path / "d.csv")
    assert said in str(refused.value)


def test_a_plumbed_tape_may_be_a_little_shorter_than_its_depths_differ(tmp_path):
    """Two points are one above the other: their gauges err by more than the tape is longer."""
    places, depths, _ = site(2)
    places[1] = places[0] + (0.02, 0.0, 4.0)
    depths[1] = depths[0] + 4.03
    tapes = {(i, j): float(np.linalg.norm(places[i] - places[j])) for i, j in PAIRS}
    adjusted = adjusted_of(tmp_path, depths, tapes)
    assert not adjusted.left_out
    assert not adjusted.blunders
    found = np.array([adjusted.positions[str(i)].position_m for i in range(6)])
    assert np.linalg.norm(found[1] - found[0]) == pytest.approx(4.0, abs=0.03)


def test_the_example_site_is_adjusted(capsys):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    args = parser.parse_args(["adjust", str(REPOSITORY / "examples" / "datums" / "site.toml")])
    assert command.run(args) == 0
    assert "15 legs" in (said := capsys.readouterr().out)
    assert "declination: no bearing was read" in said
    assert re.search(r"adjustment: 6 observations more than needed; all agree .*\(chi2 .*, variance factor .*\)", said)
