"""Eyes in lids: boundaries that a lid cuts, answers to refuse, and bright places of skin that are not worth a fit."""

from __future__ import annotations

import numpy as np
import pytest

import make_ideal_images as ideal
from eyerender.extraction import FAST, REFINED, extract
from eyerender.optics.ellipse import Ellipse, iou


def _truth(drawing) -> Ellipse:
    pupil = drawing.label["pupil"]
    return Ellipse(pupil["centre_px"], pupil["semi_axes_px"], pupil["angle_rad"])


@pytest.mark.parametrize("settings", [FAST, REFINED], ids=["fast", "refined"])
@pytest.mark.parametrize("seed", [137, 230])
def test_a_refused_outline_is_searched_again(seed, settings):
    # A lid's margin in the outline (137), and a blur that leaves the first candidate's edges unlikely (230).
    drawing = ideal.draw("mixed", seed)
    found = extract(drawing.image, settings=settings).pupil
    assert found.ok, found.reason
    assert iou(found.ellipse, _truth(drawing)) > 0.9


# Pupils that hardly differ from irises that stand out of the sclera.
FAINT = ideal.Condition(
    size=(320, 240), semi_axis=(13, 30), noise=(2, 8), blur=(0.7, 3.0), pupil_level=(20, 45), step=(12, 25),
    texture=(0, 6), glints="scatter", glint_peak=240.0, glint_sigma=(0.8, 2.0),
)  # fmt: skip


def test_faint_pupils_are_found_and_their_irises_are_not_taken_for_them():
    right, irises = 0, []
    for seed in range(20_500, 20_524):
        drawing = ideal.draw(FAINT, seed)
        found, truth = extract(drawing.image).pupil, _truth(drawing)
        right += found.ok and iou(found.ellipse, truth) > 0.9
        if found.ok and found.ellipse.area_px2 > 2.0 * truth.area_px2:  # irises have 5.8 times the area
            irises.append(found.confidence)
    # Of 60 other images 57 are right and 3 are irises. With these shares, 19 or fewer right ones, or 5 or more irises,
    # would have a probability below 1 %.
    assert right >= 20
    assert len(irises) <= 4
    # One in thirty of these irises has edges so much clearer than the pupil's that it is certain.
    assert sum(confidence > 0.95 for confidence in irises) <= 1


def test_no_later_look_finds_a_pupil_where_no_eye_is():
    sure = [extract(ideal.draw_no_eye(seed)).pupil.confidence > 0.8 for seed in range(24)]
    assert sum(sure) <= 2  # a blurred ring-shaped letter is a dark iris with a bright pupil


def test_a_highlight_of_bright_skin_is_no_glint():
    drawing = ideal.draw("noise2", 3)
    x, y = _truth(drawing).centre_px
    rows, columns = np.mgrid[: drawing.image.shape[0], : drawing.image.shape[1]]
    below = y + 2.0 * _truth(drawing).semi_axes_px[0]
    spot = 60.0 * np.exp(-0.5 * ((columns - x) ** 2 + (rows - below - 20.0) ** 2) / 1.2**2)
    skin = np.where(rows > below, 180.0, drawing.image) + spot
    found = extract(np.clip(skin, 0, 255).astype(np.uint8))
    assert len(found.glints) == len(drawing.label["glints"])
    near = [one for one in found.rejected if np.hypot(*(one.xy_px - [x, below + 20.0])) < 2.0]
    assert near
    assert "highlights of skin" in near[0].reason
