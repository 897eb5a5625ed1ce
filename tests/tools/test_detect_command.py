"""`buddyline detect` and `buddyline tune` as a person calls them: pictures and dives in, the unusable counted."""

import json
import logging

import cv2
import numpy as np
import pytest
from buddyline.node.config import load_node_config
from buddyline.node.detect import make_detector
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.messages import CompressedImage, FoxgloveTime, LightTruth, TrueLight
from buddyline.tools.cli import main

from tests.node.rendered import lamp_picture
from tests.tools.evaluated import info

AT = (100.0, 70.0)
PICTURE = lamp_picture([AT], size=(200, 150), core=300.0)
PERIOD_NS = info("a").trigger_period_ns
FIRST_NS = 100 * PERIOD_NS


def encoded(picture, suffix=".png"):
    return cv2.imencode(suffix, picture)[1].tobytes()


def write_dive(path, pictures, *, truth=True):
    with DiveLogWriter(str(path)) as writer:
        writer.write_message(info("a", width_px=200, height_px=150))
        for k, data in enumerate(pictures):
            stamp_ns = FIRST_NS + k * PERIOD_NS
            seconds, rest_ns = divmod(stamp_ns, 1_000_000_000)
            time = FoxgloveTime(sec=seconds, nsec=rest_ns)
            writer.write_message(
                CompressedImage(timestamp=time, frame_id="a_camera", data=data, format="png"),
                key="buddyline/node/a/image",
            )
            if truth:
                lights = [TrueLight(name="left", u_px=AT[0], v_px=AT[1], visible=True, merged=False)]
                writer.write_message(LightTruth(node="a", stamp_ns=stamp_ns, trigger=100 + k, lights=lights))
    return path


def test_a_folder_with_unusable_pictures_among_good_ones(tmp_path, capsys, caplog):
    for name, data in {
        "1_good.png": encoded(PICTURE),
        "2_cut_off.jpg": encoded(PICTURE, ".jpg")[:-300],
        "3_16_bit.png": encoded(PICTURE.astype(np.uint16) * 256),
        "4_nothing.png": b"",
        "5_grey.png": encoded(PICTURE[:, :, 1]),
        "6_black.png": encoded(np.zeros_like(PICTURE)),
        "7_white.png": encoded(np.full_like(PICTURE, 255)),
        "8_one_pixel.png": encoded(np.zeros((1, 1), np.uint8)),
    }.items():
        (tmp_path / name).write_bytes(data)
    with caplog.at_level(logging.WARNING):
        assert main(["detect", str(tmp_path), "--draw", str(tmp_path / "marked")]) == 1
    out, err = capsys.readouterr()
    lines = [json.loads(line) for line in out.splitlines()]
    found = {line["file"].rsplit("/", 1)[1]: line["blobs"] for line in lines}
    assert list(found) == ["1_good.png", "5_grey.png", "6_black.png", "7_white.png", "8_one_pixel.png"]
    for name in ("1_good.png", "5_grey.png"):
        assert np.hypot(found[name][0]["u_px"] - AT[0], found[name][0]["v_px"] - AT[1]) < 1.0
    assert found["6_black.png"] == found["8_one_pixel.png"] == []
    said = [line for line in err.splitlines() if line.startswith("buddyline detect: ")]
    assert len(said) == 3
    assert any("2_cut_off.jpg" in text and "cut off" in text for text in said)
    assert any("3_16_bit.png" in text and "16 bits" in text for text in said)
    assert "3 of 8 pictures skipped" in caplog.text
    assert len(list((tmp_path / "marked").glob("*.png"))) == 5


def test_a_picture_of_absurd_size_is_refused_by_its_header_and_the_rest_is_done(tmp_path, capsys):
    huge = bytearray(encoded(PICTURE))
    huge[16:24] = (60000).to_bytes(4, "big") * 2
    (tmp_path / "1_huge.png").write_bytes(huge)
    (tmp_path / "2_good.png").write_bytes(encoded(PICTURE))
    assert main(["detect", str(tmp_path)]) == 1
    out, err = capsys.readouterr()
    assert [json.loads(line)["file"] for line in out.splitlines()] == [str(tmp_path / "2_good.png")]
    assert "1_huge.png: its header says 60000x60000 px; at most 100 megapixels are read" in err


def test_only_unusable_pictures_give_exit_status_1(tmp_path, capsys):
    (tmp_path / "a.png").write_bytes(b"no picture")
    assert main(["detect", str(tmp_path)]) == 1
    assert capsys.readouterr().out == ""


def test_a_picture_of_another_size_than_its_node_says_is_counted(tmp_path, capsys):
    dive = write_dive(tmp_path / "d.mcap", [encoded(PICTURE), encoded(PICTURE[:100]), encoded(PICTURE)])
    assert main(["detect", str(dive)]) == 1
    out, err = capsys.readouterr()
    assert [json.loads(line)["trigger"] for line in out.splitlines()] == [100, 102]
    assert "2 pictures, 1 skipped" in err
    assert "200x100 px, its NodeInfo says 200x150" in err


def test_a_configuration_overrides_a_value(tmp_path):
    path = tmp_path / "node.toml"
    path.write_text('node = "a"\n[detector]\noverrides = { contrast_min = 200.0 }\n')
    detector = load_node_config(path).detector
    dim = lamp_picture([AT], size=(200, 150), core=40.0, noise=1.0)
    assert make_detector(detector.method, detector.environment).detect(dim)
    assert make_detector(detector.method, detector.environment, detector.overrides).detect(dim) == []


def test_tune_proposes_values_that_find_the_lights_and_marks_the_pictures(tmp_path, capsys):
    dim = [lamp_picture([AT], size=(200, 150), core=140.0, core_px=2.5, seed=k) for k in range(2)]
    dive = write_dive(tmp_path / "d.mcap", [encoded(picture) for picture in dim])
    words = ["tune", str(dive), "--method", "paper", "--environment", "night_reef", "--draw", str(tmp_path / "t")]
    assert main([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["judged_by"] == "truth"
    assert report["lights"] == 2
    # The preset is for brighter lights.
    assert report["present"]["recall"] == 0.0
    assert report["proposed"]["recall"] == 1.0
    assert report["proposed"]["value_min"] < report["present"]["value_min"]
    assert sorted(path.name for path in (tmp_path / "t").iterdir()) == ["a_100.png", "a_101.png"]


def test_without_truth_tune_uses_the_likely_candidates(tmp_path, capsys):
    (tmp_path / "p.png").write_bytes(encoded(PICTURE))
    (tmp_path / "q.png").write_bytes(b"broken")
    words = ["tune", str(tmp_path), "--method", "paper", "--environment", "lake", "--draw", str(tmp_path / "t")]
    assert main(words) == 1
    out, err = capsys.readouterr()
    assert "q.png: is not a picture" in err
    assert "judged by likely candidates" in out
    assert 'method = "paper"' in out
    proposed = dict(line.split(" = ", 1) for line in out.splitlines() if line.startswith("overrides"))
    assert "value_min" in proposed["overrides"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["p.png", "d.mcap"], "not both"),
        (["p.png", "--truth", "d.mcap"], "--truth"),
        (["nowhere.png"], "no such picture"),
        (["dark.png"], "no lights"),
        (["p.png", "--pictures", "0"], "--pictures"),
        (["p.png", "--method", "paper"], "--environment"),
        (["p.png", "--method", "sauce"], "source, paper"),
        ([], "give pictures"),
    ],
)
def test_tune_refuses_bad_input_in_one_line(tmp_path, monkeypatch, capsys, words, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.png").write_bytes(encoded(PICTURE))
    (tmp_path / "dark.png").write_bytes(encoded(np.zeros_like(PICTURE)))
    write_dive(tmp_path / "d.mcap", [])
    assert main(["tune", *words]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
