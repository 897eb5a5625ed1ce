"""The Foxglove export opened by rerun, in an environment of its own: what it would draw, by its own account."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from buddyline.protocol.messages import Message
from buddyline.tools.cli import main

from tests.tools.evaluated import INFOS, frame, pose, write_log
from tests.tools.watched import at, attitude, depth, image

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def test_rerun_reads_pictures_cameras_and_transforms_without_set_up(tmp_path: Path) -> None:
    rerun = installed(tmp_path / "venv")
    messages: list[Message] = list(INFOS.values())
    for k in range(5):
        for node in "ab":
            messages += [attitude(node, at(k)), depth(node, at(k)), frame(node, k), image(node, at(k))]
        messages.append(pose(k))
    output = str(tmp_path / "foxglove.mcap")
    assert main(["export", write_log(tmp_path / "dive.mcap", *messages), "--format", "foxglove", "-o", output]) == 0
    # rerun sends no usage data, and writes only to this folder.
    env = {**os.environ, "HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path), "RERUN_ANALYTICS": "0"}

    def said(*words: str) -> str:
        done = subprocess.run(
            [str(rerun), *words], env=env, capture_output=True, text=True, timeout=120, check=False, cwd=tmp_path
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "error" not in said("mcap", "check", output).lower()
    said("mcap", "convert", output, "-o", "foxglove.rrd")
    drawn = said("rrd", "print", "-v", "foxglove.rrd")
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
    """Install rerun; return its program. Skips where that cannot be done."""
    subprocess.run([sys.executable, "-m", "venv", str(directory)], check=True, timeout=120)
    done = subprocess.run(
        [str(directory / "bin" / "python"), "-m", "pip", "install", "--quiet", "rerun-sdk"],
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    if done.returncode != 0:
        pytest.skip(f"rerun-sdk cannot be installed here: {' '.join(done.stderr.strip().splitlines()[-1:])}")
    return directory / "bin" / "rerun"
