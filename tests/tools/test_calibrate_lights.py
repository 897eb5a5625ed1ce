"""Four lights out of mutual views at taped distances, against rigs that are known."""

from __future__ import annotations

import argparse
import tomllib

import cv2
import msgspec
import numpy as np
import pytest
from buddyline.protocol.codec import decode, encode
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Blob, CameraModel, Candidates, NodeInfo, RelativePose
from buddyline.protocol.topics import CANDIDATES, INFO, POSE
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rotation import matrix_to_quat, rotation_exp
from buddyline.tools.calibration import command as calibrate
from buddyline.tools.calibration.leastsquares import PoorCalibration
from buddyline.tools.calibration.lights import CalibrationNoise, TapedPlace, fit

FOCAL_PX = 1000.0
CAMERA = Camera("pinhole", 1640, 1232, FOCAL_PX, FOCAL_PX, 819.5, 615.5, (0.0,) * 5)
ENTERED = np.array([[-0.44, 0.0, 0.0], [0.44, 0.0, 0.0]])
NOISE = CalibrationNoise(pixel_px=0.3, tape_m=0.003, ruler_m=0.01)


def project(points: np.ndarray) -> np.ndarray:
    return FOCAL_PX * points[:, :2] / points[:, 2:] + [819.5, 615.5]


def world(n: int = 12, seed: int = 0, pixel_px: float = 0.3, tape_m: float = 0.003):
    """Return stations and both nodes' true lights, each a centimetre (1 sd) from where they were entered."""
    rng = np.random.default_rng(seed)
    lights_a, lights_b = ENTERED + rng.normal(0, 0.01, (2, 3)), ENTERED + rng.normal(0, 0.01, (2, 3))
    stations = []
    for i in range(n):
        along = np.array([rng.uniform(-0.25, 0.25), rng.uniform(-0.2, 0.2), 1.0])
        t = rng.uniform(1.2, 4.0) * along / np.linalg.norm(along)
        R = rotation_exp(rng.uniform(-0.3, 0.3, 3)) @ np.diag([-1.0, 1.0, -1.0])
        stations.append(
            TapedPlace(
                f"place {i}",
                project(lights_b @ R.T + t) + rng.normal(0, pixel_px, (2, 2)),
                project((lights_a - t) @ R) + rng.normal(0, pixel_px, (2, 2)),
                t + rng.normal(0, 0.03, 3),
                rotation_exp(rng.normal(0, 0.02, 3)) @ R,
                float(np.linalg.norm(t) + rng.normal(0, tape_m)),
            )
        )
    return stations, lights_a, lights_b


def bar(lights: np.ndarray) -> float:
    return float(np.linalg.norm(lights[1] - lights[0]))


def test_without_noise_the_bars_are_exact():
    stations, lights_a, lights_b = world(20, pixel_px=0.0, tape_m=0.0)
    found = fit(stations, (CAMERA, CAMERA), (ENTERED, ENTERED), CalibrationNoise(0.02, 0.0002, 0.05))
    assert bar(found.lights_m[0]) == pytest.approx(bar(lights_a), abs=2e-4)
    assert bar(found.lights_m[1]) == pytest.approx(bar(lights_b), abs=2e-4)
    assert found.chi2 < 0.3


def test_errors_match_the_sigmas():
    """Twelve bars: a centimetre of ruler error comes down to a millimetre or two, as predicted."""
    scores, before, after = [], [], []
    for seed in range(6):
        stations, *truth = world(seed=seed)
        found = fit(stations, (CAMERA, CAMERA), (ENTERED, ENTERED), NOISE)
        assert found.chi2 < 2.0
        for lights, fitted, sigma_m in zip(
            truth, (found.lights_m[0], found.lights_m[1]), found.bar_sigma_m, strict=True
        ):
            off = bar(fitted) - bar(lights)
            scores.append(off / sigma_m)
            after.append(off)
            before.append(bar(ENTERED) - bar(lights))
    assert 0.4 < np.sqrt(np.mean(np.square(scores))) < 1.6
    assert np.sqrt(np.mean(np.square(after))) < 0.002
    assert np.sqrt(np.mean(np.square(before))) > 0.008


def test_too_few_places_are_refused():
    stations, *_ = world(4)
    with pytest.raises(PoorCalibration, match="5 are needed"):
        fit(stations, (CAMERA, CAMERA), (ENTERED, ENTERED), NOISE)


def test_a_wrong_distance_is_refused_and_named():
    stations, *_ = world()
    wrong = stations[7]
    stations[7] = TapedPlace(*(getattr(wrong, f) for f in ("name", "pixels_a", "pixels_b", "t_a_b_m", "R_a_b")), 3.9)
    with pytest.raises(PoorCalibration, match=r"contradict.*place 7"):
        fit(stations, (CAMERA, CAMERA), (ENTERED, ENTERED), NOISE)


def test_distances_too_coarse_are_refused():
    stations, *_ = world(6)
    with pytest.raises(PoorCalibration, match="tape their distances better"):
        fit(stations, (CAMERA, CAMERA), (ENTERED, ENTERED), CalibrationNoise(0.5, 0.05, 0.01))


def node_info(node: str) -> NodeInfo:
    return NodeInfo(
        node=node,
        stamp_ns=0,
        width_px=1640,
        height_px=1232,
        camera=CameraModel(
            model="pinhole", fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=819.5, cy_px=615.5, distortion=[0.0] * 5
        ),
        light_left_m=(-0.44, 0.0, 0.0),
        light_right_m=(0.44, 0.0, 0.0),
        sigma_px=0.7,
        trigger_period_ns=100_000_000,
    )


@pytest.fixture
def solved(tmp_path):
    """A solved dive: ten seconds at each place, blobs in another order than the lights."""
    stations, lights_a, lights_b = world()
    rng = np.random.default_rng(9)
    path = tmp_path / "solved.mcap"
    with DiveLogWriter(path) as writer:
        for node in ("a", "b"):
            writer.write(INFO.key(node), encode(node_info(node)), 0, 0)
        for place, station in enumerate(stations):
            for k in range(20):
                trigger = place * 100 + k
                stamp_ns = trigger * 100_000_000
                for node, pixels in (("a", station.pixels_a), ("b", station.pixels_b)):
                    seen = pixels[::-1] + rng.normal(0, 0.2, (2, 2))
                    blobs = [
                        Blob(u_px=float(u), v_px=float(v), sigma_px=0.5, area_px=20.0, peak=250.0, elongation=1.0)
                        for u, v in [(5.0, 5.0), *seen]
                    ]
                    message = Candidates(
                        node=node, stamp_ns=stamp_ns, trigger=trigger, seq=trigger, boot="x",
                        width_px=1640, height_px=1232, blobs=blobs,
                    )  # fmt: skip
                    writer.write(CANDIDATES.key(node), encode(message), stamp_ns, stamp_ns)
                pose = RelativePose(
                    node_a="a", node_b="b", stamp_ns=stamp_ns, trigger=trigger,
                    t_a_b_m=tuple(station.t_a_b_m), q_a_b_xyzw=tuple(matrix_to_quat(station.R_a_b)),
                    covariance=[0.0] * 36, range_m=station.distance_m, range_a_m=0.0, range_b_m=0.0,
                    range_gap_m=0.0, twist_gap_rad=0.0, chi2=0.0, hypotheses=1,
                    blobs_a=(2, 1), blobs_b=(2, 1), method="refined", checks=[], skew_ns=0,
                )  # fmt: skip
                writer.write(POSE.key("a", "b"), encode(pose), stamp_ns, stamp_ns)
    tapes = []
    for place, station in enumerate(stations):
        tapes += ["--tape", str(place * 10), str(place * 10 + 2), f"{station.distance_m:.4f}"]
    return path, tapes, lights_a, lights_b


def arguments(*text: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    calibrate.add_arguments(parser)
    return parser.parse_args(text)


def test_command_takes_a_solved_dive_and_writes_what_solve_takes(solved, tmp_path, capsys):
    path, tapes, lights_a, lights_b = solved
    new, picture = [tmp_path / "a.json", tmp_path / "b.json"], tmp_path / "lights.png"
    how = ["--new-info", *map(str, new), "--picture", str(picture), "--pixel-sigma", "0.3", "--tape-sigma-mm", "3"]
    assert calibrate.run(arguments("lights", str(path), *tapes, *how)) == 0
    first, second = capsys.readouterr().out.split("# node b")
    printed = tomllib.loads(first)["calibration"]
    assert tomllib.loads("#" + second)["calibration"]
    for node, file, lights in (("a", new[0], lights_a), ("b", new[1], lights_b)):
        info = decode(file.read_bytes(), NodeInfo)
        assert info.node == node
        fitted = np.array([info.light_left_m, info.light_right_m])
        assert bar(fitted) == pytest.approx(bar(lights), abs=0.006)
        assert msgspec.structs.replace(
            info, light_left_m=(-0.44, 0.0, 0.0), light_right_m=(0.44, 0.0, 0.0)
        ) == node_info(node)
    assert printed["light_left_m"] == list(decode(new[0].read_bytes(), NodeInfo).light_left_m)
    assert cv2.imread(str(picture)) is not None


def test_command_refuses_a_place_where_something_moved_or_nothing_was_solved(solved, tmp_path):
    path, *_ = solved
    with pytest.raises(BuddylineError, match="0-12 s: the lights moved"):
        calibrate.run(arguments("lights", str(path), "--tape", "0", "12", "2.0"))
    with pytest.raises(BuddylineError, match=r"--tape 3-9 s: no fix; those of a/b are from 0.0 to .* choose seconds"):
        calibrate.run(arguments("lights", str(path), "--tape", "3", "9", "2.0"))
    with pytest.raises(BuddylineError, match=r"0-0.2 s: 3 fixes with all four lights, of 3 fixes; 5 are .* longer"):
        calibrate.run(arguments("lights", str(path), "--tape", "0", "0.2", "2.0"))


@pytest.mark.parametrize("tape", [("5", "1", "2"), ("1", "5", "-2")])
def test_a_tape_that_says_no_place_is_refused(solved, tape):
    with pytest.raises(BuddylineError, match=f"--tape {' '.join(tape)}: give BEGIN_S END_S METRES"):
        calibrate.run(arguments("lights", str(solved[0]), "--tape", *tape))
