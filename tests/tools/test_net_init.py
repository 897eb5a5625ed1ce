"""`buddyline net init`: where nodes on tripods stand, from a short dive."""

import json
import math
import tomllib

import numpy as np
import pytest
from buddyline.node.config import load_node_config
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import NodeInfo
from buddyline.solver_service.geometry.rotation import quat_to_matrix, rotation_exp, rotation_log
from buddyline.tools.cli import main
from buddyline.tools.net import _check_still


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    """A and c stand still and do not see each other; b moves, and sees both."""
    path = tmp_path_factory.mktemp("init") / "dive.mcap"
    words = ["--nodes", "3", "--fixed", "a", "--fixed", "c", "--seconds", "6", "--imu", "--seed", "8"]
    assert main(["simulate", str(path), *words]) == 0
    with DiveLogReader(path) as reader:
        told = [record.open().message for record in reader.records(lambda key: key.endswith("/info"))]
    return path, {one.node: one.fixed for one in told if isinstance(one, NodeInfo)}


def relative(a, c):
    R = quat_to_matrix(np.array(a["q_xyzw"]))
    return R.T @ (np.array(c["p_m"]) - a["p_m"]), R.T @ quat_to_matrix(np.array(c["q_xyzw"]))


def test_the_places_are_found_through_a_third_node(dive, tmp_path):
    path, true = dive
    assert main(["net", "init", str(path), "--still", "a", "--still", "c", "-o", str(tmp_path / "places")]) == 0
    texts = {node: (tmp_path / "places" / f"{node}.toml").read_text() for node in "ac"}
    found = {node: tomllib.loads(text)["fixed"] for node, text in texts.items()}
    expected = {node: {"p_m": true[node].p_m, "q_xyzw": true[node].q_xyzw} for node in "ac"}
    (t, R), (t_true, R_true) = relative(found["a"], found["c"]), relative(expected["a"], expected["c"])
    assert np.linalg.norm(t - t_true) < max(4 * found["c"]["sigma_m"], 0.02)
    assert np.linalg.norm(rotation_log(R @ R_true.T)) < 0.01
    assert found["a"]["p_m"][:2] == [0.0, 0.0]
    assert found["a"]["p_m"][2] == pytest.approx(true["a"].p_m[2], abs=0.02)
    # The same dive is solved with it: places count from a, and b is where it is in truth.
    solved = tmp_path / "solved.mcap"
    words = [word for node in "ac" for word in ("--place", f"{node}={tmp_path / 'places' / node}.toml")]
    assert main(["solve", str(path), "-o", str(solved), "--track", "filter", "--track-hz", "5", *words]) == 0
    with DiveLogReader(solved) as reader:
        rows = [record.open().message for record in reader.records(lambda key: key.startswith("buddyline/net/main/c"))]
    assert rows
    assert np.linalg.norm(np.array(rows[-1].p_m) - found["c"]["p_m"]) < 0.02
    # The lines are a node's configuration.
    config = tmp_path / "c.toml"
    config.write_text('node = "c"\n' + texts["c"])
    assert load_node_config(config).fixed.net == "main"


@pytest.mark.slow
def test_a_node_that_moves_is_no_fixed_node(dive, capsys):
    assert main(["net", "init", str(dive[0]), "--still", "a", "--still", "b"]) == 2
    assert "node b: does not stand still" in capsys.readouterr().err


def test_a_node_that_is_not_in_the_dive_is_named(dive, capsys):
    assert main(["net", "init", str(dive[0]), "--still", "z", "--json"]) == 2
    assert "no NodeInfo of node z; nodes: a, b, c" in capsys.readouterr().err


def test_one_node_alone_is_the_origin(dive, capsys):
    assert main(["net", "init", str(dive[0]), "--still", "c", "--json"]) == 0
    place = json.loads(capsys.readouterr().out)["c"]
    assert place["p_m"][:2] == [0.0, 0.0]
    assert place["sigma_m"] > 0.0 < place["sigma_rad"]


def test_an_origin_that_swims_is_no_origin(dive, capsys):
    assert main(["net", "init", str(dive[0]), "--still", "b"]) == 2
    assert "node b: does not stand still: its tilt scatters by" in capsys.readouterr().err


def test_seconds_that_show_no_stillness_give_no_origin(tmp_path, capsys):
    path = tmp_path / "short.mcap"
    assert main(["simulate", str(path), "--seconds", "0.5"]) == 0
    assert main(["net", "init", str(path), "--still", "a"]) == 2
    assert "attitudes of node a over 0.5 s only; record half a minute" in capsys.readouterr().err


def test_an_origin_that_turns_on_its_tripod_is_no_origin():
    """By more than a compass's own noise, which a node that stands has, too."""
    rng = np.random.default_rng(3)
    noise_rad, sigma_rad = np.radians(2.0) * rng.normal(size=200), math.radians(4.0)
    up = np.array((0.0, 0.0, 1.0))
    _check_still("a", rotation_exp((1.0 + noise_rad)[:, None] * up), sigma_rad)
    with pytest.raises(BuddylineError, match=r"node a: does not stand still: its heading scatters by 8\.\d deg"):
        _check_still("a", rotation_exp((np.linspace(0.0, 0.5, 200) + noise_rad)[:, None] * up), sigma_rad)


def test_a_node_named_twice_is_said(dive, capsys):
    assert main(["net", "init", str(dive[0]), "--still", "a", "--still", "a"]) == 2
    assert "named twice: a, a" in capsys.readouterr().err


PLACE = "[fixed]\np_m = [0.0, 0.0, 5.0]\nq_xyzw = [0.5, 0.5, 0.5, 0.5]\n"


@pytest.mark.parametrize(
    ("nodes", "text", "says"),
    [
        ("z", PLACE, "no NodeInfo of node z; nodes: a, b, c"),
        ("aa", PLACE, "node a has a place already"),
        ("a", PLACE.replace("0.5, 0.5]", "0.5, 0.9]"), "fixed.q_xyzw"),
        ("a", PLACE + "colour = 1\n", "colour"),
        ("a", "net = 'main'\n", "net"),
        ("a", PLACE + PLACE, "not TOML"),
    ],
)
def test_a_wrong_place_is_named(dive, tmp_path, capsys, nodes, text, says):
    file, out = tmp_path / "place.toml", tmp_path / "out.mcap"
    file.write_text(text)
    words = [word for node in nodes for word in ("--place", f"{node}={file}")]
    assert main(["solve", str(dive[0]), "-o", str(out), *words]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert "place.toml" in said
    assert not out.exists()
