"""From frames to messages: numbers, rows' times, and what is left out."""

import numpy as np
import pytest
from buddyline.node.detect import Detection, make_detector
from buddyline.node.detect.detection import CLIPPED, LASTING_S
from buddyline.node.devices import CAMERAS, Frame, load
from buddyline.node.pipeline import Pipeline, blobs_of
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import MAX_BLOBS, Blob
from msgspec import UNSET
from msgspec.json import encode

PERIOD_NS = 100_000_000
NOTHING = np.zeros((0, 2))


def detection(u_px, v_px, sigma_px=0.5):
    blob = Blob(u_px=u_px, v_px=v_px, sigma_px=sigma_px, area_px=1.0, peak=9.0, elongation=1.0)
    return Detection(blob, NOTHING, NOTHING, "")


def frame(stamp_ns=0, row_time_ns=0):
    return Frame(np.zeros((101, 200, 3), np.uint8), stamp_ns, row_time_ns)


def test_each_blob_has_its_rows_exposure_time():
    blobs, _ = blobs_of([detection(5.0, 0.0), detection(5.0, 50.0), detection(5.0, 100.0)], frame(row_time_ns=1000))
    assert [blob.dt_ns for blob in blobs] == [-50_000, 0, 50_000]


def test_digits_far_below_the_errors_are_not_sent():
    blob = Blob(
        u_px=12.345678901234,
        v_px=0.1 + 0.2,
        sigma_px=0.0123456789,
        area_px=458.0346984863281,
        peak=204.97,
        elongation=1.0292036533355713,
        score=0.9588340520858765,
    )
    (sent,), _ = blobs_of([Detection(blob, NOTHING, NOTHING, "")], frame())
    assert abs(sent.u_px - blob.u_px) < 0.01 * blob.sigma_px
    assert abs(sent.v_px - blob.v_px) < 0.01 * blob.sigma_px
    assert len(encode(sent)) < 125
    assert len(encode(blob)) > 180
    assert sent == blobs_of([Detection(sent, NOTHING, NOTHING, "")], frame())[0][0]


def test_blobs_outside_the_picture_are_left_out_and_surplus_ones_counted():
    blobs, truncated = blobs_of([detection(-0.6, 5.0), detection(5.0, 100.6), detection(199.4, 100.4)], frame())
    assert [(blob.u_px, blob.v_px) for blob in blobs] == [(199.4, 100.4)]
    assert truncated == 0
    blobs, truncated = blobs_of([detection(float(i), 5.0) for i in range(MAX_BLOBS + 6)], frame())
    assert (len(blobs), truncated) == (MAX_BLOBS, 6)
    assert blobs[0].u_px == 0.0


def test_triggers_are_the_nearest_and_come_once():
    pipeline = Pipeline("a", "boot", PERIOD_NS, make_detector("paper", "cavern"))
    first = pipeline.candidates(frame(7 * PERIOD_NS + 3_000_000))
    assert (first.trigger, first.seq) == (7, 0)
    assert pipeline.candidates(frame(7 * PERIOD_NS - 3_000_000)) is None
    assert pipeline.repeated == 1
    second = pipeline.candidates(frame(9 * PERIOD_NS - 1_000_000))
    assert (second.trigger, second.seq) == (9, 1)
    assert pipeline.residual_s == pytest.approx(0.001)


@pytest.mark.parametrize(
    ("peak", "own", "lasting_s"), [(CLIPPED, UNSET, LASTING_S), (CLIPPED - 1.0, UNSET, UNSET), (CLIPPED, 0.4, 0.4)]
)
def test_a_light_with_a_clipped_core_tells_for_how_long_its_error_lasts(peak, own, lasting_s):
    """A detector may tell it by itself."""
    blob = Blob(u_px=5.0, v_px=5.0, sigma_px=0.1, area_px=9.0, peak=peak, elongation=1.0, lasting_s=own)
    (sent,), _ = blobs_of([Detection(blob, NOTHING, NOTHING, "")], frame())
    assert sent.lasting_s == lasting_s


def test_an_unknown_device_is_refused_with_the_known_names():
    with pytest.raises(BuddylineError, match="simulated, stored, picamera2"):
        load(CAMERAS, "camera", "webcam")
