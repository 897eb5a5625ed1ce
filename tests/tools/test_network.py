"""`evaluate` and `export` of a net: all nodes in one frame."""

import csv
import io
import json

import numpy as np
import pytest
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.messages import CameraModel, NodeInfo, NodePose
from buddyline.tools.cli import main
from msgspec.structs import replace

from tests.disks import small_disk
from tests.tools import evaluated

START_NS = 1_764_000_000_000_000_000
STEP_NS = 100_000_000
CAMERA = CameraModel(model="pinhole", fx_px=900.0, fy_px=900.0, cx_px=409.5, cy_px=307.5, distortion=[0.0] * 5)
# The camera looks north: its x is east, its y down.
NORTH = (0.5, 0.5, 0.5, 0.5)


def pose(node, k, p_m, mode="filter", sigma_m=0.02, fixed=False):
    covariance = np.diag([sigma_m**2] * 3 + [1e-6 if sigma_m else 0.0] * 3).ravel().tolist()
    return NodePose(
        net="main",
        node=node,
        stamp_ns=START_NS + k * STEP_NS,
        p_m=p_m,
        q_xyzw=NORTH,
        v_mps=(0.1, 0.0, 0.0),
        covariance=covariance,
        fixed=fixed,
        mode=mode,
        age_s=0.0,
    )


def info(node):
    return NodeInfo(
        node=node,
        stamp_ns=START_NS,
        width_px=820,
        height_px=616,
        camera=CAMERA,
        light_left_m=(-0.4, 0.0, 0.0),
        light_right_m=(0.4, 0.0, 0.0),
        sigma_px=0.7,
        trigger_period_ns=STEP_NS,
    )


def write(path, *messages):
    with DiveLogWriter(path) as writer:
        for message in messages:
            writer.write_message(message)
    return str(path)


@pytest.fixture
def solved(tmp_path):
    """A stands still, b is off by 0.02 m east in every second row and right in the others, c once by 1 m."""
    messages = [info("a"), info("b"), info("c")]
    for k in range(10):
        true = {"a": (0.0, 0.0, 5.0), "b": (4.0 + 0.1 * k, 0.0, 5.0), "c": (5.0, 1.0, 6.0)}
        messages += [pose(node, k, p, mode="truth", sigma_m=0.0) for node, p in true.items()]
        messages.append(pose("a", k, true["a"], sigma_m=1e-4, fixed=True))
        messages.append(pose("b", k, (true["b"][0], 0.02 * (k % 2), 5.0)))
        if k < 8:
            messages.append(pose("c", k, (5.0, 1.0 + (k == 3), 6.0)))
    return write(tmp_path / "net.mcap", *messages)


def test_evaluate_tells_each_nodes_errors_and_how_true_its_covariance_is(solved, capsys):
    assert main(["evaluate", solved, "--net", "--json"]) == 0
    found = {one["node"]: one for one in json.loads(capsys.readouterr().out)["network"]}
    assert sorted(found) == ["a", "b", "c"]
    assert (found["a"]["fixed"], found["b"]["fixed"]) == (True, False)
    assert found["b"]["position_m"]["rmse"] == pytest.approx(0.02 / np.sqrt(2))
    assert found["b"]["nees6"]["mean"] == pytest.approx(0.5, rel=1e-3)
    assert (found["b"]["covered"], found["c"]["covered"]) == (1.0, 0.8)
    assert (found["b"]["wrong"], found["c"]["wrong"]) == (0, 1)
    assert main(["evaluate", solved, "--net"]) == 0
    assert "a (fixed)" in capsys.readouterr().out


def test_where_a_node_is_the_origin_places_count_from_its_true_place(tmp_path, capsys):
    messages = []
    for k in range(5):
        messages += [pose("a", k, (2.0 + k, 0.0, 5.0), mode="truth", sigma_m=0.0)]
        messages += [pose("b", k, (6.0 + k, 1.0, 5.0), mode="truth", sigma_m=0.0)]
        messages += [pose("a", k, (0.0, 0.0, 0.0), sigma_m=0.0), pose("b", k, (4.0, 1.01, 0.0))]
    assert main(["evaluate", write(tmp_path / "net.mcap", *messages), "--net", "--json"]) == 0
    found = {one["node"]: one for one in json.loads(capsys.readouterr().out)["network"]}
    assert found["a"]["position_m"]["rmse"] == 0.0
    assert found["b"]["position_m"]["rmse"] == pytest.approx(0.01)


def test_without_the_truth_of_the_origin_places_do_not_count(tmp_path, capsys):
    messages = [pose("b", 0, (6.0, 1.0, 5.0), mode="truth", sigma_m=0.0)]
    messages += [pose("a", 0, (0.0, 0.0, 0.0), sigma_m=0.0), pose("b", 0, (4.0, 1.0, 0.0))]
    assert main(["evaluate", write(tmp_path / "net.mcap", *messages), "--net", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["network"]
    assert (found["node"], found["samples"], found["wrong"]) == ("b", 0, 0)


def test_export_csv_has_a_row_for_each_node_and_time(solved, capsys):
    assert main(["export", solved, "--format", "csv", "--what", "net"]) == 0
    out, err = capsys.readouterr()
    rows = list(csv.DictReader(io.StringIO(out)))
    assert [sum(row["node"] == node for row in rows) for node in "abc"] == [10, 10, 8]
    assert float(rows[4]["north_m"]) == pytest.approx(4.1)
    assert float(rows[4]["sd_east_m"]) == pytest.approx(0.02)
    assert "nodes a, b, c" in err


def test_export_tum_is_of_one_node(solved, capsys):
    assert main(["export", solved, "--format", "tum", "--what", "net", "--node", "c"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 8
    assert lines[0] == "1764000000.000000000 5.0 1.0 6.0 0.5 0.5 0.5 0.5"


def test_export_trc_has_cameras_and_lamps_as_markers(solved, tmp_path):
    """TRC as motion capture programs read it: x north, y up, z east, millimetres."""
    path = tmp_path / "dive.trc"
    assert main(["export", solved, "--format", "trc", "-o", str(path)]) == 0
    lines = path.read_text().split("\n")
    assert lines[0].endswith("dive.trc")
    assert lines[2].split("\t")[:5] == ["10", "10", "10", "9", "mm"]
    names = [name for name in lines[3].split("\t")[2:] if name]
    assert names == [node + end for node in "abc" for end in ("", "_left", "_right")]
    first, last = lines[6].split("\t"), lines[15].split("\t")
    assert [float(x) for x in first[2:8]] == pytest.approx([0.0, -5000.0, 0.0, 0.0, -5000.0, -400.0])
    assert last[-9:] == [""] * 9
    assert {len(line.split("\t")) for line in lines[6:16]} == {2 + 27}


def test_export_c3d_has_the_same_markers_as_trc(solved, tmp_path):
    """Read back by the library: millimetres, y up, and no marker where a node has no pose."""
    ezc3d = pytest.importorskip("ezc3d")
    path = tmp_path / "dive.c3d"
    assert main(["export", solved, "--format", "c3d", "-o", str(path)]) == 0
    read = ezc3d.c3d(str(path))
    point = read["parameters"]["POINT"]
    assert point["LABELS"]["value"] == [node + end for node in "abc" for end in ("", "_left", "_right")]
    assert (point["RATE"]["value"][0], point["UNITS"]["value"]) == (10.0, ["mm"])
    points = read["data"]["points"]
    assert points.shape == (4, 9, 10)
    assert points[:3, :2, 0].T.ravel() == pytest.approx([0.0, -5000.0, 0.0, 0.0, -5000.0, -400.0], abs=1e-3)
    assert np.isnan(points[:3, 6:, 8:]).all()
    assert not np.isnan(points[:3, :6]).any()
    assert main(["export", solved, "--format", "c3d", "--what", "poses", "-o", str(tmp_path / "x.c3d")]) == 2


def test_a_c3d_file_on_a_full_disk_is_no_file(solved, tmp_path, capsys):
    pytest.importorskip("ezc3d")
    with small_disk(tmp_path / "disk", 16) as disk:
        (disk / "full").write_bytes(bytes(16 << 10))
        assert main(["export", solved, "--format", "c3d", "-o", str(disk / "dive.c3d")]) == 2
        assert "dive.c3d: cannot be written whole; look whether its disk is full" in capsys.readouterr().err
        assert [path.name for path in disk.iterdir()] == ["full"]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--format", "tum", "--what", "net"], "choose with --node: a, b, c"),
        (["--format", "csv", "--what", "net", "--node", "z"], "nothing of node z"),
        (["--format", "tum", "--node", "b"], "--node"),
        (["--format", "trc", "--what", "poses"], "--what poses"),
        (["--format", "csv", "--what", "net", "--pair", "a/b"], "--pair: not with all nodes"),
        (["--format", "foxglove", "-o", "x.mcap", "--pair", "a/b"], "it has all nodes and pairs"),
    ],
)
def test_what_cannot_be_exported_is_said(solved, capsys, words, named):
    assert main(["export", solved, *words]) == 2
    assert named in capsys.readouterr().err


@pytest.mark.parametrize("form", ["tum", "csv", "parquet"])
def test_of_several_pairs_in_a_net_one_or_all_nodes_are_to_be_chosen(tmp_path, capsys, monkeypatch, form):
    monkeypatch.chdir(tmp_path)
    pairs = [replace(evaluated.pose(0), node_a=one, node_b=two) for one, two in ("ab", "bc")]
    log = write(tmp_path / "net.mcap", info("a"), info("b"), info("c"), *pairs, pose("b", 0, (1.0, 0.0, 0.0)))
    assert main(["export", log, "--format", form, "-o", "out"]) == 2
    said = "holds pairs a/b, b/c; choose one with --pair A/B, or all nodes with --what net"
    assert said in capsys.readouterr().err
    without = write(tmp_path / "pairs.mcap", info("a"), info("b"), info("c"), *pairs)
    assert main(["export", without, "--format", form, "-o", "out"]) == 2
    assert "--what net" not in capsys.readouterr().err


def test_parquet_has_the_pair_or_the_node_that_is_asked_for(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    pairs = [replace(evaluated.pose(0), node_a=one, node_b=two) for one, two in ("ab", "bc")]
    log = write(tmp_path / "net.mcap", info("a"), info("b"), info("c"), *pairs, pose("b", 0, (1.0, 0.0, 0.0)))
    of_pair, of_node = tmp_path / "pair.parquet", tmp_path / "node.parquet"
    assert main(["export", log, "--format", "parquet", "--pair", "b/c", "-o", str(of_pair)]) == 0
    assert parquet.read_table(of_pair)["node_b"].to_pylist() == ["c"]
    assert main(["export", log, "--format", "parquet", "--what", "net", "--node", "b", "-o", str(of_node)]) == 0
    assert parquet.read_table(of_node)["north_m"].to_pylist() == [1.0]


def test_a_log_without_a_net_is_said(tmp_path, capsys):
    log = write(tmp_path / "empty.mcap", info("a"))
    assert main(["evaluate", log, "--net"]) == 2
    assert "no poses of a net" in capsys.readouterr().err
    assert main(["export", log, "--format", "trc"]) == 2
    assert "no poses of a net" in capsys.readouterr().err
