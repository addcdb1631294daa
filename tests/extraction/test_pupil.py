"""The pupil found in supersampled images: errors against the bound, polarity, encodings, invariance."""

from __future__ import annotations

import math

import numpy as np
import pytest

import make_ideal_images as ideal
from eyerender.extraction import FAST, REFINED, ExtractionSettings, extract
from eyerender.extraction.pupil.covariance import (
    GROUPS,
    HIDDEN_UNEVEN,
    hidden_part,
    outline_slopes,
    reshaped,
    towards_round,
)
from eyerender.extraction.pupil.places import SECTORS
from eyerender.optics.ellipse import Ellipse, iou

SEEDS = range(20_000, 20_006)


def _truth(drawing) -> Ellipse:
    pupil = drawing.label["pupil"]
    return Ellipse(pupil["centre_px"], pupil["semi_axes_px"], pupil["angle_rad"])


def _errors(condition: str, settings: ExtractionSettings, seeds: range = SEEDS) -> tuple[np.ndarray, np.ndarray]:
    centre, axes = [], []
    for seed in seeds:
        drawing = ideal.draw(condition, seed)
        found = extract(drawing.image, settings=settings).pupil
        assert found.ok, found.reason
        truth = _truth(drawing)
        assert iou(found.ellipse, truth) > 0.9
        centre.append(np.hypot(*(found.ellipse.centre_px - truth.centre_px)))
        axes.append(found.ellipse.semi_axes_px - truth.semi_axes_px)
    return np.array(centre), np.array(axes)


# Allowed medians: those of the full bench (40 images a row). Of six images the median scatters by about a quarter, the
# refined fit is a third below the bar or better, so a failure is a defect. In the rows of MORE it is a fifth below,
# which takes more images.
MORE = ("noise2-17px", "noise2-13px", "noise16", "shading")


@pytest.mark.parametrize(
    ("condition", "median"),
    [
        ("noise2", 0.015), ("noise2-13px", 0.021), ("blur4", 0.04), ("shading", 0.02), ("edge-glint", 0.02),
        pytest.param("clean", 0.005, marks=pytest.mark.slow),
        pytest.param("noise8", 0.05, marks=pytest.mark.slow),
        pytest.param("texture6", 0.04, marks=pytest.mark.slow),
        pytest.param("noise2-17px", 0.018, marks=pytest.mark.slow),
        pytest.param("noise16", 0.09, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_refined_centre_error(condition, median):
    seeds = range(20_000, 20_024) if condition in MORE else SEEDS
    centre, _ = _errors(condition, REFINED, seeds)
    assert np.median(centre) <= median


def test_light_from_one_side_does_not_move_a_noisy_pupil():
    """Lamps beside the camera make one side of the iris brighter by less than the noise lets anyone see.

    Five hundredths over a semi-axis each way move the fit of one outer level by 0.06 to 0.09 px, against images of
    even light with the same noise.
    """
    drawing = ideal.draw("clean", 20_000)
    truth = _truth(drawing)
    x = np.arange(drawing.image.shape[1]) - truth.centre_px[0]
    light = 1.0 + 0.05 * np.clip(x / truth.semi_axes_px[0], -3.0, 3.0)
    rng = np.random.default_rng(20_000)
    moved = []
    for _ in range(8):
        noise = rng.normal(0.0, 16.0, drawing.image.shape)
        images = (np.clip(np.rint(drawing.image * level + noise), 0, 255).astype(np.uint8) for level in (light, 1.0))
        lit, even = (extract(image).pupil.ellipse for image in images)
        moved.append(lit.centre_px - even.centre_px)
    assert np.abs(np.mean(moved, axis=0)).max() < 0.035


@pytest.mark.parametrize(("condition", "median"), [("clean", 0.005), ("noise2", 0.03), ("noise2-13px", 0.04)])
def test_fast_centre_error(condition, median):
    # The algebraic fit of edges reaches half the bound's efficiency: twice the refined bars.
    centre, axes = _errors(condition, FAST)
    assert np.median(centre) <= median
    assert np.abs(axes.mean(axis=0)).max() < 0.05


def test_lidded_pupils_are_found():
    for seed in list(SEEDS)[:3]:
        drawing = ideal.draw("lid", seed)
        found = extract(drawing.image).pupil
        assert iou(found.ellipse, _truth(drawing)) > 0.97
        assert found.goodness.gap > 0.1


def test_no_iris_lock_on_bare_globes():
    for seed in SEEDS:
        drawing = ideal.draw("remote", seed)
        found = extract(drawing.image, bit_depth=16).pupil
        # The study rigs' pupils of 13 px; an iris taken for one would overlap by less than a quarter.
        assert iou(found.ellipse, _truth(drawing)) > 0.97


def test_bright_pupil_is_the_negative_of_a_dark_one():
    drawing = ideal.draw("bright-pupil", SEEDS[0])
    found = extract(drawing.image, settings=ExtractionSettings(polarity="bright")).pupil
    assert np.hypot(*(found.ellipse.centre_px - _truth(drawing).centre_px)) < 0.05
    dark = extract(drawing.image, settings=ExtractionSettings(polarity="dark")).pupil
    undeclared = extract(drawing.image).pupil
    assert undeclared.bright
    assert iou(undeclared.ellipse, found.ellipse) > 0.999
    assert not dark.ok or iou(dark.ellipse, _truth(drawing)) < 0.9


def test_covariance_is_the_scatter():
    """Forty noises on one scene: the centre's Mahalanobis distances are chi-squared."""
    clean = ideal.draw("clean", SEEDS[0])
    truth = _truth(clean)
    rng = np.random.default_rng(5)
    distances, axes = [], []
    for _ in range(40):
        noisy = np.clip(np.rint(clean.image + rng.normal(0.0, 4.0, clean.image.shape)), 0, 255).astype(np.uint8)
        pupil = extract(noisy).pupil
        offset = pupil.ellipse.centre_px - truth.centre_px
        distances.append(offset @ np.linalg.solve(pupil.covariance[:2, :2], offset))
        axes.append((pupil.ellipse.semi_axes_px - truth.semi_axes_px) / np.sqrt(np.diag(pupil.covariance)[2:4]))
    # The mean of 40 chi-squared variables of 2 degrees is 2 +- 0.32; four standard errors.
    assert 0.8 < np.mean(distances) < 3.3
    assert 0.6 < np.std(axes) < 1.5
    assert np.all(np.linalg.eigvalsh(pupil.covariance) > 0.0)


def test_encodings_of_one_image_agree():
    """8, 10, 12 and 16 bits, floats of any scale and a stated gamma describe the same scene."""
    condition = ideal.Condition(noise=(2, 2), bit_depth=16, glints="none")
    drawing = ideal.draw(condition, SEEDS[1])
    full = drawing.image.astype(np.float64) / 65535.0
    truth = _truth(drawing)
    reference = extract(drawing.image).pupil.ellipse
    images: dict[str, tuple[np.ndarray, dict]] = {
        "8": (np.rint(full * 255).astype(np.uint8), {}),
        "10": (np.rint(full * 1023).astype(np.uint16), {"bit_depth": 10}),
        "12": (np.rint(full * 4095).astype(np.uint16), {"bit_depth": 12}),
        "float32": (full.astype(np.float32), {}),
        "radiance": (full * 37.5, {}),
        "gamma": (np.rint(255 * full ** (1 / 2.2)).astype(np.uint8), {"gamma": 2.2}),
    }
    for name, (image, options) in images.items():
        found = extract(image, **options).pupil.ellipse
        # Rounding to 8 bits moves the centre by the bound for 1/sqrt(12) DN, 0.002 px.
        assert np.hypot(*(found.centre_px - reference.centre_px)) < 0.008, name
        assert np.abs(found.semi_axes_px - truth.semi_axes_px).max() < 0.03, name
    encoded = extract(images["gamma"][0]).pupil.ellipse
    # Read as linear, an encoded image's half-level lies too far inside: about a fifth of a pixel.
    assert (truth.semi_axes_px - encoded.semi_axes_px).mean() > 0.1


def test_result_moves_and_turns_with_the_image():
    drawing = ideal.draw("noise2", SEEDS[2])
    base = extract(drawing.image)
    height, width = drawing.image.shape
    cut = extract(drawing.image[20:, 30:])
    np.testing.assert_allclose(cut.pupil.ellipse.shifted((30, 20)).centre_px, base.pupil.ellipse.centre_px, atol=2e-3)
    flipped = extract(drawing.image[::-1, ::-1])
    back = np.array([width - 1, height - 1]) - flipped.pupil.ellipse.centre_px
    np.testing.assert_allclose(back, base.pupil.ellipse.centre_px, atol=5e-3)
    turned = extract(np.rot90(drawing.image)).pupil.ellipse  # (x, y) -> (y, width - 1 - x)
    np.testing.assert_allclose(
        turned.centre_px, [base.pupil.ellipse.centre_px[1], width - 1 - base.pupil.ellipse.centre_px[0]], atol=5e-3
    )
    np.testing.assert_allclose(turned.semi_axes_px, base.pupil.ellipse.semi_axes_px, atol=5e-3)
    gap = (turned.angle_rad - base.pupil.ellipse.angle_rad + math.pi / 2) % math.pi
    assert min(gap, math.pi - gap) < 0.01


def test_same_image_same_answer():
    image = ideal.draw("noise8", SEEDS[0]).image
    first, second = extract(image), extract(image)
    assert first.pupil.ellipse == second.pupil.ellipse
    assert [g.xy_px.tolist() for g in first.glints] == [g.xy_px.tolist() for g in second.glints]


def test_an_arc_tells_little_across_it():
    """An ellipse through a third of an uneven outline: its covariance holds the truth, and a rounder one is closer."""
    rng = np.random.default_rng(5)
    seen = np.zeros(SECTORS, dtype=bool)
    seen[14:30] = True
    truth = Ellipse(np.array([80.0, 60.0]), np.array([30.0, 28.5]), 0.7)
    slopes = outline_slopes(truth)
    through_all = np.linalg.solve(slopes @ slopes.T, slopes)
    through_seen = np.linalg.solve((slopes * seen) @ slopes.T, slopes * seen)
    covariance = hidden_part(truth, seen, 1.0)
    distance, before, after = [], [], []
    for _ in range(400):
        displaced = np.repeat(rng.normal(0.0, HIDDEN_UNEVEN * np.sqrt(30.0 * 28.5), GROUPS), SECTORS // GROUPS)
        off = (through_seen - through_all) @ displaced
        distance.append(off @ np.linalg.lstsq(covariance, off, rcond=1e-9)[0])
        found = reshaped(truth, off)
        rounder, smaller = towards_round(found, covariance)
        before.append(iou(found, truth))
        after.append(iou(rounder, truth))
        assert np.trace(smaller) < np.trace(covariance)
    assert np.mean(distance) == pytest.approx(5.0, rel=0.1)  # chi^2 of five numbers
    assert np.mean(after) > np.mean(before) + 0.01
    nothing_hidden = hidden_part(truth, np.ones(SECTORS, dtype=bool), 1.0)
    assert np.abs(nothing_hidden).max() < 1e-12
    even = hidden_part(truth, seen, 0.01)  # a boundary that is smooth where it is seen
    assert np.trace(even) < 0.01 * np.trace(covariance)
    same, _ = towards_round(truth, np.eye(5) * 0.02**2)
    assert iou(same, truth) > 0.9999
