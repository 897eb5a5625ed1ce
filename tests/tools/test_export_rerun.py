"""What rerun reads, in an environment of its own: our recording for it, and the log for Foxglove."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from buddyline.protocol.messages import Message, NodePose
from buddyline.tools.cli import main

from tests.tools.evaluated import INFOS, frame, pose, rejection, track, write_log
from tests.tools.watched import at, attitude, depth, image, solver_status

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

# Prints every series and every line of the log of a recording, as {entity: [[stamp_ns, value], ...]}.
READ: str = """
import json, sys
import rerun.chunk
found = {}
for chunk in rerun.chunk.RrdReader(sys.argv[1]).stream().to_chunks():
    batch = chunk.to_record_batch()
    names = batch.schema.names
    for name in names:
        if name.endswith(("Scalars:scalars", "TextLog:text")):
            stamps = batch.column(names.index("stamp")).cast("int64").to_pylist()
            rows = zip(stamps, batch.column(names.index(name)).to_pylist())
            found.setdefault(chunk.entity_path.lstrip("/"), []).extend(map(list, rows))
        else:
            found.setdefault(chunk.entity_path.lstrip("/") + " " + name, [])
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def rerun(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., str]:
    """Run a program of an environment with rerun, which sends no usage data, and writes only to its own folder."""
    directory = tmp_path_factory.mktemp("rerun")
    bin_folder = installed(directory / "venv")
    env = {**os.environ, "HOME": str(directory), "XDG_CONFIG_HOME": str(directory), "RERUN_ANALYTICS": "0"}

    def run(program: str, *words: str) -> str:
        done = subprocess.run(
            [str(bin_folder / program), *words],
            env=env,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
            cwd=directory,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def dive(directory: Path) -> tuple[str, list[Message]]:
    messages: list[Message] = list(INFOS.values())
    for k in range(5):
        for node in "ab":
            messages += [attitude(node, at(k)), depth(node, at(k), 12.5 + k / 7), frame(node, k), image(node, at(k))]
        messages += [pose(k), track(k, (0.1 / 3 * k, -0.2 / 7, 3.0), t_ned_m=(3.0, 0.1 / 3 * k, 0.0))]
    messages += [rejection(6), solver_status(at(6), "clock of b is off", advice=["turn b 20 deg left"])]
    return write_log(directory / "dive.mcap", *messages), messages


def test_a_recording_has_every_number_of_the_log_to_the_last_digit(rerun: Callable[..., str], tmp_path: Path) -> None:
    log, messages = dive(tmp_path)
    output = tmp_path / "dive.rrd"
    rerun("python", "-P", "-m", "buddyline", "export", log, "--format", "rerun", "-o", str(output))
    found = json.loads(rerun("python", "-c", READ, str(output)))
    told = {
        "RelativePose": ("pair/a/b/pose", ("t_a_b_m", "covariance", "range_m", "trigger")),
        "Track": ("pair/a/b/track", ("t_a_b_m", "q_a_b_xyzw", "covariance", "v_covariance", "t_ned_m", "age_s")),
    }
    compared = 0
    for message in messages:
        if type(message).__name__ in told:
            entity, fields = told[type(message).__name__]
            stamp_ns = getattr(message, "stamp_ns")  # noqa: B009
            for field in fields:
                (value,) = [v for ns, v in found[f"{entity}/{field}"] if ns == stamp_ns]
                np.testing.assert_array_equal(value, np.ravel(getattr(message, field)).astype(float))
                compared += 1
    assert compared == 5 * 10
    depths = [value for _, (value,) in found["node/b/depth/depth_m"]]
    assert depths == [12.5 + k / 7 for k in range(5)]
    assert [text for _, (text,) in found["log/pose/a/b"]] == ["no pose: more than one arrangement fits"]
    assert [text for _, (text,) in found["log/coach/a/b"]] == ["turn b 20 deg left"]
    for drawn in (
        "world/a Transform3D:translation",
        "world/a/b Transform3D:translation",
        "world/a/picture EncodedImage:blob",
        "world/a/b/picture Pinhole:image_from_camera",
        "world/a/picture/candidates Points2D:positions",
        "world/a/b/lamps Points3D:positions",
        "world/trail_b Points3D:positions",
    ):
        assert drawn in found


def test_nodes_of_a_net_stand_in_its_frame(rerun: Callable[..., str], tmp_path: Path) -> None:
    placed = [
        NodePose(
            net="main", node=node, stamp_ns=at(k), p_m=(0.1 / 3 * k, -0.2 / 7, 3.0), q_xyzw=(0.5, 0.5, 0.5, 0.5),
            v_mps=(0.1 / 3, 0.0, 0.0), covariance=(np.eye(6) / 7).ravel().tolist(), fixed=False, mode="smooth",
            age_s=0.1 / 3,
        )
        for k in range(5)
        for node in "ab"
    ]  # fmt: skip
    sensed = [each for k in range(5) for each in (attitude("a", at(k)), depth("a", at(k)), pose(k))]
    log = write_log(tmp_path / "dive.mcap", *INFOS.values(), *sensed, *placed)
    output = tmp_path / "dive.rrd"
    rerun("python", "-P", "-m", "buddyline", "export", log, "--format", "rerun", "-o", str(output))
    found = json.loads(rerun("python", "-c", READ, str(output)))
    for one in placed:
        for field in ("p_m", "q_xyzw", "v_mps", "covariance", "age_s"):
            series = found[f"net/main/{one.node}/{field}"]
            (value,) = [v for ns, v in series if ns == one.stamp_ns]
            np.testing.assert_array_equal(value, np.ravel(getattr(one, field)))
    for drawn in ("/a", "/b", ""):
        assert f"world/net_main{drawn} Transform3D:translation" in found
    assert not [name for name in found if name.startswith(("world/a", "world/b"))]


def test_the_log_for_foxglove_is_drawn_without_set_up(rerun: Callable[..., str], tmp_path: Path) -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
    output, converted = str(tmp_path / "foxglove.mcap"), str(tmp_path / "foxglove.rrd")
    assert main(["export", dive(tmp_path)[0], "--format", "foxglove", "-o", output]) == 0
    assert "error" not in rerun("rerun", "mcap", "check", output).lower()
    rerun("rerun", "mcap", "convert", output, "-o", converted)
    drawn = rerun("rerun", "rrd", "print", "-v", converted)
    for column in (
        "/a/camera/image@EncodedImage:blob",
        "/b/camera/image@EncodedImage:blob",
        "/a/camera/calibration@Pinhole:image_from_camera",
        "/b/camera/calibration@Pinhole:image_from_camera",
        "/tf@Transform3D:translation",
        "/tf@Transform3D:quaternion",
        "/pair/a/b/pose@InstancePoses3D:translations",
    ):
        assert column in drawn


def installed(directory: Path) -> Path:
    """Install rerun beside what is installed here; return its programs' folder. Skips where that cannot be done."""
    subprocess.run([sys.executable, "-m", "venv", str(directory)], check=True, timeout=120)
    pip = [str(directory / "bin" / "python"), "-m", "pip", "install", "--quiet", "rerun-sdk>=0.41"]
    done = subprocess.run(pip, capture_output=True, text=True, timeout=400, check=False)
    if done.returncode != 0:
        pytest.skip(f"rerun-sdk cannot be installed here: {' '.join(done.stderr.strip().splitlines()[-1:])}")
    (packages,) = (directory / "lib").glob("python*/site-packages")
    # Then what is installed here, with its own .pth files: behind what rerun brings.
    here = [path for path in sys.path if path.endswith("site-packages")]
    lines = [f"import site; site.addsitedir({path!r})" for path in here]
    (packages / "zz_tested.pth").write_text("\n".join(lines) + "\n")
    return directory / "bin"
