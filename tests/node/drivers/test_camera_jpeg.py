"""Pictures of the camera's own JPEG encoder: matched with their frames, and replaced where the encoder fails."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from buddyline.node.config import CameraConfig, NodeConfig, RecordConfig, load_node_config
from buddyline.node.devices import Frame
from buddyline.node.drivers.samples import DeviceError
from buddyline.node.images import Images
from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import ConfigError
from buddyline.protocol.messages import CompressedImage

from tests.node.drivers.picamera2_rig import frames, make

BY_CAMERA = RecordConfig(encoder="camera", images_hz=2.0)


class Kept:
    """Keeps what would be recorded."""

    def __init__(self) -> None:
        self.recorded: list[CompressedImage] = []

    def send(self, image: CompressedImage, publish: bool = True, record: bool = True) -> None:
        if record:
            self.recorded.append(image)


def images(record: RecordConfig = BY_CAMERA) -> tuple[Images, Kept]:
    kept = Kept()
    return Images(NodeConfig(node="a", camera=CameraConfig(name="picamera2"), record=record), kept), kept


def stamp_ns(image: CompressedImage) -> int:
    return image.timestamp.sec * S_NS + image.timestamp.nsec


@pytest.mark.parametrize("colour", [False, True])
def test_the_recorded_pictures_come_from_the_camera_s_encoder_with_their_stamps(sensor, colour):
    camera = make(sensor, CameraConfig(colour=colour), record=BY_CAMERA)
    (encoder,) = sensor.encoders
    assert encoder.bits_per_s == pytest.approx(50e6 * 820 * 616 / (1920 * 1080), rel=0.01)
    sender, kept = images()
    expected = []
    for _ in range(40):
        (frame,) = frames(camera, 1)
        sender.send(frame)
        if frame.jpeg is not None:
            expected.append((frame.stamp_ns, b"jpeg of %d" % frame.image.flat[0]))
            encoder.finish()
    assert [(stamp_ns(image), image.data) for image in kept.recorded] == expected
    assert 8 <= len(expected) <= 9  # of 4 s
    camera.close()
    assert not encoder.running


def test_a_picture_that_the_encoder_loses_is_encoded_by_the_processor_under_its_own_stamp(sensor, caplog):
    camera = make(sensor, CameraConfig(colour=True), record=RecordConfig(encoder="camera", images_hz=10.0))
    (encoder,) = sensor.encoders
    sender, kept = images()
    taken = frames(camera, 1)
    sender.send(taken[0])
    encoder.finish()
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            taken += frames(camera, 1)
            sender.send(taken[-1])
        encoder.lose()
        encoder.finish()
    assert [stamp_ns(image) for image in kept.recorded] == [frame.stamp_ns for frame in taken]
    assert [image.data[:4] == b"jpeg" for image in kept.recorded] == [True, False, True]
    assert caplog.text.count("left out by the encoder") == 1
    camera.close()


def test_an_encoder_that_hangs_keeps_two_buffers_and_the_processor_takes_over(sensor):
    camera = make(sensor, record=RecordConfig(encoder="camera", images_hz=10.0))
    sender, kept = images()
    for frame in frames(camera, 30):
        assert frame.jpeg is not None
        sender.send(frame)
    assert len(kept.recorded) == 28
    camera.close()
    assert len(kept.recorded) == 30
    assert all(image.data[:2] == b"\xff\xd8" for image in kept.recorded)


def test_an_encoder_that_refuses_costs_no_frame(sensor):
    camera = make(sensor, record=RecordConfig(encoder="camera", images_hz=10.0))
    sensor.encoder_error = OSError(5, "Input/output error")
    sender, kept = images()
    for frame in frames(camera, 5):
        sender.send(frame)
    assert len(kept.recorded) == 5
    assert camera.problem == ""
    camera.close()


def test_the_camera_s_next_life_has_an_encoder_of_its_own(sensor):
    camera = make(sensor, record=RecordConfig(encoder="camera", images_hz=10.0))
    frames(camera, 5)
    sensor.job_error = RuntimeError("Camera frontend has timed out!")
    (frame,) = frames(camera, 1)
    first, second = sensor.encoders
    assert not first.running
    second.finish()
    assert frame.jpeg is not None
    assert frame.jpeg.result().startswith(b"jpeg")
    camera.close()


def test_a_machine_without_an_encoder_and_too_large_a_picture_are_refused_at_the_start(sensor):
    with pytest.raises(DeviceError, match=r"record.encoder = 'camera': 3280x2464, it takes 1920"):
        make(sensor, CameraConfig(width_px=3280, height_px=2464), S_NS, BY_CAMERA)
    sensor.has_encoder = False
    with pytest.raises(DeviceError, match=r"record.encoder = 'camera': .*not available.*a Pi 5"):
        make(sensor, record=BY_CAMERA)
    assert sensor.opened == sensor.closed
    make(sensor, record=RecordConfig()).close()


def test_other_cameras_have_no_encoder(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text('node = "a"\n[record]\nencoder = "camera"\n')
    with pytest.raises(ConfigError, match=r"a.toml: record.encoder = 'camera': camera 'simulated' has none"):
        load_node_config(path)


def test_the_processor_encodes_as_before_where_nothing_is_said(sensor):
    camera = make(sensor, record=RecordConfig())
    assert sensor.encoders == []
    sender, kept = images(RecordConfig())
    for frame in frames(camera, 12):
        assert frame.jpeg is None
        sender.send(frame)
    assert len(kept.recorded) == 2
    camera.close()


def test_a_frame_without_a_picture_by_the_camera_is_not_recorded_twice(sensor):
    sender, kept = images()
    sender.send(Frame(np.zeros((9, 12, 3), np.uint8), 0))
    assert kept.recorded == []
