"""The size in a picture's header, for each format, whole and cut off."""

import cv2
import numpy as np
import pytest
from buddyline.node.drivers.picture_header import stated_size


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif"])
def test_a_header_says_what_is_decoded(suffix):
    data = cv2.imencode(suffix, np.zeros((33, 70, 3), np.uint8))[1].tobytes()
    assert stated_size(data) == (70, 33)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif"])
@pytest.mark.parametrize("kept", [2, 4, 8, 12, 17])
def test_a_header_that_is_cut_off_says_nothing(suffix, kept):
    data = cv2.imencode(suffix, np.zeros((33, 70, 3), np.uint8))[1].tobytes()
    assert stated_size(data[:kept]) is None


def test_a_big_endian_tiff_is_read():
    entries = b"".join(
        tag.to_bytes(2, "big") + kind.to_bytes(2, "big") + b"\0\0\0\1" + value
        for tag, kind, value in ((256, 4, b"\0\0\xea\x60"), (257, 3, b"\x75\x30\0\0"))
    )
    assert stated_size(b"MM\0*\0\0\0\x08\0\x02" + entries) == (60000, 30000)


@pytest.mark.parametrize("data", [b"", b"no picture", b"\xff\xd8" + b"\0" * 50])
def test_other_bytes_say_nothing(data):
    assert stated_size(data) is None
