"""The plan: the bound against its known values and against dives, where tolerances end, and what is refused."""

import json
import math

import numpy as np
import pytest
from buddyline.node.detect import make_detector
from buddyline.node.sim.scenario import WATERS, Scenario
from buddyline.node.sim.world import World
from buddyline.tools import plan
from buddyline.tools.bound import pose_bounds
from buddyline.tools.cli import main
from buddyline.tools.evaluation.logs import load
from buddyline.tools.evaluation.result import evaluate
from buddyline.tools.plan import described, expected, light_reach_m, with_baseline

FACING = np.array([[0.0, 1.0, 0.0, 0.0]])


def test_the_bound_matches_the_geometrys_description():
    info = with_baseline(described(None), 0.88)
    camera = info.camera
    sigma_px = 0.5 * camera.fx_px / 1800.0
    for range_m, bound_m in ((2.0, 0.0014), (4.0, 0.005), (10.0, 0.031), (20.0, 0.125)):
        (covariance,) = pose_bounds(np.array([[0.0, 0.0, range_m]]), FACING, info, info, sigma_px)
        assert math.sqrt(np.trace(covariance[:3, :3])) == pytest.approx(bound_m, rel=0.12)


def test_errors_of_simulated_dives_match_the_plan(tmp_path, capsys):
    info = with_baseline(described(None), 0.88)
    dive, out = str(tmp_path / "d.mcap"), str(tmp_path / "p.mcap")
    words = ["--seconds", "22", "--rate", "3", "--seed", "901", "--undisturbed", "--lost", "0", "--gross", "0"]
    words += ["--misses", "0", "--false", "0", "--others", "0", "--range-min", "2", "--range-max", "7"]
    assert main(["simulate", dive, *words]) == 0
    assert main(["solve", dive, "-o", out]) == 0
    capsys.readouterr()
    errors = evaluate(load([out])).errors
    assert len(errors) > 40
    planned = expected(info, 0.7, np.array(plan.RANGES_M))
    for measured, column in ((errors.range_m, 0), (errors.translation_m, 1)):
        model = np.interp(errors.true_range_m, plan.RANGES_M, planned[:, column])
        assert 0.8 < np.sqrt(np.mean((measured / model) ** 2)) < 1.25


def test_wider_lights_measure_farther_and_visibility_ends_it(capsys):
    assert main(["plan", "--visibility", "3", "--json"]) == 0
    murky = json.loads(capsys.readouterr().out)
    ends_m = [spacing["ends_m"]["position"] for spacing in murky["by_baseline"]]
    assert ends_m == sorted(ends_m)
    # sd(l) grows with the square of the range over the spacing: four times the lights, twice as far.
    assert ends_m[-1] / ends_m[0] == pytest.approx(2.0, rel=0.1)
    assert murky["limit"] == "reach"
    assert murky["far_m"] == murky["reach_m"] == pytest.approx(light_reach_m(3.0))
    assert [row["within"] for row in murky["rows"]] == [
        1.0 < row["range_m"] <= murky["reach_m"] for row in murky["rows"]
    ]
    assert main(["plan", "--visibility", "60", "--json"]) == 0
    clear = json.loads(capsys.readouterr().out)
    assert clear["limit"] in ("position", "range")
    assert clear["reach_m"] > clear["far_m"] > 5.0


def test_the_table_names_what_limits_the_range(capsys):
    assert main(["plan", "--visibility", "3"]) == 0
    text = capsys.readouterr().out
    assert "where a diver sees 3 m far, the lights reach 7.5 m; geometry would do up to" in text
    assert "too faint" in text


def test_the_camera_may_come_from_a_configuration_of_a_node(capsys):
    assert main(["plan", "--camera", "node/examples/pi.toml", "--json"]) == 0
    sharp = json.loads(capsys.readouterr().out)
    assert main(["plan", "--json"]) == 0
    coarse = json.loads(capsys.readouterr().out)
    # Twice the focal length in pixels, half the error.
    ratio = coarse["rows"][4]["position_error_m"] / sharp["rows"][4]["position_error_m"]
    assert ratio == pytest.approx(2.0, rel=0.02)


def test_the_plot_is_written_once(tmp_path, capsys):
    path = tmp_path / "plan.png"
    assert main(["plan", "--plot", str(path)]) == 0
    assert path.read_bytes().startswith(b"\x89PNG")
    assert main(["plan", "--plot", str(path)]) == 2
    assert "exists" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--baseline", "0"], "--baseline"),
        (["--baseline", "1e-9"], "--baseline 1e-09: give 0.01 m at least"),
        (["--visibility", "-1"], "--visibility"),
        (["--camera", "no.toml"], "no.toml"),
    ],
)
def test_bad_values_give_a_one_line_error(words, named, capsys):
    assert main(["plan", *words]) == 2
    err = capsys.readouterr().err
    assert named in err
    assert err.count("\n") == 1


@pytest.mark.slow
def test_lights_are_found_in_a_rendered_lake_as_far_as_the_plan_says():
    water = WATERS["lake"]
    attenuation_per_m = water.absorption_per_m[1] + water.scattering_per_m[1]
    reach_m = light_reach_m(math.log(50.0) / attenuation_per_m)
    found = []
    for seed in (61, 62):
        near_m, far_m = 0.8 * reach_m, 0.98 * reach_m
        world = World(Scenario("lake", seed, interruptions=False, range_min_m=near_m, range_max_m=far_m, other_lamps=0))
        detector = make_detector()
        for stamp_ns in range(500_000_000, 12_000_000_000, 2_000_000_000):
            detections = detector.detect(world.render("a", stamp_ns))
            for light in world.light_truth("a", stamp_ns, 0).lights:
                away_px = [math.hypot(d.blob.u_px - light.u_px, d.blob.v_px - light.v_px) for d in detections]
                found += [min(away_px, default=1e9) < 8.2] if light.visible else []
    assert len(found) > 8
    assert np.mean(found) > 0.9
