"""What stays still in a dive is proposed as a mask; lights, which move or are known, are not."""

import json

import numpy as np
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.tools.cli import main
from buddyline.tools.tune.still import still_parts

from tests.node.rendered import lamp_picture
from tests.tools.test_detect_command import encoded, write_dive

SIZE = 410, 308
CLOCK = [(350.0, 280.0), (362.0, 280.0), (374.0, 281.0)]


def dive_pictures(count, clock=CLOCK, still=None):
    rng = np.random.default_rng(6)
    pictures, lights = [], []
    for i in range(count):
        lamps = [still or tuple(rng.uniform((30, 30), (320, 240)))]
        pictures.append(lamp_picture([*lamps, *clock], size=SIZE, seed=i))
        lights.append(np.array(lamps))
    return pictures, lights


def covers(rectangle, u_px, v_px):
    (u0, v0), (u1, v1) = rectangle
    return u0 <= (u_px + 0.5) / SIZE[0] <= u1 and v0 <= (v_px + 0.5) / SIZE[1] <= v1


def test_a_burned_in_clock_is_proposed():
    pictures, lights = dive_pictures(12)
    for known in (lights, None):
        found = still_parts(pictures, known)
        assert len(found) == 1
        assert all(covers(found[0], *digit) for digit in CLOCK)
        (u0, v0), (u1, v1) = found[0]
        assert (u1 - u0) * (v1 - v0) < 0.1


def test_a_light_that_stays_still_is_not_proposed_where_it_is_known():
    pictures, lights = dive_pictures(12, clock=[], still=(200.0, 150.0))
    assert still_parts(pictures, lights) == []
    # Where it is not known it is proposed: the words beside it say to look first.
    assert len(still_parts(pictures, None)) == 1


def test_a_few_pictures_tell_nothing():
    pictures, lights = dive_pictures(7)
    assert still_parts(pictures, lights) == []


def test_moving_lights_are_not_proposed():
    pictures, _ = dive_pictures(12, clock=[])
    assert still_parts(pictures, None) == []


def test_tune_proposes_what_detect_takes(tmp_path, capsys):
    corner = 190.0, 140.0
    rng = np.random.default_rng(3)
    pictures = [
        encoded(
            lamp_picture([(100.0, 70.0), corner, tuple(rng.uniform(20, 130, 2))], size=(200, 150), core=300.0, seed=i)
        )
        for i in range(10)
    ]
    dive = write_dive(tmp_path / "d.mcap", pictures)
    assert main(["tune", str(dive), "--json", "--draw", str(tmp_path / "tuned")]) == 0
    masks = json.loads(capsys.readouterr().out)["masks"]
    assert len(masks) == 1
    (u0, v0), (u1, v1) = masks[0]
    assert u0 < 190 / 200 < u1
    assert v0 < 140 / 150 < v1
    assert main(["detect", str(dive), "--mask", f"{u0},{v0},{u1},{v1}"]) == 0
    for line in capsys.readouterr().out.splitlines():
        blobs = json.loads(line)["blobs"]
        assert all(np.hypot(b["u_px"] - corner[0], b["v_px"] - corner[1]) > 3.0 for b in blobs)
        assert any(np.hypot(b["u_px"] - 100.0, b["v_px"] - 70.0) < 3.0 for b in blobs)


def test_detect_refuses_a_mask_that_is_none(tmp_path, capsys):
    dive = write_dive(tmp_path / "d.mcap", [encoded(lamp_picture([(100.0, 70.0)], size=(200, 150)))])
    for words, named in (("0.1,x", "numbers"), ("0.1,0.2,0.3", "3 numbers"), ("0,0,820,616", "820")):
        assert main(["detect", str(dive), "--mask", words]) == 2
        assert named in capsys.readouterr().err


def test_detect_takes_the_masks_that_the_node_dived_with(tmp_path, capsys):
    plain = write_dive(tmp_path / "plain.mcap", [encoded(lamp_picture([(100.0, 70.0)], size=(200, 150)))])
    config = {"node": "a", "detector": {"method": "source", "masks": [[[0.4, 0.3], [0.6, 0.6]]]}}
    for name, noted in (("masked", json.dumps(config)), ("odd", '{"detector": 3}')):
        masked = str(tmp_path / f"{name}.mcap")
        with (
            DiveLogReader(plain) as reader,
            DiveLogWriter(masked, metadata={"node": "a", "config": noted}) as writer,
        ):
            for record in reader.records():
                writer.write(record.key, record.payload, record.log_time_ns)
    found = {}
    for name, status in (("plain", 0), ("masked", 0), ("odd", 1)):
        assert main(["detect", str(tmp_path / f"{name}.mcap")]) == status
        out, err = capsys.readouterr()
        found[name] = any(abs(b["u_px"] - 100.0) < 3.0 for b in json.loads(out)["blobs"])
        assert ("odd.mcap: its masks cannot be read" in err) is (name == "odd")
    assert found == {"plain": True, "masked": False, "odd": True}
