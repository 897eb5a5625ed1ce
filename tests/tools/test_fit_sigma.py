"""The fit of sigma: what it finds, what it writes, and that the sigma it ships tells the truth."""

import io
import tomllib

import numpy as np
import pytest
from buddyline.node.detect.sigma import NAMES, SIZES, Doubt, fitted
from buddyline.tools.cli import main
from buddyline.tools.progress import Progress
from buddyline.tools.tune import scenes, sigma
from buddyline.tools.tune.sigma import Errors, truth_of, variance_px2

TRUE = {"model": 0.6, "halo": 1.5, "lean": 0.8, "focal": 0.4, "growth": 1.8, "floor_px": 0.02, "long_px": 0.8}


def errors_of(sizes, seed, count=2_000):
    rng = np.random.default_rng(seed)
    doubt = Doubt(
        np.exp(rng.normal(-7.0, 1.5, count)),
        np.exp(rng.normal(-8.0, 2.0, count)),
        rng.uniform(1.0, 1.6, count),
        rng.exponential(0.5, count),
        rng.choice([1.0, 2.0], count),
        rng.choice([1.0, 1.1, 1.3, 1.5], count),
    )
    # Student's t, with the variance that the sizes give.
    tails = sigma.TAILS
    spread = variance_px2(doubt, sizes) * (tails - 2.0) / tails / (rng.chisquare(tails, count) / tails)
    return Errors("lake", doubt, (rng.normal(size=(count, 2)) ** 2).sum(axis=1) * spread)


def test_the_fit_finds_the_sizes_that_made_the_errors():
    errors = [errors_of(TRUE, 1), errors_of(TRUE, 2)]
    found = sigma.fit(errors)
    assert found == pytest.approx(TRUE, rel=0.35, abs=0.02)
    nees, beyond = truth_of([errors_of(TRUE, 3, 20_000)], found)
    assert nees == pytest.approx(1.0, abs=0.1)
    assert beyond < 0.02
    assert truth_of(errors, found | {"model": 0.3, "growth": 0.9})[0] > 2.0


def test_each_lamp_counts_once_with_its_nearest_place():
    for view in scenes.views("cavern", 1000):
        lamps = [lamp[:2] for lamp in view.world.lamps(view.node, view.stamp_ns) if lamp[2]]
        found = sigma.located(view.detector, view.picture, 900.0, np.array(lamps).reshape(-1, 2), "cavern")
        assert sum(len(one.square_px2) for one in found) <= len(lamps)


@pytest.mark.slow
@pytest.mark.parametrize(("sizes", "far"), [(scenes.SIZES, scenes.FAR), (((320, 240),), (1.3, 2.0))])
def test_the_shipped_sigma_is_true_in_fresh_waters(monkeypatch, sizes, far):
    """Also of far lamps in pictures smaller than those that it is fitted to."""
    monkeypatch.setattr(scenes, "SIZES", sizes)
    monkeypatch.setattr(scenes, "FAR", far)
    errors = list(sigma.simulated(range(3001, 3007), Progress("test", 1, io.StringIO())))
    nees, beyond = truth_of(errors, fitted())
    assert 0.7 < nees < 1.4
    assert beyond < 0.05
    for water in {one.source for one in errors}:
        nees, beyond = truth_of([one for one in errors if one.source == water], fitted())
        assert 0.5 < nees < 2.0
        assert beyond < 0.08


def test_the_command_writes_sizes_with_their_provenance(monkeypatch, capsys):
    monkeypatch.setattr(scenes, "SEEDS", range(1, 2))
    monkeypatch.setattr(scenes, "HELD_OUT", range(2, 3))
    monkeypatch.setattr(scenes, "VIEWS", 2)
    monkeypatch.setattr(scenes, "SIZES", ((410, 308),))
    assert main(["tune", "--fit-sigma"]) == 0
    said = tomllib.loads(capsys.readouterr().out)
    assert list(said["sizes"]) == list(NAMES)
    assert sum(said["provenance"]["lights"].values()) > 0
    assert set(said["nees"]) == set(said["beyond"])
    assert said["nees"]


def test_the_shipped_sizes_say_where_they_come_from():
    shipped = tomllib.loads(SIZES.read_text())
    assert list(shipped["sizes"]) == list(NAMES)
    assert sum(shipped["provenance"]["lights"].values()) > 1500
