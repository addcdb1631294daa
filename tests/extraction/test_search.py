"""The search's looks: glints that fill a pupil, sizes from 9 to hundreds of pixels, and glints of any size."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

import make_ideal_images as ideal
from eyerender.extraction import FAST, extract
from eyerender.extraction.pupil.glare import inpaint_glints
from eyerender.extraction.statistics import median, quantile
from eyerender.optics.ellipse import Ellipse, iou


def _truth(drawing) -> Ellipse:
    pupil = drawing.label["pupil"]
    return Ellipse(np.array(pupil["centre_px"]), np.array(pupil["semi_axes_px"]), pupil["angle_rad"])


def test_eight_glints_may_fill_a_pupil():
    # 93 % of 40 held-out images of this kind are right; 4 of 6 or fewer would have a probability below 7 %.
    drawings = [ideal.draw("ring-light", seed) for seed in range(20_400, 20_406)]
    found = [extract(drawing.image, settings=FAST).pupil for drawing in drawings]
    right = [one.ok and iou(one.ellipse, _truth(d)) > 0.9 for one, d in zip(found, drawings, strict=True)]
    assert sum(right) >= 5


def test_the_level_around_glints_takes_their_place():
    drawing = ideal.draw("ring-light", 20_401)
    truth, linear = _truth(drawing), drawing.image.astype(np.float32)
    whole = (slice(0, linear.shape[1]), slice(0, linear.shape[0]))
    inpainted, mask = inpaint_glints(linear, truth, 20.0, 55.0, 2.0).cut(*whole)
    assert mask is not None
    for glint in drawing.label["glints"]:
        x, y = (round(v) for v in glint["xy_px"])
        assert mask[y, x]
        assert inpainted[y, x] < 100.0 < linear[y, x]
    np.testing.assert_array_equal(inpainted[~mask], linear[~mask])
    plain = np.minimum(linear, 80.0)
    assert not inpaint_glints(plain, truth, 20.0, 55.0, 2.0).cut(*whole)[1].any()


def test_small_pupils():
    condition = replace(ideal.CONDITIONS["any-size"], size=(320, 240), semi_axis=(9.0, 9.0), log_size=False)
    for seed in range(20_410, 20_413):
        drawing = ideal.draw(condition, seed)
        found = extract(drawing.image, settings=FAST).pupil
        assert found.ok, found.reason
        assert iou(found.ellipse, _truth(drawing)) > 0.9


def test_an_image_of_eleven_megapixels():
    drawing = ideal.draw("noise2", 20_420)
    large = cv2.resize(drawing.image, None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)
    found, truth = extract(large, settings=FAST).pupil, _truth(drawing)
    grown = Ellipse(6.0 * truth.centre_px + 2.5, 6.0 * truth.semi_axes_px, truth.angle_rad)
    assert iou(found.ellipse, grown) > 0.98


def test_a_saturated_bar_is_one_glint():
    drawing = ideal.draw(ideal.Condition(noise=(2, 2), glints="none", semi_axis=(40, 44)), 20_430)
    truth, image = _truth(drawing), drawing.image.astype(np.float64)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    middle = truth.centre_px + np.array([6.0, 15.0])
    bar = (np.abs(x - middle[0]) < 11.0) & (np.abs(y - middle[1]) < 4.0)
    image += cv2.GaussianBlur(bar.astype(np.float64), (0, 0), 1.0) * 600.0
    found = extract(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    (glint,) = found.glints
    assert glint.saturated
    assert np.hypot(*(glint.xy_px - middle)) < 1.0
    assert iou(found.pupil.ellipse, truth) > 0.97


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint16])
@pytest.mark.parametrize("size", [1, 2, 3, 10, 101, 1000])
def test_as_numpy_has_them(size, dtype):
    values = (np.random.default_rng(size).normal(100.0, 20.0, size)).astype(dtype)
    assert median(values) == pytest.approx(float(np.median(values)), rel=1e-6)
    for share in (0.0, 0.03, 0.25, 0.9, 1.0):
        assert quantile(values, share) == pytest.approx(float(np.quantile(values, share)), rel=1e-5)


def test_of_none_is_not_a_number():
    assert math.isnan(median(np.zeros(0)))
