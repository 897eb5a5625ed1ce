"""The default detector on rendered lamps: the place of the source, its sigma, the order, sizes of pictures."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from buddyline.node.detect import make_detector

from tests.node.rendered import lamp_picture

SHARED = Path(__file__).parents[3] / "shared" / "data" / "pictures"


def nearest(found, u_px, v_px):
    return min(found, key=lambda d: np.hypot(d.blob.u_px - u_px, d.blob.v_px - v_px)).blob


def error_px(found, u_px, v_px):
    blob = nearest(found, u_px, v_px)
    return float(np.hypot(blob.u_px - u_px, blob.v_px - v_px))


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5, 0.75])
@pytest.mark.parametrize("grey", [False, True])
def test_a_small_lamp_is_found_to_a_fraction_of_a_pixel(offset, grey):
    image = lamp_picture([(200 + offset, 150 - offset)], core=180.0, core_px=1.6, seed=2)
    image = np.ascontiguousarray(image[:, :, 1]) if grey else image
    assert error_px(make_detector().detect(image), 200 + offset, 150 - offset) < 0.2


def test_the_source_of_a_leaning_glow_is_not_the_centre_of_its_clipped_core():
    image = lamp_picture([(205.0, 154.0)], core=400.0, core_px=3.0, glow=8000.0, lean=0.6, noise=1.0)
    clipped = np.argwhere(image.min(axis=2) >= 250)
    middle_off_px = float(clipped[:, 1].mean() - 205.0)
    assert middle_off_px > 1.0
    assert error_px(make_detector().detect(image), 205.0, 154.0) < 0.5 * middle_off_px


def test_sigma_is_larger_for_a_large_clipped_core():
    small = lamp_picture([(205.0, 154.0)], core=180.0, core_px=1.6, noise=1.0)
    large = lamp_picture([(205.0, 154.0)], core=400.0, core_px=3.0, glow=5000.0, lean=0.6, noise=1.0)
    sigma_small = nearest(make_detector().detect(small), 205, 154).sigma_px
    sigma_large = nearest(make_detector().detect(large), 205, 154).sigma_px
    assert sigma_large > 2 * sigma_small


def test_two_lamps_close_together_stay_two():
    image = lamp_picture([(200.0, 150.0), (212.0, 152.0)], core=300.0, core_px=1.8, glow=60.0)
    found = make_detector().detect(image)
    assert error_px(found, 200, 150) < 1.0
    assert error_px(found, 212, 152) < 1.0


def test_a_faint_lamp_beside_a_glaring_one_is_found():
    image = lamp_picture([(120.0, 150.0)], core=900.0, core_px=4.0, glow=2500.0).astype(np.float64)
    image += lamp_picture([(260.0, 160.0)], core=70.0, core_px=1.6, ground=0.0, noise=0.0)
    found = make_detector().detect(np.clip(image, 0, 255).astype(np.uint8))
    assert error_px(found, 260, 160) < 1.0


@pytest.mark.parametrize("at", [(1.0, 150.0), (408.0, 150.0), (200.0, 1.0), (200.0, 306.0)])
def test_a_lamp_at_the_border_is_found_there(at):
    image = lamp_picture([at], core=600.0, core_px=3.0, glow=200.0)
    found = make_detector().detect(image)
    assert error_px(found, *at) < 4.0
    assert all(-0.5 <= d.blob.u_px <= 409.5 and -0.5 <= d.blob.v_px <= 307.5 for d in found)


@pytest.mark.parametrize("width", [200, 640, 820, 1111, 1640])
def test_the_picture_size_does_not_matter(width):
    height = width * 3 // 4
    at = (0.6 * width, 0.4 * height)
    image = lamp_picture([at], size=(width, height), core_px=max(1.6, width / 400))
    assert error_px(make_detector().detect(image), *at) < 0.5


def test_a_narrow_crop_shows_a_lamp_as_the_whole_picture_does():
    whole = lamp_picture([(410.0, 308.0)], size=(820, 616), core=900.0, core_px=6.0, glow=2500.0, lean=0.5)
    crop = np.ascontiguousarray(whole[224:416, 288:512])
    (seen, *_), (cropped, *_) = (make_detector(focal_px=904.0).detect(image) for image in (whole, crop))
    assert np.hypot(seen.blob.u_px - 288 - cropped.blob.u_px, seen.blob.v_px - 224 - cropped.blob.v_px) < 0.05
    assert cropped.blob.score == pytest.approx(seen.blob.score, abs=0.05)


def test_a_view_into_a_padded_buffer_is_as_good_as_a_picture():
    image = lamp_picture([(150.0, 100.0)], size=(320, 240))[:, :, 1]
    padded = np.zeros((256, 384), np.uint8)
    padded[:240, :320] = image
    seen = [make_detector().detect(x)[0].blob for x in (np.ascontiguousarray(image), padded[:240, :320])]
    assert seen[0] == seen[1]


def test_many_lamps_are_all_found():
    lamps = [(60.0 + 95 * column, 60.0 + 85 * row) for row in range(3) for column in range(4)]
    found = make_detector().detect(lamp_picture(lamps, core=300.0, core_px=1.8, glow=40.0))
    assert max(error_px(found, *lamp) for lamp in lamps) < 1.0


def test_lamps_go_before_a_field_of_ripples():
    v, u = np.mgrid[:308, :410]
    ripples = 70 + 60 * np.maximum(np.sin(u / 5) * np.sin(v / 4 + u / 30), 0) ** 3 * (v > 150)
    image = lamp_picture([(120.0, 80.0), (250.0, 84.0)], core=120.0, core_px=1.8, ground=0.0) + ripples[:, :, None]
    found = make_detector().detect(np.clip(image, 0, 255).astype(np.uint8))
    assert error_px(found[:2], 120, 80) < 1.0
    assert error_px(found[:2], 250, 84) < 1.0


def test_candidates_are_in_order_of_their_score():
    rng = np.random.default_rng(4)
    image = rng.normal(60, 25, (154, 205, 3)).repeat(2, axis=0).repeat(2, axis=1)
    scores = [d.blob.score for d in make_detector().detect(np.clip(image, 0, 255).astype(np.uint8))]
    assert scores == sorted(scores, reverse=True)
    assert len(scores) > 1


def test_noise_of_a_high_gain_gives_no_likely_light():
    dark = lamp_picture([], ground=20.0, noise=12.0, seed=8)
    found = make_detector().detect(dark)
    assert all(d.blob.score < 0.5 for d in found)


def test_pictures_of_other_sizes_in_between_change_nothing():
    detector = make_detector()
    image = lamp_picture([(150.0, 100.0)], size=(320, 240))
    before = [d.blob for d in detector.detect(image)]
    detector.detect(np.zeros((90, 130), np.uint8))
    detector.detect(lamp_picture([(60.0, 50.0)], size=(640, 200)))
    assert [d.blob for d in detector.detect(image)] == before


def test_values_can_be_overridden():
    image = lamp_picture([(200.0, 150.0)], core=40.0, core_px=1.6, noise=1.0)
    assert make_detector().detect(image)
    assert make_detector("source", "auto", {"contrast_min": 200.0}).detect(image) == []


@pytest.mark.parametrize("bar_px", [5, 7])
def test_a_white_lamp_on_its_bar_is_likelier_than_bubbles(bar_px):
    light = lamp_picture([(200.0, 150.0)], core=900.0, core_px=2.0, noise=0.0).astype(np.float64)
    beside = np.zeros(light.shape[:2])
    cv2.rectangle(beside, (200, 150 - bar_px // 2), (260, 150 + bar_px // 2), 150.0, -1)
    for k in range(10):
        cv2.circle(beside, (40 + 33 * k, 40 + 40 * (k % 2)), 3, 180.0, -1)
    picture = np.maximum(light, cv2.GaussianBlur(beside, (0, 0), 0.8)[:, :, None])
    picture += np.random.default_rng(1).normal(0.0, 2.0, picture.shape)
    found = make_detector().detect(np.clip(np.round(picture), 0, 255).astype(np.uint8))
    lamp = nearest(found, 200.0, 150.0)
    assert error_px(found, 200.0, 150.0) < 1.0
    assert lamp.score > max(d.blob.score for d in found if d.blob is not lamp)


@pytest.mark.skipif(not SHARED.exists(), reason="needs the sample pictures in ../shared")
def test_real_leds_are_found_and_real_caustics_are_unlikely():
    leds = [cv2.imread(str(path)) for path in sorted((SHARED / "lights").glob("ir_leds_*.tif"))]
    likely = [sum(d.blob.score > 0.5 for d in make_detector().detect(image)) for image in leds]
    assert min(likely) >= 10
    sheet = cv2.imread(str(SHARED / "negatives" / "caustics_sheet.png"))
    tiles = [sheet[10 + 126 * i : 110 + 126 * i, 42:200] for i in range(7)]
    false = [
        sum(d.blob.score > 0.5 for d in make_detector().detect(cv2.resize(tile, None, fx=3, fy=3))) for tile in tiles
    ]
    assert float(np.mean(false)) <= 0.5


@pytest.mark.parametrize("at", [(-4.0, 150.0), (413.0, 150.0), (200.0, -4.0), (200.0, 311.0)])
def test_the_glow_of_a_lamp_outside_of_the_picture_says_so_in_its_sigma(at):
    image = lamp_picture([at], core=3000.0, core_px=3.0, glow=3000.0)
    blob = nearest(make_detector().detect(image), *at)
    assert np.hypot(blob.u_px - at[0], blob.v_px - at[1]) < 2.5 * blob.sigma_px
    inside = lamp_picture([(20.0, 150.0)], core=3000.0, core_px=3.0, glow=3000.0)
    assert nearest(make_detector().detect(inside), 20.0, 150.0).sigma_px < 0.2 * blob.sigma_px
