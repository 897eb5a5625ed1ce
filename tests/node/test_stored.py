"""Stored pictures: those that can be used, and the reports of the others."""

import threading

import cv2
import numpy as np
import pytest
from buddyline.node.config import CameraConfig, NodeConfig
from buddyline.node.drivers.stored import PictureError, decode_picture, open_camera, open_sensors
from buddyline.protocol.clock import ManualClock
from buddyline.protocol.config import ConfigError
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.messages import Attitude, CompressedImage, Depth, FoxgloveTime

GREY = np.arange(48, dtype=np.uint8).reshape(6, 8)


def encoded(picture, suffix=".png"):
    return cv2.imencode(suffix, picture)[1].tobytes()


def test_grey_colour_and_alpha_pictures_are_decoded():
    assert np.array_equal(decode_picture(encoded(GREY), "x"), GREY)
    colour = np.dstack((GREY, GREY, GREY))
    assert np.array_equal(decode_picture(encoded(colour), "x"), colour)
    assert decode_picture(encoded(np.dstack((colour, GREY))), "x").shape == (6, 8, 3)
    assert decode_picture(encoded(np.zeros((1, 1), np.uint8)), "x").shape == (1, 1)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "not a picture"),
        (b"hello", "not a picture"),
        (encoded(np.zeros((200, 200, 3), np.uint8), ".jpg")[:-200], "cut off"),
        (encoded(GREY.astype(np.uint16)), "16 bits"),
    ],
)
def test_unusable_pictures_are_refused_by_name(data, says):
    with pytest.raises(PictureError, match=says) as refused:
        decode_picture(data, "folder/7.png")
    assert "folder/7.png" in str(refused.value)


def config(**camera):
    return NodeConfig(node="a", camera=CameraConfig(name="stored", **camera))


def test_a_folder_gives_one_picture_a_trigger_and_skips_the_broken(tmp_path):
    for name, data in (("1.png", encoded(GREY)), ("2.png", b"broken"), ("3.png", encoded(GREY + 1))):
        (tmp_path / name).write_bytes(data)
    (tmp_path / "notes.txt").write_text("no picture")
    camera = open_camera(config(path=str(tmp_path)), ManualClock(250_000_000))
    stop = threading.Event()
    frames = [camera.next_frame(stop) for _ in range(2)]
    assert [f.stamp_ns for f in frames] == [300_000_000, 400_000_000]
    assert camera.next_frame(stop) is None
    assert camera.skipped["unreadable"] == 1
    assert camera.info() is None


def test_a_dive_keeps_its_own_times(tmp_path):
    path = tmp_path / "dive.mcap"
    with DiveLogWriter(path) as writer:
        for i in range(3):
            stamp = FoxgloveTime(sec=100, nsec=i * 100_000_000)
            data = encoded(GREY) if i != 1 else b"broken"
            writer.write_message(CompressedImage(timestamp=stamp, frame_id="a_camera", data=data, format="png"))
            at_ns = 100 * 10**9 + i * 10**8
            writer.write_message(
                Attitude(node="a", stamp_ns=at_ns, q_ned_body_xyzw=(0.0, 0.0, 0.0, 1.0), sigma_rad=(0.1, 0.1, 0.1))
            )
            writer.write_message(Depth(node="b", stamp_ns=at_ns, depth_m=1.0, sigma_m=0.1))
    stop, clock = threading.Event(), ManualClock(5)
    camera = open_camera(config(path=str(path)), clock)
    assert [camera.next_frame(stop).stamp_ns for _ in range(2)] == [100_000_000_000, 100_200_000_000]
    assert camera.next_frame(stop) is None
    assert (camera.skipped.total(), clock.now_ns()) == (1, 200_000_005)
    (sensors,) = open_sensors(config(path=str(path)), clock)
    found = [sensors.next_messages(stop)[0] for _ in range(3)]
    assert all(isinstance(message, Attitude) for message in found)
    assert sensors.next_messages(stop) is None
    camera.close()
    sensors.close()


@pytest.mark.parametrize("path", ["", "/nonexistent", "empty"])
def test_a_source_without_pictures_is_reported(tmp_path, path):
    if path == "empty":
        path = str(tmp_path)
    with pytest.raises(ConfigError, match=r"camera\.path"):
        open_camera(config(path=path), ManualClock())
