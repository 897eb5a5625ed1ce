"""`buddyline simulate`: dive logs with truth."""

import pytest
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.messages import Candidates, CompressedImage, LightTruth, NodeInfo, NodePose, Truth
from buddyline.tools.cli import main
from msgspec import UNSET


def _simulated(path, *words):
    assert main(["simulate", str(path), "--seconds", "1.5", *words]) == 0
    with DiveLogReader(path) as reader:
        return reader.metadata(), [record.open().message for record in reader.records()]


def test_a_dive_is_written_with_its_truth_and_says_how_it_was_made(tmp_path, capsys):
    metadata, found = _simulated(tmp_path / "d.mcap", "--environment", "basin", "--baseline", "0.6", "--false", "9")
    out, err = capsys.readouterr()
    assert out == ""
    assert "d.mcap" in err
    kinds = [type(message) for message in found]
    assert kinds.count(NodeInfo) == 2
    assert kinds.count(Truth) == 14
    assert 20 <= kinds.count(Candidates) <= 28
    assert min(len(m.blobs) for m in found if isinstance(m, Candidates)) >= 9
    assert (metadata["environment"], metadata["baseline_a_m"], metadata["rate_hz"]) == ("basin", "0.6", "10.0")


def test_the_same_arguments_give_the_same_file_and_another_seed_another(tmp_path):
    files = []
    for name, seed in (("one", "5"), ("two", "5"), ("three", "6")):
        _simulated(tmp_path / name, "--seed", seed)
        files.append((tmp_path / name).read_bytes())
    assert files[0] == files[1] != files[2]


def test_four_nodes_one_of_them_fixed(tmp_path):
    _, found = _simulated(tmp_path / "d.mcap", "--nodes", "4", "--fixed", "c")
    infos = {message.node: message for message in found if isinstance(message, NodeInfo)}
    assert sorted(infos) == ["a", "b", "c", "d"]
    assert [node for node, info in infos.items() if info.fixed is not UNSET] == ["c"]
    assert sum(isinstance(message, Truth) for message in found) == 14 * 6
    truths = {node: [m for m in found if isinstance(m, NodePose) and m.node == node] for node in infos}
    assert len({(m.p_m, m.q_xyzw) for m in truths["c"]}) == 1
    # The survey of its place has errors, as its sigmas say.
    place = infos["c"].fixed
    assert truths["c"][0].p_m == pytest.approx(place.p_m, abs=5.0 * place.sigma_m)
    assert truths["c"][0].q_xyzw == pytest.approx(place.q_xyzw, abs=5.0 * place.sigma_rad)
    assert all(len({m.p_m for m in truths[node]}) == 14 and not truths[node][0].fixed for node in "abd")
    lights = [light for m in found if isinstance(m, LightTruth) and m.node == "a" for light in m.lights]
    assert {light.node for light in lights if light.visible} == {"b", "d"}


def test_pictures_are_as_wide_as_asked_for(tmp_path):
    _, found = _simulated(tmp_path / "d.mcap", "--images", "--width", "200", "--rate", "4")
    infos = [message for message in found if isinstance(message, NodeInfo)]
    assert {(info.width_px, info.height_px) for info in infos} == {(200, 150)}
    assert any(isinstance(message, CompressedImage) for message in found)
    assert not any(isinstance(message, Candidates) for message in found)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--range-min", "9", "--range-max", "3"], "range_max_m"),
        (["--seconds", "0"], "seconds"),
        (["--nodes", "1"], "--nodes 1"),
        (["--nodes", "3", "--fixed", "d"], "fixed_nodes: 'd'"),
        (["--rate", "0"], "rate_hz"),
        (["--baseline", "-1"], "baseline"),
        (["--width", "1"], "width_px"),
        (["--decoy", "walls"], "--decoy: changes pictures only; add --images"),
        (["--exposure", "auto"], "--exposure: changes pictures only"),
        (["--tags"], "--tags: changes pictures only"),
        (["--pwm-hz", "200"], "--pwm-hz: changes pictures only"),
        (["--images", "--misses", "0.5"], "--misses: changes synthetic candidates only"),
        (["--images", "--false", "0"], "--false: changes synthetic candidates only"),
        (["--inertial", "poor"], "--inertial poor: changes inertial samples only; add --imu"),
    ],
)
def test_bad_arguments_give_a_one_line_error_and_no_file(words, named, tmp_path, capsys):
    path = tmp_path / "d.mcap"
    assert main(["simulate", str(path), *words]) == 2
    err = capsys.readouterr().err
    assert named in err
    assert err.count("\n") == 1
    assert not path.exists()


def test_a_log_is_never_overwritten(tmp_path, capsys):
    path = tmp_path / "d.mcap"
    path.write_bytes(b"precious")
    assert main(["simulate", str(path), "--seconds", "1"]) == 2
    assert "exists" in capsys.readouterr().err
    assert path.read_bytes() == b"precious"
